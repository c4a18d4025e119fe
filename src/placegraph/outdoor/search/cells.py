"""The paper's pipeline on cells: candidates by embedding, then a matcher ranks them (Eq. 9-16).

`CityMap.locate` looks at viewpoints instead, which stand closer together than cells; what it does
with the network is in `rerank`. Here every matcher ranks the same cells, so that they compare.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, NamedTuple, get_args

import numpy as np

from placegraph.errors import OptionError
from placegraph.outdoor.likelihood.query import Query, compile_query
from placegraph.outdoor.search import viewpoints as search
from placegraph.outdoor.search.rerank import rerank

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from placegraph.outdoor.language.description import Description
    from placegraph.outdoor.map.city import City
    from placegraph.outdoor.network.encoded import EncodedCity
    from placegraph.vectors import Region, VectorStore

Matcher = Literal["fused", "relational", "transformer", "edit-distance", "embedding"]
"""fused: relational matching, shifted by the network; relational; the network alone (Eq. 14-17);
graph edit distance; the cosine of the graph embeddings alone (Eq. 11)."""
By = Literal["sparse", "dense", "both", "all"]
"""Candidates by the inverted index of viewpoints, by embeddings, by both in turn, or all cells."""
MATCHERS: tuple[Matcher, ...] = get_args(Matcher)
WAYS: tuple[By, ...] = get_args(By)
SPARSE = 8
"""Viewpoints looked at for each sparse candidate."""


class Ranking(NamedTuple):
    """Cells, best first."""

    rows: NDArray[np.int64]
    """(k,) rows of `city.cells.points`."""
    cells: tuple[str, ...]
    """(k,) their ids."""
    scores: NDArray[np.float64]
    """(k,) larger is better; what they are depends on the matcher: log-likelihood ratio, log odds,
    cosine, or minus edit distance."""


def retrieve(
    city: City,
    description: Description,
    *,
    matcher: Matcher = "relational",
    candidates: int = 10,
    by: By = "both",
    top: int = 5,
    store: VectorStore | None = None,
    region: Region | None = None,
    encoded: EncodedCity | None = None,
    timeout: float = 0.1,
) -> Ranking:
    """Rank cells by how well they match a description.

    Parameters
    ----------
    matcher
        What ranks the candidates.
    candidates
        How many cells are matched (the paper's n of Eq. 12).
    by
        How they are found.
    top
        How many cells to return.
    store, region
        Where embeddings are searched (the city's own if not given), and a region to stay in.
    encoded
        The city as a network reads it; by the shipped network if not given.
    timeout
        Of one edit distance [s].

    Raises
    ------
    OptionError
        There is no such matcher or way to find candidates, or an option is out of range.
    StoreError
        The store is of another map or another network.
    DescriptionError
        Edit distance needs things in the text.

    """
    if matcher not in MATCHERS or by not in WAYS:
        raise OptionError(
            f"matcher {matcher!r}, by {by!r}: choose among {', '.join(MATCHERS)} and "
            f"{', '.join(WAYS)}."
        )
    if not is_count(candidates) or not is_count(top):
        raise OptionError(f"candidates {candidates!r}, top {top!r}: choose at least 1.")
    check_sources(city, store=store, region=region, encoded=encoded)
    rows, scores = rank_cells(
        city, compile_query(description, city), matcher, candidates, by, encoded or city.encoded,
        store=store, region=region, timeout=timeout,
    )  # fmt: skip
    best = np.argsort(-scores, kind="stable")[:top]
    ids = tuple(city.cells.id_of(row) for row in rows[best])
    return Ranking(rows[best], ids, scores[best])


def is_count(value: object) -> bool:
    """Whether it is a whole number from 1 on."""
    return isinstance(value, int | np.integer) and value is not True and bool(value >= 1)


def check_sources(
    city: City,
    *,
    store: VectorStore | None,
    region: Region | None,
    encoded: EncodedCity | None,
) -> None:
    """Raise `OptionError` or `StoreError` where these are none, or belong to another map or network."""
    from placegraph.vectors import Origin, Region
    from placegraph.vectors.embedded import refuse_other

    if region is not None:
        if not isinstance(region, Region):
            raise OptionError(
                f"region is {region!r}; give a `Region` of west, south, east and north in degrees."
            )
        region.checked()
    if encoded is not None and not _reads(encoded, city):
        raise OptionError(
            f"encoded is not {city!r} as a network reads it; give `EncodedCity` of it."
        )
    if store is None:
        return
    found = getattr(store, "origin", None)
    if not isinstance(found, Origin):
        raise OptionError(f"store is {store!r}, no store of vectors; open one by `open_store`.")
    wanted = (encoded or city.encoded).origin
    # empty is not known
    known = Origin(found.map or wanted.map, found.model or wanted.model)
    refuse_other("The store", known, wanted)


def _reads(encoded: object, city: City) -> bool:
    """Whether it is this city, or the same one opened twice, as a network reads it."""
    from placegraph.outdoor.network.encoded import EncodedCity

    return isinstance(encoded, EncodedCity) and (
        encoded.city is city or encoded.origin.map == city.fingerprint
    )


def rank_cells(
    city: City,
    query: Query,
    matcher: Matcher,
    n: int,
    by: By,
    encoded: EncodedCity,
    *,
    store: VectorStore | None = None,
    region: Region | None = None,
    timeout: float = 0.1,
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Rows (K,) of `city.cells.points` of all candidates, and their scores (K,)."""
    rows = candidate_cells(city, query, n, by, encoded, store=store, region=region)
    if not len(rows):
        return rows, np.zeros(0)
    return rows, _scores(city, query, matcher, rows, encoded, timeout)


def candidate_cells(
    city: City,
    query: Query,
    n: int,
    by: By,
    encoded: EncodedCity,
    *,
    store: VectorStore | None = None,
    region: Region | None = None,
) -> NDArray[np.int64]:
    """Rows (at most n) of `city.cells.points` that are worth matching, best first."""
    if by == "all":
        return np.flatnonzero(within(city, city.cells.centers(np.arange(len(city.cells))), region))
    found = []
    if by in ("dense", "both"):
        found.append(dense_cells(city, query, n, encoded, store=store, region=region))
    if by in ("sparse", "both"):
        found.append(_sparse_cells(city, query, n, region))
    if len(found) == 1:
        return found[0]
    longest = max(map(len, found))
    turns = [rows[i] for i in range(longest) for rows in found if i < len(rows)]
    return np.array(list(dict.fromkeys(turns))[:n], np.int64)


def dense_cells(
    city: City,
    query: Query,
    n: int,
    encoded: EncodedCity,
    *,
    store: VectorStore | None = None,
    region: Region | None = None,
) -> NDArray[np.int64]:
    """Rows of the cells whose embeddings are nearest to that of the text (Eq. 11-13)."""
    text = encoded.network.embed_texts(encoded.text(query).graphs)
    near = (encoded.store if store is None else store).search(text, min(n, len(city.cells)), region)
    points = near.ids[0][near.ids[0] >= 0]
    return np.searchsorted(city.cells.points, points)


def within(city: City, positions: NDArray[np.float64], region: Region | None) -> NDArray[np.bool_]:
    """Whether positions (K, 2) [m] lie in a region."""
    if region is None:
        return np.ones(len(positions), np.bool_)
    region.checked()
    longitude, latitude = city.plane.to_lonlat(positions).T
    east, west = longitude <= region.east, longitude >= region.west
    across = east | west if region.crosses_date_line else east & west
    return across & (latitude >= region.south) & (latitude <= region.north)


def _views_within(city: City, region: Region | None) -> NDArray[np.bool_] | None:
    positions = city.views.positions
    return None if region is None else within(city, positions.astype(np.float64), region)


def _sparse_cells(city: City, query: Query, n: int, region: Region | None) -> NDArray[np.int64]:
    """Rows of the cells that hold the viewpoints of largest bound."""
    if not any(not s.negated for s in query.used):
        return np.zeros(0, np.int64)
    views = search.touched(query, city, SPARSE * n, _views_within(city, region))
    rows = city.cells.rows_at(city.views.positions[views].astype(np.float64))
    return np.array(list(dict.fromkeys(rows[rows >= 0].tolist()))[:n], np.int64)


def views_of_candidates(
    city: City,
    query: Query,
    n: int,
    by: By,
    encoded: EncodedCity | None,
    *,
    store: VectorStore | None = None,
    region: Region | None = None,
) -> NDArray[np.int64]:
    """Viewpoints (V,) in `n` dense candidates, and for ``both`` those of largest bound as well.

    `encoded` is needed for the former.
    """
    inside = _views_within(city, region)
    if by == "all":
        return np.arange(len(city.views.positions)) if inside is None else np.flatnonzero(inside)
    views = np.zeros(0, np.int64)
    if by in ("dense", "both") and encoded is not None:
        views = views_in(city, dense_cells(city, query, n, encoded, store=store, region=region))
    if by in ("sparse", "both"):
        views = np.union1d(views, search.touched(query, city, search.MOST_CANDIDATES, inside))
    return views


def views_in(city: City, rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Viewpoints (V,) that lie in cells, ascending."""
    half = city.cells.size / 2
    around = [city.views.near(center, half) for center in city.cells.centers(rows)]
    return np.unique(np.concatenate([np.zeros(0, np.int64), *around]))


def _scores(
    city: City,
    query: Query,
    matcher: Matcher,
    rows: NDArray[np.int64],
    encoded: EncodedCity,
    timeout: float,
) -> NDArray[np.float64]:
    """Scores (K,) of cells."""
    if matcher == "transformer":
        match = encoded.match(encoded.text(query), encoded.cells, rows)
        return match.logit.astype(np.float64)
    if matcher == "embedding":
        text = encoded.network.embed_texts(encoded.text(query).graphs)
        return (encoded.embeddings[rows] @ text[0]).astype(np.float64)
    if matcher == "edit-distance":
        from placegraph.outdoor.search.edit_distance import rank

        graphs = [city.graph(city.cells.id_of(row)) for row in rows]
        ranked = rank(query.description, graphs, centers=city.cells.centers(rows), timeout=timeout)
        scores = np.empty(len(rows))
        scores[ranked.rows] = -ranked.costs
        return scores
    return _relational(city, query, rows, encoded if matcher == "fused" else None)


def _relational(
    city: City, query: Query, rows: NDArray[np.int64], encoded: EncodedCity | None
) -> NDArray[np.float64]:
    """Log-likelihood ratio of the best viewpoint of each cell, shifted by the network."""
    scores = np.full(len(rows), -1e9)
    views = views_in(city, rows)
    if not len(views) or not any(not s.negated for s in query.used):
        return scores
    found = search.candidates(query, city, search.Prior(), rows=views, only=True)
    found = found if encoded is None else rerank(found, query, encoded)
    best = np.full(len(views), -1e9)
    best[np.searchsorted(views, found.rows)] = found.scores + found.log_prior
    for i, center in enumerate(city.cells.centers(rows)):  # cells may overlap
        mine = city.views.near(center, city.cells.size / 2)
        scores[i] = best[np.searchsorted(views, mine)].max(initial=-1e9)
    return scores
