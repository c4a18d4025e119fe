"""How long a block is: the spacing of crossings along the streets of the map at hand."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.outdoor.map.objects import LINE, CityObjects

USUAL = 100.0
"""Metres in a block where the map has too few streets to tell."""
STREETS = frozenset(
    f"highway={kind}"
    for kind in ("primary", "secondary", "tertiary", "residential", "unclassified", "living_street")
)
"""Streets that people count blocks between."""
STEP = 10.0
"""Streets are followed in steps of this length [m]."""
CROSSING = 20.0
"""Two streets within a square of this width cross there [m]."""
SHORTEST, LONGEST = 40.0, 600.0
"""Crossings nearer than this are one, and further apart than that end no block [m]."""
ENOUGH = 12
"""A length is told from at least so many blocks."""
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
        """Length of a block in a direction [rad]; of no particular direction where that is None."""
        if bearing is None:
            return float(np.sqrt(self.first * self.second))
        along = abs(np.cos(bearing - self.axis)) >= np.sqrt(0.5)
        return self.first if along else self.second

    @classmethod
    def measured(cls, objects: CityObjects) -> Blocks:
        """Blocks of a map: usual distances between neighbouring crossings of a street."""
        gaps = _gaps(*_followed(objects))
        length = np.hypot(*gaps.T)
        if len(gaps) < ENOUGH:
            return cls()
        usual = _usual(length)
        angle = np.arctan2(gaps[:, 0], gaps[:, 1])
        fourfold = np.mean(np.exp(4j * angle))
        axis = float(np.angle(fourfold)) / 4.0
        if abs(fourfold) < REGULAR:
            return cls(0.0, usual, usual)
        first = np.abs(np.cos(angle - axis)) >= np.sqrt(0.5)
        lengths = [
            _usual(length[rows]) if rows.sum() >= ENOUGH else usual for rows in (first, ~first)
        ]
        return cls(axis, *lengths)


def _followed(objects: CityObjects) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Points (K, 2) along all named streets [m], and the name (K,) of each."""
    streets = {row for row, label in enumerate(objects.labels) if label in STREETS}
    label = objects.label_values[objects.label_starts[:-1]]
    named = np.diff(objects.name_starts) > 0
    rows = np.flatnonzero((objects.kind == LINE) & named & np.isin(label, list(streets)))
    points, names = [np.zeros((0, 2))], [np.zeros(0, np.int32)]
    for row in rows:
        for line in objects.parts(int(row)):
            along = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))))
            at = np.arange(0.0, along[-1] + STEP, STEP)
            points.append(np.column_stack([np.interp(at, along, axis) for axis in line.T]))
            names.append(np.full(len(at), objects.name_values[objects.name_starts[row]], np.int32))
    return np.concatenate(points), np.concatenate(names)


def _gaps(points: NDArray[np.float64], names: NDArray[np.int32]) -> NDArray[np.float64]:
    """Vectors (B, 2) [m] between neighbouring crossings of each street."""
    squares = np.floor(points / CROSSING).astype(np.int64)
    met = np.unique(np.column_stack([squares, names]), axis=0)
    _, square, streets = np.unique(met[:, :2], axis=0, return_inverse=True, return_counts=True)
    met = met[streets[square.ravel()] > 1]
    found = [np.zeros((0, 2))]
    for name in np.unique(met[:, 2]):
        at = met[met[:, 2] == name, :2] * CROSSING
        _, _, axes = np.linalg.svd(at - at.mean(axis=0), full_matrices=False)
        at = at[np.argsort(at @ axes[0])]
        last = np.concatenate(([True], np.hypot(*np.diff(at, axis=0).T) >= SHORTEST))
        gaps = np.diff(at[last], axis=0)
        found.append(gaps[np.hypot(*gaps.T) <= LONGEST])
    return np.concatenate(found)


def _usual(lengths: NDArray[np.float64]) -> float:
    """Mean of the middle half: what many blocks come to, whatever a few odd ones are."""
    quarter = len(lengths) // 4
    return float(np.sort(lengths)[quarter : len(lengths) - quarter].mean())
