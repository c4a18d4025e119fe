"""What is said of rooms in other languages than English: "in der Küche, am Fenster".

The outdoor parser knows the grammar of many languages. Of what it relates, things that stand in rooms
get their English words from a table, and its relations become statements of the inside.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from importlib.resources import files
from typing import TYPE_CHECKING

from placegraph.indoor.language.likeness import room_kind
from placegraph.indoor.language.sentence import Kind, Mention, Sentence, Statement
from placegraph.outdoor.language.description import LISTENER, SPEAKER, Relation

if TYPE_CHECKING:
    from placegraph.outdoor.language.description import Description
    from placegraph.outdoor.language.description import Statement as Outside
    from placegraph.world.outside import Words


ENDING = 2
"""Letters that a word may have behind the one of the table: "Fenstern", "Lampen"."""
_IN = (Relation.INSIDE, Relation.SAME)


def in_english(said: Description, town: Words) -> Description:
    """A description in which things of rooms have their English words; what the map names stays."""
    table = _tables().get(said.language)
    if table is None:
        return said
    mentions, known = list(said.mentions), set()
    for i, m in enumerate(said.mentions[LISTENER + 1 :], LISTENER + 1):
        word = _english(m.words, table)
        if word and not (m.name and town.name_index.named(m.name)):
            mentions[i] = replace(m, words=word, name="")
            known.add(m.words)
    ignored = tuple(i for i in said.ignored if i.text not in known)
    return replace(said, mentions=tuple(mentions), ignored=ignored)


def of_rooms(said: Description) -> Sentence:
    """What a description `in_english` says of rooms, as a sentence of the inside."""
    table = _tables().get(said.language, {})
    own = {
        m.id
        for m in said.mentions[LISTENER + 1 :]
        if m.words in table.values() or (table and room_kind(m.words) and not m.name)
    }
    things = [
        Mention(m.words, m.words, m.count, room=room_kind(m.words))
        for m in said.mentions[LISTENER + 1 :]
    ]
    told: dict[tuple[Kind, tuple[int, ...]], Statement] = {}
    for s in said.statements:
        for kind, ends in _told(s, own, things):
            rows = tuple(end - LISTENER - 1 for end in ends)
            relation = "next to" if kind is Kind.RELATED else ""
            new = Statement(
                kind, rows, relation, negated=s.negated, certainty=s.certainty, text=s.text
            )
            told.setdefault((kind, rows), new)
    return Sentence(said.text, tuple(things), tuple(told.values()))


def _told(s: Outside, own: set[int], things: list[Mention]) -> list[tuple[Kind, tuple[int, ...]]]:
    """What a statement says of things in rooms, by their mentions."""

    def room(node: int) -> bool:
        return node > LISTENER and bool(things[node - LISTENER - 1].room)

    ends = [n for n in (s.source, s.target) if n in own]
    if s.far or not ends:
        return []
    if len(ends) == 2:
        if room(s.target):
            return [(Kind.ROOM, (s.target,)), (Kind.HOLDS, (s.source,))]
        return [(Kind.RELATED, (s.source, s.target))] if s.relation is Relation.NEAR else [
            (Kind.HOLDS, (n,)) for n in ends
        ]  # fmt: skip
    if room(ends[0]):  # one is in it; the kitchen of the hotel says no more
        here = s.relation in _IN and s.source == SPEAKER
        return [(Kind.ROOM, (ends[0],))] if here else []
    if SPEAKER not in (s.source, s.target):
        return [(Kind.HOLDS, (ends[0],))]
    near = s.relation in (*_IN, Relation.NEAR)
    return [(Kind.NEAR if near else Kind.HOLDS, (ends[0],))]


def _english(words: str, table: Mapping[str, str]) -> str:
    """English word of the thing that words end with, whatever its case or number; empty: not known."""
    last = words.casefold().split()[-1:] or [""]
    fits = [w for w in table if last[0].startswith(w) and len(last[0]) - len(w) <= ENDING]
    if fits:
        return table[max(fits, key=len)]
    plain = words.casefold().removeprefix("the ")  # an answer to a question is English
    return plain if room_kind(plain) else ""


@lru_cache(maxsize=1)
def _tables() -> dict[str, dict[str, str]]:
    """By language: English words of things in rooms."""
    text = files("placegraph.world").joinpath("data", "things.tsv").read_text("utf-8")
    tables: dict[str, dict[str, str]] = {}
    for line in text.splitlines():
        if not line.startswith("#"):
            language, words, english = line.split("\t")
            tables.setdefault(language, {}).update(
                dict.fromkeys((word.strip() for word in words.split(",")), english)
            )
    return tables
