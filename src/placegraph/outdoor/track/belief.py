"""Belief of a tracker: a grid of probabilities, its propagation by motion, and its update by texts.

The grid covers the viewpoints of a map and a margin; cells without a viewpoint (nothing is in sight
there) hold probability only after a motion. Probability that leaves the grid is elsewhere.

A filter needs the likelihood of all places, not only of the best, since motion may lead there. Places
that matter by belief and bound are scored as by `CityMap.locate`, others get their bound, calibrated
by those, and places without any object of a text in sight get its noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import hypot
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.estimate import Evidence
from placegraph.core.geometry import Floats
from placegraph.core.jit import kernel
from placegraph.language.text import LONGEST_TEXT
from placegraph.outdoor.language.description import Description
from placegraph.outdoor.likelihood.bound_kernels import find_views_by_bound
from placegraph.outdoor.likelihood.match_kernels import REJECTED, score_distant, score_views
from placegraph.outdoor.likelihood.query import Query
from placegraph.outdoor.map.city import City
from placegraph.outdoor.map.index import STRIDE, ViewIndex
from placegraph.outdoor.search.locate import find_evidence
from placegraph.outdoor.search.posterior import (
    MAX_DISTANT_CANDIDATES,
    NUM_REFINED,
    PRIOR_COHERENT,
    PRIOR_ELSEWHERE,
    SPACING,
    Posterior,
    find_views_near_distant,
    score_around,
)
from placegraph.outdoor.search.request import Request

MARGIN_CELLS = 15
"""Cells around the viewpoints: a speaker is tracked up to 300 m off the map."""
BACKGROUND_SHARE = 0.03
"""Share of the probability whose cells, the lightest, are shifted as a whole, where a belief fills more
than `MAX_SPREAD_CELLS` ..."""
MAX_SPREAD_CELLS = 40_000
"""... or all but so many: spreading makes so broad a belief no broader."""
SAMPLE_SPACING = 8.0
"""Largest distance of the samples of a motion [m] ..."""
MAX_SAMPLES = 400_000
"""... and their largest number."""
FOURIER_COST = 4e8
"""Product of cells and kernel cells from which motion is convolved by Fourier transform."""
MAX_DISTANCE = 5000.0
"""Length of a way after which nothing is left of the belief [m]."""
ODOMETRY_SHARE = 0.03
"""Standard deviation of measured motion, as a share of it ..."""
ODOMETRY_BASE = 1.0
"""... plus this [m]."""
COMPASS_SIGMA = 0.1
"""Standard deviation of a measured bearing [rad]."""
PRIOR_KIDNAPPED = 0.01
"""Probability that the speaker is somewhere else altogether after a motion."""
PRIOR_RETURNED = 0.2
"""Probability that a speaker who was elsewhere is on the map again after a motion."""


@dataclass(frozen=True, eq=False)
class TrackGrid:
    """Grid of square cells around the viewpoints of a map, at the stride of these."""

    low: Floats
    """(2,) centre of the first cell, east and north [m]."""
    rows: int
    columns: int
    cells: NDArray[np.int64]
    """(W,) cell of every viewpoint, ``row * columns + column``."""

    @classmethod
    def of_views(cls, views: ViewIndex) -> TrackGrid:
        """Make the grid of a map's viewpoints."""
        positions = views.positions.astype(np.float64)
        low = positions.min(axis=0) - MARGIN_CELLS * STRIDE
        column, row = np.rint((positions - low) / STRIDE).astype(np.int64).T
        rows, columns = int(row.max()) + MARGIN_CELLS + 1, int(column.max()) + MARGIN_CELLS + 1
        return cls(low, rows, columns, row * columns + column)

    def positions(self, cells: NDArray[np.int64]) -> Floats:
        """Return the centres (n, 2) of cells (n,), east and north [m]."""
        row, column = np.divmod(cells, self.columns)
        return np.asarray(self.low + STRIDE * np.stack([column, row], axis=1))


