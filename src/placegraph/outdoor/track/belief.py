"""Belief of a tracker: a grid of probabilities, how motion spreads it, and what one stop adds.

The grid covers the map's viewpoints and a margin; cells without a viewpoint (nothing is in sight
there) hold probability only where motion brought it. What leaves the grid is elsewhere.

`locate` asks where the best places are; a filter must also know how the rest compares, since motion
may lead there. So the places that matter by belief and bound are scored as `locate` scores them, the
others keep their bound, calibrated by those, and what sees nothing of a text keeps the noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import hypot
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.estimate import Evidence
from placegraph.core.geometry import Floats
from placegraph.language.text import LONGEST_TEXT
from placegraph.outdoor.language.description import Description
from placegraph.outdoor.likelihood.bound_kernels import promising_views
from placegraph.outdoor.likelihood.match_kernels import HOPELESS, distant, score_views
from placegraph.outdoor.likelihood.query import Query
from placegraph.outdoor.map.city import City
from placegraph.outdoor.map.index import STRIDE, ViewIndex
from placegraph.outdoor.search.answer import find_evidence
from placegraph.outdoor.search.candidates import FAR_CANDIDATES, find_around_far
from placegraph.outdoor.search.posterior import (
    CLOSER,
    ELSEWHERE,
    SPACING,
    TOGETHER,
    Posterior,
    look_around,
)
from placegraph.outdoor.search.posterior_kernels import background, scatter
from placegraph.outdoor.search.request import Request

BORDER = 15
"""Cells around the viewpoints: whoever leaves the map by 300 m is still followed."""
BACKGROUND = 0.03
"""Of a belief in more cells than `MOST_SPREAD`, the lightest are shifted whole: so much of the
probability ..."""
MOST_SPREAD = 40_000
"""... or all but so many. What is that broad is no broader for being spread."""
FINE = 8.0
"""A motion is sampled at least this finely [m] ..."""
MOST_SAMPLES = 400_000
"""... by no more samples than this."""
WIDE = 4e8
"""Cells times cells of the kernel from which motion goes through the Fourier transform."""
FARTHEST = 5000.0
"""After a way longer than this nothing is left of what was known [m]."""
ODOMETRY = 0.03
"""Deviation of measured motion, as a share of it ..."""
STEP = 1.0
"""... plus this [m]."""
COMPASS = 0.1
"""Deviation of a measured bearing [rad]."""
KIDNAPPED = 0.01
"""Probability that the speaker is somewhere else altogether after a motion."""
RETURNED = 0.2
"""Probability that who was elsewhere is on the map again after a motion."""


@dataclass(frozen=True, eq=False)
class TrackGrid:
    """Square cells around the viewpoints of a map, as wide as these stand apart."""

    low: Floats
    """(2,) centre of the first cell, east and north [m]."""
    rows: int
    columns: int
    cells: NDArray[np.int64]
    """(W,) cell of every viewpoint, ``row * columns + column``."""

    @classmethod
    def of(cls, views: ViewIndex) -> TrackGrid:
        """Grid of a map's viewpoints."""
        positions = views.positions.astype(np.float64)
        low = positions.min(axis=0) - BORDER * STRIDE
        column, row = np.rint((positions - low) / STRIDE).astype(np.int64).T
        rows, columns = int(row.max()) + BORDER + 1, int(column.max()) + BORDER + 1
        return cls(low, rows, columns, row * columns + column)

    def positions(self, cells: NDArray[np.int64]) -> Floats:
        """Centres (n, 2) of cells (n,), east and north [m]."""
        row, column = np.divmod(cells, self.columns)
        return np.asarray(self.low + STRIDE * np.stack([column, row], axis=1))


@dataclass(frozen=True, eq=False)
class Belief:
    """Probability of the speaker's place; masses and `elsewhere` sum to 1."""

    mass: NDArray[np.float32]
    """(rows, columns) probability of every cell."""
    elsewhere: float
    """Probability of being on no place of the grid."""

    @classmethod
    def start(cls, grid: TrackGrid, shares: Floats | None = None) -> Belief:
        """Belief before a word is heard: `shares` (W,) of the viewpoints, or all alike.

        Shares sum to 1, or to less where the speaker may have been off the map from the start.
        """
        mass = np.zeros(grid.rows * grid.columns, np.float32)
        mass[grid.cells] = (1.0 - ELSEWHERE) * (1.0 / len(grid.cells) if shares is None else shares)
        return cls(mass.reshape(grid.rows, grid.columns), 1.0 - float(mass.sum(dtype=np.float64)))


