"""Paths through a drawn flat that keep away from walls and furniture."""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import OptionError

if TYPE_CHECKING:
    from placegraph_lab.worlds.flat.flat import Flat

Floats = NDArray[np.float64]

STEP = 0.1
"""Side of the cells that a path is planned on [m]."""
BODY = 0.2
"""Least distance of a path from walls and furniture [m]."""
COMFORT = 0.55
"""Distance at which they no longer matter [m]."""


class FloorPlan:
    """Grid of places where a person may stand, and how far each is from walls and furniture."""

    def __init__(self, flat: Flat) -> None:
        self.flat = flat
        width, depth = flat.size
        shape = int(width / STEP), int(depth / STEP)
        blocked = np.ones(shape, bool)
        for i, j in np.ndindex(shape):
            row, column = flat.cell((i + 0.5) * STEP, (j + 0.5) * STEP)
            blocked[i, j] = flat.blocked[row, column]
        self.clear = _clearance(blocked)
        if not (self.clear >= BODY).any():
            raise OptionError(f"{flat.source}: nobody can stand anywhere in it; draw more floor.")

    def nearest(self, x: float, y: float) -> tuple[int, int]:
        """Cell nearest to x, y [m] where a person may stand."""
        cells = np.argwhere(self.clear >= BODY)
        distance = np.hypot(*((cells + 0.5) * STEP - (x, y)).T)
        i, j = cells[np.argmin(distance)].tolist()
        return i, j

    def way(self, stops: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
        """Cells from stop to stop."""
        path = [stops[0]]
        for goal in stops[1:]:
            path += self._leg(path[-1], goal)[1:]
        return path

    def any_way(self, length: float, rng: np.random.Generator) -> list[tuple[int, int]]:
        """Cells of a path of at least this length [m], as far as the floor allows."""
        cells = np.argwhere(self.clear >= min(COMFORT / 2, float(self.clear.max())))
        path = [(int(i), int(j)) for i, j in cells[rng.integers(len(cells))][None]]
        for _ in range(50):
            if len(path) * STEP > length + 1.0:
                break
            i, j = cells[rng.integers(len(cells))].tolist()
            try:
                path += self._leg(path[-1], (i, j))[1:]
            except OptionError:
                continue  # another part of the flat, behind a closed door
        return path

    def _leg(self, start: tuple[int, int], goal: tuple[int, int]) -> list[tuple[int, int]]:
        """Cheapest way on the grid (Dijkstra); it keeps away from walls where it can."""
        cost = 1.0 + 6.0 * np.maximum(0.0, 1.0 - self.clear / COMFORT) ** 2
        best = {start: 0.0}
        before: dict[tuple[int, int], tuple[int, int]] = {}
        queue = [(0.0, start)]
        while queue:
            spent, cell = heapq.heappop(queue)
            if cell == goal:
                break
            if spent > best[cell]:
                continue
            for di, dj in _NEIGHBOURS:
                there = (cell[0] + di, cell[1] + dj)
                if not (
                    0 <= there[0] < cost.shape[0]
                    and 0 <= there[1] < cost.shape[1]
                    and self.clear[there] >= BODY
                ):
                    continue
                total = spent + float(np.hypot(di, dj)) * float(cost[there])
                if total < best.get(there, np.inf):
                    best[there], before[there] = total, cell
                    heapq.heappush(queue, (total, there))
        if goal not in best:
            x, y = ((k + 0.5) * STEP for k in goal)
            raise OptionError(
                f"{self.flat.source}: no way leads to x = {x:.1f}, y = {y:.1f} m; "
                "open a door, or move what stands in the way."
            )
        path = [goal]
        while path[-1] != start:
            path.append(before[path[-1]])
        return path[::-1]

    def smooth(self, way: list[tuple[int, int]]) -> tuple[Floats, Floats]:
        """Line (N, 2) and its lengths (N,) [m]: as smooth as walls and furniture allow."""
        raw = (np.array(way) + 0.5) * STEP
        raw = np.repeat(raw, 2, axis=0)[: 2 * len(raw) - 1]
        raw[1::2] = (raw[0:-1:2] + raw[2::2]) / 2
        line = raw
        for sigma in (8.0, 5.0, 3.0, 1.5):  # of half cells
            line = _blurred(raw, sigma)
            i, j = (line / STEP).astype(int).T
            if (self.clear[i, j] >= BODY).all():
                break
        arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
        return line, arc


_NEIGHBOURS = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)]


def _clearance(blocked: NDArray[np.bool_]) -> Floats:
    """Distance [m] of every cell's middle from the nearest blocked one's, up to `COMFORT`."""
    reach = int(np.ceil(COMFORT / STEP))
    padded = np.pad(blocked, reach, constant_values=True)
    clear = np.full(blocked.shape, COMFORT)
    rows, columns = blocked.shape
    for i in range(2 * reach + 1):
        for j in range(2 * reach + 1):
            there = padded[i : i + rows, j : j + columns]
            distance = STEP * float(np.hypot(i - reach, j - reach))
            clear = np.where(there, np.minimum(clear, distance), clear)
    return clear


def _blurred(line: Floats, sigma: float) -> Floats:
    """Points (N, 2) averaged with their neighbours along the line; the ends stay."""
    reach = int(3 * sigma)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    weights /= weights.sum()
    # reflecting the line in its ends keeps them where they are
    start, end = 2 * line[0] - line[1 : reach + 1][::-1], 2 * line[-1] - line[-reach - 1 : -1][::-1]
    padded = np.concatenate([start, line, end]) if len(line) > reach else line
    if padded is line:
        return line
    return np.stack([np.convolve(padded[:, k], weights, "valid") for k in (0, 1)], axis=-1)
