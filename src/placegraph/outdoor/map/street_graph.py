"""Graph of the streets of a map: junctions, directed edges between them, and blocks.

Streets lose their common points when a map is built. The graph is derived from their geometry: streets
are cut where they cross or touch. A map file stores nothing of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats, bearing, wrap_angle
from placegraph.outdoor.map.objects import (
    LINE,
    POINT,
    CityObjects,
    Lines,
    Rows,
    expand,
    find_labelled,
    join,
)

_ROADS = ("trunk", "primary", "secondary", "tertiary")
_WALKED = (*_ROADS, *(f"{road}_link" for road in _ROADS), "residential", "unclassified", "living_street",
           "pedestrian")  # fmt: skip
WALKED = frozenset(f"highway={kind}" for kind in _WALKED)
"""Streets that a way is told along."""
LIGHTS = frozenset(("highway=traffic_signals", "crossing=traffic_signals"))
APART = frozenset(("bridge=yes", "bridge=viaduct", "tunnel=yes", "tunnel=building_passage"))
"""Labels of streets that cross others without meeting them."""
TOUCH = 2.0
"""Streets that come so near meet [m]."""
WIDE = 40.0
"""Largest width of a junction: the carriageways of one street meet another within this distance [m]."""
LIGHT_REACH = 30.0
"""Largest distance of a traffic light from a node of its junction [m]."""
PIECE = 60.0
"""Length of the pieces in which crossings are sought [m]."""
SAMPLE = 5.0
"""Distance of the samples of an edge [m]."""
STRAIGHT, SAME_STREET = np.deg2rad(50.0), np.deg2rad(20.0)
"""Largest turn of somebody who goes straight on, and the advantage of an edge of the same name [rad]."""


@dataclass(frozen=True, eq=False)
class StreetGraph:
    """Directed street edges (E,); edges 2 i and 2 i + 1 are the two directions of one."""

    nodes: Floats
    """(V, 2) east, north [m]."""
    junction: Rows
    """(V,) junction of every node: carriageways of one street share theirs; -1 where streets only bend."""
    lights: NDArray[np.bool_]
    """(J,) whether a junction has traffic lights; all have where the map knows of none."""
    tail: Rows
    """(E,) node where an edge begins ..."""
    head: Rows
    """(E,) ... and where it ends."""
    length: Floats
    """(E,) [m]"""
    name: Rows
    """(E,) row of its name in the map's names; -1 without one."""
    straight: Rows
    """(E,) edge that goes straight on; -1 where none does."""
    turn_starts: Rows
    """(E + 1,) bounds of the edges that one may turn into at the end of an edge ..."""
    turn_edges: Rows
    """... these edges ..."""
    turn_angles: Floats
    """... and the angle of the turn [rad, clockwise]."""
    sample_starts: Rows
    """(E / 2 + 1,) bounds of the samples of the even edges ..."""
    points: Floats
    """... their positions (K, 2), equally spaced from end to end of the edge [m] ..."""
    ahead: Floats
    """... and the direction of the edge there (K, 2)."""

    @classmethod
    def of_objects(cls, objects: CityObjects) -> StreetGraph:
        """Derive the graph from the streets among the objects of a map."""
        walked, apart = find_labelled(objects, WALKED), find_labelled(objects, APART)
        lines = Lines.of_objects(objects, walked[objects.kind[walked] == LINE])
        where = _cut(lines, np.isin(lines.row, apart))
        line, ends = lines.find_line(where), lines.locate(where)
        node = _components(*join(ends, ends, TOUCH), len(ends))
        count = np.bincount(node)
        nodes = np.column_stack([np.bincount(node, c) / count for c in ends.T])
        k = np.flatnonzero((np.diff(line, append=-1) == 0) & (np.diff(node, append=-1) != 0))
        tail = np.column_stack([node[k], node[k + 1]]).reshape(-1)
        head = np.column_stack([node[k + 1], node[k]]).reshape(-1)
        length = np.repeat(where[k + 1] - where[k], 2)
        own = np.repeat(lines.row[line[k]], 2)
        named = np.diff(objects.name_starts)[own] > 0
        name = np.full(len(own), -1, np.int64)
        name[named] = objects.name_values[objects.name_starts[own[named]]]
        edge, points, ahead = lines.sample(SAMPLE, np.column_stack([where[k], where[k + 1]]))
        starts = np.searchsorted(edge, np.arange(len(k) + 1))
        first, last = starts[:-1], starts[1:] - 1
        near = np.minimum(last - first, 3)  # some metres give the direction of an end
        leaving = [points[first + near] - points[first], points[last - near] - points[last]]
        junction = _group(tail, head, length, name, len(nodes))
        return cls(
            nodes, junction, _find_lights(objects, nodes, junction), tail, head, length, name,
            *_continue(tail, head, name, bearing(np.stack(leaving, axis=1).reshape(-1, 2))),
            starts, points, ahead,
        )  # fmt: skip

    def sample(self, edges: Rows) -> tuple[Rows, Rows, Floats]:
        """Sample directed edges (n,): the number of the edge, the sample, and the distance along it [m].

        Samples are in the order of the edge.
        """
        first, last = self.sample_starts[edges >> 1], self.sample_starts[(edges >> 1) + 1]
        own, at = expand(np.zeros(len(edges), np.int64), last - first)
        back = edges[own] & 1 == 1
        along = self.length[edges[own]] * at / (last - first - 1)[own]
        return own, np.where(back, last[own] - 1 - at, first[own] + at), along


