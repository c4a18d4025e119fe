"""Which viewpoints, or which cells, are worth comparing with the words (Eq. 11-13)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import StoreError
from placegraph.outdoor.likelihood.bound_kernels import HIGHEST, draw, promising_views
from placegraph.outdoor.likelihood.match_kernels import distant
from placegraph.outdoor.likelihood.query import Far
from placegraph.outdoor.map.city import City
from placegraph.outdoor.search.request import Request

MOST_CANDIDATES = 400
"""At most this many viewpoints are scored for themselves ..."""
DRAWN = 2048
"""... at most so many, a power of two, for all others ..."""
FAR_CANDIDATES = 3000
"""... and this many are looked at where things out of sight are spoken of."""
FAR_REACH = 400.0
"""Viewpoints up to this far from a rare thing spoken of from afar are candidates [m]."""
MOST_ANCHORS = 40
"""At most this many such things give candidates."""
SPARSE = 8
"""Viewpoints looked at for each sparse candidate."""


class Candidates(NamedTuple):
    """Viewpoints to be scored: the most promising first, then those that stand for all others."""

    rows: NDArray[np.int32]
    """(K,) rows of `city.views`."""
    bounds: NDArray[np.float64]
    """(K,) bounds on the likelihood ratio, times the prior against the largest."""
    far: NDArray[np.float32]
    """(K, S) what things out of sight add."""
    stands: NDArray[np.float64]
    """(K,) 0, or how many viewpoints that are not listed it stands for, which it may be one of."""

    @classmethod
    def given(cls, asked: Request, rows: NDArray[np.int64]) -> Candidates:
        """These viewpoints and no others."""
        chosen, statements, city = rows.astype(np.int32), asked.query.statements, asked.city
        far = np.zeros((len(chosen), len(statements.op)), np.float32)
        if asked.query.far:
            far = distant(
                statements, city.columns, asked.query.far, city.views.positions_of(chosen)
            )
        return cls(chosen, np.full(len(chosen), HIGHEST), far, np.zeros(len(chosen)))

    def part(self, kept: NDArray[np.bool_] | slice) -> Candidates:
        """Some of them."""
        return Candidates(self.rows[kept], self.bounds[kept], self.far[kept], self.stands[kept])


def rank_bounds(
    bounds: NDArray[np.float64], stands: NDArray[np.float64], most: int, drawn: int = DRAWN
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Rows of the `most` of largest bound, and of `drawn` that stand for all others, as these do.

    Columns (K,) are those of `Candidates`; the second is what each row stands for then.
    """
    own = np.flatnonzero(stands == 0.0)
    order = own[np.argsort(-bounds[own], kind="stable")]
    others = np.concatenate([order[most:], np.flatnonzero(stands)])
    some, stand = draw(bounds[others], np.where(stands[others] == 0.0, 1.0, stands[others]), drawn)
    return (
        np.concatenate([order[:most], others[some]]),
        np.concatenate([np.zeros(min(most, len(own))), stand]),
    )


def find_candidates(asked: Request, drawn: int = DRAWN, least: float = 0.0) -> Candidates:
    """Viewpoints that the statements may have been made at, by the way that was asked for.

    `drawn`, a power of two, stand for all others. Those of a bound below `least` are among these, but
    where things out of sight are spoken of, which add to it.
    """
    query, views, way = asked.query, asked.city.views, asked.matching.way
    weights = np.exp(asked.log_prior - asked.highest)
    if way == "sparse":
        most = FAR_CANDIDATES if query.far else MOST_CANDIDATES
        chosen, bounds, stands = promising_views(
            query.statements, query.mentions, views.columns, weights, most, drawn,
            0.0 if query.far else least,  # to which those add
        )  # fmt: skip
    else:
        chosen = find_views(asked).astype(np.int32)
        bounds, stands = np.full(len(chosen), HIGHEST), np.zeros(len(chosen))
    far = np.zeros((len(chosen), len(query.statements.op)), np.float32)
    found = Candidates(chosen, bounds, far, stands)
    if query.far:
        found = _with_far(asked, query.far, weights, found, drawn)
    return found if asked.prior.inside is None else found.part(weights[found.rows] > 0.0)


