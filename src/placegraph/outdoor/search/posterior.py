"""Candidates, their scores, the posterior over all viewpoints, and its modes (Eq. 11-17)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.core.jit import kernel
from placegraph.errors import StoreError
from placegraph.outdoor.likelihood.bound_kernels import (
    MAX_BOUND,
    find_views_by_bound,
    sample_systematic,
)
from placegraph.outdoor.likelihood.match_kernels import (
    REJECTED,
    score_distant,
    score_exact,
    score_views,
)
from placegraph.outdoor.likelihood.query import DistantObjects
from placegraph.outdoor.map.city import City
from placegraph.outdoor.network.graphs import PlaceGraphs
from placegraph.outdoor.search.request import Request

MAX_CANDIDATES = 400
"""Largest number of viewpoints that are scored for themselves ..."""
MAX_SAMPLES = 2048
"""... of samples, a power of two, that represent all others ..."""
MAX_DISTANT_CANDIDATES = 3000
"""... and of viewpoints that are bounded where a text mentions objects out of sight."""
DISTANT_REACH = 400.0
"""Largest distance of a candidate from a rare object that is mentioned from afar [m]."""
MAX_ANCHORS = 40
"""Largest number of such objects that give candidates."""
VIEWS_PER_CELL = 8
"""Number of viewpoints that are bounded for each candidate cell."""


class Candidates(NamedTuple):
    """Viewpoints to be scored: those of largest bound first, then samples of all others."""

    rows: NDArray[np.int32]
    """(K,) rows of `city.views`."""
    bounds: Floats
    """(K,) bounds on the likelihood ratio, times the prior against the largest."""
    distant: NDArray[np.float32]
    """(K, S) likelihood that objects out of sight add to each statement."""
    multiplicity: Floats
    """(K,) 0, or the number of viewpoints that a sample represents, itself included."""

    @classmethod
    def of_views(cls, request: Request, rows: NDArray[np.int64]) -> Candidates:
        """Make candidates of some viewpoints, each for itself."""
        statements, city = request.query.statements, request.city
        found = cls(
            rows.astype(np.int32), np.full(len(rows), MAX_BOUND),
            np.zeros((len(rows), len(statements.op)), np.float32), np.zeros(len(rows)),
        )  # fmt: skip
        if not request.query.distant:
            return found
        positions = city.views.positions_of(found.rows)
        added = score_distant(statements, city.columns, request.query.distant, positions)
        return found._replace(distant=added)

    def select(self, chosen: NDArray[Any] | slice) -> Candidates:
        """Return the candidates of some rows."""
        columns: Any = (column[chosen] for column in self)
        return Candidates(*columns)


def select_by_bound(
    bounds: Floats, multiplicity: Floats, most: int, samples: int = MAX_SAMPLES
) -> tuple[NDArray[np.int64], Floats]:
    """Select the `most` candidates of largest bound, and samples that represent all others.

    Columns (K,) are those of `Candidates`; returns the rows, and their new multiplicity.
    """
    own = np.flatnonzero(multiplicity == 0.0)
    order = own[np.argsort(-bounds[own], kind="stable")]
    others = np.concatenate([order[most:], np.flatnonzero(multiplicity)])
    counts = np.where(multiplicity[others] == 0.0, 1.0, multiplicity[others])
    drawn, represented = sample_systematic(bounds[others], counts, samples)
    best = np.zeros(min(most, len(own)))
    return np.concatenate([order[:most], others[drawn]]), np.concatenate([best, represented])


def find_candidates(request: Request, samples: int = MAX_SAMPLES, least: float = 0.0) -> Candidates:
    """Find viewpoints that the statements may have been made at, from the requested source.

    `samples`, a power of two, represent all others. Viewpoints of a bound below `least` are among
    those, unless the text mentions objects out of sight, which add to the bound.
    """
    query, views, source = request.query, request.city.views, request.matching.source
    weights = np.exp(request.log_prior.astype(np.float64) - request.highest)
    if source == "sparse":
        most = MAX_DISTANT_CANDIDATES if query.distant else MAX_CANDIDATES
        rows, bounds, multiplicity = find_views_by_bound(
            query.statements, query.mentions, views.columns, weights, most, samples,
            0.0 if query.distant else least,
        )  # fmt: skip
    else:
        rows = find_dense_views(request).astype(np.int32)
        bounds, multiplicity = np.full(len(rows), MAX_BOUND), np.zeros(len(rows))
    added = np.zeros((len(rows), len(query.statements.op)), np.float32)
    found = Candidates(rows, bounds, added, multiplicity)
    if query.distant:
        found = _add_distant(request, query.distant, weights, found, samples)
    return found if request.prior.inside is None else found.select(weights[found.rows] > 0.0)


def _add_distant(
    request: Request, far: DistantObjects, weights: Floats, candidates: Candidates, samples: int
) -> Candidates:
    """Add viewpoints around rare objects out of sight, and what those add to each statement."""
    statements, city = request.query.statements, request.city
    extra = find_views_near_distant(city, far, candidates.rows)
    extra = extra[:: 1 + len(extra) // MAX_DISTANT_CANDIDATES]
    chosen = np.concatenate([candidates.rows, extra])
    bounds = np.concatenate(
        [candidates.bounds, weights[extra] if len(weights) else np.ones(len(extra))]
    )
    multiplicity = np.concatenate([candidates.multiplicity, np.zeros(len(extra))])
    added = score_distant(statements, city.columns, far, city.views.positions_of(chosen))
    total = np.log(np.maximum(bounds, 1e-300)) + np.log1p(statements.gain * added).sum(axis=1)
    rows, multiplicity = select_by_bound(
        np.exp(total - total.max(initial=-np.inf)), multiplicity, MAX_CANDIDATES, samples
    )
    bounds = np.exp(np.minimum(total[rows], 690.0))
    return Candidates(chosen[rows], bounds, added[rows], multiplicity)


def find_views_near_distant(
    city: City, far: DistantObjects, chosen: NDArray[np.int32]
) -> NDArray[np.int32]:
    """Find viewpoints (K,) around rare objects that are not among the chosen, ascending."""
    anchors = locate_distant(city, far, far.anchors[:MAX_ANCHORS])
    around = [city.views.near(anchor, DISTANT_REACH) for anchor in anchors]
    return np.setdiff1d(np.concatenate([np.zeros(0, np.int64), *around]), chosen).astype(np.int32)


def locate_distant(city: City, far: DistantObjects, rows: NDArray[np.int64]) -> Floats:
    """Return the centres (K, 2) [m] of distant objects, and of sites beyond the map's own rows."""
    n = len(city.objects)
    own = city.objects.center[np.minimum(rows, n - 1)].astype(np.float64)
    if not len(far.sites):
        return own
    return np.where((rows < n)[:, None], own, far.sites[np.maximum(rows - n, 0)])


