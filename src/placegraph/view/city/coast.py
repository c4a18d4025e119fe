"""The sea: OpenStreetMap draws only its coast, with the land on the left hand.

Coastlines are joined to chains, cut to the picture, and closed along its border so that the sea
lies on the right hand. A chain that an extract has cut off inside the picture goes straight on,
away from its other end.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.outdoor.map.objects import CityObjects
from placegraph.view.draw.clip import clip_line, clip_ring
from placegraph.view.draw.style import POINT

if TYPE_CHECKING:
    from placegraph.view.draw.canvas import Bounds

COASTLINE = "natural=coastline"


def sea(objects: CityObjects, bounds: Bounds) -> list[Floats]:
    """Rings whose even-odd inside is the sea in a rectangle.

    Empty where there is no sea, or where the coast is too fragmentary to tell.
    """
    chains = _chains(objects)
    if not chains:
        return []
    low, high = np.percentile(objects.center, (0.5, 99.5), axis=0)
    known = (
        max(bounds[0], float(low[0])),
        max(bounds[1], float(low[1])),
        min(bounds[2], float(high[0])),
        min(bounds[3], float(high[1])),
    )
    for window in (bounds, known):  # beyond what an extract holds, chains may tangle
        if window[0] < window[2] and window[1] < window[3]:
            rings = _sea(chains, window)
            if _agrees(rings, chains, window):
                return rings
    return []


def _sea(chains: list[Floats], bounds: Bounds) -> list[Floats]:
    islands = [chain for chain in chains if (chain[0] == chain[-1]).all()]
    shores = [_prolonged(chain, bounds) for chain in chains if (chain[0] != chain[-1]).any()]
    pieces = [piece for shore in shores for piece in clip_line(shore, bounds)]
    rings = _closed(pieces, bounds)
    if not pieces:
        corner = np.array([bounds[:2]])
        if _is_seaward(chains, bounds[:2]) != _inside(islands, corner)[0]:
            rings = [_corners(bounds)]
    return rings + [ring for island in islands if len(ring := clip_ring(island, bounds)) > 3]


def _agrees(rings: list[Floats], chains: list[Floats], bounds: Bounds) -> bool:
    """Whether the rings hold the right hand of the coast in a rectangle, and not the left."""
    start = np.concatenate([chain[:-1] for chain in chains])
    delta = np.concatenate([np.diff(chain, axis=0) for chain in chains])
    length = np.hypot(*delta.T)
    middle = start + delta / 2
    low, high = np.array(bounds[:2]) + 5.0, np.array(bounds[2:]) - 5.0
    seen = np.flatnonzero(((middle > low) & (middle < high)).all(axis=1) & (length > 4.0))
    seen = seen[:: 1 + len(seen) // 300]
    if not len(seen):
        return True
    right = np.stack([delta[seen, 1], -delta[seen, 0]], axis=1) / length[seen, None]
    wrong = ~_inside(rings, middle[seen] + right) | _inside(rings, middle[seen] - right)
    return bool(wrong.mean() < 0.05)


def _inside(rings: list[Floats], points: Floats) -> NDArray[np.bool_]:
    """Whether points (N, 2) lie within rings, by the even-odd rule."""
    odd = np.zeros(len(points), np.bool_)
    for ring in rings:
        (x0, y0), (x1, y1) = ring[:-1].T, ring[1:].T
        crosses = (y0 > points[:, 1:]) != (y1 > points[:, 1:])
        with np.errstate(divide="ignore", invalid="ignore"):
            at = x0 + (points[:, 1:] - y0) / (y1 - y0) * (x1 - x0)
        odd ^= (crosses & (points[:, :1] < at)).sum(axis=1) % 2 == 1
    return odd


def _chains(objects: CityObjects) -> list[Floats]:
    """Coastlines (n, 2) joined where one ends and the next begins."""
    if COASTLINE not in objects.labels:
        return []
    label = objects.labels.index(COASTLINE)
    entries = np.flatnonzero(objects.label_values == label)
    rows = np.searchsorted(objects.label_starts, entries, side="right") - 1
    lines = [
        part.astype(np.float64)
        for row in rows
        if objects.kind[row] != POINT
        for part in objects.parts(int(row))
    ]
    begins = {tuple(line[0]): k for k, line in enumerate(lines)}
    ends = {tuple(line[-1]) for line in lines}
    # first those that nothing leads to, then what is left: closed chains
    order = sorted(range(len(lines)), key=lambda k: tuple(lines[k][0]) in ends)
    chains, used = [], set[int]()
    for first in order:
        if first in used:
            continue
        chain, k = [lines[first]], first
        used.add(k)
        while (following := begins.get(tuple(lines[k][-1]))) is not None and following not in used:
            k = following
            used.add(k)
            chain.append(lines[k][1:])
        chains.append(np.concatenate(chain))
    return chains


def _prolonged(chain: Floats, bounds: Bounds) -> Floats:
    """Return a chain that reaches out of the rectangle at both ends."""
    low, high = np.array(bounds[:2]), np.array(bounds[2:])
    outward = chain[-1] - chain[0]
    far = 2.0 * np.hypot(*(high - low)) / max(float(np.hypot(*outward)), 1e-9)
    before, after = ((end >= low) & (end <= high) for end in (chain[0], chain[-1]))
    head = [chain[:1] - far * outward] if before.all() else []
    tail = [chain[-1:] + far * outward] if after.all() else []
    return np.concatenate([*head, chain, *tail])


def _corners(bounds: Bounds) -> Floats:
    """Corners (5, 2) of a rectangle, clockwise from its south-west."""
    west, south, east, north = bounds
    return np.array(
        [(west, south), (west, north), (east, north), (east, south), (west, south)], np.float64
    )


def _closed(pieces: list[Floats], bounds: Bounds) -> list[Floats]:
    """Close pieces that run from border to border, going clockwise along the border."""
    corners = _corners(bounds)
    side = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))))

    def along(point: Floats) -> float:
        """Way from the south-west corner, clockwise along the border [m]."""
        gaps = [abs(point[k % 2] - corners[k][k % 2]) for k in range(4)]
        k = int(np.argmin(gaps))
        return float(side[k] + np.hypot(*(point - corners[k])))

    starts = [along(piece[0]) for piece in pieces]
    rings, left = [], set(range(len(pieces)))
    while left:
        first = k = min(left)
        ring: list[Floats] = []
        while k in left:
            left.discard(k)
            ring.append(pieces[k])
            here = along(pieces[k][-1])
            ahead = [(start - here) % side[-1] for start in starts]
            k = min(
                (j for j in range(len(pieces)) if j in left or j == first), key=ahead.__getitem__
            )
            turns = [
                (corner, (at - here) % side[-1])
                for corner, at in zip(corners, side[:-1], strict=False)
            ]
            passed = sorted((way, tuple(corner)) for corner, way in turns if way < ahead[k])
            ring.extend(np.array([corner]) for _, corner in passed)
        ring.append(ring[0][:1])
        rings.append(np.concatenate(ring))
    return rings


def _is_seaward(chains: list[Floats], point: tuple[float, float]) -> bool:
    """Whether a point lies on the right hand of the coast nearest to it."""
    nearest, seaward = np.inf, False
    for chain in chains:
        start, delta = chain[:-1], np.diff(chain, axis=0)
        to = np.array(point) - start
        t = np.clip((to * delta).sum(axis=1) / np.maximum((delta**2).sum(axis=1), 1e-9), 0.0, 1.0)
        away = np.hypot(*(to - t[:, None] * delta).T)
        k = int(np.argmin(away))
        if away[k] < nearest:
            nearest = float(away[k])
            seaward = bool(delta[k][0] * to[k][1] - delta[k][1] * to[k][0] < 0.0)
    return seaward
