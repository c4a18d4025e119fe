"""Scanners: a text is cut into stretches of one language, and those into words, distances and marks."""

from __future__ import annotations

import json
import re
import unicodedata
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from functools import cache
from hashlib import sha256
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from placegraph.core.cache import load_or_make
from placegraph.language.text import Word, fold_case, scan_text
from placegraph.outdoor.language.languages import Language, english, language, tables
from placegraph.outdoor.language.vocabulary import Vocabulary
from placegraph.outdoor.language.words import NameFinder, singular, spell_sounds, tokens

VERSION = "2"
"""Version of the cached data."""
NO_CODE = ""
"""Code of a text of which no language is recognised; it is read as English."""
_SENTENCE_SPAN = re.compile(
    r"(?:[^.!?。！？؟\n]|(?<=\b[A-Z])\.|[.!?]+(?!\s|$|[^\x00-\x7f]))*(?:[.!?]+|[。！？؟]+|\n|$)",
    re.MULTILINE,
)
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
_LEAST = 0.2
"""Share of a sentence's words that a language must know ..."""
_LONG = 4
"""Letters of a word in Latin script that may be a misspelt one of a language."""
_THING = 0.5
"""Evidence of a noun for its language, where a word of the grammar counts 1."""
_FEW = 0.75
"""... and how many words at least, each shared with those who know it as well."""
_ALIKE = 0.1
"""Languages whose scores differ by less are as likely as each other."""
_FOREIGN = 0.75
"""Evidence against a language of a word with letters that the language lacks."""


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
    nouns: dict[str, tuple[str, ...]]
    """Languages of a word for a thing."""
    letters: dict[str, frozenset[str]]
    """Letters of the words of a language."""
    sounds: dict[str, frozenset[str]]
    """Words of a language, of its grammar and for things, as they sound (`spell_sounds`)."""

    def count_scripts(self, code: str) -> int:
        """Count the scripts that a language is written in."""
        return sum(code in codes for codes in self.scripts.values())


@cache
def _signs(folder: Path | None) -> _Signs:
    """Return words of all languages: found without parsing the tables, which takes longer, and kept."""
    texts = {code: table.read_text("utf-8") for code, table in tables(folder).items()}
    digest = sha256("\0".join((VERSION, *texts, *texts.values())).encode()).hexdigest()[:16]
    listed = load_or_make(f"languages-{digest}.json", lambda: _list_signs(texts), json.loads)
    words, scripts, nouns, letters, sounds = (
        {word: tuple(codes) for word, codes in part.items()} for part in listed
    )
    own, heard = ({code: frozenset(of) for code, of in part.items()} for part in (letters, sounds))
    return _Signs(words, scripts, nouns, own, heard)


def _list_signs(texts: Mapping[str, str]) -> bytes:
    """Return JSON of the languages of every word of the grammar, script, and word for a thing."""
    words: dict[str, set[str]] = {}
    scripts: dict[str, set[str]] = {}
    things: dict[str, set[str]] = {}
    letters: dict[str, set[str]] = {}
    sounds: dict[str, set[str]] = {}
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
                sounds.setdefault(code, set()).add(spell_sounds(word, code))
                found.setdefault(word.strip("'") if len(word) > 2 else word, set()).add(code)
    parts = (words, scripts, things, letters, sounds)
    return json.dumps([{key: sorted(of) for key, of in part.items()} for part in parts]).encode()