def _find_sparse_views(request: Request, most: int) -> NDArray[np.int32]:
    """Find at most `most` viewpoints of the region, of largest bound on their likelihood, best first."""
    inside, query = _find_region(request), request.query
    weights = np.zeros(0) if inside is None else inside.astype(np.float64)
    chosen, _, _ = find_views_by_bound(
        query.statements, query.mentions, request.city.views.columns, weights, most, 0, 0.0
    )
    return chosen if inside is None else chosen[inside[chosen]]


def _find_region(request: Request) -> NDArray[np.bool_] | None:
    """Return which viewpoints (W,) lie in the region; None where none was given."""
    if request.matching.region is None:
        return None
    return request.inside(request.city.views.positions.astype(np.float64))


def find_dense_views(request: Request) -> NDArray[np.int64]:
    """Find viewpoints (V,) in the cells of nearest embeddings; for ``both``, of largest bound as well."""
    source = request.matching.source
    if source == "all":
        inside = _find_region(request)
        return np.arange(len(request.city.views)) if inside is None else np.flatnonzero(inside)
    cells = find_dense_cells(request, request.matching.candidates)
    views = find_views_in_cells(request.city, cells)
    if source != "both":
        return views
    return np.union1d(views, _find_sparse_views(request, MAX_CANDIDATES))