def _cut(lines: Lines, apart: NDArray[np.bool_]) -> Floats:
    """Cut lines where they meet, and at their ends; return the places of all cuts in order [m]."""
    first, last = lines.ends.T
    breaks = np.union1d(lines.along, np.arange(0.0, lines.along[-1:].sum(), PIECE))
    piece = lines.find_line(breaks[:-1])
    whole = (piece >= 0) & (breaks[1:] <= last[piece])
    begin, line = breaks[:-1][whole], piece[whole]
    p = lines.locate(begin)
    way = lines.locate(breaks[1:][whole]) - p
    i, j = join(p + way / 2.0, p + way / 2.0, PIECE + 2.0 * TOUCH)
    i, j = i[line[i] < line[j]], j[line[i] < line[j]]
    u, v, w = way[i], way[j], p[j] - p[i]
    cross, size = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0], np.hypot(*way.T)
    slanted = np.abs(cross) > 0.1 * size[i] * size[j]
    i, j, u, v, w, cross = (x[slanted] for x in (i, j, u, v, w, cross))
    s = (w[:, 0] * v[:, 1] - w[:, 1] * v[:, 0]) / cross * size[i]
    t = (w[:, 0] * u[:, 1] - w[:, 1] * u[:, 0]) / cross * size[j]
    met = (s >= -TOUCH) & (s <= size[i] + TOUCH) & (t >= -TOUCH) & (t <= size[j] + TOUCH)
    places = [(line[k], np.clip(begin[k] + x, *lines.ends[line[k]].T)) for k, x in ((i, s), (j, t))]
    for k, x in places:  # a bridge meets other streets at its ends alone
        met &= ~(apart[k] & (np.minimum(x - first[k], last[k] - x) > 5.0 * TOUCH))
    return np.sort(np.concatenate([first, last, *(x[met] for _, x in places)]))


def _components(i: Rows, j: Rows, count: int) -> Rows:
    """Number the connected components of a graph of `count` nodes with edges (i, j)."""
    label, before = np.arange(count), np.full(count, -1)
    while (label != before).any():
        before = label.copy()
        np.minimum.at(label, i, before[j])
        np.minimum.at(label, j, before[i])
        label = label[label]
    return np.unique(label, return_inverse=True)[1].reshape(-1).astype(np.int64)


def _group(tail: Rows, head: Rows, length: Floats, name: Rows, count: int) -> Rows:
    """Group nodes (V,) into junctions; -1 where fewer than three edges meet."""
    names: list[set[int]] = [set() for _ in range(count)]
    for node, value in zip(tail.tolist(), name.tolist(), strict=True):
        names[node].add(value)
    shared = [
        bool(names[a] & names[b] - {own, -1})
        for a, b, own in zip(tail.tolist(), head.tolist(), name.tolist(), strict=True)
    ]
    inner = (length < 5.0 * TOUCH) | ((length <= WIDE) & np.array(shared, np.bool_))
    group = _components(tail[inner], head[inner], count)
    is_junction = np.bincount(group[tail[~inner]], minlength=group.max(initial=-1) + 1) > 2
    return np.where(is_junction, np.cumsum(is_junction) - 1, -1)[group]