def find_stretches(
    text: str, code: str | None, folder: Path | None = None, nouns: Collection[str] = ()
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
    text = _NO_SIGN.sub(lambda found: " " * len(found.group()), text)
    spans = [m.span() for m in _SENTENCE_SPAN.finditer(text) if m.end() > m.start()]
    signs = _signs(folder)
    whole = _best(_evidence(text, signs, nouns, folder), english=True)
    found: list[Stretch] = []
    for start, end in spans:
        evidence = _evidence(text[start:end], signs, nouns, folder)
        best = _best(evidence, english=False, likely=whole) or whole
        tongue = english() if best == NO_CODE else language(best, folder)
        part = Stretch(start, end, tongue, best != NO_CODE)
        if found and found[-1][2:] == part[2:]:
            found[-1] = found[-1]._replace(end=end)
        else:
            found.append(part)
    return found or [Stretch(0, len(text), english(), whole != NO_CODE)]


class _Evidence(NamedTuple):
    scores: dict[str, float]
    """Evidence for each language."""
    words: int
    """Number of words, without unknown ones with a capital."""
    english: int
    """Number of words that are English, even if they belong to other languages, too."""


def _evidence(text: str, signs: _Signs, nouns: Collection[str], folder: Path | None) -> _Evidence:
    """Return the evidence of a text's words for each language."""
    scores: dict[str, float] = {}
    count = known = named = 0
    names = {w.lower() for w in _WORD.findall(text) if w[0].isupper()}
    words = list(_split_words(text, signs))
    for word in words:
        patterns = {} if word.isascii() else _SCRIPT  # quicker
        script = next((name for name, has in patterns.items() if has.search(word)), "Latin")
        if script in ("Kana", "Han"):
            # no spaces: letters stand for words; Chinese signs without kana are Chinese
            count += max(1, len(word) // 2)
            codes = signs.scripts.get(script, ())
            few = min((signs.count_scripts(code) for code in codes), default=0)
            for code in (code for code in codes if signs.count_scripts(code) == few):
                scores[code] = scores.get(code, 0.0) + max(1, len(word) // 2)
            continue
        count += 1
        codes, weight = signs.words.get(word, ()), 1.0
        if not codes:
            codes, weight = signs.nouns.get(word, ()), _THING
            codes = (*codes, "en") if word in nouns or singular(word) in nouns else codes
        known += "en" in codes
        named += not codes and word in names
        for code in codes:
            scores[code] = scores.get(code, 0.0) + weight / len(codes)
        if script != "Latin":
            own, weight = () if codes else signs.scripts.get(script, ()), 0.7
        elif codes or (word.isascii() and (len(word) < _LONG or word in names)):
            own = ()
        else:  # misspelt, or without diacritics: "estoi serca de la farmasia"
            own = tuple(c for c in signs.sounds if spell_sounds(word, c) in signs.sounds[c])
            weight = 1.0 if own else 0.5
            own = own or (() if word.isascii() else tuple(signs.letters))
        own = tuple(code for code in own if signs.letters[code].issuperset(word)) or own
        for code in own:
            scores[code] = scores.get(code, 0.0) + weight / len(own)
    odd = [word for word in words if not word.isascii()]
    for code in scores.keys() & signs.letters.keys() - {"en"}:
        scores[code] -= _FOREIGN * sum(not signs.letters[code].issuperset(word) for word in odd)
    _untie(scores, [word for word in words if word not in signs.words], folder)
    return _Evidence(scores, max(1, count - named) if count else 0, known)


def _split_words(text: str, signs: _Signs) -> Iterator[str]:
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
        return NO_CODE
    code = max(scores, key=lambda code: (scores[code], code == "en"))
    if likely in scores and scores[likely] > scores[code] - 0.5 * _ALIKE:
        code = likely
    if english and scores.get("en", 0.0) >= 0.5 and scores["en"] >= scores[code] - 0.5:
        return "en"
    enough = scores[code] >= max(_FEW, _LEAST * count) if count > 1 else scores[code] >= _FEW
    if enough:
        return code
    return "en" if english and 2 * known >= count else NO_CODE


LONGEST = 12
"""Letters of the longest word that is cut out of a text without spaces."""
_UNKNOWN = 3.0
"""Price of a letter of no known word, of which a known word costs 1."""
_NO_SIGN = re.compile(r"\S+://\S+|(?<=\w )avenue\b(?! \w)", re.IGNORECASE)
"""Words that are of no language: ".com" is no Portuguese, "Park Avenue" no French."""
_STOPS = ".!?;…。！？｡؟؛।"
_COMMAS = r",:()\[\]–—/、，،：（）《》〈〉"
_QUOTED = re.compile(r"[「『“„«][^」』”“»\n]{1,60}[」』”“»]|(?<!\w)\"[^\"\n]{1,60}\"(?!\w)")
_TAG = r"[A-Za-z][A-Za-z0-9_]*=(?:\*|[A-Za-z0-9_][A-Za-z0-9_:;-]*) | [A-Za-z0-9]+_\S*[^\s.,;:!?]"
_KATAKANA = re.compile(r"[ァ-ヺー]+")


def clean(text: str) -> str:
    """Return a text without characters that only format it, in one form of every letter.

    Left out are marks of direction, joiners, soft hyphens and vowel points of Arabic and Hebrew;
    full- and half-width forms and digits of any script become the ordinary ones.
    """
    if text.isascii():
        return text
    letters = []
    for letter in unicodedata.normalize("NFC", text):
        kind = unicodedata.category(letter)
        if kind == "Cf" or "\u0591" <= letter <= "\u05c7" or "\u064b" <= letter <= "\u0652":
            continue
        if letter == "ـ":
            continue
        if kind == "Nd" and not letter.isascii():
            letters.append(str(unicodedata.digit(letter)))
        elif "\uff01" <= letter <= "\uffee" or letter == "\u3000":
            letters.append(unicodedata.normalize("NFKC", letter))
        else:
            letters.append("'" if letter == "ʼ" else letter)  # an apostrophe that is a letter
    return unicodedata.normalize("NFC", "".join(letters))


@cache
def _pattern(language: Language) -> re.Pattern[str]:
    measures = language.measures

    def either(words: object) -> str:
        spelt = sorted(words, key=len, reverse=True)  # type: ignore[call-overload]
        return "|".join(re.escape(word).replace(r"\ ", r"\s+") for word in spelt) or r"(?!)"

    number = rf"\d+(?:[.,]\d+)?(?:\s*[-–~〜]\s*\d+)?|(?:{either(measures.numbers)})"
    before = rf"(?:(?:{either(measures.before)})\s*)*"
    # words are told apart by spaces, if the language has any
    start, end = (r"(?<!\w)", r"(?!\w)") if language.spaces else ("", "")
    gap = r"[\s-]*" if not language.spaces else r"(?:(?<=\d)\s*|[\s-]+)"
    units = either(measures.units)
    # without spaces a distance may begin within a stretch of letters
    letter = r"[^\W_]" if language.spaces else rf"(?!{before}(?:{number}){gap}(?:{units}))[^\W_]"
    return re.compile(
        rf"""
        (?P<measure>{start}{before}(?P<number>{number}){gap}(?P<unit>{units}){end})
      | (?P<quoted>{_QUOTED.pattern})
      | (?P<label>{_TAG})
      | (?P<word>(?:{letter})+(?:['’`´״׳"][^\W_]+)*['’]?|&)
      | (?P<comma>[{_COMMAS}]|\s--?\s)
      | (?P<stop>[{_STOPS}]+|\n\s*\n)
        """,
        re.VERBOSE | re.IGNORECASE,
    )


def scan_any(
    text: str,
    language: Language,
    is_word: Callable[[str], bool],
    span: tuple[int, int],
    named: Mapping[int, int] = MappingProxyType({}),
    sites: Collection[tuple[int, int]] = (),
) -> list[list[Word]]:
    """Cut a stretch (start, end) of a text into sentences of words, distances and marks.

    `is_word` tells whether something is a word: of the grammar, of things, or of names. `named`
    holds the names of the map in the text: the end of each, by its start; `sites` are stretches
    (start, end) that name a crossing or a house.
    """
    named = {**named, **dict(sites)}
    sentences: list[list[Word]] = [[]]
    ends = 0
    for match in _pattern(language).finditer(text, *span):
        kind, written = match.lastgroup or "", match.group()
        if match.start() < ends:
            continue  # within a name
        opens = next((at for at in range(*match.span()) if at in named), None)
        if opens is not None:
            if opens > match.start():
                sentences[-1] += _words(
                    text[match.start() : opens], match.start(), language, is_word
                )
            ends = named[opens]
            name = text[opens:ends]
            kind = "site" if (opens, ends) in sites else "quoted"
            sentences[-1].append(Word(kind, name, True, opens, ends))
            continue
        kind = "measure" if match["measure"] else kind
        start, end = match.span()
        if kind == "stop":
            if not _shortened(text, end, written, sentences[-1], language):
                sentences.append([])
        elif kind == "word":
            sentences[-1] += _words(written, start, language, is_word)
        elif kind == "quoted":
            sentences[-1].append(Word("quoted", written[1:-1], True, start + 1, end - 1))
        else:
            lower = written.lower().replace("’", "'")
            length = (
                read_metres(match["number"], match["unit"], language) if kind == "measure" else 0.0
            )
            sentences[-1].append(Word(kind, lower, written[0].isupper(), start, end, length))
    return [sentence for sentence in sentences if sentence]


def read_metres(number: str, unit: str, language: Language) -> float:
    """Return the length [m] of a number and a unit."""
    measures = language.measures
    plain = " ".join(number.lower().split())
    value = measures.numbers.get(plain)
    if value is None:
        parts = [float(part.replace(",", ".")) for part in re.findall(r"\d+(?:[.,]\d+)?", number)]
        value = sum(parts) / len(parts)
    return value * measures.units[" ".join(unit.lower().split())]


def _shortened(text: str, end: int, mark: str, sentence: list[Word], language: Language) -> bool:
    """Tell whether a full stop shortens a word: "St. Marien"."""
    if mark != "." or not sentence:
        return False
    if end < len(text) and not text[end].isspace():
        return language.spaces
    last = sentence[-1].lower.lower().rpartition(" ")[2]  # of a name: "Cihangir Cad."
    return last in language.lists["shortened"] or (last.isdecimal() and len(last) < 3)


def _words(
    written: str, start: int, language: Language, is_word: Callable[[str], bool]
) -> list[Word]:
    """Return the words of a stretch of letters: cut where there are no spaces, and behind prefixes."""
    if not language.spaces and not written.isascii():
        parts = _cut(written, is_word)
    else:
        parts = _prefixed(written, language, is_word)
    found, at = [], start
    for part in parts:
        lower = fold_case(part)
        found.append(Word("word", lower, part[0].isupper(), at, at + len(part)))
        at += len(part)
    return found


def _prefixed(written: str, language: Language, is_word: Callable[[str], bool]) -> list[str]:
    """Cut off what is written onto a word: "l'église", "والكنيسة"."""
    lower = fold_case(written)
    for prefix in () if not language.prefixes or is_word(lower) else language.prefixes:
        rest = written[len(prefix) :]
        if len(rest) < 2 or not lower.startswith(prefix):
            continue
        if prefix.endswith("'") or is_word(fold_case(rest)):
            return [written[: len(prefix)], rest]
        inner = _prefixed(rest, language, is_word)
        if len(inner) > 1:
            return [written[: len(prefix)], *inner]
    return [written]


def _cut(written: str, is_known: Callable[[str], bool]) -> list[str]:
    """Cut letters without spaces into known words, as few as possible; the rest stays together."""
    lower = written.lower()
    n = len(lower)
    whole = {m.start(): m.end() for m in _KATAKANA.finditer(lower)}
    price = [0.0] + [float("inf")] * n
    came: list[tuple[int, bool]] = [(0, False)] * (n + 1)
    for i in range(n):
        ends = [i + 1, whole[i]] if i in whole else [i + 1]
        for j in {*range(i + 1, min(n, i + LONGEST) + 1), *ends}:
            is_word = not lower[i:j].isdecimal() and is_known(lower[i:j])
            if not is_word and j not in ends:
                continue
            cost = price[i] + (1.0 if is_word else _UNKNOWN if j == i + 1 else 2.0 * _UNKNOWN)
            if cost < price[j]:
                price[j], came[j] = cost, (i, is_word)
    cuts: list[tuple[int, int, bool]] = []
    at = n
    while at:
        before, is_word = came[at]
        if cuts and not is_word and not cuts[-1][2]:
            cuts[-1] = (before, cuts[-1][1], False)  # unknown letters are one unknown word
        else:
            cuts.append((before, at, is_word))
        at = before
    return [written[a:b] for a, b, _ in reversed(cuts)]


def scan_english(
    text: str,
    language: Language,
    labels: Iterable[tuple[int, int]] = (),
    sites: Collection[tuple[int, int]] = (),
    offset: int = 0,
) -> list[list[Word]]:
    """Cut a text from `offset` on into sentences (`scan_text`); "St. Mary's" ends none."""
    spans = sorted((*labels, *sites))
    return scan_text(text, spans, sites=sites, shortened=language.lists["shortened"], offset=offset)


_LABEL = r"(?:[^.!?\n]|[.!?](?!\s|$)){1,100}?"
_SENTENCE = re.compile(
    rf"(?:(?<=[.!?]\s)|^)The (?P<source>{_LABEL}) is on the"
    r" (?:north|south|east|west)(?:-?(?:east|west))? of the"
    rf" (?P<target>{_LABEL})[.!?]?(?=\s+The\s|\s*$)",
    re.MULTILINE,
)
_ENGLISH = re.compile(
    r"\b(?:is|are|on|in|at|near|next|by|with|that|which|from|across|between|me|you|my|your|I|the|a)\b"
)
"""Pattern of a stretch of text that is more than a label."""


def is_shouting(sentence: list[Word]) -> bool:
    """Tell whether so many words have capitals that these say nothing."""
    spoken = [word for word in sentence if word.kind == "word"]
    return len(spoken) >= 6 and sum(word.capital for word in spoken) > 0.8 * len(spoken)


def find_labels(
    text: str, vocabulary: Vocabulary, names: NameFinder | None
) -> Iterator[tuple[int, int]]:
    """Find the labels of sentences of the paper's form: (start, end) of each, in order."""
    for sentence in _SENTENCE.finditer(text):
        for end in ("source", "target"):
            if _is_label(sentence[end], vocabulary, names):
                yield sentence.span(end)


def _is_label(label: str, vocabulary: Vocabulary, names: NameFinder | None) -> bool:
    if "_" in label or "=" in label:
        return " " not in label
    words = tokens(label)
    if names is not None and words and names.longest_name(words, 0) == len(words):
        return True
    if _ENGLISH.search(label):
        return False
    return label[:1].isupper() or " of " in label or bool(vocabulary.senses(label))
