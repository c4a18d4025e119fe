"""The floor that somebody says to be on: "on the second floor", "im Erdgeschoss".

Floors are taken out of a sentence before it is read for the rest: no map draws them. In English the
second floor is OpenStreetMap's level 1 (American) or 2 (British), each as likely; "im zweiten Stock"
is level 2.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from placegraph.core.estimate import Evidence
from placegraph.io.osm.indoor_osm import levels_of

WRONG = 0.12
"""Share of floors said that are wrong, as of other statements."""
USUAL = 0.25
"""Share of people on any one floor."""
BELOW = (-1.0, -2.0, -3.0)
"""Levels of a basement."""
ABOVE = tuple(map(float, range(1, 200)))
"""Levels that may be the top floor of a house that has several."""
_UP = 0.4
"""Share of people on a top floor, among those above the ground: which level it is, no map says."""
_EN = (
    "first",
    "second",
    "third",
    "fourth",
    "fifth",
    "sixth",
    "seventh",
    "eighth",
    "ninth",
    "tenth",
)
_DE = (
    "erste",
    "zweite",
    "dritte",
    "vierte",
    "fünfte",
    "sechste",
    "siebte",
    "achte",
    "neunte",
    "zehnte",
)
_NUMBER = {w: i for words in (_EN, _DE) for i, w in enumerate(words, 1)}
_NOT = r"(?P<no>\b(?:not|nicht)\s+)?"
_FLOORS = (
    (
        "en", _NOT + r"\b(?:(?:on|at|in|from)\s+)?(?:(?:the|my|our)\s+)?(?:"
        rf"(?P<nth>{'|'.join(_EN)}|\d{{1,2}}(?:st|nd|rd|th))\s+(?:floor|storey|story|level)"
        r"|(?:floor|level)\s+(?P<n>\d{1,2})|(?P<zero>ground\s+(?:floor|level))|(?P<low>basement|cellar)"
        r"|(?P<up>(?:top|upper|uppermost)\s+(?:floor|storey|story|level)|attic))\b"
        r"(?P<of>\s+of\b)?",
    ),
    (
        "de", _NOT + r"\b(?:(?:im|in\s+der|in\s+dem|auf\s+der|in\s+meinem)\s+)?(?:"
        rf"(?P<nth>(?:{'|'.join(_DE)})[nrms]?|\d{{1,2}}\.)\s*(?:stockwerk|stock|etage|obergeschoss|geschoss|og)"
        r"|(?P<zero>erdgeschoss|parterre|eg)|(?P<low>keller|untergeschoss|ug)"
        r"|(?P<up>oberste[nrms]?\s+(?:stockwerk|stock|etage|geschoss)|dachgeschoss|obergeschoss|dg))\b"
        r"(?P<of>\s+(?:der|des|vom|von|in\s+der|im)\b)?",
    ),
)  # fmt: skip
_PATTERNS = {name: re.compile(pattern, re.IGNORECASE) for name, pattern in _FLOORS}
_ME = re.compile(
    r"\b(?:i|we)(?:['’]m|['’]re|\s+(?:am|are|was|stand|sit|live|work))\b|\b(?:ich|wir)\s+(?:bin|sind|steh|sitz|wohn)"
    r"|^\W*(?:in|on|at|im|auf|not|nicht|ground|basement|erdgeschoss|\d|the\s+\w+\s+floor|"
    rf"{'|'.join((*_EN, *_DE))})\b",
    re.IGNORECASE,
)
"""Of a sentence about the speaker, or one without a verb."""
_NOTHING = re.compile(r"\W*(?:(?:i|we|ich|wir)\b\W*\w*\W*)?", re.IGNORECASE)
"""What says no more of where one is: "I am"."""
_IN = {"der": "in der", "in der": "in der", "des": "im", "of": "in"}


@dataclass(frozen=True)
class Floor:
    """One floor that was said."""

    text: str
    levels: Mapping[float, float]
    """How likely each level was meant."""
    negated: bool = False

    def ratio(self, level: str, storeys: int = 0) -> float:
        """Log-likelihood ratio of being on a level, or on one of so many storeys above; 0: not known."""
        base = levels_of(level)
        if not base:
            return 0.0
        there = {low + n for low in base for n in range(storeys + 1)}
        meant = max(self.levels.get(at, 0.0) for at in there)
        odds = 1.0 - meant if self.negated else meant / USUAL
        return float(np.log((1.0 - WRONG) * odds + WRONG))

    def evidence(self, level: str, storeys: int = 0) -> Evidence:
        """What was said of the floor, of a level."""
        weight = self.ratio(level, storeys)
        verdict = "for" if weight > 0 else "against" if weight < 0 else "silent"
        note = (
            "" if weight > 0 else f"this is level {level}" if weight else "its level is not known"
        )
        return Evidence(self.text, verdict, weight, (), note)


def said_floors(text: str) -> tuple[tuple[Floor, ...], str]:
    """Floors that a speaker says to be on, and the text without them."""
    found: list[Floor] = []
    kept = []
    for sentence in re.split(r"(?<=\D[.!?;])\s+", text):
        rest = sentence
        if _ME.search(sentence):
            for language, pattern in _PATTERNS.items():
                floors = [_floor(m, language) for m in pattern.finditer(rest)]
                found += floors
                rest = pattern.sub(_without, rest) if floors else rest
            rest = "" if _NOTHING.fullmatch(rest) else rest
        kept.append(rest)
    if not found:
        return (), text
    left = re.sub(r"\s+([,.;!?])", r"\1", " ".join(kept))
    return tuple(found), re.sub(r"[,;]+\s*([.,;!?])", r"\1", " ".join(left.split())).strip(" ,;")


def ratio_of(floors: Sequence[Floor], level: str, storeys: int = 0) -> float:
    """Log-likelihood ratio of all floors said, of being on a level."""
    return sum(floor.ratio(level, storeys) for floor in floors)


def _floor(found: re.Match[str], language: str) -> Floor:
    said = found["nth"] or (found["n"] if language == "en" else None)
    levels: dict[float, float]
    if said is not None:
        digits = re.match(r"\d+", said)
        k = float(digits[0] if digits else _number(said.casefold()))
        levels = {k: 1.0} if language == "de" else {k: 0.5, k - 1.0: 0.5}
    elif found["zero"]:
        levels = {0.0: 1.0}
    elif found["up"]:
        levels = dict.fromkeys(ABOVE, _UP)
    else:
        levels = dict.fromkeys(BELOW, 1.0)
    return Floor(found[0].removesuffix(found["of"] or "").strip(), levels, bool(found["no"]))


def _number(word: str) -> int:
    """Of an ordinal, declined or not."""
    return next(n for stem, n in _NUMBER.items() if word.startswith(stem))


def _without(found: re.Match[str]) -> str:
    """What stays of the words of a floor: "on the second floor of the hotel" is in the hotel."""
    after = " ".join((found["of"] or "").casefold().split())
    return _IN.get(after, "im") if after else ""
