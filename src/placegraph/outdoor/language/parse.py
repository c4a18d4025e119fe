"""The grammar at work: chunks of a clause become a `Clause`, or what of them can be understood."""

from __future__ import annotations

from functools import lru_cache, partialmethod
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from placegraph.language.islands import Chunk, Islands
from placegraph.outdoor.language.nodes import Clause, Noun, Place, Thing

if TYPE_CHECKING:
    from collections.abc import Iterator

Item = Thing | Place
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
            clause.start, clause.end = kept[0].start, kept[-1].end
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

    def body(self, children: list[Any]) -> tuple[Item, ...]:
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
        place = Place(how, children[0].start, children[-1].end)
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
        thing = Thing("thing", children[0].start, children[-1].end)
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
