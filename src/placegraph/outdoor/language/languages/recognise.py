"""Language of each part of a text: by its script, and by the words that the languages' tables know."""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterator, Mapping
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import NamedTuple

from placegraph.core.cache import cached
from placegraph.outdoor.language.languages import Language, english, language, tables
from placegraph.outdoor.language.words import singular

VERSION = "1"
"""Of what is kept."""
UNKNOWN = ""
"""Code of a text of which no language is recognised; it is read as English."""
_SENTENCE = re.compile(
    r"(?:[^.!?。！？؟\n]|[.!?]+(?!\s|$|[^\x00-\x7f]))*(?:[.!?]+|[。！？؟]+|\n|$)", re.MULTILINE
)
_OTHER = re.compile(r"[\u0370-\u1fff\u3040-\uffdc]")
"""A letter of another script than Latin."""
_WORD = re.compile(r"[^\W\d_]+(?:['’][^\W\d_]+)*")
_SCRIPTS = {
    "Cyrillic": r"[\u0400-\u052f]",
    "Hebrew": r"[\u0590-\u05ff]",
    "Arabic": r"[\u0600-\u06ff]",
    "Kana": r"[\u3041-\u30ff]",
    "Han": r"[\u4e00-\u9fff]",
    "Hangul": r"[\uac00-\ud7af\u1100-\u11ff]",
    "Greek": r"[\u0370-\u03ff]",
    "Devanagari": r"[\u0900-\u097f]",
    "Thai": r"[\u0e00-\u0e7f]",
}
_SCRIPT = {name: re.compile(pattern) for name, pattern in _SCRIPTS.items()}
_GRAMMAR = re.compile(
    r"^\[(?!things|say|lists|forms|order|compass_short|\[)[^\n]*\n(.*?)(?=^\[|\Z)",
    re.MULTILINE | re.DOTALL,
)
_THINGS = re.compile(r"^\[things\]\n(.*?)(?=^\[|\Z)", re.MULTILINE | re.DOTALL)
_PHRASE = re.compile(r'"([^"\n]*)"')
_PLAIN = frozenset(
    "the are and with there from you near north south east street behind next between".split()  # noqa: SIM905
)
"""English words of which nearly every English sentence has one, and hardly another's."""
_LEAST = 0.2
"""Share of a sentence's words that a language must know ..."""
_THING = 0.5
"""How much a word for a thing tells of its language, where one of the grammar tells 1."""
_FEW = 0.75
"""... and how many words at least, each shared with those who know it as well."""
_ALIKE = 0.1
"""Languages whose scores differ by less are as likely as each other."""
_FOREIGN = 0.75
"""How much a word with letters that a language lacks speaks against it."""


class Stretch(NamedTuple):
    """A part of a text in one language."""

    start: int
    end: int
    language: Language
    certain: bool = True
    """False where no language was recognised."""


class _Signs(NamedTuple):
    words: dict[str, tuple[str, ...]]
    """Languages of a word."""
    scripts: dict[str, tuple[str, ...]]
    """Languages of a script."""
    things: dict[str, tuple[str, ...]]
    """Languages of a word for a thing."""
    letters: dict[str, frozenset[str]]
    """Letters of the words of a language."""

    def written(self, code: str) -> int:
        """Count the scripts that a language is written in."""
        return sum(code in codes for codes in self.scripts.values())


@cache
def _signs(folder: Path | None) -> _Signs:
    """Return words of all languages: found without parsing the tables, which takes longer, and kept."""
    texts = {code: table.read_text("utf-8") for code, table in tables(folder).items()}
    digest = sha256("\0".join((VERSION, *texts, *texts.values())).encode()).hexdigest()[:16]
    listed = cached(f"languages-{digest}.json", lambda: _list_signs(texts), json.loads)
    words, scripts, things, letters = (
        {word: tuple(codes) for word, codes in part.items()} for part in listed
    )
    return _Signs(words, scripts, things, {code: frozenset(own) for code, own in letters.items()})


def _list_signs(texts: Mapping[str, str]) -> bytes:
    """Return JSON of the languages of every word of the grammar, script, and word for a thing."""
    words: dict[str, set[str]] = {}
    scripts: dict[str, set[str]] = {}
    things: dict[str, set[str]] = {}
    letters: dict[str, set[str]] = {}
    for code, text in texts.items():
        head = text.partition("\n[")[0]
        listed = re.search(r"^scripts\s*=\s*\[(.*)\]", head, re.MULTILINE)
        for script in _PHRASE.findall(listed[1]) if listed else ():
            scripts.setdefault(script, set()).add(code)
        for pattern, found in ((_GRAMMAR, words), (_THINGS, things)):
            lines = [line for part in pattern.findall(text) for line in part.splitlines()]
            phrases = [p for line in lines for p in _PHRASE.findall(line.partition("=")[2])]
            for word in [word for phrase in phrases for word in phrase.lower().split()]:
                letters.setdefault(code, set()).update(word)
                found.setdefault(word.strip("'") if len(word) > 2 else word, set()).add(code)
    parts = (words, scripts, things, letters)
    return json.dumps([{key: sorted(of) for key, of in part.items()} for part in parts]).encode()