@dataclass(frozen=True, eq=False)
class Belief:
    """Probability of the speaker's place; `mass` and `elsewhere` sum to 1."""

    mass: NDArray[np.float32]
    """(rows, columns) probability of every cell."""
    elsewhere: float
    """Probability of being on no place of the grid."""

    @classmethod
    def start(cls, grid: TrackGrid, shares: Floats | None = None) -> Belief:
        """Make the belief before any text: `shares` (W,) of the viewpoints, or uniform.

        Shares sum to 1, or to less where the speaker may be off the map from the start.
        """
        mass = np.zeros(grid.rows * grid.columns, np.float32)
        mass[grid.cells] = (1.0 - PRIOR_ELSEWHERE) * (
            1.0 / len(grid.cells) if shares is None else shares
        )
        return cls(mass.reshape(grid.rows, grid.columns), 1.0 - float(mass.sum(dtype=np.float64)))


class MotionKernel(NamedTuple):
    """Convolution kernel of a motion."""

    row: int
    column: int
    """Displacement of the first entry, in cells."""
    weights: NDArray[np.float32]
    """(K, L), sums to 1."""
    mean: Floats
    """(2,) expected displacement [m]."""
    covariance: Floats
    """(2, 2) of the displacement [m^2]."""


def make_displacement_kernel(east: float, north: float, sigma: float) -> MotionKernel:
    """Make the kernel of a measured displacement [m], with its standard deviation along each axis [m]."""
    nodes, share = _discretize_normal(sigma)
    shift = np.stack(np.meshgrid(nodes, nodes, indexing="ij"), axis=-1).reshape(-1, 2)
    return _make_kernel(shift + np.array([east, north]), np.outer(share, share).ravel())


def odometry_sigma(length: float) -> float:
    """Return the standard deviation of a measured motion of some length [m]."""
    return ODOMETRY_SHARE * length + ODOMETRY_BASE


def make_walk_kernel(
    distance: float, sigma: float, bearing: float | None, bearing_sigma: float
) -> MotionKernel:
    """Make the kernel of a distance [m] in a direction [rad] with their deviations; None: any direction.

    Negative distances within the deviation count by their absolute value.
    """
    lengths, share = _discretize_normal(sigma, distance)
    reach = distance + 2.5 * sigma
    if bearing is None:
        n = max(16, min(1024, int(2.0 * np.pi * reach / SAMPLE_SPACING)))
        turns, odds = 2.0 * np.pi * (np.arange(n) + 0.5) / n, np.full(n, 1.0 / n)
    else:
        turns, odds = _discretize_normal(
            bearing_sigma, bearing, fine=SAMPLE_SPACING / max(reach, SAMPLE_SPACING)
        )
    if len(lengths) * len(turns) > MAX_SAMPLES:
        lengths, share = lengths[::4], share[::4] / share[::4].sum()
    d, b = np.meshgrid(np.abs(lengths), turns, indexing="ij")
    shift = np.stack([d * np.sin(b), d * np.cos(b)], axis=-1).reshape(-1, 2)
    return _make_kernel(shift, np.outer(share, odds).ravel())


def _discretize_normal(
    sigma: float, mean: float = 0.0, fine: float = SAMPLE_SPACING
) -> tuple[Floats, Floats]:
    """Return nodes and shares of a normal distribution, at most `fine` apart, out to 2.5 sigma."""
    if sigma <= 0.0:
        return np.array([mean]), np.ones(1)
    n = 2 * int(np.clip(2.5 * sigma / fine, 5, 400)) + 1
    z = np.linspace(-2.5, 2.5, n)
    share = np.exp(-0.5 * z * z)
    return mean + sigma * z, share / share.sum()


def _make_kernel(shift: Floats, share: Floats) -> MotionKernel:
    """Make the kernel of displacements (n, 2) [m] with shares (n,), each split between four cells.

    The mean stays exact; the variance grows by at most a quarter of a cell's square.
    """
    at, part = _split_bilinearly(shift / STRIDE, share)
    first = at.min(axis=0)
    columns, rows = at.max(axis=0) - first + 1
    flat = (at[:, 1] - first[1]) * columns + at[:, 0] - first[0]
    weights = np.bincount(flat, part, rows * columns).reshape(rows, columns)
    mean = share @ shift
    off = shift - mean
    covariance = (share[:, None] * off).T @ off
    return MotionKernel(int(first[1]), int(first[0]), weights.astype(np.float32), mean, covariance)


