"""Words: the normal form in which names on a map and words of a text meet, and the scanner."""

from __future__ import annotations

import re
import unicodedata
from typing import TYPE_CHECKING, NamedTuple

from placegraph.outdoor.describe.lexicon import english
from placegraph.outdoor.describe.measures import MEASURE, metres

if TYPE_CHECKING:
    from collections.abc import Iterable

_SPELLINGS = {
    other: one
    for one, others in {
        # "St" is a saint as often as a street: on both sides of a comparison it reads the same
        "st": "street saint str",
        "ave": "avenue av",
        "blvd": "boulevard boul",
        "rd": "road",
        "dr": "drive doctor",
        "ln": "lane",
        "pl": "place",
        "sq": "square",
        "pkwy": "parkway",
        "hwy": "highway",
        "ter": "terrace",
        "mt": "mount",
        "ft": "fort",
        "bldg": "building",
        "north": "n",
        "south": "s",
        "east": "e",
        "west": "w",
        "theater": "theatre",
        "center": "centre",
        "and": "et und",
        "1st": "first",
        "2nd": "second",
        "3rd": "third",
        "4th": "fourth",
        "5th": "fifth",
        "6th": "sixth",
        "7th": "seventh",
        "8th": "eighth",
        "9th": "ninth",
        "10th": "tenth",
    }.items()
    for other in others.split()
}
_NAME_WORD = re.compile(r"[^\W_]+(?:['’`´][^\W_]+)*|&")


def fold(word: str) -> str:
    """Normal form of one word of a name: "Theatre" -> "theater", "Café" -> "cafe", "N" -> "north"."""
    if word == "&":
        return "and"
    word = word.casefold()
    if not word.isalnum() or not word.isascii():
        parts = unicodedata.normalize("NFKD", word).casefold()
        word = "".join([c for c in parts if c.isalnum()])
    return _SPELLINGS.get(word, word)


def tokens(text: str) -> list[str]:
    """Words of a name or a text in the normal form in which the two meet.

    Lower-case, without diacritics, apostrophes, punctuation and underscores, and with one
    spelling for what is often shortened: ``"Ripley's_Aquarium"`` -> ``["ripleys", "aquarium"]``,
    ``"E Carson Street"`` -> ``["east", "carson", "st"]``.
    """
    return [word for written in _NAME_WORD.findall(text) if (word := fold(written))]


def normalise(text: str) -> str:
    """Return the `tokens` of a text, joined by spaces."""
    return " ".join(tokens(text))


class Word(NamedTuple):
    """A word, a distance or a mark of a text."""

    kind: str
    """``word``, ``label`` (``amenity=bench``, ``bicycle_parking``), ``measure`` or ``comma``."""
    lower: str
    """Lower-case, apostrophes straight."""
    capital: bool
    """Whether it starts with a capital letter."""
    start: int
    end: int
    metres: float = 0.0
    """Of a measure."""


_SCAN = re.compile(
    rf"""
    (?P<measure>{MEASURE})
  | (?P<label>[^\W\d]\w*=[\w*][\w:;-]* | [^\W_][^\s_]*_\S*[^\s.,;:!?])
  | (?P<word>[^\W_]+(?:['’`´][^\W_]+)*|&)
  | (?P<comma>[,:()\[\]–—/]|\s--?\s)
  | (?P<stop>[.!?;…]+|\n\s*\n)
    """,
    re.VERBOSE | re.IGNORECASE,
)
_OPENS = re.compile(
    r"\s*(?:$|\n|(?:It|The|There|This|That|You|Your|I|If|When|We|They|On|In|At|Go|Head|Meet|Cross"
    r"|An?|Across|To|My|From|Turn|Walk|Look|Next|Its|Theres)\b(?!\s+[A-Z])"
    r"|(?:It|I|There|You|Let|That|We|They)['’])"
)
"""What opens a new sentence even after a word that a full stop may shorten."""


def scan(text: str, labels: Iterable[tuple[int, int]] = ()) -> list[list[Word]]:
    """Cut a text into sentences of words, distances and marks.

    Parameters
    ----------
    text
        The text.
    labels
        (start, end) of stretches that are one label each, in order.
    """
    sentences: list[list[Word]] = [[]]
    at = 0
    for start, end in (*labels, (len(text), len(text))):
        _scan_between(text, at, start, sentences)
        if end > start:
            label = text[start:end]
            sentences[-1].append(Word("label", label.lower(), label[0].isupper(), start, end))
        at = end
    return [sentence for sentence in sentences if sentence]


def _scan_between(text: str, begin: int, stop: int, sentences: list[list[Word]]) -> None:
    for match in _SCAN.finditer(text, begin, stop):
        kind, written = match.lastgroup or "", match.group()
        start, end = match.span()
        if kind == "stop":
            if _ends_sentence(text, end, written, sentences[-1]):
                sentences.append([])
            continue
        length = metres(written, match["number"]) if kind == "measure" else 0.0
        lower = written.lower().replace("’", "'")
        sentences[-1].append(Word(kind, lower, written[0].isupper(), start, end, length))


def _ends_sentence(text: str, end: int, mark: str, sentence: list[Word]) -> bool:
    if mark != ".":
        return True
    if end < len(text) and not text[end].isspace() and text[end] not in "\"')”’":
        return False
    return not (
        sentence
        and sentence[-1].lower in english().lists["shortened"]
        and not _OPENS.match(text, end)
    )
