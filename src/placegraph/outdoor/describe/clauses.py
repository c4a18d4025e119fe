"""Clauses: the chunks of a sentence, settled by their neighbours and cut at the finite verbs."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from math import pi
from typing import TYPE_CHECKING, NamedTuple

from placegraph.outdoor.describe.lexicon import LOOSE_SIGMA, SHARP_SIGMA, Direction, english
from placegraph.outdoor.describe.nodes import Chunk

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

VERBS = frozenset("BE EXISTS SEE HAVE MEET GO PASS CROSS FOLLOW REACH TOOFAR".split())
_STARTS = frozenset("EXISTS MEET GO PASS FOLLOW REACH TOOFAR".split())
"""Verbs that open a clause of their own even without a joint before them."""
_JOINTS = frozenset(("AND", "CUT", "COND"))
_SUBJECTS = frozenset(("ME", "YOU", "IT", "SPOT", "THIS"))
_BEFORE_THING = frozenset(("DET", "THIS", "NAME", "MY", "YOUR", "A"))
_OWNERS = frozenset(("DET", "MY", "YOUR", "ITS", "GO"))
LONGEST = 60
"""Chunks in a clause; beyond, nobody speaks so."""
UNSURE = 0.6
LOOSE = 0.8
"""Certainty of what is said to be "maybe" or "mostly" so."""


class Part(NamedTuple):
    """The chunks of one clause."""

    chunks: list[Chunk]
    certainty: float
    opens: bool
    """Whether it opens its sentence."""


def clauses(chunks: list[Chunk]) -> list[Part]:
    """Cut the chunks of a sentence into clauses."""
    chunks = list(_settled(chunks))
    verb_ahead = _verb_before_joint(chunks)
    parts: list[Part] = []
    current: list[Chunk] = []
    sure, has_verb = 1.0, False

    def flush() -> None:
        nonlocal current, sure, has_verb
        while current and current[-1].type == "AND":
            current.pop()
        if current:
            parts.append(Part(current, sure, not parts))
        current, sure, has_verb = [], 1.0, False

    for i, chunk in enumerate(chunks):
        kind = chunk.type
        if kind == "UNSURE":
            sure = UNSURE
            continue
        if kind in ("CUT", "COND") or len(current) >= LONGEST:
            flush()
        if kind == "CUT":
            continue
        if kind == "AND":
            if has_verb and verb_ahead[i]:
                flush()
            elif chunk.words == ":" and current and not has_verb and not verb_ahead[i]:
                current.append(replace(chunk, type="BE"))  # "north of me: a church"
                has_verb = True
            elif current and current[-1].type != "AND":
                current.append(chunk)
            continue
        if kind in VERBS and not _meeting(current, kind):
            subject = current.pop() if current and current[-1].type in _SUBJECTS else None
            if has_verb and (subject or kind in _STARTS):
                flush()  # "head south | meet me at the park"
            if kind in _STARTS and current and current[-1].type == "AND":
                current.pop()  # "to the north, there is"
            if subject is not None:
                if current and current[-1].type not in ("AND", "COND"):
                    current.append(Chunk("AND", subject.start, subject.start))
                current.append(subject)  # "north of here you see"
            has_verb = True
        current.append(chunk)
    flush()
    return parts


def _meeting(current: Sequence[Chunk], kind: str) -> bool:
    """Tell whether a verb says where two streets meet, and is none of the clause."""
    return kind == "CROSS" and any(chunk.type == "WHERE" for chunk in current[-6:])


def _verb_before_joint(chunks: Sequence[Chunk]) -> list[bool]:
    """For every chunk, whether a verb follows it before the next joint."""
    ahead, found = [False] * len(chunks), False
    for i in range(len(chunks) - 1, -1, -1):
        ahead[i] = found
        if chunks[i].type in _JOINTS:
            found = False
        elif chunks[i].type in VERBS:
            found = True
    return ahead


def _settled(chunks: list[Chunk]) -> Iterator[Chunk]:
    """Chunks whose meaning depends on their neighbours, decided; empty ones dropped."""
    before, hedge, hedged_at = "", "", 0
    for i, chunk in enumerate(chunks):
        if chunk.type == "ADVERB":
            if chunk.value in ("sharp", "loose"):
                hedge, hedged_at = chunk.value, i
            elif chunk.value == "unsure":
                yield replace(chunk, type="UNSURE")
            continue
        settle = _SETTLE.get(chunk.type)
        for kept in settle(chunk, before, chunks[i + 1 :]) if settle else (chunk,):
            if kept.type == "DIR" and hedge and i - hedged_at <= 2:
                kept.value, hedge = _hedged(kept.value, hedge), ""
            before = kept.type
            yield kept


def _right(chunk: Chunk, before: str, rest: Sequence[Chunk]) -> tuple[Chunk, ...]:
    """ "My right", "right of", "turn right"; else it is an adverb: "right next to"."""
    if before in _OWNERS or (rest and rest[0].type in ("OF", "PART")):
        return (replace(chunk, type="DIR", value=Direction(pi / 2, facing=True)),)
    return ()


def _short(chunk: Chunk, _before: str, rest: Sequence[Chunk]) -> tuple[Chunk, ...]:
    """ "N" where it is a capital or stands before "of"."""
    if chunk.capital or (rest and rest[0].type == "OF"):
        return (replace(chunk, type="DIR"),)
    return (replace(chunk, type="WORD"),)


def _preposition(chunk: Chunk, before: str, rest: Sequence[Chunk]) -> tuple[Chunk, ...]:
    """ "Down the street" is along it, "head down south" is not; "the opposite block"."""
    after = rest[0].type if rest else ""
    if chunk.value == "particle":
        return (replace(chunk, value="along"),) if after in _BEFORE_THING else ()
    if chunk.value == "opposite" and before in ("DET", "A"):
        return (replace(chunk, type="WORD"),)
    return (chunk,)


def _across(chunk: Chunk, _before: str, rest: Sequence[Chunk]) -> tuple[Chunk, ...]:
    """ "Over the road" is across it, "head over to" is not."""
    return (
        ()
        if chunk.words == "over" and (not rest or rest[0].type not in _BEFORE_THING)
        else (chunk,)
    )


def _that_is(chunk: Chunk, before: str, _rest: Sequence[Chunk]) -> tuple[Chunk, ...]:
    """ "That is" opens a sentence, or relates to the thing before it and says nothing more."""
    return () if before else (replace(chunk, type="THIS"), replace(chunk, type="BE"))


def _with(chunk: Chunk, before: str, _rest: Sequence[Chunk]) -> tuple[Chunk, ...]:
    """ "..., with a bakery to my east" says that there is one."""
    return (replace(chunk, type="EXISTS"),) if before in ("", "AND", "CUT") else (chunk,)


def _where(chunk: Chunk, _before: str, rest: Sequence[Chunk]) -> tuple[Chunk, ...]:
    """ "Where A meets B" is a place; any other "where" opens a clause."""
    for other in rest[:6]:
        if other.type in _JOINTS:
            break
        if other.type == "CROSS":
            return (chunk,)
    return (replace(chunk, type="CUT"),)


def _word(chunk: Chunk, before: str, rest: Sequence[Chunk]) -> tuple[Chunk, ...]:
    """A misspelt direction, where only a direction can stand: "nroth of"."""
    after = rest[0].type if rest else ""
    if after in ("OF", "PART") or before in _OWNERS:
        direction = misspelt(chunk.words, certain=after == "OF")
        if direction is not None:
            return (replace(chunk, type="DIR", value=direction),)
    return (chunk,)


def _not(chunk: Chunk, _before: str, rest: Sequence[Chunk]) -> tuple[Chunk, ...]:
    """ "Do not see" is a verb that says no."""
    if rest and rest[0].type in ("SEE", "HAVE"):
        rest[0].value = "NOT"
        return ()
    return (chunk,)


def _go(chunk: Chunk, before: str, rest: Sequence[Chunk]) -> tuple[Chunk, ...]:
    """ "I am walking along the canal" says where one is, "I am walking north" where one faces."""
    if before != "BE":
        return (chunk,)
    return (replace(chunk, type="FACE"),) if rest and rest[0].type == "DIR" else ()


def _article(chunk: Chunk, _before: str, rest: Sequence[Chunk]) -> tuple[Chunk, ...]:
    """ "A 2 minute walk"."""
    return () if rest and rest[0].type == "DIST" else (chunk,)


_SETTLE = {
    "NOT": _not,
    "GO": _go,
    "A": _article,
    "RIGHT": _right,
    "SHORT": _short,
    "PREP": _preposition,
    "ACROSS": _across,
    "THAT_IS": _that_is,
    "WITH": _with,
    "WHERE": _where,
    "WORD": _word,
}
_NO_COMPASS = frozenset(
    "worth forth fort port sort short mouth youth tooth fourth sought month rest best test nest vest"
    " pest wet went last past fast cast mast vast eats seat beast feast least yeast".split()
)
"""Words that differ from a compass point by a letter."""


@lru_cache(maxsize=4096)
def misspelt(word: str, *, certain: bool) -> Direction | None:
    """Direction that a misspelt word means, or None; short words need to be `certain`."""
    from rapidfuzz import process
    from rapidfuzz.distance import OSA

    compass = english().compass
    if len(word) < 4 or word in _NO_COMPASS:
        return None
    found = process.extractOne(word, compass.keys(), scorer=OSA.distance, score_cutoff=1)
    if found is None or (len(word) < 5 and not certain and sorted(word) != sorted(found[0])):
        return None
    return compass[found[0]]


def _hedged(direction: Direction, hedge: str) -> Direction:
    if hedge == "sharp":
        return direction._replace(sigma=SHARP_SIGMA)
    return direction._replace(sigma=LOOSE_SIGMA, certainty=LOOSE)
