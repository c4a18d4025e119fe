"""Motion in words: "I walked 200 m east", "went straight on for two minutes", "then I turned left".

A text is cut into the legs that were walked, and into what is said of places between them. What a leg
says of its end ("to the church", "along the canal") becomes a sentence about the place that it leads to.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import pi, radians

from placegraph.language.text import MEASURE, Word, metres
from placegraph.outdoor.language.description import LOOSE_SIGMA, SHARP_SIGMA
from placegraph.outdoor.language.languages import english
from placegraph.outdoor.language.scan import scan_english

_UNITS = {
    "zero": 0, "one": 1, "two": 2, "three": 3, "four": 4, "five": 5, "six": 6, "seven": 7,
    "eight": 8, "nine": 9, "ten": 10, "eleven": 11, "twelve": 12, "thirteen": 13, "fourteen": 14,
    "fifteen": 15, "sixteen": 16, "seventeen": 17, "eighteen": 18, "nineteen": 19,
}  # fmt: skip
_TENS = {
    "twenty": 20, "thirty": 30, "forty": 40, "fifty": 50, "sixty": 60, "seventy": 70,
    "eighty": 80, "ninety": 90,
}  # fmt: skip
_POWERS = {"hundred": 100, "thousand": 1000}
_WORD = "|".join(sorted((*_UNITS, *_TENS, *_POWERS), key=len, reverse=True))
_RUN = re.compile(
    rf"\b(?:(?:a|an)\s+(?=hundred|thousand))?(?:{_WORD})(?:(?:[\s-]+(?:and\s+)?)(?:{_WORD}))*\b",
    re.IGNORECASE,
)

_AMOUNT = r"""(?:\d+(?:[.,]\d+)?(?:\s*(?:[-–]|to|or)\s*\d+)? | (?:a\s+)?(?:couple(?:\s+of)?|few)
    | several | half(?:\s+of)?\s+an? | (?:a\s+)?quarter\s+of\s+an? | an?)"""
DURATION = rf"""\b(?:(?:about|around|roughly|some|almost|nearly|another)\s+)?
    {_AMOUNT}(?:\s+and\s+a\s+half)?(?:(?<=\d)\s*|[\s-]+)
    (?:seconds?|secs?|min(?:ute)?s?|hours?|hrs?|h)(?:\s+and\s+a\s+half)?(?![\w'])(?!['’]?[\s-]+walk)"""
"""Pattern of a duration (verbose, case ignored)."""
_SECONDS = {"s": 1.0, "m": 60.0, "h": 3600.0}
_FEW = {"couple": 2.0, "few": 3.0, "several": 4.0, "quarter": 0.25}


_LEAD = r"""(?:(?:so|then|now|next|again|first|also|finally|later|afterwards|and|after\ that|well
    |from\ (?:there|here)|okay|ok|just|immediately|i\ think|at\ first)\b[\s,]*)*"""
_SUBJECT = r"""(?:(?:i|we)(?:['’](?:ve|d))?
    (?:\s+(?:have|had|then|just|now|also|only|first|slowly|must\ have|started\ to))*\s+)"""
_PAST = r"""walked|went|gone|moved|ran|jogged|drove|driven|cycled|biked|rode|headed|continued
    |proceeded|strolled|wandered|marched|hiked|travell?ed|turned|carried\ on|crossed|stepped
    |(?:kept|been)\ (?:on\ )?(?:walking|going|moving|heading|running|driving|cycling|straight)"""
_PRESENT = r"""walk|go|move|run|drive|cycle|head|continue|proceed|turn|carry\ on|cross
    |keep\ (?:on\ )?(?:walking|going|moving|heading|straight)"""
_GOING = r"(?:i['’]m|i\ am|we['’]re|we\ are)\s+(?:now\s+)?(?:walking|going|moving|heading|running)"
GO = re.compile(
    rf"^{_LEAD}(?:(?P<who>{_SUBJECT})?(?:(?P<past>{_PAST})|(?P<now>{_PRESENT}))|(?P<going>{_GOING}))"
    rf"\b(?P<rest>.*)$",
    re.VERBOSE | re.IGNORECASE | re.DOTALL,
)
STAY = re.compile(
    rf"""^{_LEAD}{_SUBJECT}(?:stayed|stood\ still|waited|stopped|didn['’]t\ move|did\ not\ move
        |haven['’]t\ moved|not\ moved)\b""",
    re.VERBOSE | re.IGNORECASE,
)
REACHED = re.compile(
    rf"^{_LEAD}{_SUBJECT}?(?P<how>reached|arrived\s+at|got\s+to|came\s+to|entered)\s+(?P<what>.+)$",
    re.VERBOSE | re.IGNORECASE | re.DOTALL,
)
QUANTITY = re.compile(rf"(?P<time>{DURATION})|(?P<length>{MEASURE})", re.VERBOSE | re.IGNORECASE)
AFTER = re.compile(
    r"^(?:and\s+|then\s+)*after\s+(?:walking|going|for|another|about|some|\s)*", re.IGNORECASE
)
STEPS = re.compile(r"(\d+|few|couple of|several|some)\s+steps\b", re.IGNORECASE)
SMALL = re.compile(
    r"\b(?:a\s+(?:little\s+)?bit|a\s+little|slightly\s+further|not\s+far)\b", re.IGNORECASE
)
DEGREES = re.compile(r"\b(\d+(?:\.\d+)?)\s*(?:°|deg(?:ree)?s?\b)", re.IGNORECASE)
ENDS = re.compile(
    r"""\b(?P<how>along|down|up\s+to|up|onto|into|to|at|until|till)\s+
        (?P<what>(?:(?:the|a|an)\s+)?[^\W\d_][\w'’.-]*(?:\s+[\w'’.-]+?){0,4}?)
        (?=\s*$|\s+(?:for|along|down|to|towards?|in|at|until|till|past|from|about|around|by)\b
           |\s+\d|,)""",
    re.VERBOSE | re.IGNORECASE,
)
AHEAD = (
    "straight",
    "ahead",
    "on",
    "onward",
    "onwards",
    "forward",
    "forwards",
    "further",
    "farther",
)
BACK = ("back", "backward", "backwards", "around", "round")
JOINTS = frozenset(("and", "then", "before", "until", "till", "where", "while", "but", "when"))
FILLERS = re.compile(
    r"\b(?:an?|the|to|in|on|for|of|about|another|more|some|roughly|towards?|direction|further|and"
    r"|then|again|heading)\b"
)
SAID = {"along": "on", "down": "on", "up": "on", "onto": "on", "into": "in", "entered": "in"}
STEMS = re.compile(
    r"\b(?:walk|went|gone|go|mov|r[au]n|jog|dr[io]v|cycl|bik|rode|head|contin|proceed|stroll|wander"
    r"|march|hik|travel|turn|carr|ke[ep]p?|kept|been|cross|step|stay|stood|wait|stop|reach|arriv|got"
    r"|came|enter|after)|\d|°",
    re.IGNORECASE,
)

STRAIGHT_SIGMA, TURN_SIGMA = 0.35, 0.4
"""How loosely "straight on" and "left" are meant [rad]."""


def in_digits(text: str) -> str:
    """Return a text with its numbers in digits: "two hundred and fifty" becomes "250"."""
    return _RUN.sub(lambda match: str(_number(match.group())), text)


def _number(written: str) -> int:
    total = group = 0
    for word in re.findall(r"[a-z]+", written.lower()):
        if word == "hundred":
            group = max(group, 1) * 100
        elif word == "thousand":
            total, group = total + max(group, 1) * 1000, 0
        else:
            group += _UNITS.get(word, 0) + _TENS.get(word, 0)
    return total + group


def seconds(written: str) -> float:
    """Seconds of a duration that `DURATION` matched."""
    text = written.lower()
    words = re.findall(r"[a-z]+", text)
    unit = next(w for w in reversed(words) if w not in ("and", "a", "half"))
    numbers = [float(n.replace(",", ".")) for n in re.findall(r"\d+(?:[.,]\d+)?", text)]
    amount = (
        sum(numbers) / len(numbers)
        if numbers
        else next((_FEW[w] for w in words if w in _FEW), 0.0 if "half" in words else 1.0)
    )
    if "half" in words:
        amount += 0.5
    if not numbers and re.search(r"and\s+a\s+half", text):
        amount = 1.5  # "an hour and a half"
    return amount * _SECONDS[unit[0]]


def direction(words: str) -> tuple[float | None, float | None, float] | None:
    """Bearing, turn and sigma [rad] that words tell, or None."""
    if degrees := DEGREES.search(words):
        angle = radians(float(degrees[1]))
        side = re.search(r"\b(left|right)\b", words, re.IGNORECASE)
        if side is None:
            return angle % (2.0 * pi), None, 0.15
        return None, angle if side[1].lower() == "right" else -angle, 0.2
    tokens = re.findall(r"[^\W\d_]+", words)
    low = [w.lower() for w in tokens]
    for i in range(len(low)):
        if (found := _one_direction(tokens, low, i)) is not None:
            return found
    if any(w in BACK for w in low):
        return None, pi, TURN_SIGMA
    if any(w in AHEAD for w in low):
        return None, 0.0, STRAIGHT_SIGMA
    return None


def _one_direction(
    tokens: list[str], low: list[str], i: int
) -> tuple[float | None, float | None, float] | None:
    """Read the direction that begins at word i, or None."""
    loose = any(w in ("slightly", "mostly", "roughly", "half", "bit") for w in low)
    if low[i] == "left" or (low[i] == "right" and low[i + 1 : i + 2] != ["along"]):
        side = pi / 2 if low[i] == "right" else -pi / 2
        return None, side * (0.5 if loose else 1.0), TURN_SIGMA
    phrase = english().longest(low, i)
    kind = phrase[1][0].type if phrase else ""
    if phrase is None or not (kind == "DIR" or (kind == "SHORT" and tokens[i].isupper())):
        return None
    direction = phrase[1][0].value
    if direction.facing:
        return None, direction.bearing, TURN_SIGMA
    sharp = any(w in ("due", "directly", "exactly") for w in low)
    sigma = SHARP_SIGMA if sharp else LOOSE_SIGMA if loose else direction.sigma
    return direction.bearing, None, sigma


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


def split_legs(text: str) -> list[Leg | str]:
    """Cut a text into legs and into texts about places, in the order in which they were told.

    A text without motion comes back as it is.
    """
    if not STEMS.search(text):
        return [text]
    parts: list[Leg | str] = []
    for sentence in scan_english(text, english()):
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
    """Read the motion in a clause; return legs, and the part that speaks of a place."""
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
