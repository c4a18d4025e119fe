"""Compiled parts of `nearby`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.core.jit import kernel
from placegraph_lab.tables.outdoor.places import Ints

# mypy: allow-untyped-defs, allow-incomplete-defs


BIN = 50.0  # edge of the bins that segments are looked up by [m]


@kernel
def _rasterize(segments: Floats, low: Floats, nx: int, ny: int) -> tuple[Ints, Ints]:
    bins, passing = [], []
    for s in range(len(segments)):
        ax, ay, bx, by = segments[s]
        steps = int(np.hypot(bx - ax, by - ay) / BIN) + 1
        for k in range(steps):
            x0, x1 = ax + (bx - ax) * k / steps, ax + (bx - ax) * (k + 1) / steps
            y0, y1 = ay + (by - ay) * k / steps, ay + (by - ay) * (k + 1) / steps
            i0, i1 = int((min(x0, x1) - low[0]) / BIN), int((max(x0, x1) - low[0]) / BIN)
            j0, j1 = int((min(y0, y1) - low[1]) / BIN), int((max(y0, y1) - low[1]) / BIN)
            for i in range(i0, min(i1, nx - 1) + 1):
                for j in range(j0, min(j1, ny - 1) + 1):
                    bins.append(i * ny + j)
                    passing.append(s)
    return np.array(bins, np.int64), np.array(passing, np.int64)


@kernel
def holds(x: float, y: float, segments: Floats) -> bool:
    """Whether (x, y) lies within rings given by their segments (even-odd rule)."""
    odd = False
    for s in range(len(segments)):
        ax, ay, bx, by = segments[s]
        if (ay > y) != (by > y) and x < ax + (bx - ax) * (y - ay) / (by - ay):
            odd = not odd
    return odd


@kernel
def _nearest_on(x: float, y: float, segments: Floats) -> tuple[float, float, float]:
    best, px, py = np.inf, 0.0, 0.0
    for s in range(len(segments)):
        ax, ay, bx, by = segments[s]
        dx, dy = bx - ax, by - ay
        length2 = dx * dx + dy * dy
        t = 0.0
        if length2 > 0.0:
            t = min(1.0, max(0.0, ((x - ax) * dx + (y - ay) * dy) / length2))
        qx, qy = ax + t * dx, ay + t * dy
        d2 = (qx - x) ** 2 + (qy - y) ** 2
        if d2 < best:
            best, px, py = d2, qx, qy
    return px, py, best


@kernel
def _candidates(
    x: float,
    y: float,
    radius: float,
    grid: tuple[Floats, int, int],
    starts: Ints,
    members: NDArray[np.int32],
) -> NDArray[np.int32]:
    low, nx, ny = grid
    i0, i1 = int((x - radius - low[0]) // BIN), int((x + radius - low[0]) // BIN)
    j0, j1 = int((y - radius - low[1]) // BIN), int((y + radius - low[1]) // BIN)
    found = [np.int32(0) for _ in range(0)]
    for i in range(max(i0, 0), min(i1, nx - 1) + 1):
        for j in range(max(j0, 0), min(j1, ny - 1) + 1):
            found.extend(members[starts[i * ny + j] : starts[i * ny + j + 1]])
    return np.unique(np.array(found, np.int32))


@kernel
def _nearest_around(
    viewpoints: Floats,
    radius: float,
    grid: tuple[Floats, int, int],
    bins: tuple[Ints, NDArray[np.int32]],
    lines: tuple[Ints, Floats],
    areas: tuple[NDArray[np.bool_], Floats],
) -> tuple[Ints, NDArray[np.int32], Floats]:
    starts, owners = bins
    segment_starts, segments = lines
    is_area, center = areas
    counted = np.zeros(len(viewpoints), np.int64)
    objects, xs, ys = [], [], []
    for v in range(len(viewpoints)):
        x, y = viewpoints[v]
        for o in _candidates(x, y, radius, grid, starts, owners):
            own = segments[segment_starts[o] : segment_starts[o + 1]]
            if is_area[o] and holds(x, y, own):
                px, py = center[o]
                d2 = (px - x) ** 2 + (py - y) ** 2
            else:
                px, py, d2 = _nearest_on(x, y, own)
            if d2 <= radius * radius:
                objects.append(o)
                xs.append(px)
                ys.append(py)
                counted[v] += 1
    points = np.empty((len(objects), 2))
    points[:, 0] = np.array(xs)
    points[:, 1] = np.array(ys)
    return counted, np.array(objects, np.int32), points


# mypy: allow-untyped-defs, allow-incomplete-defs


NORTH, SOUTH, EAST, WEST = range(4)


SHORTEST, LONGEST = 1.0, 25.0  # two objects are related where they stand this far apart [m]


@kernel
def _relation(dx: float, dy: float) -> int:
    if abs(dx) <= abs(dy):
        return NORTH if dy > 0.0 else SOUTH
    return EAST if dx > 0.0 else WEST


@kernel
def _pairs(
    starts: Ints, points: Floats, longest: float
) -> tuple[Ints, NDArray[np.int32], NDArray[np.int32], NDArray[np.int8]]:
    counted = np.zeros(len(starts), np.int64)
    for fill in (False, True):
        if fill:
            total = counted.sum()
            source, target = np.empty(total, np.int32), np.empty(total, np.int32)
            related = np.empty(total, np.int8)
        n = 0
        for v in range(len(starts) - 1):
            first = n
            for a in range(starts[v], starts[v + 1]):
                for b in range(starts[v], starts[v + 1]):
                    dx, dy = points[a, 0] - points[b, 0], points[a, 1] - points[b, 1]
                    d2 = dx * dx + dy * dy
                    if a != b and SHORTEST * SHORTEST <= d2 <= longest * longest:
                        if fill:
                            source[n], target[n], related[n] = a, b, _relation(dx, dy)
                        n += 1
            counted[v + 1] = n - first
    return np.cumsum(counted), source, target, related


# mypy: allow-untyped-defs, allow-incomplete-defs


UNSAID = 5e-5  # probability of a statement that the generator would not make at a viewpoint


@kernel
def _same_place(a: Floats, b: Floats, apart: float, by_cell: bool) -> bool:
    """Whether two viewpoints (2,), in steps of the grid, are one place."""
    if by_cell:  # squares are numbered by their centres: cells begin half a step earlier
        same = np.floor((a + 0.5) / apart) == np.floor((b + 0.5) / apart)
        return bool(same[0] and same[1])
    return bool((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 <= apart * apart)


@kernel
def _rank(
    statements: tuple[Ints, Ints],
    postings: tuple[Ints, NDArray[np.int32]],
    squares: tuple[NDArray[np.int32], NDArray[np.int32]],
    own: Ints,
    truth: Floats,
    apart: float,
    by_cell: bool,
) -> Ints:
    """Places (Q, 2) with a better and with the same score as the true one, best first, greedily."""
    asked, asked_starts = statements
    starts, at = postings
    column = squares[0]
    counts = np.zeros((len(own), 2), np.int64)
    score = np.zeros(len(column), np.int16)
    for q in range(len(own)):
        words = asked[asked_starts[q] : asked_starts[q + 1]]
        for w in words:
            score[at[starts[w] : starts[w + 1]]] += 1
        rivals, best = [0 for _ in range(0)], own[q]
        for w in words:
            for v in at[starts[w] : starts[w + 1]]:
                if score[v] >= max(best, 1):
                    if _same_place(column[v].astype(np.float64), truth[q], apart, by_cell):
                        best = max(best, score[v])
                    else:
                        rivals.append(v)
        for level in range(len(words), max(best, 1) - 1, -1):
            places = _take_places(rivals, level, score, squares, apart, by_cell)
            counts[q, 0 if level > best else 1] += places
        for w in words:
            score[at[starts[w] : starts[w + 1]]] = 0
    return counts


@kernel
def _take_places(
    rivals: list[int],
    level: int,
    score: NDArray[np.int16],
    squares: tuple[NDArray[np.int32], NDArray[np.int32]],
    apart: float,
    by_cell: bool,
) -> int:
    column, square = squares
    reach, places = int(apart), 0
    for v in rivals:
        if score[v] != level:
            continue
        places += 1
        here = column[v].astype(np.float64)
        for i in range(max(column[v, 0] - reach, 0), min(column[v, 0] + reach + 1, len(square))):
            last = min(column[v, 1] + reach + 1, square.shape[1])
            for other in square[i, max(column[v, 1] - reach, 0) : last]:
                there = column[other].astype(np.float64)
                if other >= 0 and _same_place(here, there, apart, by_cell):
                    score[other] = 0
    return places


@kernel
def _likeliest(
    statements: tuple[Ints, Ints],
    postings: tuple[Ints, NDArray[np.int32]],
    squares: tuple[NDArray[np.int32], NDArray[np.int32]],
    sayable: NDArray[np.int32],
    truth: Floats,
    scale: tuple[float, float, float],
    top: int,
) -> Floats:
    asked, asked_starts = statements
    column = squares[0]
    wrong, reach, apart = scale
    distance = np.full((len(truth), top), np.inf)
    once, gain = np.zeros(len(column)), np.zeros(len(column))
    for q in range(len(truth)):
        for words in asked[asked_starts[q] : asked_starts[q + 1]]:
            _hear(words, postings, sayable, wrong, once, gain)
        best = gain.max()
        likely = np.flatnonzero(gain > max(best - 12.0, 0.0))  # the rest has no weight to speak of
        likely = likely[np.argsort(-gain[likely])[:2000]]
        weight = np.exp(gain - best) * (gain > 0.0)
        for k in range(top):
            mass = np.array([_mass(v, weight, squares, reach, False) for v in likely])
            if not len(mass) or mass.max() == 0.0:
                break
            middle = likely[np.argmax(mass)]
            delta = column[middle] - truth[q]
            distance[q, k] = np.hypot(delta[0], delta[1])
            _mass(middle, weight, squares, apart, True)
        gain[:] = 0.0
    return distance


@kernel
def _hear(
    words: Ints,
    postings: tuple[Ints, NDArray[np.int32]],
    sayable: NDArray[np.int32],
    wrong: float,
    once: Floats,
    gain: Floats,
) -> None:
    starts, at = postings
    for d in range(len(words)):
        share = 1.0 - wrong if d == 0 else wrong / (len(words) - 1)
        for v in at[starts[words[d]] : starts[words[d] + 1]]:
            once[v] += share / sayable[v]
    for word in words:
        for v in at[starts[word] : starts[word + 1]]:
            gain[v] += np.log1p(once[v] / UNSAID)
            once[v] = 0.0


@kernel
def _mass(
    v: np.int64,
    weight: Floats,
    squares: tuple[NDArray[np.int32], NDArray[np.int32]],
    apart: float,
    clear: bool,
) -> float:
    """Sum of the weights within `apart` steps of a viewpoint; set them to 0 with `clear`."""
    column, square = squares
    reach, total = int(apart), 0.0
    x, y = column[v]
    for i in range(max(x - reach, 0), min(x + reach + 1, square.shape[0])):
        for j in range(max(y - reach, 0), min(y + reach + 1, square.shape[1])):
            other = square[i, j]
            if other >= 0 and (i - x) ** 2 + (j - y) ** 2 <= apart * apart:
                total += weight[other]
                if clear:
                    weight[other] = 0.0
    return total
