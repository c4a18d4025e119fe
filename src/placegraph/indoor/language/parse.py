"""The grammar at work: chunks of a clause become nouns, where they are, and a verb between them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache, partialmethod
from importlib.resources import files
from math import pi
from typing import Any

from placegraph.language.islands import Chunk, Islands

_SKIPPED = ("WORD", "AND", "OF", "FROM", "NOT", "DET", "A", "NO", "NUM", "SOME", "PART", "SIGHT")
"""Chunks that may be left out where the grammar expects something else."""


@dataclass(slots=True)
class Noun:
    """Somebody or something spoken of, in one place of the text."""

    kind: str
    """``ME IT SPOT PART`` or ``thing``."""
    start: int
    end: int
    determiners: tuple[Chunk, ...] = ()
    words: tuple[Chunk, ...] = ()
    owner: Noun | None = None
    """Of what it is: "the door of the kitchen"."""


@dataclass(slots=True)
class Where:
    """What is said of where something is."""

    how: str
    """Rule of the grammar: ``related alone towards between faces far here sight row with_``."""
    start: int
    end: int
    things: tuple[Noun, ...] = ()
    relation: str = ""
    bearing: float = 0.0
    distance: float | None = None
    negated: bool = False


Joint = Chunk
"""A comma, or "and"."""
Item = Noun | Where | Joint


@dataclass(slots=True)
class Clause:
    """One clause: a verb, what stands before it and after it."""

    verb: str
    """Rule of the grammar: ``fragment is_ exists sees has``."""
    before: list[Item] = field(default_factory=list)
    after: list[Item] = field(default_factory=list)


@cache
def _grammar() -> Islands[Clause]:
    text = files(__package__).joinpath("sentence.lark").read_text("utf-8")
    return Islands(text, "clause", _Build(), Clause, _SKIPPED)


def parse(chunks: list[Chunk]) -> Iterator[tuple[Clause | None, list[Chunk]]]:
    """Parse the chunks of one clause by islands: what was read, and the chunks that were not."""
    for clause, _, left_out in _grammar().parse(chunks):
        yield clause, left_out


class _Build:
    """Callbacks of the grammar's rules, called as soon as a rule is complete."""

    # clauses
    def clause(self, children: list[Any]) -> Clause:
        return children[0]

    def fragment(self, children: list[Any]) -> Clause:
        return Clause("fragment", after=children[0])

    def _clause(self, children: list[Any], *, verb: str) -> Clause:
        said = Clause(verb)
        at_verb = next(i for i, child in enumerate(children) if isinstance(child, Chunk))
        for i, child in enumerate(children):
            if isinstance(child, list):
                if i < at_verb:
                    said.before = child
                else:
                    said.after = child
        return said

    is_ = partialmethod(_clause, verb="is_")
    exists = partialmethod(_clause, verb="exists")
    sees = partialmethod(_clause, verb="sees")
    has = partialmethod(_clause, verb="has")

    def body(self, children: list[Any]) -> list[Item]:
        return list(children)

    # places
    def not_(self, children: list[Any]) -> Where:
        children[1].negated = True
        return children[1]

    def _place(self, children: list[Any], *, how: str) -> Where:
        place = Where(how, children[0].start, children[-1].end)
        place.things = tuple(child for child in children if isinstance(child, Noun))
        for child in children:
            if isinstance(child, Noun):
                continue
            if child.type == "REL":
                place.relation = child.value
            elif child.type == "DIR":
                place.bearing = child.value
            elif child.type == "DIST":
                place.distance = child.value
        return place

    alone = partialmethod(_place, how="alone")
    related = partialmethod(_place, how="related")
    towards = partialmethod(_place, how="towards")
    between = partialmethod(_place, how="between")
    faces = partialmethod(_place, how="faces")
    far = partialmethod(_place, how="far")
    here = partialmethod(_place, how="here")
    sight = partialmethod(_place, how="sight")
    row = partialmethod(_place, how="row")
    with_ = partialmethod(_place, how="with_")

    def back_to(self, children: list[Any]) -> Where:
        place = self._place(children, how="faces")
        place.bearing = pi
        return place

    # things
    def no_thing(self, children: list[Any]) -> Noun:
        negation, thing = children
        thing.determiners = (Chunk("NO", negation.start, negation.end), *thing.determiners)
        return thing

    def _who(self, children: list[Any], *, kind: str) -> Noun:
        return Noun(kind, children[0].start, children[0].end)

    me = partialmethod(_who, kind="ME")
    it = partialmethod(_who, kind="IT")
    scene = partialmethod(_who, kind="SPOT")

    def named(self, children: list[Any]) -> Noun:
        words = tuple(child for child in children if child.type == "WORD")
        determiners = tuple(child for child in children if child.type != "WORD")
        return Noun("thing", children[0].start, children[-1].end, determiners, words)

    def of(self, children: list[Any]) -> Noun:
        thing, _, owner = children
        return Noun("thing", thing.start, owner.end, thing.determiners, thing.words, owner)

    def part(self, children: list[Any]) -> Noun:
        owner = children[-1] if isinstance(children[-1], Noun) else None
        if owner is not None and owner.kind != "SPOT":
            return owner  # the corner of the kitchen is in the kitchen
        words = tuple(c for c in children if isinstance(c, Chunk) and c.type == "PART")
        return Noun("PART", children[0].start, children[-1].end, words=words)
