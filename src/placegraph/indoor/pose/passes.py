"""The filter in passes over a window, and the first particles of each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from placegraph.core.estimate import PassRecord
from placegraph.core.geometry import Floats, between, compose
from placegraph.indoor.likelihood.observe import COARSE
from placegraph.indoor.options import STANDING, Pass
from placegraph.indoor.pose.filter import ParticleFilter, run_pass
from placegraph.indoor.pose.particles import Particles
from placegraph.indoor.pose.search import around, near_prior, table_seeds
from placegraph.indoor.pose.window import Window, timed


@dataclass(frozen=True, slots=True, eq=False)
class Passes:
    """What all passes of a filter left."""

    modes: Floats
    """(K, 4) poses of the last frame, heaviest first."""
    particles: Particles
    """Of the last frame, weighed."""
    history: tuple[PassRecord, ...]
    """All particles; empty unless recorded."""
    counts: list[list[int]]
    """Particles at each frame of each pass."""


def run_passes(window: Window, seeds: Floats, rng: Generator) -> Passes:
    """Filter the window, from seeds (K, 4) of the last frame, in passes coarse to fine (Sec. 3.5)."""
    options, query, poses = window.options, window.query, window.poses
    if not options.run:
        return Passes(seeds[:0], Particles.even(seeds), (), [])
    modes, masses, history, counts = seeds, np.ones(len(seeds)), [], []
    steps = np.zeros((len(window), 4))
    steps[1:] = between(poses[:-1], poses[1:])
    total, done = len(options.run) * len(window), 0

    def tick() -> None:
        nonlocal done
        done += 1
        if query.progress:
            query.progress("filtering", done, total)

    def elsewhere(t: int, count: int) -> Floats:
        """Poses (count, 4) of frame t where that frame alone fits best: a kidnapped camera."""
        if options.start == "uniform":
            drawn = everywhere(window, rng)
            return drawn[rng.choice(len(drawn), count)]
        view, noise = window.views(COARSE)[t], window.scorer.model.noise
        leaning = window.leaning
        return table_seeds(window.table, [view], poses[[t]], noise, 0, count, leaning)[0]

    with timed(window.seconds, "filter"):
        for number, spec in enumerate(options.run):
            # back to the first frame, from where the pass starts
            first = compose(modes, between(poses[-1], poses[0]))
            start = _later(spec, first, masses, rng) if number else _start(window, spec, first, rng)
            particles = Particles.even(start)
            if window.leaning is not None and not number:
                ends = compose(start, between(poses[0], poses[-1]))
                particles, _ = particles.reweighted(window.leaning.at(ends))
            filter_ = ParticleFilter(window.scorer, options, rng, particles, spec.particles)
            frames = [s.frame.index for s in window.sightings]
            run = run_pass(filter_, window.views(spec.stride), steps, frames, elsewhere, tick)
            modes, masses = run.modes, run.masses
            counts.append(list(run.counts))
            if options.record:
                history.append(PassRecord(spec.stride, run.record))
    return Passes(modes, run.particles, tuple(history), counts)


def _later(spec: Pass, modes: Floats, masses: Floats, rng: Generator) -> Floats:
    """First particles of a later pass: in a box around each mode (K, 4), by their masses (K,).

    However light a mode is, it gets a quarter of what an even split would give it; the numbers add
    up to `spec.particles`. The first particle of each box is the mode itself.
    """
    share = 0.25 / len(modes) + 0.75 * masses / masses.sum()
    ends = np.rint(spec.particles * np.cumsum(share)).astype(np.int64)
    return around(modes, np.maximum(1, np.diff(ends, prepend=0)), spec.box, spec.turn, rng)


def _start(window: Window, spec: Pass, modes: Floats, rng: Generator) -> Floats:
    """First particles of the first pass, as poses (N, 4) of the first frame."""
    options, prior = window.options, window.query.prior
    if prior is not None:
        return near_prior(prior, window, spec.particles, rng)
    if options.start == "uniform":
        return everywhere(window, rng)
    return around(modes, max(1, spec.particles // len(modes)), 0.3, 0.1, rng)


def everywhere(window: Window, rng: Generator) -> Floats:
    """The paper's start (Sec. 3.1): `per_cell` poses a free cell and height, yaws at random.

    Of a span of heights, its ends and those at which people stand between them.

    Which cells are free, the panoramas of the table say; it ranks nothing here. Where a large map
    makes its grid wider than asked, a cell gets as many more poses.
    """
    table, options = window.table, window.options
    low, high = min(options.heights), max(options.heights)
    heights = np.union1d(options.heights, [h for h in STANDING if low < h < high])
    cells = np.unique(np.column_stack([table.positions[:, :2], table.ground]), axis=0)
    each = round(options.per_cell * (table.spacing / options.spacing) ** 2)
    count = len(heights) * each
    out = np.empty((len(cells) * count, 4))
    out[:, :2] = np.repeat(cells[:, :2], count, axis=0)
    out[:, :2] += rng.uniform(-0.5, 0.5, (len(out), 2)) * table.spacing
    out[:, 2] = np.repeat(cells[:, 2], count) + np.tile(np.repeat(heights, each), len(cells))
    out[:, 3] = rng.uniform(-np.pi, np.pi, len(out))
    return out
