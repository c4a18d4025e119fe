"""The sea: OpenStreetMap draws only its coast, with the land on the left hand.

Coastlines are joined to chains, cut to the picture, and closed along its border so that the sea
lies on the right hand. A chain that an extract has cut off inside the picture goes straight on,
away from its other end.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from placegraph.view.clip import clip_line, clip_ring
from placegraph.view.style import POINT

if TYPE_CHECKING:
    from placegraph.geometry import Floats
    from placegraph.outdoor.city import CityObjects
    from placegraph.view.canvas import Bounds

COASTLINE = "natural=coastline"


def sea(objects: CityObjects, bounds: Bounds) -> list[Floats]:
    """Rings whose even-odd inside is the sea in a rectangle; empty where there is no sea."""
    chains = _chains(objects)
    islands = [chain for chain in chains if (chain[0] == chain[-1]).all()]
    shores = [_prolonged(chain, bounds) for chain in chains if (chain[0] != chain[-1]).any()]
    pieces = [piece for shore in shores for piece in clip_line(shore, bounds)]
    if pieces:
        rings = _closed(pieces, bounds)
    elif chains and _is_seaward(chains, ((bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2)):
        rings = [_corners(bounds)]
    else:
        return []
    return rings + [ring for island in islands if len(ring := clip_ring(island, bounds)) > 3]


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
