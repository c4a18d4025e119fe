"""Frames of one capture in one map: searched, filtered, polished and judged together."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from placegraph.errors import OptionError
from placegraph.estimate import PassRecord, PoseEstimate
from placegraph.geometry import between, compose
from placegraph.indoor.encode import bound
from placegraph.indoor.encode.instances import InstancesEncoder
from placegraph.indoor.encode.labels import LabelsEncoder
from placegraph.indoor.likelihood.depth_unit import check_unit
from placegraph.indoor.likelihood.observe import COARSE, FINE, sight, spread, views
from placegraph.indoor.likelihood.visibility import floor_under, visibility
from placegraph.indoor.pose.clock import timed
from placegraph.indoor.pose.filter import ParticleFilter, run_pass
from placegraph.indoor.pose.leaning import Leaning
from placegraph.indoor.pose.motion import level_poses
from placegraph.indoor.pose.particles import Particles
from placegraph.indoor.pose.polish import Round, polish
from placegraph.indoor.pose.search import around, everywhere, near_prior, table_seeds
from placegraph.indoor.pose.verdict import verdict

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.random import Generator
    from numpy.typing import ArrayLike, NDArray

    from placegraph.formats.capture.frame import Frame
    from placegraph.indoor.encode import MapEncoder
    from placegraph.indoor.language import Sentence
    from placegraph.indoor.likelihood.observe import Sighting
    from placegraph.indoor.likelihood.score import View
    from placegraph.indoor.likelihood.scorer import Scorer
    from placegraph.indoor.likelihood.visibility import VisibilityTable
    from placegraph.indoor.map.scene import Scene
    from placegraph.indoor.options import FilterOptions, Pass
    from placegraph.indoor.pose.polish import Fit
    from placegraph.indoor.pose.search import Prior

    Progress = Callable[[str, int, int], None]

NEWEST = 12
"""Frames that the last round of the polish is fitted to."""
_TRIES = 8  # poses tried around each seed
_SCREENED = 10  # frames that screen the seeds


def own_encoder(scene: Scene, frame: Frame) -> MapEncoder | None:
    """Encoder of the labels that a capture brings itself; None where it brings none."""
    if frame.label_kind == "instances":
        return InstancesEncoder(scene)
    return bound(LabelsEncoder(), scene) if frame.label_kind else None


@dataclass(eq=False)
class Sequence_:  # noqa: N801  `Sequence` is taken
    """Frames of one capture, read, encoded, and with steps between them."""

    scene: Scene
    options: FilterOptions
    scorer: Scorer
    sightings: list[Sighting]
    poses: NDArray[np.float64]
    """(T, 4) odometry, level."""
    description: str | Sentence | None = None
    """What somebody said of where the last frame was taken."""
    shares: ArrayLike | None = None
    """(S,) share of the first particles of each merged scene."""
    seconds: dict[str, float] = field(default_factory=dict)
    _views: dict[float, list[View]] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        scene: Scene,
        frames: Sequence[Frame],
        encoder: MapEncoder | None,
        options: FilterOptions,
        scorer: Scorer,
        description: str | Sentence | None = None,
        shares: ArrayLike | None = None,
    ) -> Sequence_:
        """Read and encode frames.

        Raises
        ------
        OptionError
            Nothing can be compared with the map.
        InputError
            An image is broken, or depth is not in metres (`depth_unit.check_unit`).

        """
        seconds: dict[str, float] = {}
        options = usable(scene, options)
        with timed(seconds, "reading"):
            encoder = encoder or own_encoder(scene, frames[0])
            sightings = [sight(frame, encoder, options) for frame in frames]
        if not any(s.patches or s.depth is not None or s.rgb is not None for s in sightings):
            raise OptionError(
                "Nothing to compare: the frames have no depth and no labels that the map knows, and "
                "the map has no colours (or these terms are switched off)."
            )
        check_unit(float(np.linalg.norm(np.ptp(scene.bounds, axis=0))), sightings)
        return cls(scene, options, scorer, sightings, leveled(frames), description, shares, seconds)

    def __len__(self) -> int:
        return len(self.sightings)

    def views(self, stride: float) -> list[View]:
        """Views of all frames at a stride; cut once."""
        if stride not in self._views:
            background = self.table.background
            self._views[stride] = views(self.sightings, stride, self.options, background)
        return self._views[stride]

    @property
    def table(self) -> VisibilityTable:
        """The map's table."""
        return visibility(self.scene, self.options)

    @cached_property
    def leaning(self) -> Leaning | None:
        """What is known beforehand of the last frame's pose."""
        return Leaning.of(self.scene, self.table, self.description, self.shares)

    def localized(
        self, prior: Prior | None, rng: Generator, progress: Progress | None = None
    ) -> PoseEstimate:
        """Search, filter, polish, judge."""
        with timed(self.seconds, "table"):
            self._need_table()
            self.views(COARSE)
        with timed(self.seconds, "search"):
            seeds = self._seeds(prior, rng)
        with timed(self.seconds, "filter"):
            modes, history, counts = self._filtered(seeds, prior, rng, progress)
        with timed(self.seconds, "polish"):
            fits = self._polished(modes, seeds, rng)
        with timed(self.seconds, "verdict"):
            estimate = verdict(self, fits)
        stats = {
            "seconds": {k: round(v, 4) for k, v in self.seconds.items()},
            "particles": counts,
            "poses_scored": self.scorer.poses,
            "rays": self.scorer.rays,
            "seconds_scoring": round(self.scorer.seconds, 4),
            "device": self.scorer.device,
        }
        return replace(estimate, stats=stats, history=tuple(history))

    def searched(self, rng: Generator) -> tuple[PoseEstimate, list[Fit]]:
        """Search and polish without the filter: what a tracker does until it knows its pose."""
        self._need_table()
        seeds = self._seeds(None, rng)
        fits = self._polished(seeds[:4], seeds, rng)
        return verdict(self, fits), fits

    def _need_table(self) -> None:
        if not len(self.table):
            raise OptionError(
                f"heights: {self.scene.source or 'the map'} has no free place at "
                f"{self.options.heights} m above its floor; give the camera's height."
            )

    # ------------------------------------------------------------------------------- stages

    def _seeds(self, prior: Prior | None, rng: Generator) -> NDArray[np.float64]:
        """Poses (K, 4) of the last frame that explain several frames at once; best first."""
        if self.options.start == "uniform" or prior is not None:
            return np.zeros((0, 4))
        views_, last = self.views(COARSE), len(self) - 1
        seeds, _ = table_seeds(
            self.table, views_, self.poses, self.scorer.noise, last, leaning=self.leaning
        )
        tries = around(seeds, _TRIES, 0.3, 0.06, rng)
        looked = spread(len(self), _SCREENED)
        steps = between(self.poses[last], self.poses[looked])
        values = self.scorer.together(tries, [views_[i] for i in looked], steps)
        values = values.reshape(len(seeds), _TRIES)
        best = tries.reshape(len(seeds), _TRIES, 4)[np.arange(len(seeds)), values.argmax(axis=1)]
        return best[np.argsort(-values.max(axis=1), kind="stable")]

    def _filtered(
        self,
        seeds: NDArray[np.float64],
        prior: Prior | None,
        rng: Generator,
        progress: Progress | None,
    ) -> tuple[NDArray[np.float64], list[PassRecord], list[list[int]]]:
        """Modes of the last frame after all passes, coarse to fine."""
        modes, history, counts = seeds, [], []
        steps = np.zeros((len(self), 4))
        steps[1:] = between(self.poses[:-1], self.poses[1:])
        total, done = len(self.options.passes) * len(self), 0

        def tick() -> None:
            nonlocal done
            done += 1
            if progress:
                progress("filtering", done, total)

        for number, spec in enumerate(self.options.passes):
            # back to the first frame, from where the pass starts
            back = between(self.poses[-1], self.poses[0])
            start = self._start(number, spec, compose(modes, back), prior, rng)
            particles = Particles.even(start)
            if self.leaning is not None and not number:
                ends = compose(start, between(self.poses[0], self.poses[-1]))
                particles, _ = particles.reweighted(self.leaning.at(ends))
            filter_ = ParticleFilter(self.scorer, self.options, rng, particles, spec.particles)
            frames = [s.frame.index for s in self.sightings]
            run = run_pass(filter_, self.views(spec.stride), steps, frames, self._elsewhere, tick)
            modes = run.modes
            counts.append(list(run.counts))
            if self.options.record:
                history.append(PassRecord(spec.stride, run.record))
        return modes, history, counts

    def _start(
        self,
        number: int,
        spec: Pass,
        modes: NDArray[np.float64],
        prior: Prior | None,
        rng: Generator,
    ) -> NDArray[np.float64]:
        """First particles of a pass, as poses (N, 4) of the first frame."""
        if number:
            kept = modes[: max(1, self.options.modes)]
            return around(kept, max(1, spec.particles // len(kept)), spec.box, spec.turn, rng)
        if prior is not None:
            floor = float(floor_under(self.scene, np.array([[prior.x, prior.y]]))[0])
            return near_prior(prior, floor, spec.particles, self.options, rng)
        if self.options.start == "uniform":
            floors = floor_under(self.scene, self.table.positions[:, :2])
            return everywhere(self.table, floors, self.options, rng)
        return around(modes, max(1, spec.particles // len(modes)), 0.3, 0.1, rng)

    def _elsewhere(self, t: int, count: int) -> NDArray[np.float64]:
        """Poses (count, 4) of frame t where that frame alone fits best: a kidnapped camera."""
        view = self.views(COARSE)[t]
        seeds, _ = table_seeds(self.table, [view], self.poses[[t]], self.scorer.noise, 0, count)
        return seeds

    def _polished(
        self, modes: NDArray[np.float64], seeds: NDArray[np.float64], rng: Generator
    ) -> list[Fit]:
        """Fits of the last frame's pose to all frames, best first."""
        if not self.options.polish or self.options.likelihood.kind == "gaussian":
            return polish(self.scorer, modes, [self.round(FINE, rounds=0, most=8)], rng)
        starts = np.concatenate([modes, seeds[:8]])
        # two rounds for all before any is dropped: a start may lie a hand's breadth off its peak
        levels = [
            self.round(COARSE, rounds=2, most=8, frames=5),
            self.round(COARSE, rounds=3, most=4, gap=250.0),
            self.round(FINE, rounds=4, most=3, gap=150.0),
        ]
        return polish(self.scorer, starts, levels, rng)

    def round(
        self, stride: float, *, rounds: int, most: int = 1, gap: float = np.inf, frames: int = 0
    ) -> Round:
        """A level of the polish of the last frame's pose.

        Coarse levels look at frames spread over the sequence, fine ones at the newest: drift has
        bent the way to the others.
        """
        looked = spread(len(self), frames or _SCREENED)
        if stride == FINE:
            looked = self.newest()
        views_ = self.views(stride)
        steps = between(self.poses[-1], self.poses[looked])
        return Round([views_[i] for i in looked], steps, rounds, most, gap)

    def newest(self) -> NDArray[np.int64]:
        """Rows of the newest frames, which the last level is fitted to."""
        return np.arange(max(0, len(self) - NEWEST), len(self))


def leveled(frames: Sequence[Frame]) -> NDArray[np.float64]:
    """Level poses (T, 4) of the odometry of frames."""
    return level_poses(
        np.stack([f.odometry for f in frames]), np.stack([f.gravity for f in frames])
    )


def usable(scene: Scene, options: FilterOptions) -> FilterOptions:
    """Options without the colour term where the map has no colours to compare."""
    return replace(options, colour=options.colour and scene.coloured)
