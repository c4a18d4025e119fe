"""The filter in passes over a window, and the first particles of each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from placegraph.estimate import PassRecord
from placegraph.geometry import between, compose
from placegraph.indoor.likelihood.observe import COARSE
from placegraph.indoor.likelihood.visibility import floor_under
from placegraph.indoor.pose.filter import ParticleFilter, run_pass
from placegraph.indoor.pose.particles import Particles
from placegraph.indoor.pose.search import around, table_seeds
from placegraph.indoor.pose.window import timed

if TYPE_CHECKING:
    from numpy.random import Generator

    from placegraph.geometry import Floats
    from placegraph.indoor.likelihood.visibility import VisibilityTable
    from placegraph.indoor.options import FilterOptions, Pass
    from placegraph.indoor.pose.prior import Prior
    from placegraph.indoor.pose.window import Window


@dataclass(frozen=True, slots=True, eq=False)
class Passes:
    """What all passes of a filter left."""

    modes: Floats
    """(K, 4) poses of the last frame, heaviest first."""
    history: tuple[PassRecord, ...]
    """All particles; empty unless recorded."""
    counts: list[list[int]]
    """Particles at each frame of each pass."""


def run_passes(window: Window, seeds: Floats, rng: Generator) -> Passes:
    """Filter the window, from seeds (K, 4) of the last frame, in passes coarse to fine (Sec. 3.5)."""
    options, query, poses = window.options, window.query, window.poses
    modes, history, counts = seeds, [], []
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
        view, noise = window.views(COARSE)[t], window.scorer.model.noise
        return table_seeds(window.table, [view], poses[[t]], noise, 0, count)[0]

    with timed(window.seconds, "filter"):
        for number, spec in enumerate(options.passes):
            # back to the first frame, from where the pass starts
            start = _start(window, number, spec, compose(modes, between(poses[-1], poses[0])), rng)
            particles = Particles.even(start)
            if window.leaning is not None and not number:
                ends = compose(start, between(poses[0], poses[-1]))
                particles, _ = particles.reweighted(window.leaning.at(ends))
            filter_ = ParticleFilter(window.scorer, options, rng, particles, spec.particles)
            frames = [s.frame.index for s in window.sightings]
            run = run_pass(filter_, window.views(spec.stride), steps, frames, elsewhere, tick)
            modes = run.modes
            counts.append(list(run.counts))
            if options.record:
                history.append(PassRecord(spec.stride, run.record))
    return Passes(modes, tuple(history), counts)


def _start(window: Window, number: int, spec: Pass, modes: Floats, rng: Generator) -> Floats:
    """First particles of a pass, as poses (N, 4) of the first frame."""
    options, prior = window.options, window.query.prior
    if number:
        kept = modes[: max(1, options.modes)]
        return around(kept, max(1, spec.particles // len(kept)), spec.box, spec.turn, rng)
    if prior is not None:
        floor = float(floor_under(window.scene, np.array([[prior.x, prior.y]]))[0])
        return near_prior(prior, floor, spec.particles, options, rng)
    if options.start == "uniform":
        floors = floor_under(window.scene, window.table.positions[:, :2])
        return everywhere(window.table, floors, options, rng)
    return around(modes, max(1, spec.particles // len(modes)), 0.3, 0.1, rng)


def everywhere(
    table: VisibilityTable, floors: Floats, options: FilterOptions, rng: Generator
) -> Floats:
    """The paper's start (Sec. 3.1): `per_cell` poses a free cell and height, yaws at random.

    `table`: of the same spacing; `floors`: (K,) floor under its positions.
    """
    cells = np.unique(np.column_stack([table.positions[:, :2], floors]), axis=0)
    count = len(options.heights) * options.per_cell
    out = np.empty((len(cells) * count, 4))
    out[:, :2] = np.repeat(cells[:, :2], count, axis=0)
    out[:, :2] += rng.uniform(-0.5, 0.5, (len(out), 2)) * table.spacing
    heights = np.tile(np.repeat(options.heights, options.per_cell), len(cells))
    out[:, 2] = np.repeat(cells[:, 2], count) + heights
    out[:, 3] = rng.uniform(-np.pi, np.pi, len(out))
    return out


def near_prior(
    prior: Prior, floor: float, count: int, options: FilterOptions, rng: Generator
) -> Floats:
    """`count` poses (count, 4) drawn around a prior."""
    out = rng.normal(size=(count, 4)) * np.array([prior.spread, prior.spread, 0.05, prior.turn])
    out[:, :2] += (prior.x, prior.y)
    out[:, 2] += floor + rng.choice(options.heights, count) if prior.z is None else prior.z
    if prior.yaw is None:
        out[:, 3] = rng.uniform(-np.pi, np.pi, count)
    else:
        out[:, 3] += prior.yaw
    return out
