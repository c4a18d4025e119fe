"""Clauses: chunks with a settled meaning, cut at joints between finite verbs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from math import pi
from typing import TYPE_CHECKING, NamedTuple

from placegraph.language.grammar import Chunk
from placegraph.language.measures import Measure
from placegraph.outdoor.language.description import LOOSE_SIGMA, SHARP_SIGMA, Direction

if TYPE_CHECKING:
    from placegraph.outdoor.language.languages import Language

VERBS = frozenset(
    ("BE", "EXISTS", "SEE", "HAVE", "MEET", "GO", "PASS", "CROSS", "FOLLOW", "REACH", "TOOFAR")
)
JOINTS = frozenset(("AND", "CUT", "COND"))
NEXT_BLOCK = Measure.within(0.0, blocks=1.5)
"""How far things on "the next block" are at most."""
LOOSE = 0.8
"""Certainty of what is said to be "mostly" so."""
LEADS = frozenset(("ON", "IN", "AT", "TO", "FROM", "OF", "PREP"))
_BEFORE_THING = frozenset(("DET", "THIS", "NAME", "MY", "YOUR", "A"))
_DETERMINED = frozenset(("DET", "THIS", "A", "ANOTHER", "NO", "NUM", "MY", "YOUR", "ITS"))
_IN_THING = frozenset(("DET", "THIS", "A", "ANOTHER", "NUM", "WORD", "ADVERB"))
_ENDS = frozenset(("NOUN", "NAME", "ME", "DIR", "HERE", "NEARBY"))
"""What a place may end with: a thing that follows without a joint is what is there."""
_THINGS = frozenset(("NOUN", "NAME"))


def settled(chunks: Sequence[Chunk], language: Language) -> Iterator[Chunk]:
    """Decide what the ambiguous chunks of a sentence are; drop those that say nothing."""
    before, hedge, hedged_at = "", "", 0
    measured: Measure | None = None
    for i, chunk in enumerate(chunks):
        if chunk.type == "ADVERB":
            if chunk.value in ("sharp", "loose"):
                hedge, hedged_at = chunk.value, i
            elif chunk.value == "unsure":
                yield replace(chunk, type="UNSURE")
            continue
        if chunk.type == "DIST":
            measured = chunk.value
        elif chunk.type == "NUM" and measured and chunk.value and _counts(before, chunks[i + 1 :]):
            chunk.type, chunk.value = "DIST", measured.again(chunk.value)
        rule = _RULES.get(chunk.type)
        if chunk.type == "WORD":
            rule = partial(_word, language=language)
        for kept in rule(chunk, before, chunks[i + 1 :]) if rule else (chunk,):
            if kept.type == "DIR" and hedge and i - hedged_at <= 2:
                kept.value, hedge = _hedged(kept.value, hedge), ""
            before = kept.type
            yield kept


def _hedged(direction: Direction, hedge: str) -> Direction:
    if hedge == "sharp":
        return direction._replace(sigma=SHARP_SIGMA)
    return direction._replace(sigma=LOOSE_SIGMA, certainty=LOOSE)


def _counts(before: str, rest: Sequence[Chunk]) -> bool:
    """Tell whether a number stands for a distance whose unit was said before: "then 4 north"."""
    after = [other.type for other in rest[:4] if other.type != "ADVERB"][:2]
    if before == "DIR":
        return not after or after[0] in JOINTS
    return after[:1] == ["DIR"] and after[1:] not in (["OF"], ["PART"])


def _next(rest: Sequence[Chunk]) -> str:
    """Type of the next chunk that is no adverb, or an empty string."""
    return next((chunk.type for chunk in rest[:4] if chunk.type != "ADVERB"), "")


def _right(chunk: Chunk, before: str, rest: Sequence[Chunk]) -> tuple[Chunk, ...]:
    """Tell "my right", "right of", "turn right" from the adverb in "right next to"."""
    if before in ("DET", "MY", "YOUR", "ITS", "GO") or _next(rest) in ("OF", "PART"):
        return (replace(chunk, type="DIR", value=Direction(pi / 2, facing=True)),)
    return ()


def _short(chunk: Chunk, _before: str, rest: Sequence[Chunk]) -> tuple[Chunk, ...]:
    """Take "N" as north where it is a capital or stands before "of"."""
    north = chunk.capital or _next(rest) == "OF"
    return (replace(chunk, type="DIR" if north else "WORD"),)


def _preposition(chunk: Chunk, before: str, rest: Sequence[Chunk]) -> tuple[Chunk, ...]:
    """Tell "down the street" from "head down south", "opposite the" from "the opposite"."""
    if chunk.value == "particle":
        return (replace(chunk, value="along"),) if _next(rest) in _BEFORE_THING else ()
    if chunk.value == "opposite" and before in ("DET", "A"):
        return (replace(chunk, type="WORD"),)
    return (chunk,)


def _across(chunk: Chunk, _before: str, rest: Sequence[Chunk]) -> tuple[Chunk, ...]:
    """Tell "over the road", which is across it, from "head over to"."""
    if chunk.words == "over" and _next(rest) not in _BEFORE_THING:
        return ()
    return (chunk,)


def _that_is(chunk: Chunk, before: str, _rest: Sequence[Chunk]) -> tuple[Chunk, ...]:
    """Tell "that is" that opens a sentence from the one that relates to the thing before."""
    return () if before else (replace(chunk, type="THIS"), replace(chunk, type="BE"))


def _this(chunk: Chunk, before: str, _rest: Sequence[Chunk]) -> tuple[Chunk, ...]:
    """Drop the "that" of "a garden that borders the lot"."""
    return () if chunk.words == "that" and before in _THINGS else (chunk,)


def _with(chunk: Chunk, before: str, _rest: Sequence[Chunk]) -> tuple[Chunk, ...]:
    """Take ", with a bakery to my east" as saying that there is one."""
    return (replace(chunk, type="EXISTS"),) if before in ("", *JOINTS) else (chunk,)


def _where(chunk: Chunk, _before: str, rest: Sequence[Chunk]) -> tuple[Chunk, ...]:
    """Keep "where A meets B", a place; any other "where" opens a clause."""
    for other in rest[:6]:
        if other.type in JOINTS:
            break
        if other.type == "CROSS":
            return (chunk,)
    return (replace(chunk, type="CUT"),)


def _not(chunk: Chunk, _before: str, rest: Sequence[Chunk]) -> tuple[Chunk, ...]:
    """Let the verb in "do not see" say no."""
    verb = next((other for other in rest[:3] if other.type != "ADVERB"), None)
    if verb is None or verb.type not in ("SEE", "HAVE"):
        return (chunk,)
    verb.value = "NOT"
    return ()


def _have(chunk: Chunk, before: str, rest: Sequence[Chunk]) -> tuple[Chunk, ...]:
    """Drop the verb of "have gone too far", "we're having coffee at"."""
    return () if before == "BE" or _next(rest) == "TOOFAR" else (chunk,)


def _go(chunk: Chunk, before: str, rest: Sequence[Chunk]) -> tuple[Chunk, ...]:
    """Take "I am walking along" as where one is, "I am walking north" as where one faces."""
    if before != "BE":
        return (chunk,)
    return (replace(chunk, type="FACE"),) if _next(rest) == "DIR" else ()


def _to(chunk: Chunk, before: str, rest: Sequence[Chunk]) -> tuple[Chunk, ...]:
    """Cut before "to meet me"."""
    if rest and rest[0].type in VERBS and before:
        return (replace(chunk, type="CUT"),)
    return (chunk,)


def _article(chunk: Chunk, before: str, rest: Sequence[Chunk]) -> tuple[Chunk, ...]:
    """Drop what stands before a measure: "a 2 minute walk", "for another 5 m", "a bit south of"."""
    after = [other.type for other in rest[:4] if other.type != "ADVERB"][:2]
    if chunk.type == "A" and before in _ENDS and after[:1] in (["NOUN"], ["NAME"], ["WORD"]):
        return (replace(chunk, type="EXISTS"), chunk)  # "next to me a bank, to the north a park"
    measured = after[:1] == ["DIST"] or (chunk.type == "OF" and after == ["ANOTHER", "DIST"])
    return () if measured or (chunk.type == "A" and after == ["DIR", "OF"]) else (chunk,)


def _its(chunk: Chunk, before: str, _rest: Sequence[Chunk]) -> tuple[Chunk, ...]:
    """Read "at it's end" as "at its end"."""
    if chunk.words == "it's" and before in LEADS:
        return (replace(chunk, type="ITS"),)
    return (chunk,)


def _its_own(chunk: Chunk, before: str, rest: Sequence[Chunk]) -> tuple[Chunk, ...]:
    """Read "its next to a school" as "it is next to a school"."""
    owned = ("NOUN", "NAME", "WORD", "DIR", "PART", "NUM", "")
    if chunk.words != "its" or before not in ("", *JOINTS) or _next(rest) in owned:
        return (chunk,)
    return replace(chunk, type="IT"), replace(chunk, type="BE")


def _be(chunk: Chunk, before: str, rest: Sequence[Chunk]) -> tuple[Chunk, ...]:
    """Drop the verb of "at it's end", of "you are too far", "I'm looking at", "where the bank is"."""
    return (
        ()
        if (chunk.words == "it's" and before == "ITS") or _next(rest) in ("TOOFAR", "SEE", "")
        else (chunk,)
    )


def _called(_chunk: Chunk, _before: str, rest: Sequence[Chunk]) -> tuple[Chunk, ...]:
    """Let a name follow its noun: "a bar called The Fox"."""
    if len(rest) > 1 and rest[0].type == "DET" and rest[1].type == "NAME":
        rest[0].type, rest[0].value = "ADVERB", "skip"
    return ()


def _block(chunk: Chunk, _before: str, rest: Sequence[Chunk]) -> tuple[Chunk, ...]:
    """Take "on the next block north" as that far to the north: a block is no thing on a map."""
    for i, other in enumerate(rest[:-1]):
        if other.type == "PART" and other.value == "block" and rest[i + 1].type == "DIR":
            for skipped in rest[: i + 1]:
                skipped.type, skipped.value = "ADVERB", "skip"
            return (replace(chunk, type="DIST", value=NEXT_BLOCK),)
        if other.type not in _IN_THING:
            break
    return (chunk,)


def _lets(chunk: Chunk, _before: str, rest: Sequence[Chunk]) -> tuple[Chunk, ...]:
    """Take "let's get some paint at the store" as meeting at the store."""
    if not rest or _next(rest) in VERBS - {"HAVE"}:  # "let's have a drink at the bar"
        return ()
    place = len(rest)
    for i, other in enumerate(rest):
        if other.type in JOINTS:
            break
        if other.type in ("AT", "IN", "ON") or (other.type == "PREP" and other.value == "near"):
            place = i
            break
        if other.type in ("DET", "THIS"):  # "let's visit the museum"
            place = i
            break
        if other.type in _DETERMINED and place == len(rest):
            place = i
    if place == len(rest):
        return ()
    for other in rest[:place]:
        other.type, other.value = "ADVERB", "skip"
    return (replace(chunk, type="MEET"),)


def _word(
    chunk: Chunk, before: str, rest: Sequence[Chunk], *, language: Language
) -> tuple[Chunk, ...]:
    """Mend a misspelt direction where only one can stand; set aside an unknown verb."""
    after = _next(rest)
    if after in ("OF", "PART") or before in ("DET", "MY", "YOUR", "ITS", "GO"):
        direction = misspelt(chunk.words, language, certain=after == "OF")
        if direction is not None:
            return (replace(chunk, type="DIR", value=direction),)
    if after in _DETERMINED and before not in _DETERMINED:
        return (replace(chunk, type="JUNK"),)
    return (chunk,)


_RULES = {
    "RIGHT": _right,
    "ON": _block,
    "IN": _block,
    "AT": _block,
    "SHORT": _short,
    "PREP": _preposition,
    "ACROSS": _across,
    "THAT_IS": _that_is,
    "THIS": _this,
    "WITH": _with,
    "WHERE": _where,
    "NOT": _not,
    "GO": _go,
    "HAVE": _have,
    "TO": _to,
    "A": _article,
    "ANOTHER": _article,
    "OF": _article,
    "IT": _its,
    "ITS": _its_own,
    "BE": _be,
    "CALLED": _called,
    "LETS": _lets,
}


@lru_cache(maxsize=4096)
def misspelt(word: str, language: Language, *, certain: bool) -> Direction | None:
    """Direction that a misspelt word means, or None; short words need to be `certain`."""
    from rapidfuzz import process
    from rapidfuzz.distance import OSA

    compass = language.compass
    if len(word) < 4 or word in language.lists["no_compass"]:
        return None
    found = process.extractOne(word, compass.keys(), scorer=OSA.distance, score_cutoff=1)
    if found is None or (len(word) < 5 and not certain and sorted(word) != sorted(found[0])):
        return None
    return compass[found[0]]


_STARTS = VERBS - {"BE", "SEE", "HAVE"}
"""Verbs that open a clause of their own even without a joint before them."""
_BEFORE_TARGET = frozenset(("AND", "COND", "PREP", "OF", "FROM", "BETWEEN"))
"""What a person after them is no subject of, or joined to already: "next to it is a bank"."""
_SUBJECTS = frozenset(("ME", "YOU", "IT", "SPOT", "THIS"))
_GOVERNS = frozenset(("PREP", "OF", "FROM", "BETWEEN", "ACROSS", "IN", "ON", "AT", "TO", "WITH"))
"""What makes a pronoun no subject of the verb behind it: "next to it is a bakery"."""
LONGEST = 60
"""Chunks in a clause; nobody speaks in longer ones."""
UNSURE = 0.6
"""Certainty of what is said to be "maybe" so."""


class Part(NamedTuple):
    """The chunks of one clause."""

    chunks: list[Chunk]
    certainty: float
    opens: bool
    """Whether it opens its sentence."""


def clauses(sentence: list[Chunk], language: Language) -> list[Part]:
    """Cut the chunks of a sentence into clauses."""
    chunks = list(settled(sentence, language))
    cutter = _Cutter()
    for chunk, verb_ahead in zip(chunks, _verb_before_joint(chunks), strict=True):
        cutter.take(chunk, verb_ahead=verb_ahead)
    cutter.cut()
    return cutter.parts


class _Cutter:
    """Collects the chunks of a clause until the next one begins."""

    def __init__(self) -> None:
        self.parts: list[Part] = []
        self.current: list[Chunk] = []
        self.certainty, self.has_verb = 1.0, False

    def take(self, chunk: Chunk, *, verb_ahead: bool) -> None:
        kind = chunk.type
        if kind == "UNSURE":
            self.certainty = UNSURE
        elif kind == "AND":
            self._joint(chunk, verb_ahead=verb_ahead)
        elif kind == "CUT":
            self.cut()
        else:
            if kind == "COND" or len(self.current) >= LONGEST:
                self.cut()
            if kind in VERBS and not (kind == "CROSS" and self._has_where()):
                self._verb(kind)
            self.current.append(chunk)

    def cut(self) -> None:
        """End the clause."""
        self._drop_joints()
        if self.current:
            self.parts.append(Part(self.current, self.certainty, not self.parts))
        self.current, self.certainty, self.has_verb = [], 1.0, False

    def _joint(self, chunk: Chunk, *, verb_ahead: bool) -> None:
        if self.has_verb and verb_ahead:
            self.cut()
        elif not self.current or self.current[-1].type == "AND":
            return
        elif chunk.words == ":" and not self.has_verb and not verb_ahead:
            self.current.append(replace(chunk, type="BE"))  # "north of me: a church"
            self.has_verb = True
        else:
            self.current.append(chunk)

    def _verb(self, kind: str) -> None:
        subject = None
        before = self.current[-2].type if len(self.current) > 1 else ""
        if self.current and self.current[-1].type in _SUBJECTS and before not in _GOVERNS:
            subject = self.current.pop()
        if self.has_verb and (subject is not None or kind in _STARTS):
            self.cut()  # "head south | meet me at the park"
        if kind in _STARTS or (kind == "BE" and subject is None):
            self._drop_joints()  # "to the north, there is"
        if subject is not None:
            if self.current and self.current[-1].type not in _BEFORE_TARGET:
                self.current.append(Chunk("AND", subject.start, subject.start))
            self.current.append(subject)  # "north of here you see"
        self.has_verb = True

    def _drop_joints(self) -> None:
        while self.current and self.current[-1].type == "AND":
            self.current.pop()

    def _has_where(self) -> bool:
        """Tell whether a verb says where two streets meet, and is none of the clause."""
        return any(chunk.type == "WHERE" for chunk in self.current[-6:])


def _verb_before_joint(chunks: Sequence[Chunk]) -> list[bool]:
    """For every chunk, whether a verb follows it before the next joint."""
    ahead, found = [False] * len(chunks), False
    for i in range(len(chunks) - 1, -1, -1):
        ahead[i] = found
        if chunks[i].type in JOINTS:
            found = False
        elif chunks[i].type in VERBS:
            found = True
    return ahead
