"""Inverted index over labels, looks and relations of what may be described of scenes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from math import log
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.graph import SceneGraph
from placegraph.errors import OptionError
from placegraph.indoor.language.appearance import COLUMNS, describe_objects, describe_room
from placegraph.indoor.language.likeness import (
    EXACT,
    Floats,
    Floats32,
    kind_by_name,
    kinds_of,
    likenesses,
    match_labels,
)
from placegraph.indoor.map.floor import STRUCTURE_WORDS, is_nameless, split_label
from placegraph.indoor.map.relations import NEXT_TO, SAME_ROOM, normalize_relation

Triple = tuple[str, str, str]
"""Label, relation by its canonical name and never turned, label."""
_PLAIN = 0.25
"""Frequency with which texts mention a wall, relative to a chair."""
_canonical = cache(normalize_relation)


@dataclass(frozen=True, slots=True, eq=False)
class DescriptionUnit:
    """A room, or a scene as a whole: what somebody may describe."""

    labels: dict[str, int]
    """Number of objects of each label."""
    triples: dict[Triple, int]
    """Maximum number of objects in this relation to one other object."""
    name: str = ""
    """Name of the room, where it has one."""
    is_scene: bool = False
    """Whether it is a scene of several rooms, which are units too."""
    undivided: bool = False
    """Whether nobody told its rooms apart."""
    appearance: dict[str, Floats] = field(default_factory=dict)
    """(C,) of each label how the things of that name look, each column the most of any of them."""
    room: Floats = field(default_factory=lambda: np.full(len(COLUMNS), np.nan))
    """(C,) of the room itself (`appearance.describe_room`)."""


def units(
    graph: SceneGraph, rooms: Sequence[str] = (), attributes: Sequence[Mapping[str, str]] = ()
) -> list[DescriptionUnit]:
    """Return the describable units of a scene: its rooms and, if there are several, the scene.

    `rooms`: (N,) name of the room of each object, empty where unknown; `attributes`: (N,) what else
    is known of them. Raises `OptionError` where there is not one for each object.
    """
    for what, given in (("rooms", rooms), ("attributes", attributes)):
        if len(given) not in (0, len(graph)):
            raise OptionError(
                f"{what}: {len(given)} values for {len(graph)} objects; give one per object."
            )
    groups = _group_rooms(graph, rooms)
    edges = list(triples(graph))
    if len(groups) <= 1:
        every = range(len(graph))  # with what lies between rooms
        name = groups[0][0] if groups else ""
        return [_unit(graph, every, edges, attributes, name, undivided=not groups)]
    out = []
    for name, rows in groups:
        inside = set(rows)
        out.append(_unit(graph, rows, [t for t in edges if t[0] in inside], attributes, name))
    whole = _unit(graph, range(len(graph)), edges, attributes, "")
    return [*out, replace(whole, is_scene=True)]


def _unit(
    graph: SceneGraph,
    rows: Sequence[int],
    edges: Sequence[tuple[int, str, int]],
    attributes: Sequence[Mapping[str, str]],
    name: str,
    *,
    undivided: bool = False,
) -> DescriptionUnit:
    labels = [graph.labels[row] for row in rows]
    looks: dict[str, Floats] = {}
    for label, own in zip(labels, describe_objects(graph, rows, attributes), strict=True):
        looks[label] = np.fmax(looks[label], own) if label in looks else own
    subjects: dict[tuple[str, str, int], set[int]] = {}
    for s, relation, t in edges:
        subjects.setdefault((graph.labels[s], relation, t), set()).add(s)
    counts: dict[Triple, int] = {}
    for (one, relation, t), found in subjects.items():
        key = (one, relation, graph.labels[t])
        counts[key] = max(counts.get(key, 0), len(found))
    return DescriptionUnit(
        dict(Counter(labels)), counts, name, undivided=undivided, appearance=looks,
        room=describe_room(graph, rows),
    )  # fmt: skip


def _group_rooms(graph: SceneGraph, rooms: Sequence[str]) -> list[tuple[str, list[int]]]:
    """Return name and objects of each room; none where nothing says which are together."""
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
    sources, targets = graph.sources[together].tolist(), graph.targets[together].tolist()
    for s, t in zip(sources, targets, strict=True):
        owner[root(s)] = root(t)
    found: dict[int, list[int]] = {}
    for row in {*sources, *targets}:
        found.setdefault(root(row), []).append(row)
    return [("", rows) for rows in found.values()]


def triples(graph: SceneGraph) -> Iterable[tuple[int, str, int]]:
    """Yield subject, relation by its canonical name, and target, of every edge that says where."""
    ends = zip(graph.sources.tolist(), graph.relations, graph.targets.tolist(), strict=True)
    for a, written, b in ends:
        name, turned = _canonical(written)
        if name == SAME_ROOM:
            continue
        yield (b, name, a) if turned else (a, name, b)
        if name == NEXT_TO or name.startswith("same "):
            yield b, name, a


class MatchCounts(NamedTuple):
    """Counts of the words that were asked for, in each unit (U,)."""

    exact: Floats
    """Number of objects with the label that was asked for."""
    kin: Floats
    """Number of objects with that label or a related one."""
    best: Floats32
    """Similarity of the best object."""
    entries: NDArray[np.int64]
    """Entries of the postings that fit at all."""


class Postings(NamedTuple):
    """In which units a word is, and how often: the entries of word w are starts[w] : starts[w + 1]."""

    starts: NDArray[np.int64]
    units: NDArray[np.int32]
    counts: Floats32

    @property
    def words(self) -> NDArray[np.int64]:
        """(E,) word of each entry."""
        return np.repeat(np.arange(len(self.starts) - 1), np.diff(self.starts))

    def count_matches(self, weights: Floats32, total: int) -> MatchCounts:
        """Count the words that each of `total` units has.

        `weights`: (W,) how well each word fits what is asked for.
        """
        words = np.flatnonzero(weights > 0.0)
        sizes = self.starts[words + 1] - self.starts[words]
        entries = np.arange(sizes.sum()) + np.repeat(
            self.starts[words] - np.cumsum(sizes) + sizes, sizes
        )
        rows, counts = self.units[entries], self.counts[entries]
        weight = weights[words].repeat(sizes)
        best = np.zeros(total, np.float32)
        np.maximum.at(best, rows, weight)
        exact = np.bincount(rows, counts * (weight >= EXACT), total).astype(np.float64)
        return MatchCounts(
            exact, np.bincount(rows, counts, total).astype(np.float64), best, entries
        )


class Columns(NamedTuple):
    """All units of an index, as arrays."""

    labels: tuple[str, ...]
    relations: tuple[str, ...]
    of_labels: Postings
    of_triples: Postings
    triples: NDArray[np.int64]
    """(T, 3) rows of labels, relations, labels: subject, how, and target of each."""
    appearance: Floats32
    """(E, C) looks of the entries of `of_labels` (`appearance.COLUMNS`)."""
    room_looks: Floats
    """(U, C) of the rooms."""
    much: Floats
    """(U,) how much there is to speak of."""
    rooms: Floats
    """(U, R) expected number of rooms of each kind (`likeness.table`)."""
    is_scene: NDArray[np.bool_]
    """(U,)"""
    scene: NDArray[np.int32]
    """(U,) row of the scene of each unit, ascending."""
    scenes: int
    """Number of scenes."""

    def match_labels(self, query: str) -> Floats32:
        """Return the similarity (L,) of the labels to the query."""
        return match_labels(query, self.labels)


def columns_of(scenes: Sequence[Sequence[DescriptionUnit]]) -> Columns:
    """Return the units of scenes as arrays."""
    flat = [unit for scene in scenes for unit in scene]
    label_row: dict[str, int] = {}
    triple_row: dict[Triple, int] = {}
    relation_row: dict[str, int] = {}
    of_labels = _postings([unit.labels for unit in flat], label_row)
    of_triples = _postings([unit.triples for unit in flat], triple_row)
    edges = [
        (label_row[a], relation_row.setdefault(r, len(relation_row)), label_row[b])
        for a, r, b in triple_row
    ]
    # looks in the order of the entries of the postings: by label, then by unit
    looks: dict[str, list[Floats]] = {label: [] for label in label_row}
    for unit in flat:
        for label in unit.labels:
            looks[label].append(unit.appearance.get(label, np.full(len(COLUMNS), np.nan)))
    entries = [own for listed in looks.values() for own in listed]
    scene = np.repeat(np.arange(len(scenes), dtype=np.int32), [len(s) for s in scenes])
    return Columns(
        labels=tuple(label_row),
        relations=tuple(relation_row),
        of_labels=of_labels,
        of_triples=of_triples,
        triples=np.array(edges, np.int64).reshape(-1, 3),
        appearance=np.array(entries, np.float32).reshape(-1, len(COLUMNS)),
        room_looks=np.array([unit.room for unit in flat]).reshape(-1, len(COLUMNS)),
        much=np.array(
            [  # many things of a kind are little more than one
                1.0
                + sum(
                    (1.0 + log(count)) * _spoken_of(label) for label, count in unit.labels.items()
                )
                for unit in flat
            ]
        ),
        rooms=_rooms(flat, tuple(label_row), of_labels, scene),
        is_scene=np.array([unit.is_scene for unit in flat], np.bool_),
        scene=scene,
        scenes=len(scenes),
    )


def _rooms(
    flat: Sequence[DescriptionUnit],
    labels: Sequence[str],
    of_labels: Postings,
    scene: NDArray[np.int32],
) -> Floats:
    """Return the expected number (U, R) of rooms of each kind; of a whole the sum of its rooms'."""
    held = [of_labels.count_matches(likeness, len(flat)).best for likeness in likenesses(labels).T]
    out = kinds_of(np.stack(held, axis=1), np.array([unit.undivided for unit in flat], np.bool_))
    for row, unit in enumerate(flat):
        if unit.name:
            out[row] = kind_by_name(unit.name, out[row])
    whole = np.array([unit.is_scene for unit in flat], np.bool_)
    for kind in range(out.shape[1]):
        sums = np.bincount(scene[~whole], out[~whole, kind], int(scene.max(initial=-1)) + 1)
        out[whole, kind] = sums[scene[whole]]
    return out


@cache
def _spoken_of(label: str) -> float:
    return (
        0.0 if is_nameless(label) else _PLAIN if split_label(label)[-1] in STRUCTURE_WORDS else 1.0
    )


def _postings(counts: Sequence[dict[Any, int]], row_of: dict[Any, int]) -> Postings:
    """Return postings of words by the units that have them; `row_of` is filled."""
    words = [row_of.setdefault(word, len(row_of)) for own in counts for word in own]
    many = [count for own in counts for count in own.values()]
    unit = np.repeat(np.arange(len(counts), dtype=np.int32), [len(own) for own in counts])
    word = np.array(words, np.int64)
    order = np.argsort(word, kind="stable")
    starts = np.searchsorted(word[order], np.arange(len(row_of) + 1))
    return Postings(starts, unit[order], np.array(many, np.float32)[order])
