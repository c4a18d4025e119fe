"""How people tell of a way: numbers and times in words, and the patterns of motion."""

from __future__ import annotations

import re
from math import pi, radians

from placegraph.language.measures import MEASURE
from placegraph.outdoor.language.description import LOOSE_SIGMA, SHARP_SIGMA
from placegraph.outdoor.language.languages import english

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
