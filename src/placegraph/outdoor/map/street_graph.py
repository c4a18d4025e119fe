"""Graph of the streets of a map: junctions, and directed edges between them.

Streets lose their common points when a map is built. The graph is derived from their geometry: streets
are cut where they cross or touch. A map file stores nothing of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats, bearing, wrap_angle
from placegraph.outdoor.map.objects import LINE, POINT, CityObjects

Rows = NDArray[np.int64]

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
        rows = walked[objects.kind[walked] == LINE]
        parts = [
            (row, line.astype(np.float64)) for row in rows.tolist() for line in objects.parts(row)
        ]
        street = np.array([row for row, line in parts if len(line) > 1], np.int64)
        lines = [line for _, line in parts if len(line) > 1]
        along = [np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(p, axis=0).T)))) for p in lines]
        owner, where = _cut(lines, along, np.isin(street, apart))
        at = [_interpolate(lines[i], along[i], s) for i, s in zip(owner, where, strict=True)]
        ends = np.array(at).reshape(-1, 2)
        node = _components(*join(ends, ends, TOUCH), len(ends))
        count = np.bincount(node)
        nodes = np.column_stack([np.bincount(node, c) / count for c in ends.T])
        k = np.flatnonzero((np.diff(owner, append=-1) == 0) & (np.diff(node, append=-1) != 0))
        tail = np.column_stack([node[k], node[k + 1]]).reshape(-1)
        head = np.column_stack([node[k + 1], node[k]]).reshape(-1)
        length = np.repeat(where[k + 1] - where[k], 2)
        own = np.repeat(street[owner[k]], 2)
        named = np.diff(objects.name_starts)[own] > 0
        name = np.full(len(own), -1, np.int64)
        name[named] = objects.name_values[objects.name_starts[own[named]]]
        samples = [
            _interpolate(lines[i], along[i], np.linspace(a, b, int(np.ceil((b - a) / SAMPLE)) + 1))
            for i, a, b in zip(owner[k], where[k], where[k + 1], strict=True)
        ]
        ahead = [np.gradient(p, axis=0) for p in samples]
        near = [min(len(p) - 1, 3) for p in samples]  # some metres give the direction of an end
        leaving = [
            d for p, n in zip(samples, near, strict=True) for d in (p[n] - p[0], p[-1 - n] - p[-1])
        ]
        junction = _group(tail, head, length, name, len(nodes))
        return cls(
            nodes, junction, _find_lights(objects, nodes, junction), tail, head, length, name,
            *_continue(tail, head, name, bearing(np.array(leaving).reshape(-1, 2))),
            np.cumsum([0, *map(len, samples)]), np.concatenate([np.zeros((0, 2)), *samples]),
            np.concatenate([np.zeros((0, 2)), *ahead]),
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


def expand(first: Rows, count: Rows) -> tuple[Rows, Rows]:
    """Return the owner and the value of all entries of ranges (n,) by their begin and length."""
    own = np.repeat(np.arange(len(first)), count)
    return own, np.arange(len(own)) - np.repeat(np.cumsum(count) - count - first, count)


def join(a: Floats, b: Floats, reach: float) -> tuple[Rows, Rows]:
    """Return all pairs of rows of points (N, 2) and (M, 2) that lie within `reach` of each other."""

    def keys(cells: Floats) -> Rows:
        return (cells[:, 0].astype(np.int64) << 32) + cells[:, 1].astype(np.int64)

    order = np.argsort(keys(np.floor(b / reach)), kind="stable")
    sorted_keys = keys(np.floor(b / reach))[order]
    i, j = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for shift in np.ndindex(3, 3):
        key = keys(np.floor(a / reach) + shift - 1)
        first, last = np.searchsorted(sorted_keys, key), np.searchsorted(sorted_keys, key, "right")
        own, at = expand(first, last - first)
        near = ((a[own] - b[order[at]]) ** 2).sum(axis=1) <= reach**2
        i.append(own[near])
        j.append(order[at[near]])
    return np.concatenate(i), np.concatenate(j)


def find_labelled(objects: CityObjects, labels: frozenset[str]) -> Rows:
    """Find the rows of objects that bear one of some labels."""
    wanted = [i for i, label in enumerate(objects.labels) if label in labels]
    hits = np.flatnonzero(np.isin(objects.label_values, wanted))
    return np.unique(np.searchsorted(objects.label_starts, hits, "right") - 1)


def _interpolate(line: Floats, along: Floats, at: Floats | float) -> Floats:
    return np.stack([np.interp(at, along, line[:, 0]), np.interp(at, along, line[:, 1])], axis=-1)


def _cut(lines: list[Floats], along: list[Floats], apart: NDArray[np.bool_]) -> tuple[Rows, Floats]:
    """Cut lines where they meet: the line of every cut, and the distance along it, in order."""
    total = np.array([s[-1] for s in along])
    pieces = [np.union1d(s, np.arange(0.0, s[-1], PIECE)) for s in along]
    line = np.repeat(np.arange(len(lines)), [len(at) - 1 for at in pieces])
    points = [_interpolate(*each) for each in zip(lines, along, pieces, strict=True)]
    begin = np.concatenate([np.zeros(0), *(at[:-1] for at in pieces)])
    p = np.concatenate([np.zeros((0, 2)), *(each[:-1] for each in points)])
    way = np.concatenate([np.zeros((0, 2)), *(np.diff(each, axis=0) for each in points)])
    i, j = join(p + way / 2.0, p + way / 2.0, PIECE + 2.0 * TOUCH)
    i, j = i[line[i] < line[j]], j[line[i] < line[j]]
    u, v, w = way[i], way[j], p[j] - p[i]
    cross, size = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0], np.hypot(*way.T)
    slanted = np.abs(cross) > 0.1 * size[i] * size[j]
    i, j, u, v, w, cross = (x[slanted] for x in (i, j, u, v, w, cross))
    s = (w[:, 0] * v[:, 1] - w[:, 1] * v[:, 0]) / cross * size[i]
    t = (w[:, 0] * u[:, 1] - w[:, 1] * u[:, 0]) / cross * size[j]
    met = (s >= -TOUCH) & (s <= size[i] + TOUCH) & (t >= -TOUCH) & (t <= size[j] + TOUCH)
    owners, cuts = [np.arange(len(lines))] * 2, [np.zeros(len(lines)), total]
    places = [(line[k], np.clip(begin[k] + x, 0.0, total[line[k]])) for k, x in ((i, s), (j, t))]
    for k, x in places:  # a bridge meets other streets at its ends alone
        met &= ~(apart[k] & (np.minimum(x, total[k] - x) > 5.0 * TOUCH))
    for k, x in places:
        owners.append(k[met])
        cuts.append(x[met])
    owner, where = np.concatenate(owners).astype(np.int64), np.concatenate(cuts)
    order = np.lexsort((where, owner))
    return owner[order], where[order]


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
