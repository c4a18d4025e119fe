"""Larger cities than there are files: copies of an extract side by side, their labels shuffled."""

from __future__ import annotations

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
        """Of a file."""
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


def shuffled(tags: list[Tags], groups: list[object], rng: Generator) -> list[Tags]:
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

    extract = Extract.read(path)
    lonlat = np.array(extract.lonlat)
    city = read_raw(path)
    size = np.ptp(city.plane.to_lonlat(city.center), axis=0) + GAP
    shifts = shifts_of(size, copies)
    short = [bool((np.ptp(lonlat[refs], axis=0) < size).all()) for refs in extract.ways]
    closed: list[object] = [refs[0] == refs[-1] for refs in extract.ways]
    types: list[object] = [tags.get("type") for tags in extract.relation_tags]
    tags = [
        (extract.node_tags, extract.way_tags, extract.relation_tags)
        if k == 0
        else (
            shuffled(extract.node_tags, [None] * len(lonlat), rng),
            shuffled(extract.way_tags, closed, rng),
            shuffled(extract.relation_tags, types, rng),
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


def shifts_of(size: Floats, copies: int) -> Floats:
    """Where the copies (copies, 2) of a city of `size` stand, relative to the first [deg]."""
    side = int(np.ceil(np.sqrt(copies)))
    k = np.arange(copies)
    return np.asarray(np.stack([k % side, k // side], 1) * size)