class Kernel(NamedTuple):
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


def make_displacement(east: float, north: float, sigma: float) -> Kernel:
    """Kernel of a measured displacement [m], with its standard deviation along each axis [m]."""
    along = _normal(sigma)
    shift, share = _grid_of(along, along)
    return _kernel(shift + np.array([east, north]), share)


def odometry_sigma(length: float) -> float:
    """Deviation of a measured motion of this length [m]."""
    return ODOMETRY * length + STEP


def make_walk(distance: float, sigma: float, bearing: float | None, bearing_sigma: float) -> Kernel:
    """Kernel of a distance [m] in a direction [rad], each with its deviation; None: in any direction.

    A negative distance that the deviation allows counts as its amount: who hardly moved may have
    gone to any side.
    """
    lengths, share = _normal(sigma, distance)
    reach = distance + 2.5 * sigma
    if bearing is None:
        n = max(16, min(1024, int(2.0 * np.pi * reach / FINE)))
        turns, odds = 2.0 * np.pi * (np.arange(n) + 0.5) / n, np.full(n, 1.0 / n)
    else:
        turns, odds = _normal(bearing_sigma, bearing, fine=FINE / max(reach, FINE))
    if len(lengths) * len(turns) > MOST_SAMPLES:
        lengths, share = lengths[::4], share[::4] / share[::4].sum()
    d, b = np.meshgrid(np.abs(lengths), turns, indexing="ij")
    shift = np.stack([d * np.sin(b), d * np.cos(b)], axis=-1).reshape(-1, 2)
    return _kernel(shift, np.outer(share, odds).ravel())


def _normal(sigma: float, mean: float = 0.0, fine: float = FINE) -> tuple[Floats, Floats]:
    """Nodes and shares of a normal distribution, `fine` apart at the most, out to 2.5 sigma."""
    if sigma <= 0.0:
        return np.array([mean]), np.ones(1)
    n = 2 * int(np.clip(2.5 * sigma / fine, 5, 400)) + 1
    z = np.linspace(-2.5, 2.5, n)
    share = np.exp(-0.5 * z * z)
    return mean + sigma * z, share / share.sum()


def _grid_of(x: tuple[Floats, Floats], y: tuple[Floats, Floats]) -> tuple[Floats, Floats]:
    east, north = np.meshgrid(x[0], y[0], indexing="ij")
    return np.stack([east, north], axis=-1).reshape(-1, 2), np.outer(x[1], y[1]).ravel()


def _kernel(shift: Floats, share: Floats) -> Kernel:
    """Kernel of displacements (n, 2) [m] with shares (n,), each split between its four cells.

    So the mean is kept exactly; the variance grows by a quarter of a cell's square at the most.
    """
    at, part = _split(shift / STRIDE, share)
    first = at.min(axis=0)
    columns, rows = at.max(axis=0) - first + 1
    flat = (at[:, 1] - first[1]) * columns + at[:, 0] - first[0]
    weights = np.bincount(flat, part, rows * columns).reshape(rows, columns)
    mean = share @ shift
    off = shift - mean
    return Kernel(
        int(first[1]),
        int(first[0]),
        weights.astype(np.float32),
        mean,
        (share[:, None] * off).T @ off,
    )


