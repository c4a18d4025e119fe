"""Particle filter (SG2Loc, Sec. 3): propagate, reweight, resample by KLD-sampling; coarse to fine."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from placegraph.core.estimate import PassRecord
from placegraph.core.geometry import Floats, between, compose, wrap_angle
from placegraph.indoor.likelihood.observe import COARSE, View
from placegraph.indoor.likelihood.score import log_sum
from placegraph.indoor.options import STANDING, FilterOptions, MotionNoise, Pass
from placegraph.indoor.pose.local_fit import FINEST, Fit
from placegraph.indoor.pose.search import (
    are_near,
    draw_near_prior,
    scatter_poses,
    select_distinct,
    table_seeds,
)
from placegraph.indoor.pose.window import Chain, Window, deviations, time_stage

if TYPE_CHECKING:
    from placegraph.indoor.likelihood.score import Scorer

BIN = np.array([0.2, 0.2, 0.2, np.deg2rad(10.0)])
"""Bins of the state histogram of KLD-sampling: x, y, z [m], yaw [rad]."""


@dataclass(frozen=True, slots=True, eq=False)
class Particles:
    """N particles with normalized log weights."""

    poses: NDArray[np.float64]
    """(N, 4) float64, x, y, z [m], yaw [rad]."""
    log_weights: NDArray[np.float64]
    """(N,) float64; their exponentials add up to 1."""

    @classmethod
    def uniform(cls, poses: NDArray[np.float64]) -> Particles:
        """Make particles of equal weight."""
        return cls(poses, np.full(len(poses), -np.log(max(1, len(poses)))))

    def __len__(self) -> int:
        return len(self.poses)

    @property
    def weights(self) -> NDArray[np.float64]:
        """(N,) adding up to 1."""
        return np.asarray(np.exp(self.log_weights))

    def reweight(self, log_likelihoods: NDArray[np.float64]) -> tuple[Particles, float]:
        """Return the particles after an observation, and the log of its mean likelihood."""
        raw = self.log_weights + log_likelihoods
        total = log_sum(raw)
        return Particles(self.poses, raw - total), total

    def effective(self) -> float:
        """Return the effective sample size, 1 to N."""
        return float(np.exp(-log_sum(2.0 * self.log_weights)))


def kld_count(particles: Particles, options: FilterOptions) -> int:
    """Return the number of particles by KLD-sampling (Fox 2001): n of Sec. 3.5, k counted by weight.

    k is the number of bins of the histogram of resampled particles: bins with less than the weight of
    half a particle do not count.
    """
    bins = np.floor(particles.poses / BIN).astype(np.int64)
    bins[:, 3] %= round(2.0 * np.pi / BIN[3])  # yaws that have gone round are the same
    _, inverse = np.unique(bins, axis=0, return_inverse=True)
    mass = np.bincount(inverse.ravel(), weights=particles.weights)
    k = int((mass > 0.5 / len(particles)).sum())
    return kld_bound(k, options.kld_error, options.kld_confidence)


def kld_bound(bins: int, error: float, confidence: float) -> int:
    """Return the number of samples that bounds the histogram's divergence by `error`."""
    if bins < 2:
        return 1
    from statistics import NormalDist

    z = NormalDist().inv_cdf(confidence)
    a = 2.0 / (9.0 * (bins - 1))
    return int(np.ceil((bins - 1) / (2.0 * error) * (1.0 - a + np.sqrt(a) * z) ** 3))


def resample(particles: Particles, count: int, rng: Generator) -> Particles:
    """Draw `count` particles by stratified resampling: one from each `1 / count` of the weight."""
    edges = np.cumsum(particles.weights)
    points = (np.arange(count) + rng.random(count)) / count * edges[-1]
    rows = np.minimum(np.searchsorted(edges, points, side="right"), len(particles) - 1)
    return Particles.uniform(particles.poses[rows])


