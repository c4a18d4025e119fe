"""Larger cities than there are files: copies of an extract side by side, their labels shuffled."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from placegraph_lab.tables.outdoor.raw import read_raw, tag_label

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.random import Generator
    from numpy.typing import NDArray

    from placegraph.geometry import Floats

GAP = 0.005
"""Space between copies [deg]."""

Tags = dict[str, str]


@dataclass
class _Extract:
    """Elements of an extract, referring to each other by row; missing members are left out."""

    lonlat: list[tuple[float, float]] = field(default_factory=list)
    node_tags: list[Tags] = field(default_factory=list)
    ways: list[list[int]] = field(default_factory=list)
    way_tags: list[Tags] = field(default_factory=list)
    relations: list[list[tuple[str, int, str]]] = field(default_factory=list)
    relation_tags: list[Tags] = field(default_factory=list)

    @classmethod
    def read(cls, path: Path) -> _Extract:
        import osmium

        extract = cls()
        row: dict[tuple[str, int], int] = {}
        for o in osmium.FileProcessor(str(path)):
            tags = {t.k: t.v for t in o.tags}
            if isinstance(o, osmium.osm.Node):
                row["n", o.id] = len(extract.lonlat)
                extract.lonlat.append((o.lon, o.lat))
                extract.node_tags.append(tags)
            elif isinstance(o, osmium.osm.Way):
                refs = [row["n", n.ref] for n in o.nodes if ("n", n.ref) in row]
                if len(refs) > 1:
                    row["w", o.id] = len(extract.ways)
                    extract.ways.append(refs)
                    extract.way_tags.append(tags)
            elif isinstance(o, osmium.osm.Relation):
                members = [
                    (m.type, row[m.type, m.ref], m.role)
                    for m in o.members
                    if (m.type, m.ref) in row
                ]
                if members:
                    extract.relations.append(members)
                    extract.relation_tags.append(tags)
        return extract


def _shuffled(tags: list[Tags], groups: list[object], rng: Generator) -> list[Tags]:
    """Exchange tags among the objects of a group; what is no object keeps its tags."""
    rows: dict[object, list[int]] = {}
    for i, (own, group) in enumerate(zip(tags, groups, strict=True)):
        if tag_label(own):
            rows.setdefault(group, []).append(i)
    result = list(tags)
    for members in rows.values():
        for i, j in zip(members, rng.permutation(members).tolist(), strict=True):
            result[i] = tags[j]
    return result


def tile(path: Path, out: Path, copies: int, rng: Generator) -> None:
    """Write `copies` copies of an extract, laid out on a square grid, as one extract.

    The first copy stands where the extract does and keeps its tags. In every other one, tags are
    exchanged among nodes, among open ways, among closed ways and among relations of one type.
    Ways longer than the city are left out: they would run through the other copies.
    """
    import osmium
    from osmium.osm.mutable import Node, Relation, Way

    extract = _Extract.read(path)
    lonlat = np.array(extract.lonlat)
    city = read_raw(path)
    size = np.ptp(city.plane.to_lonlat(city.center), axis=0) + GAP
    shifts = _shifts(size, copies)
    short = [bool((np.ptp(lonlat[refs], axis=0) < size).all()) for refs in extract.ways]
    closed: list[object] = [refs[0] == refs[-1] for refs in extract.ways]
    types: list[object] = [tags.get("type") for tags in extract.relation_tags]
    tags = [
        (extract.node_tags, extract.way_tags, extract.relation_tags)
        if k == 0
        else (
            _shuffled(extract.node_tags, [None] * len(lonlat), rng),
            _shuffled(extract.way_tags, closed, rng),
            _shuffled(extract.relation_tags, types, rng),
        )
        for k in range(copies)
    ]
    nodes, ways, relations = len(lonlat), len(extract.ways), len(extract.relations)
    first = {"n": nodes, "w": ways, "r": relations}
    # an extract lists all nodes, then all ways, then all relations, each by rising id
    with osmium.SimpleWriter(str(out), overwrite=True) as writer:
        for k, shift in enumerate(shifts):
            for i, at in enumerate((lonlat + shift).tolist()):
                writer.add_node(Node(id=k * nodes + i + 1, location=at, tags=tags[k][0][i]))
        for k in range(copies):
            for i, refs in enumerate(extract.ways):
                if not short[i]:
                    continue
                own = [k * nodes + n + 1 for n in refs]
                writer.add_way(Way(id=k * ways + i + 1, nodes=own, tags=tags[k][1][i]))
        for k in range(copies):
            for i, members in enumerate(extract.relations):
                moved = [(t, k * first[t] + ref + 1, role) for t, ref, role in members]
                writer.add_relation(
                    Relation(id=k * relations + i + 1, members=moved, tags=tags[k][2][i])
                )


def _shifts(size: Floats, copies: int) -> Floats:
    """Where the copies (copies, 2) of a city of `size` stand, relative to the first [deg]."""
    side = int(np.ceil(np.sqrt(copies)))
    k = np.arange(copies)
    return np.asarray(np.stack([k % side, k // side], 1) * size)


class _Copied:
    """An extract that is written again and again, its tags exchanged anew each time."""

    def __init__(self, path: Path) -> None:
        self.extract = e = _Extract.read(path)
        self.lonlat = np.array(e.lonlat)
        self.low, self.high = np.percentile(self.lonlat, (1, 99), axis=0)
        near = (self.lonlat >= self.low - GAP) & (self.lonlat <= self.high + GAP)
        self.inside = near.all(axis=1)
        self.ways = [bool(self.inside[refs].all()) for refs in e.ways]
        self.tags = (e.node_tags, e.way_tags, e.relation_tags)
        self.counts = tuple(map(len, self.tags))
        self.groups = (
            _groups(e.node_tags, [None] * len(e.node_tags)),
            _groups(e.way_tags, [refs[0] == refs[-1] for refs in e.ways]),
            _groups(e.relation_tags, [tags.get("type") for tags in e.relation_tags]),
        )

    def drawn(self, kind: int, rng: Generator) -> list[Tags]:
        """Tags of all nodes, ways or relations of one copy."""
        result = list(self.tags[kind])
        for members in self.groups[kind]:
            for i, j in zip(members.tolist(), rng.permutation(members).tolist(), strict=True):
                result[i] = self.tags[kind][j]
        return result


def country(paths: Sequence[Path], out: Path, copies: int, seed: int) -> int:
    """Write copies of extracts in turn, side by side, as one extract of any size; how many nodes.

    Memory holds each extract once. Tags are exchanged as by `tile`, in every copy anew. What lies
    far from the middle 98 % of an extract's nodes is left out.
    """
    import osmium
    from osmium.osm.mutable import Node, Relation, Way

    copied = [_Copied(path) for path in paths]
    size = np.max([c.high - c.low for c in copied], axis=0) + GAP
    shifts = _shifts(size, copies)
    shifts += (10.0, 48.0) - shifts.mean(axis=0)
    turns = [copied[k % len(copied)] for k in range(copies)]
    firsts = 1 + np.cumsum([(0, 0, 0), *(c.counts for c in turns)], axis=0)[:-1]
    rngs = [[np.random.default_rng((seed, k, kind)) for kind in range(3)] for k in range(copies)]
    written = 0
    with osmium.SimpleWriter(str(out), overwrite=True) as writer:
        for c, (first, _, _), shift, rng in zip(turns, firsts.tolist(), shifts, rngs, strict=True):
            at, tags = (c.lonlat + (shift - c.low)).tolist(), c.drawn(0, rng[0])
            rows = np.flatnonzero(c.inside).tolist()
            written += len(rows)
            for i in rows:
                writer.add_node(Node(id=first + i, location=at[i], tags=tags[i]))
        for c, (node, first, _), rng in zip(turns, firsts.tolist(), rngs, strict=True):
            tags = c.drawn(1, rng[1])
            for i, refs in enumerate(c.extract.ways):
                if c.ways[i]:
                    own = [node + n for n in refs]
                    writer.add_way(Way(id=first + i, nodes=own, tags=tags[i]))
        for c, base, rng in zip(turns, firsts.tolist(), rngs, strict=True):
            tags = c.drawn(2, rng[2])
            for i, members in enumerate(c.extract.relations):
                moved = [(t, base["nwr".index(t)] + ref, role) for t, ref, role in members]
                writer.add_relation(Relation(id=base[2] + i, members=moved, tags=tags[i]))
    return written


def _groups(tags: list[Tags], kinds: list[object]) -> list[NDArray[np.int64]]:
    """Rows of objects of one kind each."""
    rows: dict[object, list[int]] = {}
    for i, (own, kind) in enumerate(zip(tags, kinds, strict=True)):
        if tag_label(own):
            rows.setdefault(kind, []).append(i)
    return [np.array(members) for members in rows.values()]
