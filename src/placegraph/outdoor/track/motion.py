"""Motion in words: "I walked 200 m east", "went straight on for two minutes", "then I turned left".

A text is cut into the ways that were gone and what is said of places between them. What a way says
of its end ("to the church", "along the canal") becomes a sentence about the place it leads to.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import pi

from placegraph.language.measures import metres
from placegraph.language.text import Word
from placegraph.outdoor.language.languages import english
from placegraph.outdoor.language.scan import scan
from placegraph.outdoor.track.phrases import (
    AFTER,
    ENDS,
    FILLERS,
    GO,
    JOINTS,
    QUANTITY,
    REACHED,
    SAID,
    SMALL,
    STAY,
    STEMS,
    STEPS,
    STRAIGHT_SIGMA,
    direction,
    in_digits,
    seconds,
)

LOOSE = 0.25
"""Deviation of a stated distance, as a share of it; "exactly" makes it less, blocks and times more."""
EXACT, BLOCKS, TIMED = 0.08, 0.4, 0.35
UNSAID, UNSAID_SPREAD = 100.0, 80.0
"""What "I walked on" may mean [m]."""
A_BIT = 25.0
"""What "a bit" may mean [m]."""
CROSSED = 15.0
"""Width of what one crosses [m]."""
SPEED = {"ran": 2.5, "run": 2.5, "jogged": 2.5, "cycled": 4.5, "biked": 4.5, "cycle": 4.5,
         "rode": 4.5, "drove": 8.0, "driven": 8.0, "drive": 8.0}  # fmt: skip
WALKING = 4.0 / 3.0
"""Speed on foot [m/s]: 80 m a minute, as in "a 2 minute walk"."""


@dataclass(frozen=True, slots=True)
class Leg:
    """A way that was gone, as far as it was told."""

    text: str
    distance: float
    """[m]; 0 of a turn."""
    spread: float
    """Standard deviation of the distance [m]."""
    bearing: float | None = None
    """[rad] clockwise from north."""
    turn: float | None = None
    """[rad] clockwise from the way before; where neither is known, it went in any direction."""
    sigma: float = 0.5
    """Standard deviation of the direction [rad]."""


def ways(text: str) -> list[Leg | str]:
    """Cut a text into legs and into texts about places, in the order in which they were told.

    A text without motion comes back as it is.
    """
    if not STEMS.search(text):
        return [text]
    parts: list[Leg | str] = []
    for sentence in scan(text, english()):
        spans = list(_clauses(sentence))
        for part in _of_sentence(text, spans):
            if isinstance(part, str) and parts and isinstance(parts[-1], str):
                parts[-1] = f"{parts[-1]} {part}"
            else:
                parts.append(part)
    if not any(isinstance(part, Leg) for part in parts):
        return [text]
    return _onward(parts)


def _onward(parts: list[Leg | str]) -> list[Leg | str]:
    """Go straight on after a turn: "turned right and went 50 m", "turned around and went back"."""
    told: list[Leg | str] = []
    turned: Leg | None = None
    for part in parts:
        leg = part
        if isinstance(part, Leg):
            if turned is not None and part.distance > 0.0:
                again = part.turn is not None and part.turn == turned.turn == pi
                if again or (part.turn is None and part.bearing is None):
                    leg = replace(part, turn=0.0, sigma=STRAIGHT_SIGMA)
            turned = part if part.distance == 0.0 and part.sigma > 0.0 else None
        told.append(leg)
    return told


def _clauses(sentence: list[Word]) -> Iterator[tuple[int, int]]:
    """Start and end of the clauses of a sentence of words, joints left out."""
    start = end = sentence[0].start
    open_ = False
    for k, word in enumerate(sentence):
        joint = word.kind == "comma" or word.lower in JOINTS
        if word.lower == "and" and 0 < k < len(sentence) - 1:
            before, after = in_digits(sentence[k - 1].lower), in_digits(sentence[k + 1].lower)
            numbers = before[-1:].isdigit() and (after[:1].isdigit() or after == "a")
            joint = not (numbers or after == "half")
        if joint:
            if open_:
                yield start, end
            open_ = False
            if word.lower in ("until", "till"):
                start, open_ = word.start, True
        elif not open_:
            start, open_ = word.start, True
        end = word.end
    if open_:
        yield start, end


def _of_sentence(text: str, spans: list[tuple[int, int]]) -> Iterator[Leg | str]:
    """Legs and statements of one sentence."""
    going = False
    said: tuple[int, int] | None = None
    for a, b in spans:
        found, rest = _leg(text[a:b], going=going, alone=len(spans) == 1)
        if not found:
            said = (a if said is None else said[0], b)
            continue
        if said is not None:
            yield _sentence(text[said[0] : said[1]])
            said = None
        going = True
        yield from found
        if rest:
            said = (b - len(rest), b)
    if said is not None:
        yield _sentence(text[said[0] : said[1]])


def _sentence(text: str) -> str:
    return f"{text.strip()}."


def _leg(clause: str, *, going: bool, alone: bool) -> tuple[list[Leg | str], str]:
    """What a clause says of motion, and what of it is left to be said of a place."""
    words = STEPS.sub(r"\1 paces", in_digits(clause))
    if match := STAY.match(words):
        return [Leg(clause, 0.0, 0.0, turn=0.0, sigma=0.0)], ""
    if match := AFTER.match(words):
        return _after(clause, words, match.end())
    until = re.match(r"(?:until|till)\s+(.*)", words, re.IGNORECASE | re.DOTALL)
    if match := REACHED.match(until[1] if until else words):
        at = SAID.get(match["how"].lower(), "at")
        said = f"I am {at} {match['what'].strip()}."
        unsaid = Leg(clause, UNSAID, UNSAID_SPREAD)
        return [said] if going else [unsaid, said], ""
    if until:
        return [f"I am at {until[1].strip()}."] if going else [], ""
    if match := GO.match(words):
        return _gone(clause, match), ""
    leg = _direct(clause, words) if going or alone else None
    return [] if leg is None else [leg], ""


def _after(clause: str, words: str, start: int) -> tuple[list[Leg | str], str]:
    """Read "after 100 m I see a bakery"."""
    quantity = QUANTITY.match(words, start)
    if quantity is None:
        return [], ""
    rest = words[quantity.end() :].strip(" ,")
    told = re.match(r"(?:\s*(?:to\s+the\s+)?[\w-]+)?", rest)
    heading = direction(told[0] if told else "")
    if heading is not None and told is not None:
        rest = rest[told.end() :].strip(" ,")
    distance, spread = _amount(words, quantity, WALKING)
    bearing, turn, sigma = heading or (None, 0.0, STRAIGHT_SIGMA)
    return [Leg(clause, distance, spread, bearing, turn, sigma)], rest


def _gone(clause: str, match: re.Match[str]) -> list[Leg | str]:
    """Read a clause with a verb of motion; empty where it says something else."""
    verb = (match["past"] or match["now"] or match["going"]).lower()
    rest = match["rest"]
    quantity = QUANTITY.search(rest)
    cut = rest if quantity is None else rest[: quantity.start()] + " , " + rest[quantity.end() :]
    ends = [] if verb.startswith("cross") else list(_ends(cut))
    bare = ENDS.sub(" ", cut) if ends else cut
    if re.search(r"\byou", rest, re.IGNORECASE) or _position(cut):
        return []
    heading = direction(bare)
    if match["going"] and quantity is None:
        return []  # says which way one faces
    if match["who"] is None and match["past"] is None and quantity is None and heading is None:
        return []
    bearing, turn, sigma = heading or (None, None, pi)
    if verb.startswith("turn"):
        leg = Leg(clause, 0.0, 0.0, bearing, turn, sigma)
        if quantity is not None:
            distance, spread = _amount(rest, quantity, WALKING)
            leg = replace(leg, distance=distance, spread=spread)
    elif verb.startswith("cross"):
        leg = Leg(clause, CROSSED, 0.5 * CROSSED, bearing, turn, sigma)
    else:
        onward = verb.startswith(("contin", "carr", "kep", "kee", "proc"))
        if heading is None and onward and not ends:
            turn, sigma = 0.0, STRAIGHT_SIGMA
        distance, spread = (
            _amount(rest, quantity, SPEED.get(verb, WALKING))
            if quantity is not None
            else (A_BIT, 0.6 * A_BIT)
            if SMALL.search(rest)
            else (UNSAID, UNSAID_SPREAD)
        )
        leg = Leg(clause, distance, spread, bearing, turn, sigma)
    return [leg, *ends]


def _direct(clause: str, words: str) -> Leg | None:
    """Read "100 m north" after a way, or as all that is said."""
    quantity = QUANTITY.search(words)
    if quantity is None:
        return None
    rest = words[: quantity.start()] + " " + words[quantity.end() :]
    heading = direction(rest)
    left = re.findall(r"[^\W\d_]+", FILLERS.sub(" ", rest.lower()))
    if heading is None or len(left) > 2 or _position(rest):
        return None
    distance, spread = _amount(words, quantity, WALKING)
    return Leg(clause, distance, spread, *heading)


def _amount(words: str, quantity: re.Match[str], speed: float) -> tuple[float, float]:
    """Distance and its deviation [m]."""
    written = quantity.group()
    before = words[max(0, quantity.start() - 12) : quantity.end()].lower()
    if quantity["time"]:
        distance, share = speed * seconds(written), TIMED
    else:
        distance = metres(written, quantity["number"])
        share = BLOCKS if "block" in written.lower() else LOOSE
        if re.search(r"exact|precise", before):
            share = EXACT
    return distance, share * distance + 2.0


def _position(words: str) -> bool:
    """Whether a direction says where something is ("north of the church"), not which way one went."""
    return bool(
        re.search(r"\b(?:north|south|east|west|left|right)\w*\s+of\b", words, re.IGNORECASE)
    )


def _ends(words: str) -> Iterator[str]:
    """Sentences about the place that a way leads to."""
    for match in ENDS.finditer(words):
        what = match["what"].strip(" .")
        if direction(what) is not None or re.match(r"(?:my|your|me|you)\b", what, re.IGNORECASE):
            continue
        how = match["how"].lower()
        yield f"I am {SAID.get(how, 'at')} {what}."
