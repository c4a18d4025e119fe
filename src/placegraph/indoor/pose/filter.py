"""The particle filter: propagate, reweight, resample; it reads as its equations (Sec. 3)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from placegraph.core.geometry import compose
from placegraph.indoor.likelihood.view import View
from placegraph.indoor.options import FilterOptions
from placegraph.indoor.pose.motion import propagate
from placegraph.indoor.pose.particles import (
    Particles,
    distinct,
    kld_count,
    log_sum,
    masses,
    resample,
)

if TYPE_CHECKING:
    from placegraph.indoor.likelihood.score import Scorer

_ALIVE = 0.1  # share of particles that must stay effective when an observation is weighed
_DROP = 25.0  # fall of the mean log-likelihood of a frame below its running mean: kidnapped [nat]
_MEMORY = 0.2  # of the running mean


@dataclass(eq=False)
class ParticleFilter:
    """Particles of the newest frame, and how they got there."""

    scorer: Scorer
    options: FilterOptions
    rng: Generator
    particles: Particles
    most: int
    """Most particles kept."""
    usual: float | None = field(default=None)
    """Running mean of the frames' log-likelihoods, None before the first."""
    dropped: bool = field(default=False)
    """The last frame was explained far worse than those before."""

    def move(self, step: NDArray[np.float64]) -> None:
        """Prediction (Sec. 3.2): all particles take the step (4,), each with its own error."""
        poses = propagate(self.particles.poses, step, self.options.motion, self.rng)
        self.particles = Particles(poses, self.particles.log_weights)

    def weigh(self, view: View) -> None:
        """Update (Sec. 3.3): weights times likelihoods, flattened where they would leave too few.

        A likelihood sharper than the particles are dense makes the nearest particle win by chance;
        it is tempered until a tenth of them stay effective. The paper's Eq. 2 is left as it is.
        """
        values = self.scorer(self.particles.poses, view)
        flat = self._flatten(values) if self.options.likelihood.tempered else 1.0
        explained = float(values.max())
        self.dropped = self.usual is not None and explained < self.usual - _DROP
        self.usual = (
            explained if self.usual is None else (1.0 - _MEMORY) * self.usual + _MEMORY * explained
        )
        self.particles, _ = self.particles.reweighted(flat * values)

    def _flatten(self, values: NDArray[np.float64]) -> float:
        """Exponent in (0, 1] of the likelihood that leaves enough particles effective."""
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

    def renew(self) -> None:
        """Adaptive resampling (Sec. 3.5) by KLD, or to as many as before."""
        count = len(self.particles)
        if self.options.kld:
            count = max(kld_count(self.particles, self.options), self.options.fewest)
        self.particles = resample(self.particles, min(count, self.most), self.rng)

    def inject(self, poses: NDArray[np.float64]) -> None:
        """Poses from elsewhere take the place of others, at most half of them, evenly from all.

        The particles were resampled, and hence are equal; but neighbours stand side by side, and a
        mode whose particles came first would be lost.
        """
        old = self.particles.poses
        left = max(len(old) - len(poses), len(old) // 2)
        kept = old[np.linspace(0, len(old) - 1, left).round().astype(np.int64)]
        self.particles = Particles.even(np.concatenate([poses[: self.most - left], kept]))

    def modes(self) -> NDArray[np.float64]:
        """Distinct poses (K, 4) of high weight, heaviest first; at most `options.modes`."""
        rows = distinct(self.particles.poses, self.particles.log_weights, self.options.modes)
        return self.particles.poses[rows]


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """What one pass over a sequence left."""

    modes: NDArray[np.float64]
    """(K, 4) poses of the last frame, heaviest first, of the last frame or of all (`pooled`)."""
    masses: NDArray[np.float64]
    """(K,) weight of the particles of each."""
    particles: Particles
    """Of the last frame, weighed."""
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
    first = min(options.unscored, len(views) - 1)
    record = []
    counts = []
    pool = np.zeros((0, 5))  # modes and their masses, carried along
    for t, view in enumerate(views):
        if t > first:  # resampling follows an update
            filter_.renew()
        if t:
            count = _injected(filter_, t) if elsewhere is not None else 0
            if elsewhere is not None and count:
                filter_.inject(elsewhere(t - 1, count))
            filter_.move(steps[t])
            pool[:, :4] = compose(pool[:, :4], steps[t])
        if t >= first:
            filter_.weigh(view)
        if (options.pooled and t >= first) or t == len(views) - 1:
            modes = filter_.modes()
            pool = np.vstack([pool, np.column_stack([modes, masses(filter_.particles, modes)])])
        counts.append(len(filter_.particles))
        if options.record:
            weighed = filter_.particles
            record.append((int(frames[t]), weighed.poses.copy(), weighed.weights))
        if tick:
            tick()
    if options.pooled:
        pool = pool[distinct(pool[:, :4], pool[:, 4], options.modes)]
    return Run(pool[:, :4], pool[:, 4], filter_.particles, tuple(record), tuple(counts))


def _injected(filter_: ParticleFilter, t: int) -> int:
    """How many poses from elsewhere are asked for before frame t."""
    options = filter_.options
    if options.inject_every:
        due = t % options.inject_every == 0
        return int(options.injection * len(filter_.particles)) if due else 0
    # KLD has left few: what is lost is looked for with a share of all that there may be
    lost = filter_.dropped and options.injection > 0
    return int(options.injection * filter_.most) + 1 if lost else 0
