"""What a scene graph says, by labels: what there is, how it lies, and in which kind of room."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING

from placegraph.errors import OptionError
from placegraph.indoor.map.relation_words import canonical
from placegraph.indoor.map.relations import NEXT_TO, SAME_ROOM

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from placegraph.graph import SceneGraph

Triple = tuple[str, str, str]
"""Label, relation by its canonical name and never turned, label."""


@dataclass(frozen=True, slots=True, eq=False)
class Unit:
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


def units(graph: SceneGraph, rooms: Sequence[str] = ()) -> list[Unit]:
    """What may be described of a scene: its rooms, and, where there are several, all of it.

    `rooms`: (N,) name of the room of each object, empty where unknown. Raises `OptionError` where
    there is not one for each object.
    """
    if len(rooms) not in (0, len(graph)):
        raise OptionError(f"rooms: {len(rooms)} names for {len(graph)} objects; give one for each.")
    groups = _groups(graph, rooms)
    all_ = list(triples(graph))
    if not groups:
        labels = Counter(graph.labels)
        return [Unit(dict(labels), _counted(all_, graph.labels), undivided=True)]
    out = []
    for name, rows in groups:
        labels = Counter(graph.labels[row] for row in rows)
        inside = set(rows)
        own = all_ if len(groups) == 1 else [t for t in all_ if t[0] in inside]
        out.append(Unit(dict(labels), _counted(own, graph.labels), name))
    if len(out) == 1:  # with what lies between rooms
        return [replace(out[0], labels=dict(Counter(graph.labels)))]
    return [*out, Unit(dict(Counter(graph.labels)), _counted(all_, graph.labels), whole=True)]


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
