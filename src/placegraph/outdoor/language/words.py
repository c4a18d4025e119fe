"""Words: the normal form in which names and text meet, directions, labels."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple, Protocol

from placegraph.language import words
from placegraph.outdoor.language.description import Sense

if TYPE_CHECKING:
    from placegraph.outdoor.language.languages import Language


CARDINAL_SIGMA, DIAGONAL_SIGMA, SHARP_SIGMA, LOOSE_SIGMA = 0.5, 0.4, 0.25, 0.6
"""How loosely people mean "north", "north-east", "directly north", "mostly north" [rad]."""


class Direction(NamedTuple):
    """A direction of the compass, or of the body."""

    bearing: float
    """[rad], clockwise from north or, if `facing`, from where the speaker faces."""
    sigma: float = CARDINAL_SIGMA
    facing: bool = False
    certainty: float = 1.0


NORTH = Direction(0.0)


class Words(Protocol):
    """What the chunker needs of a vocabulary."""

    def senses(self, phrase: str) -> tuple[Sense, ...]:
        """Labels a phrase may stand for, likeliest first."""

    def longest_match(
        self, tokens: Sequence[str], start: int = 0
    ) -> tuple[int, tuple[Sense, ...]] | None:
        """Longest phrase that begins at `start`: number of words and senses.

        There are none for a word that is known and that no map draws.
        """

    def closest(self, phrase: str, *, cutoff: float) -> tuple[str, float] | None:
        """Most similar known phrase and its similarity in [0, 1]."""

    def unknown(self, phrase: str) -> str:
        """Say why a phrase has no senses."""


class NameFinder(Protocol):
    """The proper names of a map."""

    def longest_name(self, tokens: Sequence[str], start: int) -> int:
        """Count the words of the longest name that begins at `start`; 0 for none.

        Words are in the normal form of `tokens`.
        """

    def closest_name(self, phrase: str) -> tuple[str, float] | None:
        """Most similar name and its similarity in [0, 1], or None."""


_SPELLINGS = {
    other: one
    for one, others in {
        # "St" is a saint as often as a street: on both sides of a comparison it reads the same
        "st": "street saint str",
        "ave": "avenue av",
        "blvd": "boulevard boul bd bulvari bulvar",
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
        "center": "centre ctr cntr",
        "university": "univ uni",
        "company": "co",
        "brothers": "bros",
        "saints": "sts",
        "heights": "hts",
        "junction": "jct jctn",
        "international": "intl",
        "national": "natl",
        "hospital": "hosp",
        "apartments": "apts",
        "caddesi": "cad cd",
        "sokak": "sok sk sokagi",
        "улица": "ул",
        "вулиця": "вул",
        "проспект": "пр просп",
        "площадь": "пл площа",
        "north": "n",
        "south": "s",
        "east": "e",
        "west": "w",
        "theater": "theatre",
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
        "11th": "eleventh",
        "12th": "twelfth",
        "13th": "thirteenth",
        "14th": "fourteenth",
        "15th": "fifteenth",
        "16th": "sixteenth",
        "17th": "seventeenth",
        "18th": "eighteenth",
        "19th": "nineteenth",
        "20th": "twentieth",
    }.items()
    for other in others.split()
}
COMPASS = frozenset(
    ("north", "south", "east", "west", "northeast", "northwest", "southeast", "southwest")
)
"""Points of the compass, as `tokens` writes them: "East Street" is not "West Street"."""
ROADS = frozenset(
    ("st", "ave", "rd", "blvd", "ln", "dr", "hwy", "pl", "ter", "alley", "pkwy", "sokak", "caddesi")
)
"""What names of roads end with, as `tokens` writes it."""
# fmt: off
SMALL = frozenset((
    "the", "a", "an", "of", "and", "at", "in", "on", "for", "by", "de", "la", "le", "les", "du",
    "des", "d", "l", "del", "della", "di", "da", "do", "dos", "el", "los", "las", "y", "e", "der",
    "die", "das", "dem", "den", "von", "vom", "zu", "zum", "zur", "am", "im", "van", "het",
))
# fmt: on
"""Words of names that tell no two names apart."""
_ORDINAL = re.compile(r"(\d{1,9})(?:st|nd|rd|th|d)")
_NAME_WORD = re.compile(r"[^\W_]+(?:['’`´][^\W_]+)*|&")


def fold(word: str) -> str:
    """Normal form of one word of a name: "Theatre" -> "theater", "Café" -> "cafe", "N" -> "north"."""
    if word == "&":
        return "and"
    word = word.casefold()
    if not word.isalnum() or not word.isascii():
        parts = unicodedata.normalize("NFKD", words.spelt(word)).casefold()
        word = "".join([c for c in parts if c.isalnum()])
    if word[0:1].isdigit() and (number := _ORDINAL.fullmatch(word)):
        return ordinal(int(number[1]))  # "43th"
    if word.endswith("strasse") and len(word) > 7:
        return word[:-4]  # "Hauptstr."
    return _SPELLINGS.get(word, word)


def ordinal(number: int) -> str:
    """Write a number as streets are counted: "2nd", "11th", "43rd"."""
    tens, ones = divmod(number, 10)
    ending = {1: "st", 2: "nd", 3: "rd"}.get(ones, "th") if tens % 10 != 1 else "th"
    return f"{number}{ending}"


def tokens(text: str) -> list[str]:
    """Words of a name or a text in the normal form in which the two meet.

    Lower-case, without diacritics, apostrophes, punctuation and underscores, and with one
    spelling for what is often shortened: ``"Ripley's_Aquarium"`` -> ``["ripleys", "aquarium"]``,
    ``"E Carson Street"`` -> ``["east", "carson", "st"]``.
    """
    found = [word for written in _NAME_WORD.findall(text) if (word := fold(written))]
    for i, word in enumerate(found[1:]):
        if word in ("st", "ave") and len(found[i]) < 4 and found[i].isdecimal():
            found[i] = ordinal(int(found[i]))  # "East 40 Street"
    return found


def normalise(text: str) -> str:
    """Return the `tokens` of a text, joined by spaces."""
    return " ".join(tokens(text))


def scan(
    text: str, language: Language, labels: Iterable[tuple[int, int]] = (), begin: int = 0
) -> list[list[words.Word]]:
    """Cut a text from `begin` on into sentences (`language.words.scan`); "St. Mary's" ends none."""
    return words.scan(text, labels, shortened=language.lists["shortened"], begin=begin)


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


def shouting(sentence: list[words.Word]) -> bool:
    """Tell whether so many words have capitals that these say nothing."""
    spoken = [word for word in sentence if word.kind == "word"]
    return len(spoken) >= 6 and sum(word.capital for word in spoken) > 0.8 * len(spoken)


def labels(text: str, vocabulary: Words, names: NameFinder | None) -> Iterator[tuple[int, int]]:
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
