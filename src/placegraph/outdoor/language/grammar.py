"""The grammar at work: chunks of a clause become a `Clause`, or what of them can be understood (Eq. 3)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from typing import Any, TypeAlias

from placegraph.language.grammar import (
    Chunk,
    Clause,
    IslandParser,
    PlacePhrase,
    build_clause,
    build_place,
    build_with,
    negate,
)
from placegraph.outdoor.language.description import Sense


@dataclass(slots=True)
class NounMeaning:
    """Value of a NOUN or NAME chunk: what it may be on a map."""

    senses: tuple[Sense, ...] = ()
    name: str = ""
    exact: bool = False
    """Whether it is a label as a map has it, and no English."""


@dataclass(slots=True)
class NounPhrase:
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


Place: TypeAlias = PlacePhrase[NounPhrase]
Item: TypeAlias = NounPhrase | Place
Items: TypeAlias = tuple[Item, ...]
_DETERMINERS = ("DET", "THIS", "A", "ANOTHER", "NO", "NUM", "MY", "YOUR", "ITS")
_SKIPPED = ("WORD", "JUNK", "AND", "TO", "NOT")
"""Chunks that may be left out where the grammar expects something else."""


def parse(chunks: list[Chunk]) -> Iterator[tuple[Clause, list[Chunk]]]:
    """Parse the chunks of one clause by islands (Eq. 3 of the paper).

    Yields
    ------
    clause, left_out
        What could be parsed, in order, and the chunks that had to be left out of it. Where nothing
        could be parsed, an empty clause.
    """
    for clause, used, left_out in _parser().parse(chunks):
        if clause is None:
            yield Clause("", start=used[0].start, end=used[-1].end), left_out
        else:
            parsed = [chunk for chunk in used if chunk not in left_out]
            clause.start, clause.end = min(c.start for c in parsed), max(c.end for c in parsed)
            yield clause, left_out


def _build_conditional(children: list[Any]) -> Clause:
    clause: Clause = children[-1]
    clause.condition = len(children) > 1
    return clause


def _build_denied(children: list[Any]) -> NounPhrase:
    thing: NounPhrase = children[1]
    thing.determiner = "NO"
    return thing


def _build_measured(children: list[Any]) -> Place:
    """Build "50 m north of the church", "two blocks away"."""
    measure, last = children[0], children[-1]
    place: Place = (
        last if isinstance(last, PlacePhrase) else PlacePhrase("away", measure.start, last.end)
    )
    place.start, place.distance = measure.start, measure.value
    return place


def _build_person(children: list[Any]) -> NounPhrase:
    chunk: Chunk = children[0]
    return NounPhrase("IT" if chunk.type == "THIS" else chunk.type, chunk.start, chunk.end)


def _build_thing(children: list[Any]) -> NounPhrase:
    """Build a noun phrase of its determiner, words, nouns, name and part."""
    start, end = min(c.start for c in children), max(c.end for c in children)
    thing = NounPhrase("thing", start, end)
    nouns = [child for child in children if child.type == "NOUN"]
    thing.head = " ".join([child.words for child in children if child.type == "WORD"])
    for child in children:
        if child.type in _DETERMINERS:
            thing.determiner = thing.determiner or child.type
            thing.count = child.value if child.type == "NUM" else None
        elif child.type == "NAME":
            thing.name, thing.senses = child.value.name, child.value.senses
        elif child.type == "PART" and not nouns:
            thing.part = child.value
    if nouns:
        _take_nouns(thing, nouns)
    return thing


def _take_nouns(thing: NounPhrase, nouns: Sequence[Chunk]) -> None:
    """Set the common noun of a phrase: "alcohol shop" is shop=alcohol, not any shop."""
    if thing.name and len(nouns) > 1:  # "Cupka's cafe restaurant"
        thing.name = " ".join([thing.name, *[noun.words for noun in nouns[:-1]]])
        nouns = nouns[-1:]
    meaning: NounMeaning = nouns[-1].value
    thing.modifiers = (*thing.head.split(), *[noun.words for noun in nouns[:-1]])
    thing.senses, thing.head, thing.exact = meaning.senses, nouns[-1].words, meaning.exact
    keys = {s.label.partition("=")[0] for s in meaning.senses if s.label.endswith(("=*", "=yes"))}
    for noun in nouns[:-1]:
        special = tuple([s for s in noun.value.senses if s.label.partition("=")[0] in keys])
        thing.senses = special or thing.senses


_BUILDERS = {
    **build_with(build_clause, "verb", "is_ exists sees meets goes too_far"),
    **build_with(
        build_place,
        "how",
        "towards side possessed at prep bare across between faces at_both with_ of start nearby here",
    ),
    "clause": _build_conditional,
    "fragment": lambda children: Clause("fragment", before=children[0]),
    "body": lambda children: tuple([item for item in children if not isinstance(item, Chunk)]),
    "not_": negate,
    "no_thing": _build_denied,
    "measured": _build_measured,
    "person": _build_person,
    "thing": _build_thing,
}


@lru_cache(maxsize=1)
def _parser() -> IslandParser[Clause]:
    text = files(__package__).joinpath("outdoor.lark").read_text("utf-8")
    return IslandParser(text, "clause", _BUILDERS, Clause, _SKIPPED)
