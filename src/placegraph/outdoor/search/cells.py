"""The paper's pipeline on cells: candidates by embedding, then a matcher ranks them (Eq. 9-16).

`CityMap.locate` looks at viewpoints instead, which stand closer together than cells; what it does
with the network is in `rerank`. Here every matcher ranks the same cells, so that they compare.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.errors import OptionError
from placegraph.outdoor.language.description import Description
from placegraph.outdoor.likelihood.query import compile_query
from placegraph.outdoor.map.city import City
from placegraph.outdoor.search.posterior import (
    Candidates,
    Posterior,
    apply_bayes,
    find_candidate_cells,
    find_views_in_cells,
    rerank,
    score_candidates,
)
from placegraph.outdoor.search.request import LocationPrior, Matching, Request, is_count

TIMEOUT = 0.1
"""Time limit of one edit distance [s]."""


class Ranking(NamedTuple):
    """Cells, best first."""

    rows: NDArray[np.int64]
    """(k,) rows of `city.cells.points`."""
    cells: tuple[str, ...]
    """(k,) their ids."""
    scores: Floats
    """(k,) larger is better; what they are depends on the matcher: log-likelihood ratio, log odds,
    cosine, or minus edit distance."""


def retrieve(
    city: City,
    description: Description,
    matching: Matching | None = None,
    *,
    top: int = 5,
    timeout: float = TIMEOUT,
) -> Ranking:
    """Rank cells by how well they match a description: the best `top` of the candidates (Eq. 16).

    `matching` says how candidates are found and what ranks them, `timeout` is of one edit distance [s].

    Raises
    ------
    OptionError
        An option is out of range.
    StoreError
        The store is of another map or another network.
    DescriptionError
        Edit distance needs things in the text.

    """
    matching = matching or Matching()
    if not is_count(top):
        raise OptionError(f"top is {top!r}; give at least 1.")
    matching.check(city)
    request = Request(city, compile_query(description, city), matching=matching)
    rows, scores = rank_cells(request, timeout)
    best = np.argsort(-scores, kind="stable")[:top]
    ids = tuple(city.cells.id_of(row) for row in rows[best])
    return Ranking(rows[best], ids, scores[best])


def search_cells(request: Request) -> Posterior:
    """Posterior over the centres of cells, best first, that one of the paper's matchers has ranked.

    Log odds of matching are taken as log-likelihood ratios, and a cell that was not looked at fits
    as well as the lightest third of those that were: few candidates make nobody sure. A cosine or
    a number of edits is neither; there every cell keeps the probability of the prior.
    """
    rows, scores = rank_cells(request)
    if not len(rows):
        return Posterior(np.zeros((0, 2)), np.zeros(0), 1.0)
    best = np.argsort(-scores, kind="stable")
    rows, fits = (
        rows[best],
        np.zeros(len(rows)) if request.matching.is_ranking_only else scores[best],
    )
    centers = request.city.cells.centers(np.arange(len(request.city.cells)))
    log_prior = request.prior.evaluate(centers)
    log_prior -= np.logaddexp.reduce(log_prior, initial=-700.0)  # where all of it is forbidden
    tail = fits[2 * len(rows) // 3 :]
    left = max(1e-12, 1.0 - float(np.exp(log_prior[rows]).sum()))
    rest = np.log(left) + np.logaddexp.reduce(tail) - np.log(len(tail))
    total = np.logaddexp(np.logaddexp.reduce(fits + log_prior[rows]), rest)
    return apply_bayes(centers[rows], fits - total, log_prior[rows], rest - total)


def rank_cells(request: Request, timeout: float = TIMEOUT) -> tuple[NDArray[np.int64], Floats]:
    """Rows (K,) of `city.cells.points` of all candidates, and their scores (K,)."""
    rows = find_candidate_cells(request)
    if not len(rows):
        return rows, np.zeros(0)
    match request.matching.matcher:
        case "transformer":
            match = request.encoded.match(request.text, request.encoded.cells, rows)
            scores = match.cosine if request.matching.score == "cosine" else match.logit
            return rows, scores.astype(np.float64)
        case "embedding":
            cosine = request.encoded.embeddings[rows] @ request.embedding[0]
            return rows, cosine.astype(np.float64)
        case "edit-distance" | "edit-distance-plain":
            return rows, _by_edits(request, rows, timeout)
        case _:
            return rows, _relational(request, rows)


def _by_edits(request: Request, rows: NDArray[np.int64], timeout: float) -> Floats:
    """Minus the edit distances (K,) of cells."""
    from placegraph.outdoor.search.edit_distance import rank

    cells = request.city.cells
    graphs = [request.city.graph(cells.id_of(row)) for row in rows]
    ranked = rank(
        request.query.description, graphs, centers=cells.centers(rows), timeout=timeout,
        plain=request.matching.matcher == "edit-distance-plain",
    )  # fmt: skip
    scores = np.empty(len(rows))
    scores[ranked.rows] = -ranked.costs
    return scores


def _relational(request: Request, rows: NDArray[np.int64]) -> Floats:
    """Log-likelihood ratio of the best viewpoint of each cell, shifted by the network if `fused`."""
    city, scores = request.city, np.full(len(rows), -1e9)
    views = find_views_in_cells(city, rows)
    if not len(views) or not request.is_positive:
        return scores
    plain = replace(request, prior=LocationPrior())
    found = score_candidates(plain, Candidates.of_views(plain, views))
    found = rerank(plain, found) if request.matching.matcher == "fused" else found
    best = np.full(len(views), -1e9)
    best[np.searchsorted(views, found.rows)] = found.scores + found.log_prior
    for i, center in enumerate(city.cells.centers(rows)):  # cells may overlap
        mine = city.views.near(center, city.cells.size / 2)
        scores[i] = best[np.searchsorted(views, mine)].max(initial=-1e9)
    return scores