def _with_far(
    asked: Request, far: Far, weights: NDArray[np.float64], found: Candidates, drawn: int
) -> Candidates:
    """Add viewpoints around rare things out of sight, and what those add to each statement."""
    statements, city = asked.query.statements, asked.city
    extra = find_around_far(city, far, found.rows)
    extra = extra[:: 1 + len(extra) // FAR_CANDIDATES]
    chosen = np.concatenate([found.rows, extra])
    bounds = np.concatenate([found.bounds, weights[extra] if len(weights) else np.ones(len(extra))])
    stands = np.concatenate([found.stands, np.zeros(len(extra))])
    added = distant(statements, city.columns, far, city.views.positions_of(chosen))
    total = np.log(np.maximum(bounds, 1e-300)) + np.log1p(statements.gain * added).sum(axis=1)
    rows, stands = rank_bounds(
        np.exp(total - total.max(initial=-np.inf)), stands, MOST_CANDIDATES, drawn
    )
    bounds = np.exp(np.minimum(total[rows], 690.0))
    return Candidates(chosen[rows], bounds, added[rows], stands)


def find_around_far(city: City, far: Far, chosen: NDArray[np.int32]) -> NDArray[np.int32]:
    """Viewpoints (K,) around rare things out of sight that are not among the chosen, ascending."""
    anchors = city.objects.center[far.anchors[:MOST_ANCHORS]]
    around = [city.views.near(anchor, FAR_REACH) for anchor in anchors]
    return np.setdiff1d(np.concatenate([np.zeros(0, np.int64), *around]), chosen).astype(np.int32)


def _touched(asked: Request, most: int) -> NDArray[np.int32]:
    """Viewpoints (at most `most`) of the region, of largest bound on their likelihood, best first."""
    views, inside = asked.city.views, _inside(asked)
    weights = np.zeros(0) if inside is None else inside.astype(np.float64)
    chosen, _, _ = promising_views(
        asked.query.statements, asked.query.mentions, views.columns, weights, most, 0, 0.0
    )
    return chosen if inside is None else chosen[inside[chosen]]


def _inside(asked: Request) -> NDArray[np.bool_] | None:
    """Which viewpoints (W,) lie in the region; None where none was given."""
    if asked.matching.region is None:
        return None
    return asked.inside(asked.city.views.positions.astype(np.float64))


def find_views(asked: Request) -> NDArray[np.int64]:
    """Viewpoints (V,) in the dense candidates, and for ``both`` those of largest bound as well."""
    way, inside = asked.matching.way, _inside(asked)
    if way == "all":
        return np.arange(len(asked.city.views)) if inside is None else np.flatnonzero(inside)
    views = find_views_in(asked.city, find_dense_cells(asked, asked.matching.candidates))
    return np.union1d(views, _touched(asked, MOST_CANDIDATES)) if way == "both" else views


def find_views_in(city: City, rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Viewpoints (V,) that lie in cells, ascending."""
    half = city.cells.size / 2
    around = [city.views.near(center, half) for center in city.cells.centers(rows)]
    return np.unique(np.concatenate([np.zeros(0, np.int64), *around]))


def find_cells(asked: Request) -> NDArray[np.int64]:
    """Rows of `city.cells.points` that are worth matching, best first (Eq. 12-13)."""
    cells, n, way = asked.city.cells, asked.matching.candidates, asked.matching.way
    if way == "all":
        return np.flatnonzero(asked.inside(cells.centers(np.arange(len(cells)))))
    found = []
    if way != "sparse":
        found.append(find_dense_cells(asked, n))
    if way != "dense":
        found.append(_sparse_cells(asked, n))
    if len(found) == 1:
        return found[0]
    longest = max(map(len, found))
    turns = [rows[i] for i in range(longest) for rows in found if i < len(rows)]
    return np.array(list(dict.fromkeys(turns))[:n], np.int64)


def find_dense_cells(asked: Request, n: int) -> NDArray[np.int64]:
    """Rows of the `n` cells whose embeddings are nearest to that of the text (Eq. 11-13)."""
    store, cells = asked.matching.store, asked.city.cells
    store = asked.encoded.store if store is None else store
    near = store.search(asked.embedding, min(n, len(cells)), asked.matching.region)
    ids = near.ids[0][near.ids[0] >= 0]
    rows = np.searchsorted(cells.points, ids)
    if (cells.points[np.minimum(rows, len(cells) - 1)] != ids).any():
        raise StoreError(
            "The store of vectors names cells that the map has not; make it again with "
            "`placegraph city embed`."
        )
    return rows


def _sparse_cells(asked: Request, n: int) -> NDArray[np.int64]:
    """Rows of the cells that hold the viewpoints of largest bound."""
    if not asked.is_positive:
        return np.zeros(0, np.int64)
    views = _touched(asked, SPARSE * n)
    rows = asked.city.cells.rows_at(asked.city.views.positions_of(views).astype(np.float64))
    return np.array(list(dict.fromkeys(rows[rows >= 0].tolist()))[:n], np.int64)