def find_stretches(
    text: str, code: str | None, folder: Path | None = None, things: Collection[str] = ()
) -> list[Stretch]:
    """Cut a text into parts of one language each.

    Parameters
    ----------
    text
        Cleaned (`scan.clean`).
    code
        The language, where it is known.
    folder
        A user's folder, whose ``languages`` are known too.
    things
        English words for things, whose table lists none.

    Raises
    ------
    OptionError
        If there is no language of that code; lists the codes.
    """
    if code is not None:
        return [Stretch(0, len(text), language(code, folder))]
    spans = [m.span() for m in _SENTENCE.finditer(text) if m.end() > m.start()]
    if not _OTHER.search(text) and all(_is_english(text[a:b]) for a, b in spans):
        return [Stretch(0, len(text), english())]
    signs = _signs(folder)
    whole = _best(_evidence(text, signs, things, folder), english=True)
    found: list[Stretch] = []
    for start, end in spans:
        evidence = _evidence(text[start:end], signs, things, folder)
        best = _best(evidence, english=False, likely=whole) or whole
        tongue = english() if best == UNKNOWN else language(best, folder)
        part = Stretch(start, end, tongue, best != UNKNOWN)
        if found and found[-1][2:] == part[2:]:
            found[-1] = found[-1]._replace(end=end)
        else:
            found.append(part)
    return found or [Stretch(0, len(text), english(), whole != UNKNOWN)]


def _is_english(sentence: str) -> bool:
    words = set(_WORD.findall(sentence))
    # in "vor einer Bank in der Wall Street" only a name is English
    spoken = {word for word in words if word.islower()} or {word.lower() for word in words}
    return not words or not _PLAIN.isdisjoint(spoken)


class _Evidence(NamedTuple):
    scores: dict[str, float]
    """How much speaks for each language."""
    words: int
    """Of how many words."""
    english: int
    """How many of them are English, whatever else they are."""


def _evidence(text: str, signs: _Signs, things: Collection[str], folder: Path | None) -> _Evidence:
    """Return how much the words of a text speak for each language."""
    scores: dict[str, float] = {}
    count = known = 0
    words = list(_words(text, signs))
    for word in words:
        script = next((name for name, has in _SCRIPT.items() if has.search(word)), "Latin")
        if script in ("Kana", "Han"):
            # no spaces: letters stand for words; Chinese signs without kana are Chinese
            count += max(1, len(word) // 2)
            codes = signs.scripts.get(script, ())
            few = min((signs.written(code) for code in codes), default=0)
            for code in (code for code in codes if signs.written(code) == few):
                scores[code] = scores.get(code, 0.0) + max(1, len(word) // 2)
            continue
        count += 1
        codes, weight = signs.words.get(word, ()), 1.0
        if not codes:
            codes, weight = signs.things.get(word, ()), _THING
            codes = (*codes, "en") if word in things or singular(word) in things else codes
        known += "en" in codes
        for code in codes:
            scores[code] = scores.get(code, 0.0) + weight / len(codes)
        own = () if script == "Latin" or codes else signs.scripts.get(script, ())
        own = tuple(code for code in own if signs.letters[code].issuperset(word)) or own
        for code in own:
            scores[code] = scores.get(code, 0.0) + 0.7 / len(own)
    odd = [word for word in words if not word.isascii()]
    for code in scores.keys() & signs.letters.keys() - {"en"}:
        scores[code] -= _FOREIGN * sum(not signs.letters[code].issuperset(word) for word in odd)
    _untie(scores, [word for word in words if word not in signs.words], folder)
    return _Evidence(scores, count, known)


def _words(text: str, signs: _Signs) -> Iterator[str]:
    """Yield words of a text in lower case; of an unknown one with an apostrophe both parts: "l'", "est"."""
    for found in _WORD.findall(text):
        word = found.lower().replace("’", "'")
        before, apostrophe, after = word.partition("'")
        if apostrophe and after and word not in signs.words:
            yield before + apostrophe
            yield after
        else:
            yield word


def _untie(scores: dict[str, float], words: list[str], folder: Path | None) -> None:
    """Let words of things, in any form, speak where those of the grammar say little or too much."""
    best = max(scores.values(), default=0.0)
    near, weight = (best, _THING) if best < _FEW else (_ALIKE, _ALIKE)
    tied = [code for code, score in scores.items() if score > best - near and code != "en"]
    for code in tied if len(tied) > 1 or best < _FEW else ():
        tongue = language(code, folder)
        scores[code] += weight * sum(tongue.has_thing(word) for word in words)


def _best(evidence: _Evidence, *, english: bool, likely: str = "") -> str:
    """Return the language for which most speaks; unknown where that is too little.

    `english`: whether one known English word is enough, as it always was. `likely`: which it is if
    several are as good.
    """
    scores, count, known = evidence
    if not scores:
        return UNKNOWN
    code = max(scores, key=lambda code: (scores[code], code == "en"))
    if likely in scores and scores[likely] > scores[code] - 0.5 * _ALIKE:
        code = likely
    if english and scores.get("en", 0.0) >= 0.5 and scores["en"] >= scores[code] - 0.5:
        return "en"
    enough = scores[code] >= max(_FEW, _LEAST * count) if count > 1 else scores[code] >= _FEW
    if enough:
        return code
    return "en" if english and 2 * known >= count else UNKNOWN
