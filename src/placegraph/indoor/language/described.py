"""What may be described of a scene: its rooms, by what is in them and how it lies and looks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from placegraph.core.graph import SceneGraph
from placegraph.errors import OptionError
from placegraph.indoor.language.seen import COLUMNS, room_seen, seen
from placegraph.indoor.map.relations import NEXT_TO, SAME_ROOM
from placegraph.indoor.map.relations.words import canonical

Floats = NDArray[np.float64]


Triple = tuple[str, str, str]
"""Label, relation by its canonical name and never turned, label."""


@dataclass(frozen=True, slots=True, eq=False)
class Described:
    """A room, or a scene as a whole: what somebody may describe."""

    labels: dict[str, int]
    """How many things of each label."""
    triples: dict[Triple, int]
    """How many things at most lie so to one other."""
    name: str = ""
    """Of the room, where it has one."""
    whole: bool = False
    """Whether it is a scene of several rooms, which are units too."""
    undivided: bool = False
    """Whether nobody told its rooms apart."""
    looks: dict[str, Floats] = field(default_factory=dict)
    """(C,) of each label how the things of that name look, each column the most of any of them."""
    room: Floats = field(default_factory=lambda: np.full(len(COLUMNS), np.nan))
    """(C,) of the room itself (`seen.room_seen`)."""


def units(
    graph: SceneGraph, rooms: Sequence[str] = (), attributes: Sequence[Mapping[str, str]] = ()
) -> list[Described]:
    """What may be described of a scene: its rooms, and, where there are several, all of it.

    `rooms`: (N,) name of the room of each object, empty where unknown; `attributes`: (N,) what else
    is known of them. Raises `OptionError` where there is not one for each object.
    """
    for what, given in (("rooms", rooms), ("attributes", attributes)):
        if len(given) not in (0, len(graph)):
            raise OptionError(f"{what}: {len(given)} for {len(graph)} objects; give one for each.")
    groups = _groups(graph, rooms)
    all_ = list(triples(graph))
    if len(groups) <= 1:
        every = range(len(graph))  # with what lies between rooms
        name = groups[0][0] if groups else ""
        return [_unit(graph, every, all_, attributes, name, undivided=not groups)]
    out = []
    for name, rows in groups:
        inside = set(rows)
        out.append(_unit(graph, rows, [t for t in all_ if t[0] in inside], attributes, name))
    whole = _unit(graph, range(len(graph)), all_, attributes, "")
    return [*out, replace(whole, whole=True)]


def _unit(
    graph: SceneGraph,
    rows: Sequence[int],
    found: Sequence[tuple[int, str, int]],
    attributes: Sequence[Mapping[str, str]],
    name: str,
    *,
    undivided: bool = False,
) -> Described:
    labels = [graph.labels[row] for row in rows]
    looks: dict[str, Floats] = {}
    for label, own in zip(labels, seen(graph, rows, attributes), strict=True):
        looks[label] = np.fmax(looks[label], own) if label in looks else own
    return Described(
        dict(Counter(labels)), _counted(found, graph.labels), name, undivided=undivided,
        looks=looks, room=room_seen(graph, rows),
    )  # fmt: skip


def _groups(graph: SceneGraph, rooms: Sequence[str]) -> list[tuple[str, list[int]]]:
    """Name and objects of each room; none where nothing says which are together."""
    groups: dict[str, list[int]] = {}
    for row, name in enumerate(rooms):
        if name:
            groups.setdefault(name, []).append(row)
    if groups:
        return list(groups.items())
    owner = list(range(len(graph)))

    def root(i: int) -> int:
        while owner[i] != i:
            owner[i] = owner[owner[i]]
            i = owner[i]
        return i

    together = [j for j, r in enumerate(graph.relations) if _canonical(r)[0] == SAME_ROOM]
    for s, t in zip(
        graph.sources[together].tolist(), graph.targets[together].tolist(), strict=True
    ):
        owner[root(s)] = root(t)
    found: dict[int, list[int]] = {}
    for row in {*graph.sources[together].tolist(), *graph.targets[together].tolist()}:
        found.setdefault(root(row), []).append(row)
    return [("", rows) for rows in found.values()]


def triples(graph: SceneGraph) -> Iterable[tuple[int, str, int]]:
    """Subject, relation by its canonical name, and target, of every edge that says where."""
    ends = zip(graph.sources.tolist(), graph.relations, graph.targets.tolist(), strict=True)
    for a, written, b in ends:
        name, turned = _canonical(written)
        if name == SAME_ROOM:
            continue
        yield (b, name, a) if turned else (a, name, b)
        if name == NEXT_TO or name.startswith("same "):
            yield b, name, a


def _counted(found: Iterable[tuple[int, str, int]], labels: Sequence[str]) -> dict[Triple, int]:
    subjects: dict[tuple[str, str, int], set[int]] = {}
    for s, name, t in found:
        subjects.setdefault((labels[s], name, t), set()).add(s)
    out: dict[Triple, int] = {}
    for (one, name, t), rows in subjects.items():
        key = (one, name, labels[t])
        out[key] = max(out.get(key, 0), len(rows))
    return out


@cache
def _canonical(relation: str) -> tuple[str, bool]:
    return canonical(relation)
