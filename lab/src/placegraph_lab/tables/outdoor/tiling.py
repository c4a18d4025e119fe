"""Larger cities than there are files: copies of an extract side by side, their labels shuffled."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.random import Generator

from placegraph.core.geometry import Floats
from placegraph_lab.tables.outdoor.places import read_raw, tag_label

GAP = 0.005  # space between copies [deg]

Tags = dict[str, str]


@dataclass
class Extract:
    """Elements of an extract, referring to each other by row; missing members are left out."""

    lonlat: list[tuple[float, float]] = field(default_factory=list)
    node_tags: list[Tags] = field(default_factory=list)
    ways: list[list[int]] = field(default_factory=list)
    way_tags: list[Tags] = field(default_factory=list)
    relations: list[list[tuple[str, int, str]]] = field(default_factory=list)
    relation_tags: list[Tags] = field(default_factory=list)

    @classmethod
    def read(cls, path: Path) -> Extract:
        """Read a file."""
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


def shuffle_tags(tags: list[Tags], groups: list[object], rng: Generator) -> list[Tags]:
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


def tile(paths: Sequence[Path], out: Path, copies: int, seed: int) -> int:
    """Write copies of extracts in turn, on a square grid, as one extract; return its nodes.

    The first copy stands where the first extract does and keeps its tags. In every other one, tags are
    exchanged among nodes, among open ways, among closed ways and among relations of one type.
    Ways longer than the city are left out: they would run through the other copies.
    """
    import osmium
    from osmium.osm.mutable import Node, Relation, Way

    extracts = [Extract.read(path) for path in paths]
    cities = [read_raw(path) for path in paths]
    sizes = [np.ptp(c.plane.to_lonlat(c.center), axis=0) + GAP for c in cities]
    shifts = shifts_of(np.max(sizes, axis=0), copies)
    low = [np.array(e.lonlat).min(axis=0) for e in extracts]
    turns = [(extracts[k % len(paths)], k % len(paths)) for k in range(copies)]
    counts = [(len(e.lonlat), len(e.ways), len(e.relations)) for e, _ in turns]
    first = np.cumsum([(0, 0, 0), *counts], axis=0).tolist()  # of nodes, ways, relations
    groups = [
        ([None] * len(e.lonlat), [w[0] == w[-1] for w in e.ways],
         [tags.get("type") for tags in e.relation_tags])
        for e in extracts
    ]  # fmt: skip

    def tags_of(k: int, kind: int) -> list[Tags]:
        extract, which = turns[k]
        own = (extract.node_tags, extract.way_tags, extract.relation_tags)[kind]
        rng = np.random.default_rng([seed, k, kind])
        return own if k == 0 else shuffle_tags(own, list(groups[which][kind]), rng)

    # an extract lists all nodes, then all ways, then all relations, each by rising id
    with osmium.SimpleWriter(str(out), overwrite=True) as writer:
        for k, (extract, which) in enumerate(turns):
            at = (np.array(extract.lonlat) + (low[0] - low[which]) + shifts[k]).tolist()
            for i, (place, tags) in enumerate(zip(at, tags_of(k, 0), strict=True)):
                writer.add_node(Node(id=first[k][0] + i + 1, location=place, tags=tags))
        for k, (extract, which) in enumerate(turns):
            lonlat = np.array(extract.lonlat)
            for i, (refs, tags) in enumerate(zip(extract.ways, tags_of(k, 1), strict=True)):
                if (np.ptp(lonlat[refs], axis=0) < sizes[which]).all():
                    own = [first[k][0] + n + 1 for n in refs]
                    writer.add_way(Way(id=first[k][1] + i + 1, nodes=own, tags=tags))
        for k, (extract, _) in enumerate(turns):
            of = dict(zip("nwr", first[k], strict=True))
            for i, (members, tags) in enumerate(zip(extract.relations, tags_of(k, 2), strict=True)):
                moved = [(kind, of[kind] + ref + 1, role) for kind, ref, role in members]
                writer.add_relation(Relation(id=of["r"] + i + 1, members=moved, tags=tags))
    return int(first[-1][0])


def shifts_of(size: Floats, copies: int) -> Floats:
    """Return the places (copies, 2) of copies of a city of `size`, relative to the first [deg]."""
    side = int(np.ceil(np.sqrt(copies)))
    k = np.arange(copies)
    return np.asarray(np.stack([k % side, k // side], 1) * size)
