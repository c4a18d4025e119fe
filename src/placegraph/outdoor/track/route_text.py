"""Instructions of a way, such as "Go to the second light and turn left".

A text becomes a list of steps in the order of the way: turns, junctions counted, landmarks, shares of
a block. The few words around each say how it belongs to the way.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import StrEnum

from placegraph.language.text import MEASURE, metres
from placegraph.outdoor.language.description import Sense
from placegraph.outdoor.language.words import read_words
from placegraph.outdoor.map.city import City


class Move(StrEnum):
    """Kind of a step."""

    TURN = "turn"
    """Turn at the junction ahead."""
    PASS = "pass"  # noqa: S105  # no password
    """Go past junctions."""
    REACH = "reach"
    """Go to a junction."""
    WALK = "walk"
    """Go some metres."""
    MARK = "mark"
    """Be where a landmark is."""
    SHARE = "share"
    """End at a share of the block: 0 is its beginning and 1 its end."""


@dataclass(frozen=True, slots=True)
class Step:
    """Step of a way: an observation of the path."""

    move: Move
    start: int
    end: int
    """Span in the text."""
    amount: float = 1.0
    """Angle of a turn [deg, clockwise], number of junctions, metres of a walk, or share of a block."""
    unit: str = ""
    """What is counted: "light", "block" or "junction"."""
    is_ordinal: bool = False
    """Whether the count begins at the last turn: "the third light"."""
    is_end: bool = False
    """Whether the street ends there."""
    names: tuple[tuple[int, float], ...] = ()
    """Rows of the map's names that a landmark may bear, with weights; or ..."""
    kinds: tuple[Sense, ...] = ()
    """... what kind it is."""
    where: str = ""
    """How the way lies to a landmark: "past", "before", "after" or at it; or to a junction: "before"."""
    side: float = 0.0
    """Side of the way on which a landmark is: -1 left, 1 right, 0 untold."""


_ORDINALS = "first 1st,second 2nd,third 3rd,fourth 4th,fifth 5th,sixth 6th,seventh 7th"
_COUNTS = "one 1,two 2 both couple,three 3 few,four 4,five 5,six 6,seven 7,eight 8"
ORDINALS, COUNTS = (
    {word: n for n, words in enumerate(table.split(","), 1) for word in words.split()}
    for table in (_ORDINALS, _COUNTS)
)
NEW = read_words("next following another more last other final upcoming available")
_MODIFIER = "|".join((
    *ORDINALS, *COUNTS, *NEW, "the", "your", "an?", "of", "sets?", "traffic", "very", "same",
    "immediate", "cross", "side", "small", "big", "quick", "sharp", "slight", "only", "these", "this",
    "that", r"end\s+of", r"middle\s+of", r"cent(?:er|re)\s+of",
))  # fmt: skip
_MODIFIERS = rf"(?:(?:{_MODIFIER})\s+)*"
TURN = re.compile(
    rf"""\b(?P<verb>turn(?:ing)?|make|making|take|taking|hang|bear|veer|keep|stay|go|head|then|and|another)
    \s+(?P<mods>(?:to\s+(?:the|your)\s+)?{_MODIFIERS})
    (?:(?:street|road|turn(?:ing)?|exit)\s+(?:on|to)\s+(?:the|your)\s+)?(?P<side>left|right|around)
    (?!\s+(?:corners?|side|near|far)\b)""",
    re.VERBOSE | re.IGNORECASE,
)
JUNCTION = re.compile(
    rf"""(?:\b(?P<how>through|past|pass(?:ing|ed)?|cross(?:ing)?|over|after|to|at|until|till|reach(?:ing)?
    |before|in|by|down|up|along|for|on|approach|go|going)\s+)?\b(?P<mods>{_MODIFIERS})
    (?P<unit>(?:stop\s*)?lights?|signals?|intersections?|corners?|junctions?|crossings?|cross(?:walks?|roads)
    |(?:t[- ])(?:intersection|junction)|blocks?|(?<=\bcross\s)(?:the\s)?(?:street|road)
    |(?<=(?:side|ross)\s)streets?|(?<=end\sof\sthe\s)(?:street|road))\b""",
    re.VERBOSE | re.IGNORECASE,
)
SHARE = re.compile(
    r"""\b(?:(?P<s50>half|halfway|1/2|midway|middle\s+of\s+the\s+block)|(?P<s33>1/3|a\s+third)
    |(?P<s67>2/3|two\s+thirds)|(?P<s25>1/4|(?:a\s+)?quarter)|(?P<s75>3/4|three[ -]quarters)
    |(?P<s85>(?:almost|nearly)\s+all)|(?P<s0>immediately|shortly|right\s+away|(?:few|couple(?:\s+of)?|one|1|two|2)
    \s+(?:small\s+)?(?:steps?|feet|paces)(?!\s+(?:before|from))))\b""",
    re.VERBOSE | re.IGNORECASE,
)
NAME = re.compile(
    r"(?:[A-Z]|\d+[a-zA-Z])[\w'’.&-]*(?:\s+(?:(?:of|the|&|de)\s+)?(?:[A-Z]|\d)[\w'’.&-]*)*(?<!\.)"
)
WORD = re.compile(r"[^\W_]+(?:['’&-][^\W_]+)*")
SENTENCE = re.compile(r"(?:[^.;!?]|\b(?:[A-Z]|St|Dr|Mrs?|Ms|Jr)\.(?=\s)|\.(?=\w))+")
WHERE = re.compile(
    r"\b(pass(?:ing|ed|es)?|past|cross(?:ing)?|before|after|onto|at|in front of|next to|by|near|outside"
    r"|between|with|see|to)\b",
    re.IGNORECASE,
)
SIDE = re.compile(
    r"(?:_|[^\W_]|[ &'’-]){0,40}?\b(?:on|to|at)\s+(?:the|your)\s+(?:(?:far|near)\s+)?(?P<side>left|right)\b",
    re.IGNORECASE,
)
TOO_FAR = re.compile(r"too\s+far|do\s+not\s+go|don['’]t\s+go", re.IGNORECASE)
ALMOST = re.compile(r"\b(?:almost|nearly|before|short of)\b[^,]*$", re.IGNORECASE)
GOING = re.compile(
    r"\b(?:go|going|continue|walk|head|proceed|pass|passing|past|stop|stopping|follow|after|and|then)\b",
    re.IGNORECASE,
)
VERBS = read_words("""head go pass stop turn continue walk make take keep follow start begin cross once when
    at the there you in on after before if your and destination then exit travel move proceed to a with
    this that it as do just stay step come from halfway past look""")
