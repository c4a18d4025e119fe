"""Features of one image, and which of two images' features belong together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.indoor.refine.matching.matches import Matches, inside


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """Points of one image with what they look like."""

    points: Floats
    """(N, 2) float64, x y [px], pixel centres at +0.5."""
    vectors: NDArray[np.float32]
    """(N, D) float32, unit vectors."""

    def __len__(self) -> int:
        return len(self.points)

    @classmethod
    def none(cls, dimension: int = 1) -> Features:
        """No feature."""
        return cls(np.empty((0, 2)), np.empty((0, dimension), np.float32))

    def within(self, mask: NDArray[np.bool_] | None, margin: int) -> Features:
        """Those that lie in a mask (H, W), and `margin` px from its edge."""
        keep = inside(mask, self.points, margin)
        return self if keep.all() else Features(self.points[keep], self.vectors[keep])

    def matched(
        self, view: Features, *, ratio: float = 1.0, least: float = -1.0, apart: float = 0.0
    ) -> Matches:
        """Matches with the features of a view; parameters as of `mutual`."""
        rows, columns, sure = mutual(self, view, ratio=ratio, least=least, apart=apart)
        return Matches.of(self.points[rows], view.points[columns], sure)


def mutual(
    query: Features, view: Features, *, ratio: float = 1.0, least: float = -1.0, apart: float = 0.0
) -> tuple[NDArray[np.intp], NDArray[np.intp], Floats]:
    """Pairs of features that are each other's nearest, and clearly so (Lowe's ratio, both ways).

    Parameters
    ----------
    query, view
        Features with vectors of the same length.
    ratio
        Largest ratio of the distance to the nearest vector and to the second nearest; 1: any.
    least
        Smallest cosine of two vectors that match.
    apart
        Features nearer than this to the match [px] are no rivals of it: one spot may have several
        features, at several scales.

    Returns
    -------
    tuple
        Rows (K,) of the query, rows (K,) of the view, and how sure each pair is (K,), in [0, 1]: 1
        less the ratio, or the cosine where every ratio will do.

    """
    if not len(query) or not len(view):
        return np.empty(0, np.intp), np.empty(0, np.intp), np.empty(0)
    cosine = query.vectors @ view.vectors.T
    nearest = cosine.argmax(axis=1)
    rows = np.flatnonzero(cosine.argmax(axis=0)[nearest] == np.arange(len(query)))
    rows = rows[cosine[rows, nearest[rows]] >= least]
    columns = nearest[rows]
    best = cosine[rows, columns].astype(np.float64)
    if ratio >= 1.0:
        return rows, columns, np.maximum(best, 0.0)
    rival = np.maximum(
        _second(cosine[rows], view.points, columns, apart),
        _second(cosine.T[columns], query.points, rows, apart),
    )
    # distances of unit vectors: |a - b|^2 = 2 - 2 a.b
    ratios = np.sqrt(np.maximum(1.0 - best, 0.0) / np.maximum(1.0 - rival, 1e-9))
    keep = ratios <= ratio
    return rows[keep], columns[keep], 1.0 - ratios[keep]


def _second(
    cosine: NDArray[np.float32], points: Floats, best: NDArray[np.intp], apart: float
) -> NDArray[np.float32]:
    """Largest cosine (K,) of rows (K, N) elsewhere than near the best feature of each."""
    spots = points.astype(np.float32)
    dx = spots[:, 0] - spots[best, :1]
    dy = spots[:, 1] - spots[best, 1:]
    away: NDArray[np.float32] = np.where(
        dx * dx + dy * dy > apart * apart, cosine, np.float32(-1.0)
    ).max(axis=1, initial=-1.0)
    return away