def _split_bilinearly(at: Floats, mass: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Split masses (n,) at positions (n, 2) [cells] between cells (4 n, 2), column and row."""
    base = np.floor(at)
    rest = at - base
    corners, parts = [], []
    for x in (0, 1):
        for y in (0, 1):
            corners.append(base + np.array([x, y]))
            parts.append(mass * np.abs(1 - x - rest[:, 0]) * np.abs(1 - y - rest[:, 1]))
    return np.concatenate(corners).astype(np.int64), np.concatenate(parts)


def add_mass(mass: NDArray[np.float32], grid: TrackGrid, positions: Floats, shares: Floats) -> None:
    """Add shares (n,) at positions (n, 2) [m] on the grid to the masses of its cells."""
    at, part = _split_bilinearly((positions - grid.low) / STRIDE, shares)
    np.add.at(mass, (at[:, 1], at[:, 0]), part.astype(np.float32))


def propagate(belief: Belief, motion: MotionKernel) -> Belief:
    """Propagate a belief by a motion; probability that leaves the grid is elsewhere."""
    mass, weights = belief.mass, motion.weights
    broad = np.count_nonzero(mass) > MAX_SPREAD_CELLS
    light = background(mass.ravel(), BACKGROUND_SHARE, MAX_SPREAD_CELLS) if broad else 0.0
    if np.count_nonzero(mass > light) * float(np.count_nonzero(weights)) > FOURIER_COST:
        out = _convolve_by_fourier(mass, motion)
    else:
        out = np.zeros_like(mass)
        used = weights > 0.0
        ends = weights.shape[1] - used[:, ::-1].argmax(axis=1)
        bounds = np.stack([used.argmax(axis=1), np.where(used.any(axis=1), ends, 0)], axis=1)
        column, row = np.rint(motion.mean / STRIDE).astype(int).tolist()
        scatter(
            mass, weights, bounds.astype(np.int64), motion.row, motion.column,
            light, (row, column), out,
        )  # fmt: skip
    return Belief(out, max(0.0, 1.0 - float(out.sum(dtype=np.float64))))


@kernel
def background(mass: NDArray[np.float32], share: float, most: int) -> float:
    """Find the mass below which cells (n,) are background: at most `share` of the total, or all but `most`.

    One pass over buckets by the leading bits of the numbers; at most a sixteenth too high.
    """
    bits = mass.view(np.int32)
    counts = np.zeros(1 << 12, np.int64)
    sums = np.zeros(1 << 12)
    for i in range(len(mass)):
        if mass[i] > 0.0:
            bucket = bits[i] >> 19
            counts[bucket] += 1
            sums[bucket] += mass[i]
    wanted = (1.0 - share) * sums.sum()
    kept, n = 0.0, 0
    for bucket in range(len(counts) - 1, -1, -1):
        n += counts[bucket]
        if n > most or kept >= wanted:
            edge = np.array([(bucket + 1) << 19], np.int32).view(np.float32)
            return float(edge[0])
        kept += sums[bucket]
    return 0.0


@kernel(finite=True)
def scatter(
    mass: NDArray[np.float32],
    weights: NDArray[np.float32],
    bounds: NDArray[np.int64],
    row: int,
    column: int,
    light: float,
    shift: tuple[int, int],
    out: NDArray[np.float32],
) -> None:
    """Convolve `mass` (R, C) with a motion kernel, and add it to `out` (R, C); mass off the grid is lost.

    Cell (i, j) of the kernel `weights` (K, L) stands for a displacement of (row + i, column + j)
    cells; in its row i only columns from `bounds[i, 0]` to `bounds[i, 1]` matter. Cells that hold less
    than `light` are shifted as a whole, by `shift` rows and columns.
    """
    rows, columns = mass.shape
    for r in range(rows):
        for c in range(columns):
            here = mass[r, c]
            if here < light or here == 0.0:
                if here > 0.0 and 0 <= r + shift[0] < rows and 0 <= c + shift[1] < columns:
                    out[r + shift[0], c + shift[1]] += here
                continue
            for i in range(max(0, -r - row), min(weights.shape[0], rows - r - row)):
                first = max(bounds[i, 0], -c - column)
                last = min(bounds[i, 1], columns - c - column)
                for j in range(first, last):
                    out[r + row + i, c + column + j] += here * weights[i, j]


def _convolve_by_fourier(mass: NDArray[np.float32], motion: MotionKernel) -> NDArray[np.float32]:
    """Convolve masses with a large kernel; equals `scatter` but for rounding."""
    shape = [m + k - 1 for m, k in zip(mass.shape, motion.weights.shape, strict=True)]
    product = np.fft.rfft2(mass, shape) * np.fft.rfft2(motion.weights, shape)
    full = np.fft.irfft2(product, shape)
    out = np.zeros(mass.shape, np.float32)
    to, of = [], []
    for shift, size, n in zip((motion.row, motion.column), mass.shape, shape, strict=True):
        first, last = max(0, shift), min(size, n + shift)
        to.append(slice(first, max(first, last)))
        of.append(slice(first - shift, max(first, last) - shift))
    out[tuple(to)] = np.maximum(full[tuple(of)], 0.0)
    return out


def inject_uniform(belief: Belief, grid: TrackGrid) -> Belief:
    """Inject uniform probability for a speaker who was lost, as in augmented Monte Carlo localization.

    A small share of the probability on the map, and a larger one of that elsewhere, becomes uniform.
    """
    fresh = PRIOR_KIDNAPPED * (1.0 - belief.elsewhere) + PRIOR_RETURNED * belief.elsewhere
    return mix_uniform(belief, grid, 1.0 - PRIOR_KIDNAPPED, 1.0 - PRIOR_RETURNED, fresh)


def mix_uniform(
    belief: Belief, grid: TrackGrid, stay_on_map: float, stay_elsewhere: float, fresh: float
) -> Belief:
    """Keep shares of the mass on the map and of the mass elsewhere; add `fresh` uniform mass."""
    mass = belief.mass * np.float32(stay_on_map)
    mass.ravel()[grid.cells] += np.float32(fresh * (1.0 - PRIOR_ELSEWHERE) / len(grid.cells))
    return Belief(mass, stay_elsewhere * belief.elsewhere + fresh * PRIOR_ELSEWHERE)


MAX_STATEMENTS = 24
"""Largest number of statements of the texts at one place that are parsed as one text."""
MIN_EVIDENCE = 0.1
"""Likelihood ratio under the belief below which a text may be from somewhere else."""
PRIOR_UNTOLD_MOTION = 0.02
"""Prior probability that the speaker has moved without telling."""
MIN_RELATIVE_MASS = 1e-5
"""Smallest mass of a cell in a mode, against the heaviest cell."""
MAX_REMEMBERED = 400
"""Largest number of positions of an earlier place."""


@dataclass(frozen=True, eq=False)
class Measurement:
    """Texts at one place, with the belief before and after."""

    prior: Belief
    texts: tuple[str | Description, ...] = ()
    query: Query | None = None
    log_evidence: float = 0.0
    """Log-likelihood ratio of the texts under the prior, against elsewhere."""
    updated: Belief | None = None
    """Belief after the texts; None where nothing was understood."""
    fine: tuple[Floats, Floats] | None = None
    """Positions (K, 2) [m] within the heaviest cells, and their probabilities (K,)."""

    @property
    def current(self) -> Belief:
        """Belief after all texts."""
        return self.prior if self.updated is None else self.updated

    def accepts(self, text: str | Description) -> bool:
        """Whether a text can be parsed together with those before."""
        if isinstance(text, Description) or any(isinstance(t, Description) for t in self.texts):
            return False
        if sum(len(str(t)) for t in (*self.texts, text)) + len(self.texts) > LONGEST_TEXT:
            return False
        return self.query is None or len(self.query.used) < MAX_STATEMENTS

    def update(
        self, texts: tuple[str | Description, ...], query: Query, city: City, grid: TrackGrid
    ) -> Measurement:
        """Update the prior by the likelihood of texts (Bayes' rule)."""
        prior = self.prior
        weights = prior.mass.ravel()[grid.cells].astype(np.float64)
        scores = score_belief(query, city, weights)
        highest = max(0.0, float(scores.views.max()))
        mass = prior.mass.ravel() * np.float32(np.exp(scores.nothing - highest))
        mass[grid.cells] = weights * np.exp(scores.views - highest)
        lost = prior.elsewhere * np.exp(-highest)
        total = float(mass.sum(dtype=np.float64)) + lost
        belief = Belief((mass / np.float32(total)).reshape(prior.mass.shape), lost / total)
        n = scores.ratios.shape[1]
        share = weights[scores.refined][:, None] / n * np.exp(scores.ratios - highest) / total
        fine = scores.positions.reshape(-1, 2), share.ravel()
        return Measurement(prior, texts, query, float(np.log(total)) + highest, belief, fine)

    def with_injection(self, grid: TrackGrid) -> Measurement:
        """Return a new measurement whose speaker may have moved without telling."""
        stays = 1.0 - PRIOR_UNTOLD_MOTION
        return Measurement(mix_uniform(self.current, grid, stays, stays, PRIOR_UNTOLD_MOTION))

    def to_refined_belief(self, grid: TrackGrid) -> Belief:
        """Return the belief with the mass of refined cells at their fine positions."""
        if self.fine is None:
            return self.current
        mass = self.current.mass.copy()
        mass.ravel()[_find_cells(grid, self.fine[0])] = 0.0
        add_mass(mass, grid, *self.fine)
        return Belief(mass, self.current.elsewhere)

    def to_posterior(self, grid: TrackGrid, most: int) -> Posterior:
        """Return the heaviest positions of the belief, fine ones where there are any."""
        mass = self.current.mass.ravel()
        cells = np.flatnonzero(mass > MIN_RELATIVE_MASS * mass.max())
        if len(cells) > most:
            cells = cells[np.argpartition(-mass[cells], most)[:most]]
            cells.sort()
        positions = grid.positions(cells)
        probabilities = mass[cells].astype(np.float64)
        if self.fine is not None:
            at, share = self.fine
            coarse = ~np.isin(cells, _find_cells(grid, at))
            positions = np.concatenate([at, positions[coarse]])
            probabilities = np.concatenate([share, probabilities[coarse]])
        return Posterior(positions, probabilities, self.current.elsewhere)

    def to_past(self, grid: TrackGrid) -> PastMeasurement | None:
        """Return the measurement of a place that the speaker leaves; None where nothing was understood."""
        if self.query is None:
            return None
        found = self.to_posterior(grid, MAX_REMEMBERED)
        some = found.probabilities > 0.0
        logs = np.log(found.probabilities[some])
        return PastMeasurement(
            self.query, found.positions[some], logs, np.zeros(2), np.zeros((2, 2))
        )


@dataclass(frozen=True, eq=False)
class PastMeasurement:
    """Query of an earlier place, and the motion since."""

    query: Query
    positions: Floats
    """(K, 2) positions of the place [m] ..."""
    log_probability: Floats
    """(K,) ... and their log probability."""
    shift: Floats
    """(2,) expected displacement since [m] ..."""
    spread: Floats
    """... and its covariance (2, 2) [m^2]."""

    def find_evidence(self, position: Floats, city: City) -> tuple[Evidence, ...]:
        """Find the evidence at the place that most likely led to a position (2,) [m]."""
        off = position - self.shift - self.positions
        loose = np.linalg.inv(self.spread + np.eye(2) * SPACING**2)
        fits = self.log_probability - 0.5 * np.einsum("ni,ij,nj->n", off, loose, off)
        at = self.positions[int(np.argmax(fits))]
        way = hypot(*(position - at))
        note = f"said {way:.0f} m before" if way >= 1.0 else "said earlier at this place"
        return tuple(
            replace(e, note="; ".join(part for part in (note, e.note) if part))
            for e in find_evidence(at, city, self.query)
        )

    def propagate(self, shift: Floats, spread: Floats) -> PastMeasurement:
        """Add a motion (2,) [m] with covariance (2, 2) [m^2]."""
        return replace(self, shift=self.shift + shift, spread=self.spread + spread)


def _find_cells(grid: TrackGrid, positions: Floats) -> NDArray[np.int64]:
    """Find the cells that hold positions (K, 2) [m]."""
    column, row = np.rint((positions - grid.low) / STRIDE).astype(np.int64).T
    return np.unique(row * grid.columns + column)


MAX_SCORED = 2500
"""Largest number of viewpoints that are scored."""
MARGIN = 12.0
"""Log-likelihood ratio to the best viewpoint beyond which others are not scored."""


class BeliefScores(NamedTuple):
    """Log-likelihood ratios of viewpoints against elsewhere."""

    views: Floats
    """(W,) ratios of all viewpoints."""
    nothing: float
    """Ratio of a place without any object in sight."""
    refined: NDArray[np.int64]
    """(B,) viewpoints that are scored again ..."""
    positions: Floats
    """(B, 9, 2) ... at these positions [m] ..."""
    ratios: Floats
    """(B, 9) ... with these ratios."""


def score_belief(query: Query, city: City, weights: Floats) -> BeliefScores:
    """Score a query under a belief: `weights` (W,) of the viewpoints, at any scale."""
    statements, views = query.statements, city.views
    relative = weights / max(float(weights.max()), 1e-300)
    request, nothing = Request(city, query), statements.floor
    ratios = np.full(len(weights), nothing)
    chosen, bounds, far = _find_candidates(query, city, relative)
    if not len(chosen):
        none = np.zeros(0)
        return BeliefScores(
            ratios, nothing, none.astype(np.int64), none.reshape(0, 9, 2), none[:, None]
        )
    prior = np.log(relative[chosen])
    first = slice(MAX_SCORED)
    found, _ = score_views(
        statements, city.columns, views.columns, request.token_weights, chosen[first], bounds[first],
        prior[first], far[first], PRIOR_COHERENT, MARGIN,
    )  # fmt: skip
    found = found.astype(np.float64)
    reached = np.flatnonzero(found > 0.5 * REJECTED)
    last = int(reached[-1]) + 1 if len(reached) else 0
    left = nothing
    if last:  # others keep the share of their bounds that the lightest third has
        tail = slice(2 * last // 3, last)
        left = float(np.logaddexp.reduce((found + prior[first])[tail]) - np.log(bounds[tail].sum()))
    least = float(np.log(statements.noise).sum())
    ratios[chosen] = np.maximum(np.log(bounds) - prior + left, least)
    ratios[chosen[reached]] = found[reached]
    best = reached[np.argsort(-(found + prior[first])[reached], kind="stable")[:NUM_REFINED]]
    positions, close = score_around(request, chosen[best], far[best])
    ratios[chosen[best]] = np.logaddexp.reduce(close, axis=1) - np.log(close.shape[1])
    return BeliefScores(ratios, nothing, chosen[best].astype(np.int64), positions, close)


def _find_candidates(
    query: Query, city: City, relative: Floats
) -> tuple[NDArray[np.int32], Floats, NDArray[np.float32]]:
    """Find viewpoints (K,), by descending bound, their bounds, and the share of distant objects."""
    statements, views = query.statements, city.views
    if statements.negated.all():
        chosen = np.argsort(-relative, kind="stable")[:MAX_SCORED].astype(np.int32)
        bounds = relative[chosen]
    else:
        chosen, bounds, _ = find_views_by_bound(
            statements, query.mentions, views.columns, relative, len(relative), 0, 0.0
        )
    chosen, bounds = chosen[bounds > 0.0], bounds[bounds > 0.0]
    far = np.zeros((min(len(chosen), MAX_SCORED), len(statements.op)), np.float32)
    if query.distant is None:
        return chosen, bounds, far
    extra = find_views_near_distant(city, query.distant, chosen)
    extra = extra[relative[extra] > 0.0]
    chosen = np.concatenate([chosen, extra])
    bounds = np.concatenate([bounds, relative[extra]])
    heavy = np.argsort(-bounds, kind="stable")[:MAX_DISTANT_CANDIDATES]
    heavy = np.union1d(heavy, np.arange(len(chosen) - len(extra), len(chosen)))
    added = score_distant(
        statements, city.columns, query.distant, views.positions_of(chosen[heavy])
    )
    log_bounds = np.log(bounds)
    log_bounds[heavy] += np.log1p(statements.gain * added).sum(axis=1)
    order = np.argsort(-log_bounds, kind="stable")
    row = np.full(len(chosen), -1)
    row[heavy] = np.arange(len(heavy))
    row = row[order[:MAX_SCORED]]
    far = np.where(row[:, None] >= 0, added[row], np.float32(0.0)).astype(np.float32)
    return chosen[order], np.exp(np.minimum(log_bounds[order], 690.0)), far