BLIND = read_words("""block street building store restaurant way road side step place door hand middle end
    half stop area front set shop avenue traffic entrance walk left right path first second""")


def read_route(text: str, city: City) -> list[Step]:
    """Read the steps of a way from a text; empty where it gives no instructions of one."""
    steps: list[Step] = []
    for sentence in SENTENCE.finditer(text):
        if not TOO_FAR.search(sentence.group()):
            steps += _order(text, _read_sentence(text, *sentence.span(), city))
    return steps


def _read_sentence(text: str, first: int, last: int, city: City) -> list[Step]:
    """Read the steps of the sentence at a span of a text, in the order of its words."""
    blank = text[:last]  # with all that was read replaced by underscores
    steps: list[Step] = []

    def add(step: Step | None) -> None:
        nonlocal blank
        if step is not None:
            steps.append(step)
            blank = blank[: step.start] + "_" * (step.end - step.start) + blank[step.end :]

    for match in TURN.finditer(blank, first):
        add(_read_turn(match))
    for match in list(NAME.finditer(blank, first)):
        add(_read_name(match, city))
    for match in re.compile(MEASURE, re.VERBOSE | re.IGNORECASE).finditer(blank, first):
        if not re.search(r"block|step|pace|door|walk|min", match.group(), re.IGNORECASE):
            add(Step(Move.WALK, *match.span(), amount=metres(match.group(), match["number"])))
    for match in SHARE.finditer(blank, first):
        add(Step(Move.SHARE, *match.span(), amount=float((match.lastgroup or "s0")[1:]) / 100.0))
    for match in JUNCTION.finditer(blank, first):
        add(_read_junction(match, text[first : match.start()]))
    steps += _find_kinds(blank, first, city)
    steps.sort(key=lambda step: step.start)
    return [_place(text, first, s) if s.move is Move.MARK else s for s in steps]


def _find_kinds(blank: str, first: int, city: City) -> Iterator[Step]:
    """Find landmarks by their kind; "bank" in "Chase bank" is none."""
    words = list(WORD.finditer(blank, first))
    low = [word.group().lower() for word in words]
    i = 0
    while i < len(words):
        known = city.vocabulary.longest_match(low, i) if low[i] not in BLIND | VERBS else None
        n, senses = known or (1, ())
        start, end = words[i].start(), words[i + n - 1].end()
        if senses and "_" not in blank[start:end]:
            yield Step(Move.MARK, start, end, kinds=senses)
        i += n