def _split(at: Floats, mass: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Cells (4 n, 2) column and row, and parts (4 n,) of masses (n,) at positions (n, 2) in cells."""
    base = np.floor(at)
    rest = at - base
    corners, parts = [], []
    for x in (0, 1):
        for y in (0, 1):
            corners.append(base + np.array([x, y]))
            parts.append(mass * np.abs(1 - x - rest[:, 0]) * np.abs(1 - y - rest[:, 1]))
    return np.concatenate(corners).astype(np.int64), np.concatenate(parts)


def add_positions(
    mass: NDArray[np.float32], grid: TrackGrid, positions: Floats, shares: Floats
) -> None:
    """Add shares (n,) at positions (n, 2) [m] on the grid to the masses of its cells."""
    at, part = _split((positions - grid.low) / STRIDE, shares)
    np.add.at(mass, (at[:, 1], at[:, 0]), part.astype(np.float32))


def propagate(belief: Belief, kernel: Kernel) -> Belief:
    """Belief after a motion; what leaves the grid is elsewhere."""
    mass, weights = belief.mass, kernel.weights
    broad = np.count_nonzero(mass) > MOST_SPREAD
    light = background(mass.ravel(), BACKGROUND, MOST_SPREAD) if broad else 0.0
    if np.count_nonzero(mass > light) * float(np.count_nonzero(weights)) > WIDE:
        out = _by_fourier(mass, kernel)
    else:
        out = np.zeros_like(mass)
        used = weights > 0.0
        ends = weights.shape[1] - used[:, ::-1].argmax(axis=1)
        bounds = np.stack([used.argmax(axis=1), np.where(used.any(axis=1), ends, 0)], axis=1)
        column, row = np.rint(kernel.mean / STRIDE).astype(int).tolist()
        scatter(
            mass, weights, bounds.astype(np.int64), kernel.row, kernel.column,
            light, (row, column), out,
        )  # fmt: skip
    return Belief(out, max(0.0, 1.0 - float(out.sum(dtype=np.float64))))


def _by_fourier(mass: NDArray[np.float32], kernel: Kernel) -> NDArray[np.float32]:
    """Convolution of a large kernel; the same as `scatter` but for rounding."""
    shape = [m + k - 1 for m, k in zip(mass.shape, kernel.weights.shape, strict=True)]
    product = np.fft.rfft2(mass, shape) * np.fft.rfft2(kernel.weights, shape)
    full = np.fft.irfft2(product, shape)
    out = np.zeros(mass.shape, np.float32)
    to, of = [], []
    for shift, size, n in zip((kernel.row, kernel.column), mass.shape, shape, strict=True):
        first, last = max(0, shift), min(size, n + shift)
        to.append(slice(first, max(first, last)))
        of.append(slice(first - shift, max(first, last) - shift))
    out[tuple(to)] = np.maximum(full[tuple(of)], 0.0)
    return out


def inject_uniform(belief: Belief, grid: TrackGrid) -> Belief:
    """Belief that allows for having been lost on the way, as in augmented Monte Carlo localization.

    A small share of what is on the map, and a larger one of what is elsewhere, starts anew anywhere.
    """
    fresh = KIDNAPPED * (1.0 - belief.elsewhere) + RETURNED * belief.elsewhere
    return mix_uniform(belief, grid, 1.0 - KIDNAPPED, 1.0 - RETURNED, fresh)


def mix_uniform(belief: Belief, grid: TrackGrid, kept: float, stays: float, fresh: float) -> Belief:
    """Keep a share of the map's mass, and of what is elsewhere; `fresh` mass starts anew."""
    mass = belief.mass * np.float32(kept)
    mass.ravel()[grid.cells] += np.float32(fresh * (1.0 - ELSEWHERE) / len(grid.cells))
    return Belief(mass, stays * belief.elsewhere + fresh * ELSEWHERE)


MOST_STATEMENTS = 24
"""What was said at one place is read as one text up to so many statements."""
SURPRISED = 0.1
"""A text that believed places explain worse than this may have been said somewhere else."""
UNTOLD = 0.02
"""Prior probability that the speaker has moved without a word."""
LIGHT = 1e-5
"""Cells lighter than this, against the heaviest, are no part of a mode."""
MOST_REMEMBERED = 400
"""At most this many positions of a place that was left are kept."""


@dataclass(frozen=True, eq=False)
class Stop:
    """A place at which something was said, and what is believed of it."""

    arrival: Belief
    texts: tuple[str | Description, ...] = ()
    query: Query | None = None
    log_evidence: float = 0.0
    """Log probability of the texts against being said elsewhere [nat]."""
    belief: Belief | None = None
    """After the texts; None where nothing was understood."""
    fine: tuple[Floats, Floats] | None = None
    """Positions (K, 2) [m] within the heaviest cells, and their probabilities (K,)."""

    @property
    def now(self) -> Belief:
        """Return what is believed after all that was said."""
        return self.arrival if self.belief is None else self.belief

    def goes_on(self, text: str | Description) -> bool:
        """Whether a text can be read together with those said here."""
        if isinstance(text, Description) or any(isinstance(t, Description) for t in self.texts):
            return False
        if sum(len(str(t)) for t in (*self.texts, text)) + len(self.texts) > LONGEST_TEXT:
            return False
        return self.query is None or len(self.query.used) < MOST_STATEMENTS

    def update(
        self, texts: tuple[str | Description, ...], query: Query, city: City, grid: TrackGrid
    ) -> Stop:
        """Bayes: the belief on arrival times the likelihood of what was said."""
        arrival = self.arrival
        weights = arrival.mass.ravel()[grid.cells].astype(np.float64)
        scores = score_belief(query, city, weights)
        highest = max(0.0, float(scores.views.max()))
        mass = arrival.mass.ravel() * np.float32(np.exp(scores.nothing - highest))
        mass[grid.cells] = weights * np.exp(scores.views - highest)
        lost = arrival.elsewhere * np.exp(-highest)
        total = float(mass.sum(dtype=np.float64)) + lost
        return Stop(
            arrival,
            texts,
            query,
            float(np.log(total)) + highest,
            Belief((mass / np.float32(total)).reshape(arrival.mass.shape), lost / total),
            _fine(scores, weights, highest, total),
        )

    def unsure(self, grid: TrackGrid) -> Stop:
        """Return a fresh one, whose speaker may have moved without a word."""
        return Stop(mix_uniform(self.now, grid, 1.0 - UNTOLD, 1.0 - UNTOLD, UNTOLD))

    def placed(self, grid: TrackGrid) -> Belief:
        """Belief in which the heaviest cells lie where the closer look saw them."""
        if self.fine is None:
            return self.now
        mass = self.now.mass.copy()
        mass.ravel()[_cells_at(grid, self.fine[0])] = 0.0
        add_positions(mass, grid, *self.fine)
        return Belief(mass, self.now.elsewhere)

    def posterior(self, grid: TrackGrid, most: int) -> Posterior:
        """Heaviest positions of the belief, fine ones where there are any."""
        mass = self.now.mass.ravel()
        cells = np.flatnonzero(mass > LIGHT * mass.max())
        if len(cells) > most:
            cells = cells[np.argpartition(-mass[cells], most)[:most]]
            cells.sort()
        positions = grid.positions(cells)
        probabilities = mass[cells].astype(np.float64)
        if self.fine is not None:
            at, share = self.fine
            coarse = ~np.isin(cells, _cells_at(grid, at))
            positions = np.concatenate([at, positions[coarse]])
            probabilities = np.concatenate([share, probabilities[coarse]])
        return Posterior(positions, probabilities, self.now.elsewhere)

    def memory(self, grid: TrackGrid) -> Memory | None:
        """Return what stays of it once it is left; None where nothing was understood."""
        if self.query is None:
            return None
        found = self.posterior(grid, MOST_REMEMBERED)
        some = found.probabilities > 0.0
        nowhere = np.zeros(2)
        odds = np.log(found.probabilities[some])
        return Memory(self.query, found.positions[some], odds, nowhere, np.zeros((2, 2)))


@dataclass(frozen=True, eq=False)
class Memory:
    """Query of an earlier place, and the motion since."""

    query: Query
    positions: Floats
    """(K, 2) [m] where it may have been said ..."""
    log_probability: Floats
    """(K,)"""
    shift: Floats
    """(2,) expected displacement since [m] ..."""
    spread: Floats
    """... and its covariance (2, 2) [m^2]."""

    def evidence(self, position: Floats, city: City) -> tuple[Evidence, ...]:
        """Evidence at the place that most likely led to a position (2,) [m]."""
        off = position - self.shift - self.positions
        loose = np.linalg.inv(self.spread + np.eye(2) * SPACING**2)
        fits = self.log_probability - 0.5 * np.einsum("ni,ij,nj->n", off, loose, off)
        at = self.positions[int(np.argmax(fits))]
        way = hypot(*(position - at))
        note = f"said {way:.0f} m before" if way >= 1.0 else "said here before"
        return tuple(
            replace(e, note="; ".join(part for part in (note, e.note) if part))
            for e in find_evidence(at, city, self.query)
        )

    def after(self, shift: Floats, spread: Floats) -> Memory:
        """Return it after one more motion (2,) [m] with covariance (2, 2) [m^2]."""
        return replace(self, shift=self.shift + shift, spread=self.spread + spread)


def _fine(scores: Scores, weights: Floats, highest: float, total: float) -> tuple[Floats, Floats]:
    """Positions (K, 2) [m] looked at closely, and their probabilities (K,)."""
    n = scores.ratios.shape[1]
    share = weights[scores.closer][:, None] / n * np.exp(scores.ratios - highest) / total
    return scores.positions.reshape(-1, 2), share.ravel()


def _cells_at(grid: TrackGrid, positions: Floats) -> NDArray[np.int64]:
    """Cells that hold positions (K, 2) [m]."""
    column, row = np.rint((positions - grid.low) / STRIDE).astype(np.int64).T
    return np.unique(row * grid.columns + column)


MOST_SCORED = 2500
"""At most this many viewpoints are scored."""
MARGIN = 12.0
"""Viewpoints that must lie this far behind the best are not scored [nat]."""


class Scores(NamedTuple):
    """Log-likelihood ratios against being elsewhere [nat]."""

    views: Floats
    """(W,) of the viewpoints."""
    nothing: float
    """Of a place from which nothing is in sight."""
    closer: NDArray[np.int64]
    """(B,) viewpoints looked at more closely ..."""
    positions: Floats
    """(B, 9, 2) ... at these positions [m] ..."""
    ratios: Floats
    """(B, 9) ... and the ratios there."""


def score_belief(query: Query, city: City, weights: Floats) -> Scores:
    """Score what was said under a belief: `weights` (W,) of the viewpoints, any scale."""
    statements, views = query.statements, city.views
    relative = weights / max(float(weights.max()), 1e-300)
    asked, nothing = Request(city, query), statements.floor
    ratios = np.full(len(weights), nothing)
    chosen, bounds, far = _candidates(query, city, relative)
    if not len(chosen):
        none = np.zeros(0)
        return Scores(ratios, nothing, none.astype(np.int64), none.reshape(0, 9, 2), none[:, None])
    prior = np.log(relative[chosen])
    first = slice(MOST_SCORED)
    found, _ = score_views(
        statements, city.columns, views.columns, asked.words, chosen[first], bounds[first], prior[first],
        far[first], TOGETHER, MARGIN,
    )  # fmt: skip
    found = found.astype(np.float64)
    reached = np.flatnonzero(found > 0.5 * HOPELESS)
    last = int(reached[-1]) + 1 if len(reached) else 0
    left = _kept((found + prior[first])[:last], bounds[:last]) if last else nothing
    least = float(np.log(statements.noise).sum())
    ratios[chosen] = np.maximum(np.log(bounds) - prior + left, least)
    ratios[chosen[reached]] = found[reached]
    best = reached[np.argsort(-(found + prior[first])[reached], kind="stable")[:CLOSER]]
    positions, close = look_around(asked, chosen[best], far[best])
    ratios[chosen[best]] = np.logaddexp.reduce(close, axis=1) - np.log(close.shape[1])
    return Scores(ratios, nothing, chosen[best].astype(np.int64), positions, close)


def _kept(weights: Floats, bounds: Floats) -> float:
    """Log of what the lightest third of the scored keep of their bounds; what is not scored does too."""
    tail = slice(2 * len(weights) // 3, None)
    return float(np.logaddexp.reduce(weights[tail]) - np.log(bounds[tail].sum()))


def _candidates(
    query: Query, city: City, relative: Floats
) -> tuple[NDArray[np.int32], Floats, NDArray[np.float32]]:
    """Viewpoints that matter (K,), the most promising first, their bounds, and what far things add."""
    statements, views = query.statements, city.views
    if statements.negated.all():
        chosen = np.argsort(-relative, kind="stable")[:MOST_SCORED].astype(np.int32)
        bounds = relative[chosen]
    else:
        chosen, bounds, _ = promising_views(
            statements, query.mentions, views.columns, relative, len(relative), 0, 0.0
        )
    chosen, bounds = chosen[bounds > 0.0], bounds[bounds > 0.0]
    far = np.zeros((min(len(chosen), MOST_SCORED), len(statements.op)), np.float32)
    if query.far is None:
        return chosen, bounds, far
    extra = find_around_far(city, query.far, chosen)
    extra = extra[relative[extra] > 0.0]
    chosen = np.concatenate([chosen, extra])
    bounds = np.concatenate([bounds, relative[extra]])
    heavy = np.argsort(-bounds, kind="stable")[:FAR_CANDIDATES]
    heavy = np.union1d(heavy, np.arange(len(chosen) - len(extra), len(chosen)))
    added = distant(statements, city.columns, query.far, views.positions_of(chosen[heavy]))
    log_bounds = np.log(bounds)
    log_bounds[heavy] += np.log1p(statements.gain * added).sum(axis=1)
    order = np.argsort(-log_bounds, kind="stable")
    row = np.full(len(chosen), -1)
    row[heavy] = np.arange(len(heavy))
    row = row[order[:MOST_SCORED]]
    far = np.where(row[:, None] >= 0, added[row], np.float32(0.0)).astype(np.float32)
    return chosen[order], np.exp(np.minimum(log_bounds[order], 690.0)), far