def find_views_in_cells(city: City, rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Find the viewpoints (V,) that lie in cells, ascending."""
    half = city.cells.size / 2
    around = [city.views.near(center, half) for center in city.cells.centers(rows)]
    return np.unique(np.concatenate([np.zeros(0, np.int64), *around]))


def find_candidate_cells(request: Request) -> NDArray[np.int64]:
    """Find rows of `city.cells.points` that are worth matching, best first (Eq. 12-13)."""
    cells, n, source = request.city.cells, request.matching.candidates, request.matching.source
    if source == "all":
        return np.flatnonzero(request.inside(cells.centers(np.arange(len(cells)))))
    found = []
    if source != "sparse":
        found.append(find_dense_cells(request, n).tolist())
    if source != "dense":
        found.append(_find_sparse_cells(request, n))
    longest = max(map(len, found))
    turns = [rows[i] for i in range(longest) for rows in found if i < len(rows)]
    return np.array(list(dict.fromkeys(turns))[:n], np.int64)


def find_dense_cells(request: Request, n: int) -> NDArray[np.int64]:
    """Find rows of the `n` cells whose embeddings are nearest to that of the text (Eq. 11-13)."""
    store, cells = request.matching.store, request.city.cells
    store = request.encoded.store if store is None else store
    near = store.search(request.embedding, min(n, len(cells)), request.matching.region)
    ids = near.ids[0][near.ids[0] >= 0]
    rows = np.searchsorted(cells.points, ids)
    if (cells.points[np.minimum(rows, len(cells) - 1)] != ids).any():
        raise StoreError(
            "The vector store has cells that are not on this map; create it again with `placegraph "
            "city embed`."
        )
    return rows


def _find_sparse_cells(request: Request, n: int) -> list[int]:
    """Find rows of the cells that hold the viewpoints of largest bound."""
    if not request.is_positive:
        return []
    views = _find_sparse_views(request, VIEWS_PER_CELL * n)
    positions = request.city.views.positions_of(views).astype(np.float64)
    rows = request.city.cells.rows_at(positions)
    return list(dict.fromkeys(rows[rows >= 0].tolist()))[:n]


PRIOR_COHERENT = 0.3
"""Prior probability that a mention means one and the same object in all statements."""
MARGIN, NO_MARGIN = 12.0, 1e8
"""Log-likelihood ratio to the best viewpoint beyond which others are left out; and none."""
MIN_SAMPLES = 64
"""Number of samples that are scored first; then twice as many, and so on ..."""
TOLERANCE = 0.003
"""... until their standard error changes the probability of the best place by no more than this."""
NUM_REFINED = 8
"""Number of the best viewpoints that are scored again ..."""
SPACING = 6.67
"""... at positions this far apart [m] ..."""
FINE_OFFSETS = np.array(
    [(x, y) for x in (-SPACING, 0.0, SPACING) for y in (-SPACING, 0.0, SPACING)]
)
"""... around them, east and north [m]."""
NUM_RERANKED = 24
"""Number of the best viewpoints by relational matching that the network re-ranks."""
DENSE_RECALL, PRINTED_DENSE_RECALL = 0.4, 0.28
"""Probability that the place is near one of 50 cells that embeddings propose, in a large city (120 texts
each: Vancouver .33, Ankara .43, Liechtenstein .43; by the network as printed .24, .31, .30): an estimate
by these alone cannot be surer."""


class ScoredViews(NamedTuple):
    """Scored candidates, and the weight of all other viewpoints."""

    rows: NDArray[np.int32]
    """(K,) rows of `city.views`."""
    scores: NDArray[np.float32]
    """(K,) log-likelihood ratios."""
    log_prior: Floats
    """(K,)"""
    distant: NDArray[np.float32]
    """(K, S) likelihood that objects out of sight add to each statement."""
    log_rest: float = -np.inf
    """Log weight of all other viewpoints together, as estimated by samples."""


def score_candidates(
    request: Request, candidates: Candidates, margin: float = MARGIN
) -> ScoredViews:
    """Score candidates, and as many samples of all other viewpoints as it takes to be sure.

    Viewpoints whose sum over statements (`score_views`) lies `margin` below the best are left out.
    """
    sampled = candidates.multiplicity > 0.0
    own, samples = candidates.select(~sampled), candidates.select(sampled)
    scored = _score_all(request, own, margin)
    mass = (
        np.exp(scored.log_prior).sum()
        + np.exp(request.relative(samples.rows) + request.highest) @ samples.multiplicity
    )
    rest = request.query.statements.floor + float(np.log(max(1e-12, 1.0 - mass)))
    kept = scored.scores > 0.5 * REJECTED
    columns: Any = (column[kept] for column in scored[:4])
    scored = ScoredViews(*columns)
    if len(scored.rows):
        rest = float(np.logaddexp(rest, _estimate_rest(request, samples, scored)))
    return scored._replace(log_rest=rest)


def _score_all(request: Request, candidates: Candidates, margin: float) -> ScoredViews:
    rows, relative = candidates.rows, request.relative(candidates.rows)
    scores, _ = score_views(
        request.query.statements, request.city.columns, request.city.views.columns, request.token_weights,
        rows, candidates.bounds, relative, candidates.distant, PRIOR_COHERENT, margin,
    )  # fmt: skip
    return ScoredViews(rows, scores, relative + request.highest, candidates.distant)


def _estimate_rest(request: Request, samples: Candidates, scored: ScoredViews) -> float:
    """Estimate the log weight of all viewpoints that were not found, by samples of them."""
    here = scored.scores + scored.log_prior
    total, best = float(np.logaddexp.reduce(here)), int(np.argmax(here))
    positions = request.city.views.positions_of(scored.rows)
    away = np.hypot(*(positions - positions[best]).T)
    near = float(np.exp(here - total) @ (away <= MODE_RADIUS))
    weights, rest = np.zeros(0), 0.0
    while not are_samples_enough(weights, len(samples.rows), near):
        some = samples.select(slice(len(weights), max(MIN_SAMPLES, 2 * len(weights))))
        more = _score_all(request, some, NO_MARGIN)
        shares = np.exp(more.scores + more.log_prior - total) * some.multiplicity
        weights = np.concatenate([weights, shares])
        rest = weights.mean() * len(samples.rows)
    return total + float(np.log(max(1e-300, rest)))


def are_samples_enough(weights: Floats, drawn: int, near: float) -> bool:
    """Whether chance alters the probability of the best place by no more than `TOLERANCE`.

    `weights` (K,) are those of the first of `drawn` samples, as shares of what was scored for
    itself; of that the best place holds the share `near`.
    """
    if not 0 < len(weights) < drawn:
        return len(weights) == drawn
    off, rest = weights.std() / np.sqrt(len(weights)) * drawn, weights.mean() * drawn
    return bool(near * off <= TOLERANCE * (1.0 + rest) ** 2)


def rerank(request: Request, scored: ScoredViews) -> ScoredViews:
    """Add the scores of the network to the log prior of the best viewpoints (Eq. 14-17).

    Probability shifts among these viewpoints; all of them together weigh against the rest of the city
    and against elsewhere as before.
    """
    before = scored.scores + scored.log_prior
    best = np.argsort(-before, kind="stable")[:NUM_RERANKED]
    if len(best) < 2:
        return scored
    encoded = request.encoded
    places = PlaceGraphs.of_views(encoded.city, scored.rows[best].astype(np.int64))
    match = encoded.match(request.text, places, np.arange(len(best)))
    _, scale, weight = encoded.network.arrays["prior"]
    after = scale * scored.scores[best] + weight * match.residual + scored.log_prior[best]
    after += np.logaddexp.reduce(before[best]) - np.logaddexp.reduce(after)
    log_prior = scored.log_prior.copy()
    log_prior[best] += after - before[best]
    return scored._replace(log_prior=log_prior)


@dataclass(frozen=True)
class Posterior:
    """Probabilities of viewpoints; the remainder to 1 lies elsewhere, or was not scored."""

    positions: Floats
    """(K, 2) east, north [m]."""
    probabilities: Floats
    """(K,)"""
    elsewhere: float
    """Probability that the place is not on this map, or that the text is not about one."""

    def mass_within(self, position: Floats, radius: float) -> float:
        """Return the probability of a place within `radius` [m] of a position (2,)."""
        east, north = (self.positions - position).T
        return float(self.probabilities[east * east + north * north <= radius * radius].sum())


def compute_posterior(request: Request, scored: ScoredViews) -> Posterior:
    """Score the best viewpoints again at finer positions, and apply Bayes' rule to all.

    Candidates by embeddings alone hold the right one with probability `DENSE_RECALL` (by the network as
    printed `PRINTED_DENSE_RECALL`), and together weigh no more than that.
    """
    order = np.argsort(-(scored.scores + scored.log_prior), kind="stable")
    best, others = order[:NUM_REFINED], np.sort(order[NUM_REFINED:])
    fine, ratios = score_around(request, scored.rows[best], scored.distant[best])
    share = np.repeat(scored.log_prior[best] - np.log(len(FINE_OFFSETS)), len(FINE_OFFSETS))
    positions = request.city.views.positions_of(scored.rows[others]).astype(np.float64)
    positions = np.concatenate([positions, fine.reshape(-1, 2)])
    scores = np.concatenate([scored.scores[others], ratios.ravel()]).astype(np.float64)
    log_prior = np.concatenate([scored.log_prior[others], share])
    rest = scored.log_rest
    if request.matching.source == "dense" and len(scores):
        here = np.logaddexp.reduce(scores + log_prior)
        recall = PRINTED_DENSE_RECALL if request.encoded.printed else DENSE_RECALL
        rest = max(rest, float(here + np.log(1.0 / recall - 1.0)))
    return apply_bayes(positions, scores, log_prior, rest)


def score_around(
    request: Request, rows: NDArray[np.int32], added: NDArray[np.float32]
) -> tuple[Floats, Floats]:
    """Score fine positions (B, 9, 2) [m] around viewpoints (B,); return these and their scores (B, 9)."""
    positions = request.city.views.positions_of(rows).astype(np.float64)[:, None] + FINE_OFFSETS
    seen = request.city.in_sight(rows)
    ratios, _, _ = score_exact(
        request.query.statements, request.city.columns, request.token_weights, positions,
        (seen.starts, seen.objects), np.repeat(added[:, None], len(FINE_OFFSETS), axis=1),
        PRIOR_COHERENT, False,
    )  # fmt: skip
    return positions, ratios.astype(np.float64)


def make_prior_posterior(request: Request) -> Posterior:
    """Return the prior as the posterior of a text that only tells the way to the place."""
    views, log_prior = request.city.views, request.log_prior
    likely = np.argsort(-log_prior, kind="stable")[:MAX_DISTANT_CANDIDATES]
    norm = np.logaddexp.reduce(log_prior)
    rest = np.log(max(1e-12, 1.0 - np.exp(log_prior[likely] - norm).sum()))
    positions = views.positions_of(likely).astype(np.float64)
    return apply_bayes(positions, np.zeros(len(likely)), log_prior[likely] - norm, float(rest))


PRIOR_ELSEWHERE = 0.03
"""Prior probability that the place is not on the map."""


def apply_bayes(positions: Floats, scores: Floats, log_prior: Floats, log_rest: float) -> Posterior:
    """Apply Bayes' rule to viewpoints.

    `scores` (K,) are log-likelihood ratios against anywhere, `log_prior` (K,) log shares of the
    viewpoints, `log_rest` is the log weight of all viewpoints that were not scored.
    """
    here = scores + log_prior
    log_total = np.logaddexp.reduce(np.concatenate((here, [log_rest])) + np.log1p(-PRIOR_ELSEWHERE))
    log_total = np.logaddexp(log_total, np.log(PRIOR_ELSEWHERE))
    probabilities = np.exp(here + np.log1p(-PRIOR_ELSEWHERE) - log_total)
    return Posterior(positions, probabilities, float(np.exp(np.log(PRIOR_ELSEWHERE) - log_total)))


MODE_RADIUS = 50.0
"""A mode's probability is that of the true place lying within this distance [m]."""
MODE_SEPARATION = 40.0
"""Smallest distance of two modes [m]."""
MIN_PEAKS = 8
"""Smallest number of peaks that are compared: the first one found is not always the heaviest."""
NUM_SEEDS = 32
"""Number of heaviest points that peaks are sought around."""


@dataclass(frozen=True)
class Mode:
    """A peak of the posterior."""

    position: Floats
    """(2,) east, north [m]."""
    covariance: Floats
    """(2, 2) [m^2]."""
    probability: float


def find_modes(posterior: Posterior, top: int, spacing: float) -> list[Mode]:
    """Find the heaviest peaks of a posterior whose positions lie on a grid of `spacing` [m]."""
    seeds = np.argsort(-posterior.probabilities, kind="stable")[:NUM_SEEDS]
    own = (spacing**2 / 12.0 + 1.0) * np.eye(2)
    places, covariances, masses = find_peaks(
        posterior.positions, posterior.probabilities, seeds, max(top, MIN_PEAKS), MODE_SEPARATION,
        MODE_RADIUS,
    )  # fmt: skip
    return [
        Mode(places[i], covariances[i] + own, min(1.0, float(masses[i])))
        for i in np.argsort(-masses, kind="stable")[:top].tolist()
    ]


def rank_modes(posterior: Posterior, top: int, spacing: float) -> list[Mode]:
    """Find peaks of positions in their order, best first, whatever they weigh; see `find_modes`."""
    # each outweighs all below it together
    weights = 0.5 ** np.arange(1.0, 1.0 + len(posterior.positions))
    best = find_modes(replace(posterior, probabilities=weights), top, spacing)
    return [
        replace(mode, probability=posterior.mass_within(mode.position, MODE_RADIUS))
        for mode in best
    ]


@kernel(finite=True)
def find_peaks(  # noqa: C901, PLR0912  # one compiled loop
    positions: Floats,
    probabilities: Floats,
    seeds: NDArray[np.int64],
    most: int,
    separation: float,
    radius: float,
) -> tuple[Floats, Floats, Floats]:
    """Find up to `most` peaks, those with most mass around first: positions, covariances, masses.

    A peak is the mean of what is not more than `separation` [m] from one of the `seeds`, since peaks
    are broad, not sharp; it holds what lies within `radius` [m] of it, and belongs to no other.
    """
    left = probabilities.copy()
    smooth = np.empty(len(seeds))
    for h in range(len(seeds)):
        smooth[h] = 1e-3 * left[seeds[h]]
        for i in range(len(left)):
            if _is_near(positions[i], positions[seeds[h]], separation):
                smooth[h] += left[i]
    place, covariance, mass = np.empty((most, 2)), np.zeros((most, 2, 2)), np.zeros(most)
    n = 0
    while n < most and len(seeds):
        best = np.argmax(smooth)
        if smooth[best] <= 1e-9:
            break
        middle = positions[seeds[best]]
        total = east = north = 0.0
        for i in range(len(left)):
            if _is_near(positions[i], middle, separation):
                total += left[i]
                east += left[i] * positions[i, 0]
                north += left[i] * positions[i, 1]
        for h in range(len(seeds)):
            if _is_near(positions[seeds[h]], middle, separation):
                smooth[h] = 0.0
        if total <= 0.0:
            continue
        place[n, 0], place[n, 1] = east / total, north / total
        for i in range(len(left)):
            if _is_near(positions[i], middle, separation):
                x, y = positions[i, 0] - place[n, 0], positions[i, 1] - place[n, 1]
                share = left[i] / total
                covariance[n, 0, 0] += share * x * x
                covariance[n, 0, 1] += share * x * y
                covariance[n, 1, 1] += share * y * y
        covariance[n, 1, 0] = covariance[n, 0, 1]
        for i in range(len(left)):
            if _is_near(positions[i], place[n], radius):
                mass[n] += left[i]
                left[i] = 0.0
        for h in range(len(seeds)):
            if _is_near(positions[seeds[h]], place[n], radius):
                smooth[h] = 0.0
        n += 1
    return place[:n], covariance[:n], mass[:n]


@kernel(inline=True)
def _is_near(a: Floats, b: Floats, reach: float) -> bool:
    """Whether two points (2,) lie within a distance."""
    east, north = a[0] - b[0], a[1] - b[1]
    return east * east + north * north <= reach * reach
