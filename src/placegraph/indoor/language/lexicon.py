"""The English words of the grammar, from lexicon.toml, and the rooms, from rooms.toml."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from math import radians
from typing import TYPE_CHECKING

from placegraph.indoor.map.floor import label_words
from placegraph.language.phrases import Phrases, Terminal

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

_COUNTED = {"couple": 2, "pair": 2, "pairs": 4}


@dataclass(frozen=True, slots=True)
class Rooms:
    """Kinds of rooms."""

    kind_of: Mapping[tuple[str, ...], str]
    """Kind that words name."""
    usual: Mapping[str, float]
    """Share of each kind among the rooms of homes; they sum to 1."""
    holds: Mapping[str, Mapping[str, float]]
    """How probably a room of a kind holds such a thing, by what it is called."""


@cache
def english() -> Phrases:
    """The phrases of the grammar."""
    table = tomllib.loads(_file("lexicon.toml"))
    known: dict[tuple[str, ...], tuple[Terminal, ...]] = {}
    for section, entries in table.items():
        for key, phrases in entries.items():
            for phrase in phrases:
                words = tuple(phrase.split())
                known.setdefault(words, tuple(_terminals(section, key, words)))
    return Phrases(known)


def _terminals(section: str, key: str, words: Sequence[str]) -> Iterator[Terminal]:
    if section == "relations":
        yield Terminal("REL", key)
    elif section == "directions":
        yield Terminal("DIR", radians(float(key)))
    else:
        for terminal in key.split():
            yield Terminal(terminal, next((_COUNTED[w] for w in words if w in _COUNTED), None))


@cache
def rooms() -> Rooms:
    """The kinds of rooms that placegraph knows."""
    table = tomllib.loads(_file("rooms.toml"))
    names = {kind: [kind, *entry.get("names", [])] for kind, entry in table.items()}
    total = sum(entry["usual"] for entry in table.values())
    return Rooms(
        kind_of={tuple(name.split()): kind for kind, all_ in names.items() for name in all_},
        usual={kind: entry["usual"] / total for kind, entry in table.items()},
        holds={kind: entry["holds"] for kind, entry in table.items()},
    )


def room_kind(label: str) -> str:
    """Kind of room that a label names: its last words do; empty if it names none."""
    words = label_words(label)
    for last in (words[-1:], [words[-1].removesuffix("s")] if words else []):
        for n in (3, 2, 1):
            kind = rooms().kind_of.get((*words[-n:-1], *last)) if len(words) >= n else None
            if kind:
                return kind
    return ""


@cache
def attributes() -> frozenset[str]:
    """Words that say what a thing looks like, and not what it is."""
    return frozenset(_file("attributes.txt").split())


def _file(name: str) -> str:
    return files(__package__).joinpath("data", name).read_text("utf-8")
