"""The grammar at work: chunks of a clause become a `Clause`, or what of them can be understood (Eq. 3)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache, partialmethod
from importlib.resources import files
from typing import Any

from placegraph.language.grammar import Chunk
from placegraph.language.grammar import IslandParser as Islands
from placegraph.outdoor.language.description import NORTH, Direction, Sense


@dataclass(slots=True)
class Noun:
    """Value of a NOUN or NAME: what it may be on a map."""

    senses: tuple[Sense, ...] = ()
    name: str = ""
    exact: bool = False
    """Whether it is a label as a map has it, and no English."""


@dataclass(slots=True)
class Thing:
    """Somebody or something spoken of, in one place of the text."""

    kind: str
    """``ME YOU IT SPOT HERE`` or ``thing``."""
    start: int
    end: int
    determiner: str = ""
    """Terminal of the determiner: ``DET A ANOTHER NO NUM MY ...``, or empty."""
    count: int | None = None
    senses: tuple[Sense, ...] = ()
    head: str = ""
    """Common noun, lower-case: "bakery"; the last unknown word where there is none."""
    modifiers: tuple[str, ...] = ()
    """Words before the noun: "grey", "main"."""
    exact: bool = False
    """Whether the noun is a label as a map has it, and no English."""
    name: str = ""
    part: str = ""
    """Of a part of a thing: ``corner middle block ...``."""


@dataclass(slots=True)
class Place:
    """What is said of where something is: "50 m north of the church"."""

    how: str
    """Rule of the grammar: ``towards side possessed at prep across between ...``."""
    start: int
    end: int
    targets: tuple[Thing, ...] = ()
    word: str = ""
    """Which preposition: ``ON IN AT TO``, or a relation of the language."""
    direction: Direction = NORTH
    """Of directions."""
    distance: float | None = None
    part: str = ""
    owner: str = ""
    """``MY YOUR ITS``."""
    negated: bool = False


@dataclass(slots=True)
class Clause:
    """One clause: a verb, what stands before it and after it."""

    verb: str
    """Rule of the grammar: ``fragment is_ exists sees meets goes too_far``."""
    before: tuple[Thing | Place, ...] = ()
    after: tuple[Thing | Place, ...] = ()
    negated: bool = False
    condition: bool = False
    """"if you see ...", "when you get to ...", "until ..."."""
    travel: str = ""
    """``GO PASS CROSS FOLLOW REACH``."""
    certainty: float = 1.0
    start: int = 0
    end: int = 0


Item = Thing | Place
Items = tuple[Item, ...]
_OWNERS = ("MY", "YOUR", "ITS")
_DETERMINERS = ("DET", "THIS", "A", "ANOTHER", "NO", "NUM", *_OWNERS)
_SKIPPED = ("WORD", "JUNK", "AND", "TO", "NOT")
"""Chunks that may be left out where the grammar expects something else."""


@lru_cache(maxsize=1)
def _grammar() -> Islands[Clause]:
    text = files(__package__).joinpath("outdoor.lark").read_text("utf-8")
    return Islands(text, "clause", _Build(), Clause, _SKIPPED)


def parse(chunks: list[Chunk]) -> Iterator[tuple[Clause, list[Chunk]]]:
    """Parse the chunks of one clause by islands (Eq. 3 of the paper).

    Yields
    ------
    clause, left_out
        What could be parsed, in order, and the chunks that had to be left out of it. Where nothing
        could be parsed, an empty clause.
    """
    for clause, used, left_out in _grammar().parse(chunks):
        if clause is None:
            yield Clause("", start=used[0].start, end=used[-1].end), left_out
        else:
            kept = [chunk for chunk in used if chunk not in left_out]
            clause.start, clause.end = min(c.start for c in kept), max(c.end for c in kept)
            yield clause, left_out


class _Build:
    """Callbacks of the grammar's rules, called as soon as a rule is complete."""

    # clauses
    def clause(self, children: list[Any]) -> Clause:
        said: Clause = children[-1]
        said.condition = len(children) > 1
        return said

    def _clause(self, children: list[Any], *, verb: str) -> Clause:
        said = Clause(verb)
        for child in children:
            if isinstance(child, tuple):
                if said.travel:
                    said.after = child
                else:
                    said.before = child
            else:
                said.travel = child.type
                said.negated = child.value == "NOT"
        return said

    def fragment(self, children: list[Any]) -> Clause:
        return Clause("fragment", before=children[0])

    is_ = partialmethod(_clause, verb="is_")
    exists = partialmethod(_clause, verb="exists")
    sees = partialmethod(_clause, verb="sees")
    meets = partialmethod(_clause, verb="meets")
    goes = partialmethod(_clause, verb="goes")
    too_far = partialmethod(_clause, verb="too_far")

    def body(self, children: list[Any]) -> Items:
        return tuple([child for child in children if not isinstance(child, Chunk)])

    # places
    def not_(self, children: list[Any]) -> Place:
        children[1].negated = True
        return children[1]

    def no_thing(self, children: list[Any]) -> Thing:
        children[1].determiner = "NO"
        return children[1]

    def measured(self, children: list[Any]) -> Place:
        measure: Chunk = children[0]
        if isinstance(children[-1], Place):
            place: Place = children[-1]
            place.start = measure.start
        else:
            place = Place("away", measure.start, children[-1].end)
        place.distance = measure.value
        return place

    def _place(self, children: list[Any], *, how: str) -> Place:
        # words may have been brought into the order of the grammar from another
        start, end = min(c.start for c in children), max(c.end for c in children)
        place = Place(how, start, end)
        things = []
        for child in children:
            if isinstance(child, Thing):
                things.append(child)
            elif child.type == "HERE":
                things.append(Thing("HERE", child.start, child.end))
            elif child.type == "DIR":
                place.direction = child.value
            elif child.type == "PART":
                place.part = child.value
            elif child.type == "PREP":
                place.word = child.value
            elif child.type in _OWNERS:
                place.owner = child.type
            elif child.type in ("ON", "IN", "AT", "TO"):
                place.word = child.type
        place.targets = tuple(things)
        return place

    towards = partialmethod(_place, how="towards")
    side = partialmethod(_place, how="side")
    possessed = partialmethod(_place, how="possessed")
    at = partialmethod(_place, how="at")
    prep = partialmethod(_place, how="prep")
    bare = partialmethod(_place, how="bare")
    across = partialmethod(_place, how="across")
    between = partialmethod(_place, how="between")
    faces = partialmethod(_place, how="faces")
    at_both = partialmethod(_place, how="at_both")
    with_ = partialmethod(_place, how="with_")
    of = partialmethod(_place, how="of")
    start = partialmethod(_place, how="start")
    nearby = partialmethod(_place, how="nearby")
    here = partialmethod(_place, how="here")

    def thing(self, children: list[Any]) -> Thing:
        start, end = min(c.start for c in children), max(c.end for c in children)
        thing = Thing("thing", start, end)
        nouns = [child for child in children if child.type == "NOUN"]
        words = [child.words for child in children if child.type == "WORD"]
        for child in children:
            if child.type in _DETERMINERS:
                thing.determiner = thing.determiner or child.type
                thing.count = child.value if child.type == "NUM" else None
            elif child.type == "NAME":
                thing.name, thing.senses = child.value.name, child.value.senses
            elif child.type == "PART" and not nouns:
                thing.part = child.value
        thing.head = " ".join(words)
        if nouns:
            _take_nouns(thing, nouns)
        return thing

    def person(self, children: list[Any]) -> Thing:
        chunk: Chunk = children[0]
        kind = "IT" if chunk.type == "THIS" else chunk.type
        return Thing(kind, chunk.start, chunk.end)


def _take_nouns(thing: Thing, nouns: list[Chunk]) -> None:
    """Take the common nouns of a thing: "alcohol shop" is shop=alcohol, not any shop."""
    if thing.name and len(nouns) > 1:  # "Cupka's cafe restaurant"
        thing.name = f"{thing.name} {' '.join(noun.words for noun in nouns[:-1])}"
        nouns = nouns[-1:]
    head: Noun = nouns[-1].value
    thing.modifiers = (*thing.head.split(), *[noun.words for noun in nouns[:-1]])
    thing.senses, thing.head, thing.exact = head.senses, nouns[-1].words, head.exact
    keys = {s.label.partition("=")[0] for s in head.senses if s.label.endswith(("=*", "=yes"))}
    for noun in nouns[:-1]:
        special = tuple([s for s in noun.value.senses if s.label.partition("=")[0] in keys])
        thing.senses = special or thing.senses
