"""Outlines of rooms: made simple where they cross themselves, cut into triangles, found again."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geojson import nest_rings, orient_ring
from placegraph.core.geometry import Floats

LEAST_AREA = 0.05  # Of a ring that is kept [m2]
_TINY = 1e-9
_FLAT = 1e-4  # Twice the area of a triangle that is left out [m2]
_MOST_SPLITS = 200


def area(ring: Floats) -> float:
    """Return the area of a closed ring (n, 2) [m2], positive where it is counter-clockwise."""
    x, y = (ring - ring[0]).T
    return float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum()) / 2.0


def make_polygons(rings: Sequence[Floats]) -> list[list[Floats]]:
    """Make simple polygons of closed rings (n, 2) [m]: the outer ring, then its holes.

    An outer ring that crosses itself falls into those that it is made of, without holes; what is
    smaller than `LEAST_AREA` is dropped.
    """
    found = []
    for outer, *holes in nest_rings(rings):
        loops = untangle(rings[outer])
        if len(loops) == 1:
            inner = [loop for k in holes for loop in untangle(rings[k])]
            found.append([orient_ring(loops[0], 1.0), *(orient_ring(loop, -1.0) for loop in inner)])
        else:
            found.extend([orient_ring(loop, 1.0)] for loop in loops)
    return found


def untangle(ring: Floats) -> list[Floats]:
    """Cut a closed ring (n, 2) [m] into closed rings that neither cross nor touch themselves."""
    left, simple = [np.asarray(ring, np.float64)[:-1]], []
    for _ in range(_MOST_SPLITS):
        if not left:
            break
        loop = left.pop()
        crossing = _find_crossing(loop)
        if crossing is None:
            closed = np.concatenate([loop, loop[:1]])
            if len(loop) > 2 and abs(area(closed)) > LEAST_AREA:
                simple.append(closed)
            continue
        i, j, at = crossing
        parts = loop[i + 1 : j + 1], np.concatenate([loop[j + 1 :], loop[: i + 1]])
        left += [np.concatenate([[at], part[(part != at).any(axis=1)]]) for part in parts]
    return simple


def _find_crossing(loop: Floats) -> tuple[int, int, Floats] | None:
    """Find edges i < j of an open loop (n, 2) that cross or touch, and where; None: it is simple."""
    n = len(loop)
    for i in range(n):
        same = np.flatnonzero((loop[i + 1 :] == loop[i]).all(axis=1))
        if len(same):  # through one node twice
            return i - 1, i + int(same[0]), loop[i]
    ends = np.roll(loop, -1, axis=0)
    along = ends - loop
    for i in range(n - 2):
        rows = np.arange(i + 2, n - (i == 0))
        if not len(rows):
            continue

        away = loop[rows] - loop[i]
        turn = _cross(along[i], along[rows])
        with np.errstate(divide="ignore", invalid="ignore"):
            s, t = _cross(away, along[rows]) / turn, _cross(away, along[i]) / turn
        met = (
            (np.abs(turn) > _TINY)
            & (np.abs(s - 0.5) < 0.5 + _TINY)
            & (np.abs(t - 0.5) < 0.5 + _TINY)
        )
        met &= (np.abs(s - 0.5) < 0.5 - _TINY) | (np.abs(t - 0.5) < 0.5 - _TINY)
        if met.any():
            k = int(np.flatnonzero(met)[0])
            j = int(rows[k])
            at = loop[i] + s[k] * along[i]
            for share, nodes in ((s[k], (loop[i], ends[i])), (t[k], (loop[j], ends[j]))):
                if abs(share - round(share)) <= _TINY:  # a node on the other edge
                    at = nodes[round(share)]
            return i, j, at
    return None


def triangulate(rings: Sequence[Floats]) -> tuple[Floats, NDArray[np.int64]]:
    """Triangulate a simple polygon by clipping ears: points (V, 2), triangles (T, 3).

    `rings`: closed, the outer one counter-clockwise, holes clockwise; no point is added.
    """
    points = np.concatenate([ring[:-1] for ring in rings])
    starts = np.cumsum([0, *(len(ring) - 1 for ring in rings)])
    loops = [list(range(a, b)) for a, b in pairwise(starts.tolist())]
    loop = loops[0]
    for hole in sorted(loops[1:], key=lambda rows: -points[rows, 0].max()):
        edges = [*pairwise([*loop, loop[0]]), *pairwise([*hole, hole[0]])]
        start, end = points[[a for a, _ in edges]], points[[b for _, b in edges]]
        lengths = np.linalg.norm(points[loop][:, None] - points[hole][None], axis=2)
        for k in np.argsort(lengths, axis=None, kind="stable").tolist():
            i, j = divmod(k, len(hole))
            if not _is_crossed(points[loop[i]], points[hole[j]], start, end):
                break
        loop = [*loop[: i + 1], *hole[j:], *hole[: j + 1], *loop[i:]]
    return points, np.array(_clip_ears(points, loop), np.int64).reshape(-1, 3)


def _is_crossed(a: Floats, b: Floats, start: Floats, end: Floats) -> bool:
    """Return whether a segment crosses one of others, ends aside."""
    along, others = b - a, end - start
    turn = _cross(along, others)
    with np.errstate(divide="ignore", invalid="ignore"):
        s, t = _cross(start - a, others) / turn, _cross(start - a, along) / turn
    within = (s > _TINY) & (s < 1 - _TINY) & (t > -_TINY) & (t < 1 + _TINY)
    return bool((within & (np.abs(turn) > _TINY)).any())


def _clip_ears(points: Floats, loop: list[int]) -> list[tuple[int, int, int]]:
    ears: list[tuple[int, int, int]] = []
    loop, i, idle = list(loop), 0, 0
    while len(loop) > 2 and idle <= len(loop):
        i %= len(loop)
        corner = loop[i - 1], loop[i], loop[(i + 1) % len(loop)]
        a, b, c = points[list(corner)]
        doubled = float(_cross(b - a, c - b))
        flat = abs(doubled) <= _FLAT
        if flat or (doubled > 0 and not _contains_any(a, b, c, points[loop])):
            if not flat:
                ears.append(corner)
            loop.pop(i)
            i, idle = i - 1, 0
        else:
            i, idle = i + 1, idle + 1
    return ears


def _contains_any(a: Floats, b: Floats, c: Floats, points: Floats) -> bool:
    """Return whether a counter-clockwise triangle holds a point that is none of its corners."""
    own = (points == a).all(axis=1) | (points == b).all(axis=1) | (points == c).all(axis=1)
    sides = [_cross(q - p, points - p) for p, q in ((a, b), (b, c), (c, a))]
    return bool((~own & (np.min(sides, axis=0) >= -_TINY)).any())


def find_outlines(points: Floats, triangles: NDArray[np.int64]) -> list[Floats]:
    """Find closed rings around triangles (T, 3) seen from above: edges of one triangle only.

    `points`: (V, 2) [m]; those within 0.1 mm are one. Empty where the edges make no rings.
    """
    used = points[triangles].reshape(-1, 2)
    _, number = np.unique(np.rint(used * 1e4).astype(np.int64), axis=0, return_inverse=True)
    place = dict(zip(number.ravel().tolist(), used, strict=True))
    edges: Counter[tuple[int, int]] = Counter()
    for corners in number.reshape(-1, 3).tolist():
        a, b, c = (place[k] for k in corners)
        doubled = float(_cross(b - a, c - b))
        if abs(doubled) > 1e-8:
            turned = corners if doubled > 0 else corners[::-1]
            edges.update(pairwise([*turned, turned[0]]))
    after: dict[int, list[int]] = {}
    for (one, other), count in edges.items():
        for _ in range(count - edges.get((other, one), 0)):
            after.setdefault(one, []).append(other)
    return [_straighten(np.array([place[k] for k in way])) for way in _trace_rings(after)]


def trace_cells(mask: NDArray[np.bool_], origin: Floats, cell: float) -> list[Floats]:
    """Trace closed rings (n, 2) [m] around the set cells (nx, ny) of a grid, straightened to a cell's width.

    The largest first, counter-clockwise around cells, clockwise around holes; those below 0.5 m2
    are left out.
    """
    ny = mask.shape[1] + 1
    padded = np.pad(mask, 1)
    after: dict[int, list[int]] = {}
    # which neighbour is not set, and the side towards it, with the cell to its left
    for step, start, end in (
        ((0, -1), (0, 0), (1, 0)), ((1, 0), (1, 0), (1, 1)),
        ((0, 1), (1, 1), (0, 1)), ((-1, 0), (0, 1), (0, 0)),
    ):  # fmt: skip
        x, y = np.nonzero(mask & ~np.roll(padded, (-step[0], -step[1]), (0, 1))[1:-1, 1:-1])
        one, other = ((x + dx) * ny + y + dy for dx, dy in (start, end))
        for a, b in zip(one.tolist(), other.tolist(), strict=True):
            after.setdefault(a, []).append(b)
    rings = [
        _simplify_ring(origin + cell * np.stack(np.divmod(np.array(way), ny), axis=1), cell)
        for way in _trace_rings(after)
    ]
    large = [ring for ring in rings if len(ring) > 3 and abs(area(ring)) > 0.5]
    return sorted(large, key=lambda ring: -abs(area(ring)))


def _trace_rings(after: dict[int, list[int]]) -> list[list[int]]:
    """Trace closed ways along directed edges; empty where they make none."""
    ways = []
    while after:
        first = at = next(iter(after))
        way = [first]
        while at in after:
            following = after[at]
            at = following.pop()
            if not following:
                del after[way[-1]]
            way.append(at)
            if at == first:
                break
        if at != first:
            return []
        ways.append(way)
    return ways


def _simplify_ring(ring: Floats, tolerance: float) -> Floats:
    """Simplify a closed ring to a tolerance [m] (Douglas, Peucker)."""
    far = int(np.linalg.norm(ring - ring[0], axis=1).argmax())
    kept = np.zeros(len(ring), np.bool_)
    kept[[0, far, -1]] = True
    spans = [(0, far), (far, len(ring) - 1)]
    while spans:
        a, b = spans.pop()
        if b - a < 2:
            continue
        along = (ring[b] - ring[a]) / max(float(np.linalg.norm(ring[b] - ring[a])), 1e-9)
        away = ring[a + 1 : b] - ring[a]
        off = np.abs(along[0] * away[:, 1] - along[1] * away[:, 0])
        k = int(off.argmax())
        if off[k] > tolerance:
            kept[a + 1 + k] = True
            spans += [(a, a + 1 + k), (a + 1 + k, b)]
    return ring[kept]


def _straighten(ring: Floats) -> Floats:
    loop = ring[:-1]
    before, after = loop - np.roll(loop, 1, axis=0), np.roll(loop, -1, axis=0) - loop
    scale = np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
    kept = loop[np.abs(_cross(before, after)) > 1e-6 * scale]
    return np.concatenate([kept, kept[:1]])


def _cross(a: Floats, b: Floats) -> Floats:
    crossed: Floats = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return crossed
