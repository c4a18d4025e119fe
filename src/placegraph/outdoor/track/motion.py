"""Motion in texts: "I walked 200 m east", "went straight on for two minutes", "then I turned left".

A text is split into legs of motion and sentences about places between them. The destination of a leg
("to the church", "along the canal") becomes a sentence about the place that it leads to.
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
from placegraph.outdoor.language.words import read_words

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
MOTION = re.compile(
    rf"^{_LEAD}(?:(?P<who>{_SUBJECT})?(?:(?P<past>{_PAST})|(?P<now>{_PRESENT}))|(?P<going>{_GOING}))"
    rf"\b(?P<rest>.*)$",
    re.VERBOSE | re.IGNORECASE | re.DOTALL,
)
STAY = re.compile(
    rf"""^{_LEAD}{_SUBJECT}(?:stayed|stood\ still|waited|stopped|didn['’]t\ move|did\ not\ move
        |haven['’]t\ moved|not\ moved)\b""",
    re.VERBOSE | re.IGNORECASE,
)
ARRIVAL = re.compile(
    rf"^{_LEAD}{_SUBJECT}?(?P<how>reached|arrived\s+at|got\s+to|came\s+to|entered)\s+(?P<what>.+)$",
    re.VERBOSE | re.IGNORECASE | re.DOTALL,
)
QUANTITY = re.compile(rf"(?P<time>{DURATION})|(?P<length>{MEASURE})", re.VERBOSE | re.IGNORECASE)
AFTER = re.compile(
    r"^(?:and\s+|then\s+)*after\s+(?:walking|going|for|another|about|some|\s)*", re.IGNORECASE
)
STEPS = re.compile(r"(\d+|few|couple of|several|some)\s+steps\b", re.IGNORECASE)
SMALL_DISTANCE = re.compile(
    r"\b(?:a\s+(?:little\s+)?bit|a\s+little|slightly\s+further|not\s+far)\b", re.IGNORECASE
)
DEGREES = re.compile(r"\b(\d+(?:\.\d+)?)\s*(?:°|deg(?:ree)?s?\b)", re.IGNORECASE)
DESTINATION = re.compile(
    r"""\b(?P<how>along|down|up\s+to|up|onto|into|to|at|until|till)\s+
        (?P<what>(?:(?:the|a|an)\s+)?[^\W\d_][\w'’.-]*(?:\s+[\w'’.-]+?){0,4}?)
        (?=\s*$|\s+(?:for|along|down|to|towards?|in|at|until|till|past|from|about|around|by)\b
           |\s+\d|,)""",
    re.VERBOSE | re.IGNORECASE,
)
AHEAD = read_words("straight ahead on onward onwards forward forwards further farther")
BACK = read_words("back backward backwards around round")
CONJUNCTIONS = read_words("and then before until till where while but when")
FILLERS = re.compile(
    r"\b(?:an?|the|to|in|on|for|of|about|another|more|some|roughly|towards?|direction|further|and"
    r"|then|again|heading)\b"
)
PREPOSITIONS = dict.fromkeys(("along", "down", "up", "onto"), "on") | dict.fromkeys(
    ("into", "entered"), "in"
)
MOTION_STEMS = re.compile(
    r"\b(?:walk|went|gone|go|mov|r[au]n|jog|dr[io]v|cycl|bik|rode|head|contin|proceed|stroll|wander"
    r"|march|hik|travel|turn|carr|ke[ep]p?|kept|been|cross|step|stay|stood|wait|stop|reach|arriv|got"
    r"|came|enter|after)|\d|°",
    re.IGNORECASE,
)

STRAIGHT_SIGMA, TURN_SIGMA = 0.35, 0.4
"""Standard deviations of "straight on" and "left" [rad]."""


def write_digits(text: str) -> str:
    """Write the numbers of a text in digits: "two hundred and fifty" becomes "250"."""
    return _RUN.sub(lambda match: str(_parse_number(match.group())), text)


def _parse_number(written: str) -> int:
    total = group = 0
    for word in re.findall(r"[a-z]+", written.lower()):
        if word == "hundred":
            group = max(group, 1) * 100
        elif word == "thousand":
            total, group = total + max(group, 1) * 1000, 0
        else:
            group += _UNITS.get(word, 0) + _TENS.get(word, 0)
    return total + group


def parse_duration(written: str) -> float:
    """Parse a duration that matches `DURATION`; return seconds."""
    text = written.lower()
    words = re.findall(r"[a-z]+", text)
    unit = next(w for w in reversed(words) if w not in ("and", "a", "half"))
    numbers = [float(n.replace(",", ".")) for n in re.findall(r"\d+(?:[.,]\d+)?", text)]
    amount = next((_FEW[w] for w in words if w in _FEW), 0.0 if "half" in words else 1.0)
    if numbers:
        amount = sum(numbers) / len(numbers)
    if "half" in words:
        amount += 0.5
    if not numbers and re.search(r"and\s+a\s+half", text):
        amount = 1.5  # "an hour and a half"
    return amount * _SECONDS[unit[0]]


def parse_direction(words: str) -> tuple[float | None, float | None, float] | None:
    """Parse a direction; return bearing, turn and standard deviation [rad], or None."""
    if degrees := DEGREES.search(words):
        angle = radians(float(degrees[1]))
        side = re.search(r"\b(left|right)\b", words, re.IGNORECASE)
        if side is None:
            return angle % (2.0 * pi), None, 0.15
        return None, angle if side[1].lower() == "right" else -angle, 0.2
    tokens = re.findall(r"[^\W\d_]+", words)
    low = [w.lower() for w in tokens]
    for i in range(len(low)):
        if (found := _parse_direction_at(tokens, low, i)) is not None:
            return found
    if any(w in BACK for w in low):
        return None, pi, TURN_SIGMA
    if any(w in AHEAD for w in low):
        return None, 0.0, STRAIGHT_SIGMA
    return None


def _parse_direction_at(
    tokens: list[str], low: list[str], i: int
) -> tuple[float | None, float | None, float] | None:
    """Parse the direction that begins at word i, or return None."""
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


DISTANCE_ERROR = 0.25
"""Standard deviation of a stated distance, as a share of it; smaller for "exactly", larger for others."""
EXACT_ERROR, BLOCK_ERROR, TIME_ERROR = 0.08, 0.4, 0.35
DEFAULT_DISTANCE, DEFAULT_SPREAD = 100.0, 80.0
"""Mean and standard deviation of "I walked on" [m]."""
SHORT_DISTANCE = 25.0
"""Mean of "a bit" [m]."""
ROAD_WIDTH = 15.0
"""Mean width of a road or square that somebody crosses [m]."""
SPEEDS = {"ran": 2.5, "run": 2.5, "jogged": 2.5, "cycled": 4.5, "biked": 4.5, "cycle": 4.5,
         "rode": 4.5, "drove": 8.0, "driven": 8.0, "drive": 8.0}  # fmt: skip
WALKING_SPEED = 4.0 / 3.0
"""Speed on foot [m/s]: 80 m a minute, as in "a 2 minute walk"."""


@dataclass(frozen=True, slots=True)
class Leg:
    """One leg of motion, as far as the text tells it."""

    text: str
    distance: float
    """[m]; 0 for a turn."""
    spread: float
    """Standard deviation of the distance [m]."""
    bearing: float | None = None
    """[rad] clockwise from north."""
    turn: float | None = None
    """[rad] clockwise from the leg before; any direction where bearing and turn are None."""
    sigma: float = 0.5
    """Standard deviation of the direction [rad]."""


def split_legs(text: str) -> list[Leg | str]:
    """Split a text into legs and sentences about places, in order; one without motion stays as it is."""
    if not MOTION_STEMS.search(text):
        return [text]
    parts: list[Leg | str] = []
    for sentence in scan_english(text, english()):
        spans = list(_split_clauses(sentence))
        for part in _parse_sentence(text, spans):
            if isinstance(part, str) and parts and isinstance(parts[-1], str):
                parts[-1] = f"{parts[-1]} {part}"
            else:
                parts.append(part)
    if not any(isinstance(part, Leg) for part in parts):
        return [text]
    return _resolve_turns(parts)


def _resolve_turns(parts: list[Leg | str]) -> list[Leg | str]:
    """Make legs after a turn go straight on: "turned right and went 50 m", "turned around and went back"."""
    legs: list[Leg | str] = []
    turned: Leg | None = None
    for part in parts:
        leg = part
        if isinstance(part, Leg):
            if turned is not None and part.distance > 0.0:
                again = part.turn is not None and part.turn == turned.turn == pi
                if again or (part.turn is None and part.bearing is None):
                    leg = replace(part, turn=0.0, sigma=STRAIGHT_SIGMA)
            turned = part if part.distance == 0.0 and part.sigma > 0.0 else None
        legs.append(leg)
    return legs


def _split_clauses(sentence: list[Word]) -> Iterator[tuple[int, int]]:
    """Find start and end of each clause of a sentence, without conjunctions."""
    start = end = sentence[0].start
    is_open = False
    for k, word in enumerate(sentence):
        is_joint = word.kind == "comma" or word.lower in CONJUNCTIONS
        if word.lower == "and" and 0 < k < len(sentence) - 1:
            before, after = write_digits(sentence[k - 1].lower), write_digits(sentence[k + 1].lower)
            numbers = before[-1:].isdigit() and (after[:1].isdigit() or after == "a")
            is_joint = not (numbers or after == "half")
        if is_joint:
            if is_open:
                yield start, end
            is_open = False
            if word.lower in ("until", "till"):
                start, is_open = word.start, True
        elif not is_open:
            start, is_open = word.start, True
        end = word.end
    if is_open:
        yield start, end


def _parse_sentence(text: str, spans: list[tuple[int, int]]) -> Iterator[Leg | str]:
    """Parse the clauses of a sentence into legs and sentences about places."""
    is_under_way = False
    place: tuple[int, int] | None = None
    for a, b in spans:
        found, rest = _parse_clause(
            text[a:b], is_under_way=is_under_way, is_only_clause=len(spans) == 1
        )
        if not found:
            place = (a if place is None else place[0], b)
            continue
        if place is not None:
            yield f"{text[slice(*place)].strip()}."
            place = None
        is_under_way = True
        yield from found
        if rest:
            place = (b - len(rest), b)
    if place is not None:
        yield f"{text[slice(*place)].strip()}."


def _parse_clause(
    clause: str, *, is_under_way: bool, is_only_clause: bool
) -> tuple[list[Leg | str], str]:
    """Parse the motion in a clause; return legs, and the part that is about a place."""
    words = STEPS.sub(r"\1 paces", write_digits(clause))
    if match := STAY.match(words):
        return [Leg(clause, 0.0, 0.0, turn=0.0, sigma=0.0)], ""
    if match := AFTER.match(words):
        return _parse_after(clause, words, match.end())
    until = re.match(r"(?:until|till)\s+(.*)", words, re.IGNORECASE | re.DOTALL)
    if match := ARRIVAL.match(until[1] if until else words):
        at = PREPOSITIONS.get(match["how"].lower(), "at")
        sentence = f"I am {at} {match['what'].strip()}."
        leg = Leg(clause, DEFAULT_DISTANCE, DEFAULT_SPREAD)
        return [sentence] if is_under_way else [leg, sentence], ""
    if until:
        return [f"I am at {until[1].strip()}."] if is_under_way else [], ""
    if match := MOTION.match(words):
        return _parse_motion(clause, match), ""
    bare = _parse_bare_leg(clause, words) if is_under_way or is_only_clause else None
    return [] if bare is None else [bare], ""


def _parse_after(clause: str, words: str, start: int) -> tuple[list[Leg | str], str]:
    """Parse "after 100 m I see a bakery"."""
    quantity = QUANTITY.match(words, start)
    if quantity is None:
        return [], ""
    rest = words[quantity.end() :].strip(" ,")
    first = re.match(r"(?:\s*(?:to\s+the\s+)?[\w-]+)?", rest)
    heading = parse_direction(first[0] if first else "")
    if heading is not None and first is not None:
        rest = rest[first.end() :].strip(" ,")
    distance, spread = _parse_distance(words, quantity, WALKING_SPEED)
    bearing, turn, sigma = heading or (None, 0.0, STRAIGHT_SIGMA)
    return [Leg(clause, distance, spread, bearing, turn, sigma)], rest


def _parse_motion(clause: str, match: re.Match[str]) -> list[Leg | str]:
    """Parse a clause with a verb of motion; return nothing where it is not about motion."""
    verb = (match["past"] or match["now"] or match["going"]).lower()
    rest = match["rest"]
    quantity = QUANTITY.search(rest)
    cut = rest if quantity is None else rest[: quantity.start()] + " , " + rest[quantity.end() :]
    ends = [] if verb.startswith("cross") else list(_parse_destinations(cut))
    bare = DESTINATION.sub(" ", cut) if ends else cut
    if re.search(r"\byou", rest, re.IGNORECASE) or _is_position(cut):
        return []
    heading = parse_direction(bare)
    if match["going"] and quantity is None:
        return []  # tells which way the speaker faces
    if match["who"] is None and match["past"] is None and quantity is None and heading is None:
        return []
    bearing, turn, sigma = heading or (None, None, pi)
    if verb.startswith("turn"):
        leg = Leg(clause, 0.0, 0.0, bearing, turn, sigma)
        if quantity is not None:
            distance, spread = _parse_distance(rest, quantity, WALKING_SPEED)
            leg = replace(leg, distance=distance, spread=spread)
    elif verb.startswith("cross"):
        leg = Leg(clause, ROAD_WIDTH, 0.5 * ROAD_WIDTH, bearing, turn, sigma)
    else:
        onward = verb.startswith(("contin", "carr", "kep", "kee", "proc"))
        if heading is None and onward and not ends:
            turn, sigma = 0.0, STRAIGHT_SIGMA
        distance, spread = DEFAULT_DISTANCE, DEFAULT_SPREAD
        if quantity is not None:
            distance, spread = _parse_distance(rest, quantity, SPEEDS.get(verb, WALKING_SPEED))
        elif SMALL_DISTANCE.search(rest):
            distance, spread = SHORT_DISTANCE, 0.6 * SHORT_DISTANCE
        leg = Leg(clause, distance, spread, bearing, turn, sigma)
    return [leg, *ends]


def _parse_bare_leg(clause: str, words: str) -> Leg | None:
    """Parse "100 m north" after another leg, or as a whole text."""
    quantity = QUANTITY.search(words)
    if quantity is None:
        return None
    rest = words[: quantity.start()] + " " + words[quantity.end() :]
    heading = parse_direction(rest)
    left = re.findall(r"[^\W\d_]+", FILLERS.sub(" ", rest.lower()))
    if heading is None or len(left) > 2 or _is_position(rest):
        return None
    distance, spread = _parse_distance(words, quantity, WALKING_SPEED)
    return Leg(clause, distance, spread, *heading)


def _parse_distance(words: str, quantity: re.Match[str], speed: float) -> tuple[float, float]:
    """Parse a distance; return it and its standard deviation [m]."""
    written = quantity.group()
    before = words[max(0, quantity.start() - 12) : quantity.end()].lower()
    if quantity["time"]:
        distance, share = speed * parse_duration(written), TIME_ERROR
    else:
        distance = metres(written, quantity["number"])
        share = BLOCK_ERROR if "block" in written.lower() else DISTANCE_ERROR
        if re.search(r"exact|precise", before):
            share = EXACT_ERROR
    return distance, share * distance + 2.0


def _is_position(words: str) -> bool:
    """Whether a direction is that of an object ("north of the church"), and not that of motion."""
    return bool(
        re.search(r"\b(?:north|south|east|west|left|right)\w*\s+of\b", words, re.IGNORECASE)
    )


def _parse_destinations(words: str) -> Iterator[str]:
    """Make sentences about the place that a leg leads to."""
    for match in DESTINATION.finditer(words):
        what = match["what"].strip(" .")
        if parse_direction(what) is not None or re.match(
            r"(?:my|your|me|you)\b", what, re.IGNORECASE
        ):
            continue
        how = match["how"].lower()
        yield f"I am {PREPOSITIONS.get(how, 'at')} {what}."