def _read_turn(match: re.Match[str]) -> Step | None:
    mods = match["mods"].lower().split()
    verb, side = match["verb"].lower(), match["side"].lower()
    ends = verb in ("go", "head") and re.match(r"\s*(?:at|on|$|[.,])", match.string[match.end() :])
    if not mods and verb in ("then", "and", "go", "head") and not ends:  # "go right past the bank"
        return None
    slight = verb in ("bear", "veer", "keep", "stay") or "slight" in mods
    angle = 180.0 if side == "around" else 40.0 if slight else 90.0
    order = next(
        (ORDINALS[word] for word in mods if word in ORDINALS), int(not NEW.isdisjoint(mods))
    )
    return Step(
        Move.TURN, *match.span(), amount=-angle if side == "left" else angle, unit=f"{order or ''}"
    )


def _read_name(match: re.Match[str], city: City) -> Step | None:
    words = list(WORD.finditer(match.group()))
    while words and words[0].group().lower() in VERBS:
        words = words[1:]
    begin = match.start() + words[0].start() if words else 0
    low = [word.group().lower() for word in words]
    while words and not (len(words) == 1 and low[0] in VERBS | BLIND | ORDINALS.keys()):
        end = match.start() + words[-1].end()
        if rows := city.name_index.find_rows(match.string[begin:end]):
            return Step(Move.MARK, begin, end, names=tuple(rows.items()))
        words = words[:-1]
    return None


def _read_junction(match: re.Match[str], before: str) -> Step | None:
    how, unit = (match["how"] or "").lower(), match["unit"].lower()
    mods = match["mods"].lower().split()
    order = next((ORDINALS[word] for word in mods if word in ORDINALS), 0)
    count = next((COUNTS[word] for word in mods if word in COUNTS), 0)
    names = {"light": "light", "signal": "light", "block": "block"}
    kind = next((names[word] for word in names if word in unit), "junction")
    if unit.startswith("corner") and how in ("", "on"):
        return None
    if kind == "block" and not (count or order or "end" in mods):
        return None
    passes = how.startswith(("through", "past", "pass", "cross", "over", "after"))
    move = Move.PASS if passes and kind != "block" else Move.REACH
    inside = how == "in" or not {"middle", "center", "centre"}.isdisjoint(mods)
    if inside and not (order or count or not NEW.isdisjoint(mods)):
        return None
    short = how == "before" or (move is Move.REACH and ALMOST.search(before[-40:]))
    return Step(
        Move.REACH if short else move, *match.span(),
        amount=float(count or order or 1), unit=kind, is_ordinal=bool(order and not count),
        is_end=unit.startswith(("t-", "t ")) or ("end" in mods and kind != "block"),
        where="before" if short else "",
    )  # fmt: skip


def _place(text: str, first: int, step: Step) -> Step:
    """Add to a landmark how the way lies to it, by the words before it."""
    lead = WHERE.findall(" ".join(text[first : step.start].split()[-5:]))
    word = lead[-1].lower() if lead else ""
    where = (
        "past" if word.startswith(("pas", "cross")) else word if word in ("before", "after") else ""
    )
    beside = SIDE.match(text, step.end)
    side = {"l": -1.0, "r": 1.0}[beside["side"][0].lower()] if beside else 0.0
    return replace(step, where=where, side=side)


def _order(text: str, steps: list[Step]) -> Iterator[Step]:
    """Put what says where to turn before the turn: "turn left at the second light"."""
    i = 0
    while i < len(steps):
        step, i = steps[i], i + 1
        if step.move is not Move.TURN:
            yield step
            continue
        edge, counted = step.end, False
        while i < len(steps) and steps[i].move in (Move.REACH, Move.MARK):
            is_mark = steps[i].move is Move.MARK
            gap = text[edge : steps[i].start if is_mark else steps[i].end]
            if GOING.search(gap) or steps[i].where == "past":
                break
            yield steps[i]
            edge, counted, i = steps[i].end, counted or steps[i].move is Move.REACH, i + 1
        if step.unit and not counted:
            yield Step(Move.REACH, step.start, step.end, amount=float(step.unit), unit="junction")
        yield replace(step, unit="")