def masses(particles: Particles, modes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the weight (K,) of the particles of each of modes (K, 4), without those of earlier modes."""
    left, out = particles.weights, np.zeros(len(modes))
    for k, mode in enumerate(modes):
        own = are_near(particles.poses, mode)
        out[k] = left[own].sum()
        left = np.where(own, 0.0, left)
    return out


_ALIVE = 0.1  # share of particles that must stay effective when an observation is weighed
_DROP = 25.0  # fall of the mean log-likelihood of a frame below its running mean: kidnapped [nat]
_MEMORY = 0.2  # of the running mean


def propagate(
    poses: NDArray[np.float64],
    step: NDArray[np.float64],
    noise: MotionNoise,
    rng: Generator,
) -> NDArray[np.float64]:
    """Move poses (N, 4) by a step (4,) with noise: s_{t+1} = s_t (+) (t_t + w_t), Eq. 1."""
    errors = rng.normal(size=poses.shape) * deviations(step, noise)
    return compose(poses, step + errors)


@dataclass(eq=False)
class ParticleFilter:
    """Particle filter of one pass over a sequence."""

    scorer: Scorer
    options: FilterOptions
    rng: Generator
    particles: Particles
    max_particles: int
    """Largest number of particles."""
    mean_log_likelihood: float | None = field(default=None)
    """Running mean of the frames' log-likelihoods, None before the first."""
    dropped: bool = field(default=False)
    """Whether the last frame was far less likely than those before."""

    def propagate(self, step: NDArray[np.float64]) -> None:
        """Predict (Sec. 3.2): move all particles by the step (4,), each with its own error."""
        poses = propagate(self.particles.poses, step, self.options.motion, self.rng)
        self.particles = Particles(poses, self.particles.log_weights)

    def reweight(self, view: View) -> None:
        """Update (Sec. 3.3): multiply weights by likelihoods, tempered if too few stay effective.

        If the likelihood is sharper than the particles are dense, the nearest particle wins by chance;
        so it is tempered until a tenth stay effective. The paper's Eq. 2 is not tempered.
        """
        values = self.scorer(self.particles.poses, view)
        flat = self._temper(values) if self.options.likelihood.tempered else 1.0
        explained = float(values.max())
        mean = self.mean_log_likelihood
        self.dropped = mean is not None and explained < mean - _DROP
        self.mean_log_likelihood = (
            explained if mean is None else (1.0 - _MEMORY) * mean + _MEMORY * explained
        )
        self.particles, _ = self.particles.reweight(flat * values)

    def _temper(self, values: NDArray[np.float64]) -> float:
        """Return the tempering exponent in (0, 1] that leaves enough particles effective."""
        wanted = max(4.0, _ALIVE * len(values))
        low, high = 0.0, 1.0

        def effective(exponent: float) -> float:
            logs = self.particles.log_weights + exponent * values
            logs = logs - log_sum(logs)
            return float(np.exp(-log_sum(2.0 * logs)))

        if effective(1.0) >= wanted:
            return 1.0
        for _ in range(12):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if effective(middle) >= wanted else (low, middle)
        return max(low, 1e-3)

    def resample(self) -> None:
        """Resample (Sec. 3.5) to the number of KLD-sampling, or to as many as before."""
        count = len(self.particles)
        if self.options.kld:
            count = max(kld_count(self.particles, self.options), self.options.min_particles)
        self.particles = resample(self.particles, min(count, self.max_particles), self.rng)

    def inject(self, poses: NDArray[np.float64]) -> None:
        """Replace at most half of the particles by other poses, evenly from all.

        Resampled particles weigh the same, but those of one mode lie side by side: replacing the first ones
        would lose a mode.
        """
        old = self.particles.poses
        left = max(len(old) - len(poses), len(old) // 2)
        kept = old[np.linspace(0, len(old) - 1, left).round().astype(np.int64)]
        self.particles = Particles.uniform(
            np.concatenate([poses[: self.max_particles - left], kept])
        )

    def modes(self) -> NDArray[np.float64]:
        """Return distinct poses (K, 4) of high weight, heaviest first; at most `options.modes`."""
        rows = select_distinct(self.particles.poses, self.particles.log_weights, self.options.modes)
        return self.particles.poses[rows]


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """Result of one pass over a sequence."""

    modes: NDArray[np.float64]
    """(K, 4) poses of the last frame, heaviest first, of the last frame or of all (`pool_modes`)."""
    masses: NDArray[np.float64]
    """(K,) weight of the particles of each."""
    particles: Particles
    """Weighted particles of the last frame."""
    record: tuple[tuple[int, NDArray[np.float64], NDArray[np.float64]], ...]
    """Index of the frame, poses (N, 4), weights (N,); empty unless recorded."""
    counts: tuple[int, ...]
    """Particles at each frame."""


def run_pass(
    filter_: ParticleFilter,
    views: Sequence[View],
    steps: NDArray[np.float64],
    frames: Sequence[int],
    elsewhere: Callable[[int, int], NDArray[np.float64]] | None = None,
    tick: Callable[[], None] | None = None,
) -> Run:
    """Filter a sequence from its first frame to its last.

    `steps`: (T, 4), step t leads from frame t - 1 to frame t; `elsewhere(t, n)` draws n poses of
    frame t from the whole map, for a camera that was carried away.
    """
    options = filter_.options
    first = min(options.burn_in, len(views) - 1)
    record = []
    counts = []
    pool = np.zeros((0, 5))  # modes and their masses, carried along
    for t, view in enumerate(views):
        if t > first:  # resampling follows an update
            filter_.resample()
        if t:
            count = _injected(filter_, t) if elsewhere is not None else 0
            if elsewhere is not None and count:
                filter_.inject(elsewhere(t - 1, count))
            filter_.propagate(steps[t])
            pool[:, :4] = compose(pool[:, :4], steps[t])
        if t >= first:
            filter_.reweight(view)
        if (options.pool_modes and t >= first) or t == len(views) - 1:
            modes = filter_.modes()
            pool = np.vstack([pool, np.column_stack([modes, masses(filter_.particles, modes)])])
        counts.append(len(filter_.particles))
        if options.record:
            weighed = filter_.particles
            record.append((int(frames[t]), weighed.poses.copy(), weighed.weights))
        if tick:
            tick()
    if options.pool_modes:
        pool = pool[select_distinct(pool[:, :4], pool[:, 4], options.modes)]
    return Run(pool[:, :4], pool[:, 4], filter_.particles, tuple(record), tuple(counts))


def _injected(filter_: ParticleFilter, t: int) -> int:
    """Return the number of poses to inject before frame t."""
    options = filter_.options
    if options.inject_every:
        due = t % options.inject_every == 0
        return int(options.injection * len(filter_.particles)) if due else 0
    # KLD-sampling leaves few: a lost camera is searched with a share of the largest number
    lost = filter_.dropped and options.injection > 0
    return int(options.injection * filter_.max_particles) + 1 if lost else 0


@dataclass(frozen=True, slots=True, eq=False)
class FilteredPasses:
    """Result of all passes of a filter."""

    modes: Floats
    """(K, 4) poses of the last frame, heaviest first."""
    particles: Particles
    """Weighted particles of the last frame."""
    history: tuple[PassRecord, ...]
    """All particles; empty unless recorded."""
    counts: list[list[int]]
    """Particles at each frame of each pass."""


def run_passes(window: Window, seeds: Floats, rng: Generator) -> FilteredPasses:
    """Filter the window, from seeds (K, 4) of the last frame, in passes coarse to fine (Sec. 3.5)."""
    options, query, poses = window.options.particle_filter, window.query, window.poses
    assert options is not None  # noqa: S101  else nothing is filtered
    modes, masses, history, counts = seeds, np.ones(len(seeds)), [], []
    steps = np.zeros((len(window), 4))
    steps[1:] = between(poses[:-1], poses[1:])
    total, done = len(options.passes) * len(window), 0

    def tick() -> None:
        nonlocal done
        done += 1
        if query.progress:
            query.progress("filtering", done, total)

    def elsewhere(t: int, count: int) -> Floats:
        """Poses (count, 4) of frame t where that frame alone fits best: a kidnapped camera."""
        if options.start == "uniform":
            drawn = draw_uniform_start(window, options, rng)
            return drawn[rng.choice(len(drawn), count)]
        view, noise = window.views(COARSE)[t], window.scorer.model.noise
        log_prior = window.log_prior
        return table_seeds(window.table, [view], poses[[t]], noise, 0, count, log_prior)[0]

    with time_stage(window.seconds, "filter"):
        for number, spec in enumerate(options.passes):
            # back to the first frame, from where the pass starts
            first = compose(modes, between(poses[-1], poses[0]))
            start = (
                _later(spec, first, masses, rng)
                if number
                else _start(window, options, spec, first, rng)
            )
            particles = Particles.uniform(start)
            if window.log_prior is not None and not number:
                ends = compose(start, between(poses[0], poses[-1]))
                particles, _ = particles.reweight(window.log_prior.at(ends))
            filter_ = ParticleFilter(window.scorer, options, rng, particles, spec.particles)
            frames = [s.frame.index for s in window.observations]
            views = window.views(spec.stride, scaled=spec.scaled)
            run = run_pass(filter_, views, steps, frames, elsewhere, tick)
            modes, masses = run.modes, run.masses
            counts.append(list(run.counts))
            if options.record:
                history.append(PassRecord(spec.stride, run.record))
    return FilteredPasses(modes, run.particles, tuple(history), counts)


def _later(spec: Pass, modes: Floats, masses: Floats, rng: Generator) -> Floats:
    """Draw the first particles of a later pass in a box around each mode (K, 4), by their masses (K,).

    A mode gets at least a quarter of an even split; the numbers add up to `spec.particles`. The first
    particle of each box is the mode itself.
    """
    share = 0.25 / len(modes) + 0.75 * masses / masses.sum()
    ends = np.rint(spec.particles * np.cumsum(share)).astype(np.int64)
    return scatter_poses(modes, np.maximum(1, np.diff(ends, prepend=0)), spec.box, spec.turn, rng)


def _start(
    window: Window, options: FilterOptions, spec: Pass, modes: Floats, rng: Generator
) -> Floats:
    """Draw the first particles of the first pass, as poses (N, 4) of the first frame."""
    prior = window.query.prior
    if prior is not None and not prior.is_wide:
        return draw_near_prior(prior, window, spec.particles, rng)
    if options.start == "uniform":
        return draw_uniform_start(window, options, rng)
    return scatter_poses(modes, max(1, spec.particles // len(modes)), 0.3, 0.1, rng)


def draw_uniform_start(window: Window, options: FilterOptions, rng: Generator) -> Floats:
    """Draw the paper's start (Sec. 3.1): `per_cell` poses a free cell and height, with random yaws.

    Two heights are a span: its ends and those of `STANDING` between them are used. Free cells are
    those of the visibility table. If a large map makes its grid wider, a cell gets as many more poses.
    """
    table = window.table
    heights = np.unique(options.heights)
    if len(heights) == 2:
        heights = np.union1d(heights, [h for h in STANDING if heights[0] < h < heights[1]])
    cells = np.unique(np.column_stack([table.positions[:, :2], table.ground]), axis=0)
    each = round(options.per_cell * (table.spacing / options.spacing) ** 2)
    count = len(heights) * each
    out = np.empty((len(cells) * count, 4))
    out[:, :2] = np.repeat(cells[:, :2], count, axis=0)
    out[:, :2] += rng.uniform(-0.5, 0.5, (len(out), 2)) * table.spacing
    out[:, 2] = np.repeat(cells[:, 2], count) + np.tile(np.repeat(heights, each), len(cells))
    out[:, 3] = rng.uniform(-np.pi, np.pi, len(out))
    return out


def heaviest_modes(chain: Chain, particles: Particles, most: int) -> list[Fit]:
    """Return at most `most` modes of particles, heaviest particle first (Sec. 3.5).

    The first is the maximum likelihood estimate. Particles within `APART` and `TURNED` of a mode give its
    weight and covariance.
    """
    poses, weights = particles.poses, particles.weights
    modes = poses[select_distinct(poses, weights, most)]
    fits = []
    for mode, mass in zip(modes, masses(particles, modes), strict=True):
        own = are_near(poses, mode)
        errors = poses[own] - mode
        errors[:, 3] = wrap_angle(errors[:, 3])
        covariance = np.einsum("n,ni,nj->ij", weights[own] / weights[own].sum(), errors, errors)
        known = covariance + FINEST
        fits.append(Fit(chain.rigid(mode), float(np.log(mass)), known, known))
    return fits
