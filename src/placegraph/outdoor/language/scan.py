"""Scanners: an English text, or one of any language, becomes sentences of words, distances and marks."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable, Iterable, Iterator
from functools import cache

from placegraph.language.text import Word, fold_case, scan_text
from placegraph.outdoor.language.languages import Language
from placegraph.outdoor.language.words import NameFinder, Words, tokens

LONGEST = 12
"""Letters of the longest word that is cut out of a text without spaces."""
_UNKNOWN = 3.0
"""Price of a letter of no known word, of which a known word costs 1."""
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
    text: str, language: Language, known: Callable[[str], bool], span: tuple[int, int]
) -> list[list[Word]]:
    """Cut a stretch (start, end) of a text into sentences of words, distances and marks.

    `known` tells whether something is a word: of the grammar, of things, or of names.
    """
    sentences: list[list[Word]] = [[]]
    for match in _pattern(language).finditer(text, *span):
        kind, written = match.lastgroup or "", match.group()
        kind = "measure" if match["measure"] else kind
        start, end = match.span()
        if kind == "stop":
            if not _shortened(text, end, written, sentences[-1], language):
                sentences.append([])
        elif kind == "word":
            sentences[-1] += _words(written, start, language, known)
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
    return sentence[-1].lower in language.lists["shortened"] or (
        sentence[-1].lower.isdecimal() and len(sentence[-1].lower) < 3
    )


def _words(
    written: str, start: int, language: Language, known: Callable[[str], bool]
) -> list[Word]:
    """Return the words of a stretch of letters: cut where there are no spaces, and behind prefixes."""
    if not language.spaces and not written.isascii():
        parts = _cut(written, known)
    else:
        parts = _prefixed(written, language, known)
    found, at = [], start
    for part in parts:
        lower = fold_case(part)
        found.append(Word("word", lower, part[0].isupper(), at, at + len(part)))
        at += len(part)
    return found


def _prefixed(written: str, language: Language, known: Callable[[str], bool]) -> list[str]:
    """Cut off what is written onto a word: "l'église", "والكنيسة"."""
    lower = fold_case(written)
    for prefix in () if not language.prefixes or known(lower) else language.prefixes:
        rest = written[len(prefix) :]
        if len(rest) < 2 or not lower.startswith(prefix):
            continue
        if prefix.endswith("'") or known(fold_case(rest)):
            return [written[: len(prefix)], rest]
        inner = _prefixed(rest, language, known)
        if len(inner) > 1:
            return [written[: len(prefix)], *inner]
    return [written]


def _cut(written: str, known: Callable[[str], bool]) -> list[str]:
    """Cut letters without spaces into known words, as few as possible; the rest stays together."""
    lower = written.lower()
    n = len(lower)
    whole = {m.start(): m.end() for m in _KATAKANA.finditer(lower)}
    inside = {i for a, b in whole.items() for i in range(a + 1, b)}
    price = [0.0] + [float("inf")] * n
    came: list[tuple[int, bool]] = [(0, False)] * (n + 1)
    for i in range(n):
        if price[i] == float("inf"):
            continue
        ends = [i + 1, whole[i]] if i in whole else [i + 1]
        for j in {*range(i + 1, min(n, i + LONGEST) + 1), *ends}:
            if i in inside and came[i][1] is False:
                is_word = False  # part of an unknown word of katakana
            else:
                is_word = not lower[i:j].isdecimal() and known(lower[i:j])
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
    text: str, language: Language, labels: Iterable[tuple[int, int]] = (), begin: int = 0
) -> list[list[Word]]:
    """Cut a text from `begin` on into sentences (`scan_text`); "St. Mary's" ends none."""
    return scan_text(text, labels, shortened=language.lists["shortened"], begin=begin)


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
"""What makes a stretch of text more than a label."""


def is_shouting(sentence: list[Word]) -> bool:
    """Tell whether so many words have capitals that these say nothing."""
    spoken = [word for word in sentence if word.kind == "word"]
    return len(spoken) >= 6 and sum(word.capital for word in spoken) > 0.8 * len(spoken)


def find_labels(
    text: str, vocabulary: Words, names: NameFinder | None
) -> Iterator[tuple[int, int]]:
    """Find the labels of sentences of the paper's form: (start, end) of each, in order."""
    for sentence in _SENTENCE.finditer(text):
        for end in ("source", "target"):
            if _is_label(sentence[end], vocabulary, names):
                yield sentence.span(end)


def _is_label(label: str, vocabulary: Words, names: NameFinder | None) -> bool:
    if "_" in label or "=" in label:
        return " " not in label
    words = tokens(label)
    if names is not None and words and names.longest_name(words, 0) == len(words):
        return True
    if _ENGLISH.search(label):
        return False
    return label[:1].isupper() or " of " in label or bool(vocabulary.senses(label))