def _continue(
    tail: Rows, head: Rows, name: Rows, leaving: Floats
) -> tuple[Rows, Rows, Rows, Floats]:
    """Find the edge straight on from every edge, and (as CSR) all that one may turn into, with angles."""
    order = np.argsort(tail, kind="stable")
    first, last = (np.searchsorted(tail[order], head, side) for side in ("left", "right"))
    own, at = expand(first, last - first)
    own, to = own[order[at] != own ^ 1], order[at][order[at] != own ^ 1]
    turn = wrap_angle(leaving[to] - leaving[own ^ 1] - np.pi)
    count = np.bincount(own, minlength=len(tail))
    same = (name[to] == name[own]) & (name[to] >= 0)
    off = np.where(count[own] == 1, 0.0, np.abs(turn) - SAME_STREET * same)
    straight = np.full(len(tail), -1, np.int64)
    best = np.argsort(-off, kind="stable")
    best = best[off[best] <= STRAIGHT]
    straight[own[best]] = to[best]  # the last one stays
    return straight, np.concatenate(([0], np.cumsum(count))), to, turn


def _find_lights(objects: CityObjects, nodes: Floats, junction: Rows) -> NDArray[np.bool_]:
    """Find the junctions (J,) with traffic lights; all where the map knows of no lights."""
    rows = find_labelled(objects, LIGHTS)
    lamps = objects.center[rows[objects.kind[rows] == POINT]].astype(np.float64)
    found = np.zeros(junction.max(initial=-1) + 1, np.bool_)
    near = junction[join(lamps, nodes, LIGHT_REACH)[1]]
    found[near[near >= 0]] = True
    return found if len(lamps) else ~found


USUAL = 100.0
"""Metres in a block where the map has too few streets to tell."""
SHORTEST, LONGEST = 40.0, 600.0
"""Junctions nearer than this are one, and further apart than that end no block [m]."""
MAX_BENDS = 24
"""Largest number of edges of a block."""
ENOUGH = 24
"""A length is told from at least so many blocks, each counted in both directions."""
REGULAR = 0.4
"""Mean of the fourfold direction of blocks from which the streets make a grid; 1 in a perfect one."""


class Blocks(NamedTuple):
    """Length of a block along the two axes of a street grid."""

    axis: float = 0.0
    """Bearing of the first axis [rad], in (-pi/4, pi/4]; the second is at a right angle."""
    first: float = USUAL
    """Length along the first axis, the one nearer to north [m]."""
    second: float = USUAL
    """Length along the second [m]."""

    def length(self, bearing: float | None) -> float:
        """Return the length of a block [m] in a direction [rad], or the mean length for None."""
        if bearing is None:
            return float(np.sqrt(self.first * self.second))
        along = abs(np.cos(bearing - self.axis)) >= np.sqrt(0.5)
        return self.first if along else self.second

    @classmethod
    def measure(cls, graph: StreetGraph) -> Blocks:
        """Measure the usual distances between neighbouring junctions of the named streets."""
        starts = graph.junction[graph.tail]
        first = np.flatnonzero((starts >= 0) & (graph.name >= 0))
        edge, ends = first, np.append(graph.junction[graph.head], -2)
        for _ in range(MAX_BENDS):
            bends = (ends[edge] == -1) | (ends[edge] == starts[first])
            edge = np.where(bends, graph.straight[edge], edge)
        done = ends[edge] >= 0
        gaps = graph.nodes[graph.head[edge[done]]] - graph.nodes[graph.tail[first[done]]]
        length = np.hypot(*gaps.T)
        gaps = gaps[(length >= SHORTEST) & (length <= LONGEST)]
        if len(gaps) < ENOUGH:
            return cls()
        length, angle = np.hypot(*gaps.T), np.arctan2(*gaps.T)
        fourfold = np.mean(np.exp(4j * angle))
        if abs(fourfold) < REGULAR:
            return cls(0.0, *[_trimmed_mean(length)] * 2)
        axis = float(np.angle(fourfold)) / 4.0
        along = np.abs(np.cos(angle - axis)) >= np.sqrt(0.5)
        lengths = [
            _trimmed_mean(length[rows] if rows.sum() >= ENOUGH else length)
            for rows in (along, ~along)
        ]
        return cls(axis, *lengths)


def _trimmed_mean(lengths: Floats) -> float:
    """Return the interquartile mean."""
    quarter = len(lengths) // 4
    return float(np.sort(lengths)[quarter : len(lengths) - quarter].mean())
