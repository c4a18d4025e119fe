"""Words: the normal form in which names on a map and words of a text meet, and the scanner."""

from __future__ import annotations

import re
import unicodedata
from typing import TYPE_CHECKING

from placegraph.language import words
from placegraph.outdoor.language.lexicon import english

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


def scan(text: str, labels: Iterable[tuple[int, int]] = ()) -> list[list[words.Word]]:
    """Cut a text into sentences (`text.words.scan`); "St. Mary's" ends none."""
    return words.scan(text, labels, shortened=english().lists["shortened"])
