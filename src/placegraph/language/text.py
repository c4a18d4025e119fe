"""Text as both wings read it: distances, sentences of words, and phrases of a language."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

from placegraph.errors import DescriptionError

_UNITS = {
    name: metres
    for names, metres in {
        "m meter meters metre metres": 1.0,
        "cm centimeter centimeters centimetre centimetres": 0.01,
        "km kilometer kilometers kilometre kilometres": 1000.0,
        "ft foot feet": 0.3048,
        "yd yds yard yards": 0.9144,
        "mi mile miles": 1609.344,
        "block blocks": 100.0,
        "pace paces step steps": 0.75,
        "door doors": 8.0,  # along a street of shops
        "walk walking distance min mins minute minutes": 80.0,  # a minute's walk
    }.items()
    for name in names.split()
}
"""Metres in a unit, by the last word of its name."""


class Measure(float):
    """A distance as said [m], a block being 100 m."""

    blocks: float = 0.0
    """Number of blocks, of a distance in blocks: a map may know how long these are."""
    unit: float = 1.0
    """Length of the unit [m]."""
    at_most: bool = False
    """Whether the distance is an upper bound: "within 50 m"."""

    def times(self, count: float) -> Self:
        """Return as many of the same unit: "9 blocks west, then 4 north"."""
        measure = type(self)(self.unit * count)
        measure.unit, measure.blocks = self.unit, count if self.blocks else 0.0
        return measure

    @classmethod
    def within(cls, metres: float, *, blocks: float = 0.0) -> Self:
        """Return a distance that is this or less, or that many blocks or less."""
        measure = cls(metres or blocks * _UNITS["block"])
        measure.blocks, measure.at_most = blocks, True
        return measure


_NUMBERS = {
    "one": 1.0, "two": 2.0, "three": 3.0, "four": 4.0, "five": 5.0, "six": 6.0, "seven": 7.0,
    "eight": 8.0, "nine": 9.0, "ten": 10.0, "eleven": 11.0, "twelve": 12.0, "thirteen": 13.0,
    "fourteen": 14.0, "fifteen": 15.0, "sixteen": 16.0, "twenty": 20.0,
    "thirty": 30.0, "fifty": 50.0, "hundred": 100.0,
    "couple": 2.0, "few": 3.0, "several": 3.0, "quarter": 0.25,
}  # fmt: skip
COUNTS = {word: int(n) for word, n in _NUMBERS.items() if n >= 1 and word != "hundred"}
"""Numbers of things by their words: "two", "several"."""

_NUMBER = r"""(?:
    \d+\s*(?:[-–]|to\b|or\b)\s*\d+ | \d+\s+1/2 | \d+(?:[.,]\d+)?\s*½? | ½
  | (?:one|two|three|four|five|six|seven|eight|nine|ten|eleven|twelve|thirteen|fourteen|fifteen
      |sixteen|twenty|thirty|fifty)(?:\s+(?:or|to)\s+(?:two|three|four|five|six))?(?:\s+hundred)?
  | (?:an?\s+)?(?:couple(?:\s+of)?|few|hundred|quarter(?:\s+of\s+an?)?) | several | an?(?:\s+single)?
)"""
_UNIT = r"""(?:
    m | met(?:er|re)s? | cm | centimet(?:er|re)s? | km | kilomet(?:er|re)s?
  | ft | feet | foot | yds? | yards? | miles? | mi
  | (?:city\s+|long\s+|short\s+|more\s+)?blocks? | paces?
  | (?:steps?|doors?)(?=\s+(?:of|from|away|down|up|along|further)\b)
  | min(?:ute)?s?(?=\s+(?:away|from|on\s+foot)\b) | min(?:ute)?s?['’]?[\s-]+walk(?:ing)?(?:\s+distance)?
)"""
_HALF = r"(?:\s*(?:&|\band\b)\s*(?:an?\s+|one\s+)?half)?"
# "a block" is a distance only before a direction: otherwise it is what stands between streets
_A_BLOCK = r"""(?:(?<!\ba\sblock)(?<!\bone\sblock)|(?=\s+(?:and\s+an?\s+half\s+)?
    (?:(?:to|on)\s+the\s+)?(?:just\s+|directly\s+|due\s+)?
    (?:(?:north|south|east|west)\w*|[nesw]{1,2}|away|from|past|after|before|up|down|further
       |beyond|walk|over|off)\b))"""
MEASURE = rf"""\b(?=[\d½acefhjlnoqrstw])(?:(?:about|around|roughly|approximately|some|within|almost
        |nearly|only|just|less\s+than|over|for)\s+)?
    (?: (?P<number>{_NUMBER})(?:[\s-]plus|\+)?{_HALF}(?:(?<=[\d½])\s*|[\s-]+){_UNIT}{_HALF}(?![\w']){_A_BLOCK}
      | (?:an?\s+)?half(?:\s+of)?(?:\s+an?)?\s+{_UNIT}(?![\w']))"""
"""Pattern of a distance (verbose, case ignored), with a group ``number``."""

_AT_MOST = ("within", "less than")
_NUMERAL = re.compile(r"\d+(?:[.,]\d+)?|[a-z]+")
_LAST_UNIT = re.compile(rf"\b(?:{'|'.join(_UNITS)})\b")
_LETTERS = re.compile(r"[a-z]+")


def parse_count(word: str, counts: Mapping[str, int] = COUNTS, largest: int = 10**6) -> int | None:
    """Return the number that a word or digits mean, at most `largest`; None for another word."""
    if word in counts or not word.isdecimal():
        return counts.get(word)
    return largest if len(word) > 300 else min(int(word), largest)  # int() reads 4,300 digits


def metres(text: str, number: str | None) -> Measure:
    """Return the length [m] of a distance matched by `MEASURE`, and of its group ``number``."""
    text = text.lower()
    unit = _LAST_UNIT.findall(re.sub(r"(?<=[\d½])(?=[a-z])", " ", text))[-1]
    half = 0.5 if re.search(r"half|½|1/2", text) else 0.0
    words = _NUMERAL.findall((number or "").lower().replace("1/2", ""))
    values = [
        _NUMBERS.get(w) or float(w.replace(",", "."))
        for w in words
        if w in _NUMBERS or w[0].isdigit()
    ]
    if len(values) == 2 and words[-1] == "hundred":
        values = [100.0 * values[0]]
    if not values:  # "a block", "half a mile"
        values = [0.0 if number is None else 1.0]
    count = sum(values) / len(values) + half
    measure = Measure(_UNITS[unit] * count)
    measure.blocks = count if unit.startswith("block") else 0.0
    measure.unit = _UNITS[unit]
    measure.at_most = text.startswith(_AT_MOST)
    return measure


LONGEST_TEXT = 20_000
"""Characters."""
_CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f\x80-\x84\x86-\x9f\ud800-\udfff]")


@dataclass(frozen=True, slots=True)
class IgnoredText:
    """A stretch of the text that was not used, and why."""

    text: str
    reason: str


def check_text(text: str, example: str = "A bakery is north of me.") -> None:
    """Refuse what is no readable text.

    `example`: what a description is like, for the message to somebody who gave none.

    Raises `DescriptionError`: if it is empty, longer than `LONGEST_TEXT`, or no text; says how to
    mend it.
    """
    if not isinstance(text, str):
        raise DescriptionError(
            f"The description is of type {type(text).__name__}, not text; pass a str."
        )
    if len(text) > LONGEST_TEXT:
        raise DescriptionError(
            f"The description has {len(text):,} characters, but at most {LONGEST_TEXT:,} "
            "are allowed; shorten it."
        )
    if not text.strip():
        raise DescriptionError(
            f'The description is empty; say what is around you, as in "{example}"'
        )
    control = _CONTROL.search(text)
    if control is not None:
        raise DescriptionError(
            f"The description contains the control character {control[0]!r} at position "
            f"{control.start()}; remove it, and check that the file is text."
        )


class Word(NamedTuple):
    """A word, a distance or a mark of a text."""

    kind: str
    """``word``, ``label`` (``amenity=bench``), ``site`` (a crossing), ``measure`` or ``comma``."""
    lower: str
    """Lower-case, apostrophes straight."""
    capital: bool
    """Whether it starts with a capital letter."""
    start: int
    end: int
    metres: float = 0.0
    """Length of a measure."""


_UNMEASURED = r"""
    (?P<label>[^\W\d]\w*=[\w*][\w:;-]* | [^\W_][^\s_]*_\S*[^\s.,;:!?])
  | (?P<word>[ns]\.\s?[ew]\b\.?|[^\W_]+(?:['’`´][^\W_]+)*|&)
  | (?P<stop>[.!?;…]+|\s[-–—]{1,2}\s|\n\s*\n|\n)
  | (?P<comma>[,:()\[\]–—/])
"""
_PLAIN, _SCAN = (
    re.compile(pattern, re.VERBOSE | re.IGNORECASE)
    for pattern in (_UNMEASURED, f"(?P<measure>{MEASURE}) | {_UNMEASURED}")
)
_OPENS = re.compile(
    r"\s*(?:$|\n|(?:It|The|There|This|That|You|Your|I|If|When|We|They|On|In|At|Go|Head|Meet|Cross"
    r"|An?|Across|To|My|From|Turn|Walk|Look|Next|Its|Theres|After|Before|Once|Then"
    r"|Keep|Continue|Follow|Pass|Take|Stop|Come|Get|And|But|So|Our)\b(?!\s+[A-Z])"
    r"|(?:It|I|There|You|Let|That|We|They)['’])"
)
"""Pattern of a new sentence, even after a word that is often abbreviated by a full stop."""


WRAPPED = 60
"""Characters of the shortest line that is wrapped, and ends no sentence."""
_MIXED = str.maketrans("أإآٱىیةک", "ااااييهك")
"""Letters of Arabic that people write for each other."""


def fold_case(word: str) -> str:
    """Return a word in lower case, with one apostrophe and one of the letters that Arabic mixes up."""
    word = word.lower()
    return word if word.isascii() else word.replace("’", "'").translate(_MIXED)


def scan_text(
    text: str,
    labels: Iterable[tuple[int, int]] = (),
    *,
    sites: Collection[tuple[int, int]] = (),
    shortened: Collection[str] = (),
    offset: int = 0,
) -> list[list[Word]]:
    """Cut a text into sentences of words, distances and marks.

    `labels`: (start, end) of stretches that are one label each, in order.
    `sites`: labels that name a crossing or a house.
    `shortened`: words that a full stop may shorten without ending the sentence: "St. Mary's".
    """
    sentences: list[list[Word]] = [[]]
    at = offset
    for start, end in (*labels, (len(text), len(text))):
        _scan_between(text, at, start, sentences, shortened)
        if end > start:
            label = text[start:end]
            kind = "site" if (start, end) in sites else "label"
            sentences[-1].append(Word(kind, label.lower(), label[0].isupper(), start, end))
        at = end
    return [sentence for sentence in sentences if sentence]


def _scan_between(
    text: str, start_at: int, stop: int, sentences: list[list[Word]], shortened: Collection[str]
) -> None:
    words = _LETTERS.findall(text[start_at:stop].casefold())
    pattern = _PLAIN if _UNITS.keys().isdisjoint(words) else _SCAN  # quicker without a unit
    for match in pattern.finditer(text, start_at, stop):
        kind, written = match.lastgroup or "", match.group()
        start, end = match.span()
        if kind == "stop":
            if _ends_sentence(text, end, written, sentences[-1], shortened):
                sentences.append([])
            continue
        length = metres(written, match["number"]) if kind == "measure" else 0.0
        lower = fold_case(written)
        if "." in lower and kind == "word":  # "S.W."
            lower = lower[0] + lower.rstrip(".")[-1]
        sentences[-1].append(Word(kind, lower, written[0].isupper(), start, end, length))


def _ends_sentence(
    text: str, end: int, mark: str, sentence: list[Word], shortened: Collection[str]
) -> bool:
    if mark == "\n":  # of a list; wrapped lines are longer
        return end - text.rfind("\n", 0, end - 1) < WRAPPED
    if mark != ".":
        return True
    if end < len(text) and not text[end].isspace() and text[end] not in "\"')”’":
        return False
    return not (sentence and sentence[-1].lower in shortened and not _OPENS.match(text, end))


class Terminal(NamedTuple):
    """Terminal of the grammar that a phrase stands for, and what it carries."""

    type: str
    value: Any = None


class Phrases:
    """Phrases by their first word, longest first.

    `known`: terminals of each phrase, by its words in lower case.
    """

    def __init__(self, phrases: Mapping[tuple[str, ...], tuple[Terminal, ...]]) -> None:
        first: dict[str, list[tuple[tuple[str, ...], tuple[Terminal, ...]]]] = {}
        for words in sorted(phrases, key=len, reverse=True):
            first.setdefault(words[0], []).append((words, phrases[words]))
        self.by_word = {word: tuple(entries) for word, entries in first.items()}
        self._known = phrases
        self._lengths = {
            word: sorted({len(words) for words, _ in entries}, reverse=True)
            for word, entries in first.items()
        }

    def longest(self, words: Sequence[str], start: int) -> tuple[int, tuple[Terminal, ...]] | None:
        """Return the number of words of the longest phrase that begins at `start`, and its terminals."""
        for n in self._lengths.get(words[start], ()):
            phrase = tuple(words[start : start + n])
            if phrase in self._known:
                return len(phrase), self._known[phrase]
        return None
