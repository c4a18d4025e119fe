"""Rounds of matching images with the map, from wide to fine."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.core.threads import count_processors
from placegraph.indoor.likelihood.observe import spread
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.options import RefineOptions
from placegraph.indoor.pose.covariance import map_error
from placegraph.indoor.pose.window import Progress, Window, time_stage
from placegraph.indoor.refine.correspondences import (
    FARTHEST,
    SHARE,
    SIGMA,
    PointMatches,
    Readings,
    Surfaces,
    drop_held_back,
    has_plenty,
    held_back,
    match_views,
    match_window,
    measure_move,
    sample_readings,
    solve_frame,
    solve_rig,
    turn_views,
)
from placegraph.indoor.refine.fit import Lags, Problem, Solution, covariance, drift_of, solve
from placegraph.indoor.refine.matching.guided import GuidedMatcher
from placegraph.indoor.render import Renderer
from placegraph.io.capture.frame import Frame

if TYPE_CHECKING:
    from placegraph.indoor.refine.matching import Matcher


@dataclass(frozen=True, slots=True)
class Stage:
    """One round of matching: at which size, how, and how well matches are placed."""

    matcher: Matcher | None
    """None: what matches are the map's landmarks, and renderings are not asked."""
    size: int
    """Longer side of renderings and queries [px]; images that are smaller stay so."""
    sigma: float
    """Standard deviation of a right match [px of an image `REFERENCE` wide]."""
    turned: bool = False
    """Views turned in yaw are matched too."""
    rigid: bool = True
    """Only matches count that agree on one pose of all frames, tied together by odometry; where all
    lie near already, the robust kernel tells better."""
    share: float = 0.0
    """Least share of the matches that must agree: features do so by chance if few do."""


LANDMARKS = Stage(None, 0, SIGMA, share=SHARE)
"""The round before all others, of a map that carries landmarks."""
LARGEST = 960
"""Longer side [px] to which larger images are brought for feature matchers."""


def matching_stages(matcher: Matcher | None, *, near: bool) -> list[Stage]:
    """Return rounds of matching by a matcher, the guided one if None; `near`: depth has been aligned."""
    if matcher is not None:
        first = Stage(matcher, LARGEST, 2.0, turned=True, share=SHARE)
        return [first, replace(first, turned=False)]
    fine = [Stage(GuidedMatcher(radius=10, half=7, cell=8), 160, 2.0)]
    if near:
        return fine
    wide = [Stage(GuidedMatcher(radius=34, half=5, cell=8), 160, 3.0)]
    return [*wide, *fine, Stage(GuidedMatcher(radius=8, half=7, cell=12), 320, 1.0, rigid=False)]


DEPTH_WIDTHS = ((10.0, 6.0), (5.0, 3.0), (3.0, 2.0))
"""Kernels of depth and pixels from a start within a hand's breadth, in standard deviations."""
FINE_WIDTHS = ((5.0, 6.0), (3.0, 3.0), (3.0, 2.0))
"""Kernels once matches are there."""
UNSURE = 0.45
"""Mean robust cost of the depth readings from which on images are asked too."""
LOST = 0.97
"""Mean robust cost from which on depth has not even brought the pose near."""
READ = 60
"""Least readings of depth a frame, on average, that count as depth."""
UNEXPLAINED = 0.024
"""Error [m] of a mesh that explains no reading of depth (benchmark: halves of an office as scans)."""
MANY, FEW = 12, 5
"""Most frames that the guided matcher is given, and one that knows no neighbourhood and is slow."""


@dataclass(frozen=True, slots=True, eq=False)
class FittedTrajectory:
    """A refined trajectory, and what it rests on."""

    poses: Floats
    """(T, 4, 4) map_from_camera"""
    solution: Solution | None
    """None: nothing was there to go by."""
    matches: list[PointMatches]
    """(T,) matches used."""
    covariance: Floats
    """(6, 6) of the last frame, as `PoseMode.covariance`."""
    by_depth: FittedTrajectory | None = None
    """Trajectory by depth alone, if images took part as well."""

    @property
    def lags(self) -> Lags | None:
        """By what depth and images are late."""
        return None if self.solution is None else self.solution.lags


@dataclass(eq=False)
class Refiner:
    """Frames of one capture, ready to be aligned with one map."""

    scene: Scene
    frames: Sequence[Frame]
    depths: Sequence[NDArray[np.float32] | None]
    """(T,) of (h, w) [m]"""
    queries: Sequence[NDArray[np.uint8] | None]
    """(T,) of (H, W, 3)"""
    options: RefineOptions
    matcher: Matcher | None
    """None: the guided matcher."""
    prior: tuple[Floats, Floats] | None = None
    """Known poses (T, 4, 4) and their standard deviations (6,), see `Problem.prior`."""
    landmarks: Sequence[PointMatches] = ()
    """(T,) landmarks of the map that frames show; empty: nobody looked."""
    stats: dict[str, Any] = field(default_factory=dict)
    rng: Generator = field(default_factory=lambda: np.random.default_rng(0))
    """Turns views."""

    @classmethod
    def of(cls, window: Window, options: RefineOptions, matcher: Matcher | None) -> Refiner:
        """Return refiner of the frames of a window."""
        return cls(
            scene=window.scene,
            frames=[s.frame for s in window.observations],
            depths=[s.depth for s in window.observations],
            queries=[s.rgb for s in window.observations],
            options=options,
            matcher=matcher,
            landmarks=match_window(window) if options.images else (),
            rng=np.random.default_rng(window.query.seed),
        )

    def __post_init__(self) -> None:
        self.surfaces, self.seconds = Surfaces.of(self.scene), dict[str, float]()
        self.renderer = Renderer(self.scene)
        self._readings: dict[int, list[Readings | None]] = {}
        self.landmark_matches: int | None = None  # landmarks that agree on a pose near the start
        self.by_landmarks = False  # whether they alone decided
        self.loose: Floats | None = None  # covariance (3, 3) of the coarse position
        self.drift = (1.0, 1.0)  # `Problem.drift`, of where the frames are thought to be

    @cached_property
    def has_depth(self) -> bool:
        """Whether depth takes part: a handful of readings is none."""
        read = sum(int((r.depth > 0).sum()) for r in self.readings() if r is not None)
        return read >= READ * len(self.frames)

    def readings(self, phase: int = 0) -> list[Readings | None]:
        """Return depth readings (T,) of a phase: 0 for the fit, 1 for the check; cut once."""
        if phase not in self._readings:
            count = self.options.readings if self.options.depth else 0
            self._readings[phase] = [
                sample_readings(frame, depth, count, phase) if count and depth is not None else None
                for frame, depth in zip(self.frames, self.depths, strict=True)
            ]
        return self._readings[phase]

    def problem(self, matches: Sequence[PointMatches] | None = None) -> Problem:
        """Return the fitting problem of the frames, with matches or without."""
        return Problem(
            self.surfaces,
            self.readings(),
            matches or [PointMatches.empty()] * len(self.frames),
            np.stack([f.odometry for f in self.frames]),
            np.stack([f.gravity for f in self.frames]),
            np.array([f.stamp for f in self.frames], np.float64),
            len(self.scene),
            self.options,
            self.drift,
            self.prior,
        )

    def fit_trajectory(self, start: Floats, progress: Progress | None = None) -> FittedTrajectory:
        """Return best trajectory from a start (T, 4, 4) that is known to a hand's breadth or two."""
        tell = progress or (lambda *_: None)
        if self.has_depth:
            tell("aligning depth", 0, 1)
        self.drift = (1.0, 1.0)
        self.drift = drift_of(self.problem(), start)
        solution = self._align_depth(start)
        poses = start if solution is None else solution.poses
        matches: list[PointMatches] = [PointMatches.empty()] * len(self.frames)
        stages = self._stages(solution)
        by_depth = self._conclude(poses, solution, matches) if solution and stages else None
        for number, stage in enumerate(stages):
            tell("matching images", number, len(stages))
            found = self.match(stage, poses)
            if not self.options.joint:
                return self._best_frame(found, poses)
            matches, led = self._find_consensus(stage, found, poses)
            if stage.matcher is None:
                self.landmark_matches = sum(map(len, matches)) or None
                if self.landmark_matches is None:
                    continue
            with time_stage(self.seconds, "solving"):
                solution = solve(self.problem(matches), led, FINE_WIDTHS)
            poses = solution.poses
            if stage.matcher is None and has_plenty(matches):
                self.by_landmarks = True
                self.stats["landmarks"] = self.landmark_matches
                break
        tell("checking", 0, 1)
        return replace(self._conclude(poses, solution, matches), by_depth=by_depth)

    def add_held_back(self, fit_trajectory: FittedTrajectory) -> FittedTrajectory:
        """Return an accepted fit, with those landmarks too that were kept for its check."""
        if not self.by_landmarks or not any(map(len, fit_trajectory.matches)):
            return fit_trajectory
        with time_stage(self.seconds, "solving"):
            matches = self._inliers(list(self.landmarks), fit_trajectory.poses)
            solution = solve(self.problem(matches), fit_trajectory.poses, FINE_WIDTHS[-1:])
        return self._conclude(solution.poses, solution, matches)

    # ------------------------------------------------------------------------------- stages

    def _align_depth(self, start: Floats) -> Solution | None:
        """Return poses by depth alone; None where there is none."""
        if not self.has_depth:
            return None
        with time_stage(self.seconds, "depth"):
            solution = solve(self.problem(), start, DEPTH_WIDTHS)
        self.stats["depth_cost"] = None if np.isnan(solution.cost) else round(solution.cost, 3)
        return solution

    def _stages(self, solution: Solution | None) -> list[Stage]:
        """Return rounds of matching that are wanted and may help."""
        wanted = self.options.images
        if solution is not None and wanted == "auto":
            wanted = not solution.cost <= UNSURE
        coloured = self.scene.has_colours and any(q is not None for q in self.queries)
        prior = [LANDMARKS] if any(map(len, self.landmarks)) and self.options.joint else []
        if not wanted or not coloured:
            return prior
        return prior + matching_stages(
            self.matcher, near=solution is not None and solution.cost <= LOST
        )

    def match(self, stage: Stage, poses: Floats) -> list[PointMatches]:
        """Return matches of the frames that are looked at, those in held-back blocks left out."""
        if stage.matcher is None:
            return drop_held_back(self.landmarks, self.frames, self.options)
        rows = [t for t in self.image_rows() if self.queries[t] is not None]
        matcher, matches = stage.matcher, [PointMatches.empty()] * len(self.frames)
        views = {
            t: turn_views(poses[t], self.options, self.rng) if stage.turned else [poses[t]]
            for t in rows
        }

        def one(t: int) -> PointMatches:
            frame, query = self.frames[t], self.queries[t]
            assert query is not None  # noqa: S101  chosen so
            seen = match_views(
                self.renderer, frame, query, views[t], matcher,
                size=stage.size, sigma=stage.sigma,
            )  # fmt: skip
            return seen[~held_back(seen.pixels, frame.camera)] if self.options.check else seen

        with time_stage(self.seconds, "matching"), ThreadPoolExecutor(_threads(matcher)) as pool:
            for t, seen in zip(rows, pool.map(one, rows), strict=True):
                matches[t] = seen
        self.stats["matches"] = sum(map(len, matches))
        return matches

    def image_rows(self) -> NDArray[np.int64]:
        """Return rows of the frames whose images are used."""
        deviation = MANY if self.matcher is None else FEW
        return spread(len(self.frames), self.options.frames or deviation)

    def _find_consensus(
        self, stage: Stage, matches: list[PointMatches], poses: Floats
    ) -> tuple[list[PointMatches], Floats]:
        """Return matches that agree on one pose of the rig, and the trajectory that follows from it."""
        if not stage.rigid:
            return matches, poses
        with time_stage(self.seconds, "ransac"):
            mounts = np.linalg.inv(poses[-1]) @ poses
            consensus = solve_rig(matches, list(mounts), self.options)
        if consensus is None or consensus.count < stage.share * sum(map(len, matches)):
            return [PointMatches.empty()] * len(matches), poses
        move = measure_move(poses[-1], consensus.pose)
        if stage.matcher is None and any(np.greater(move, FARTHEST)):
            return [PointMatches.empty()] * len(matches), poses
        kept = [seen[inlier] for seen, inlier in zip(matches, consensus.inliers, strict=True)]
        # depth has said where the poses are; without it, or by many landmarks, the consensus does
        leads = not self.has_depth or (stage.matcher is None and has_plenty(kept))
        led = consensus.pose @ mounts if leads else poses
        return kept, led

    def _inliers(self, matches: list[PointMatches], poses: Floats) -> list[PointMatches]:
        """Return matches (T,) that the poses explain."""
        limit = self.options.inlier
        return [s[s.errors(p) < limit * s.unit] for s, p in zip(matches, poses, strict=True)]

    def _best_frame(self, matches: list[PointMatches], poses: Floats) -> FittedTrajectory:
        """Sec. 3.6: PnP frame by frame, the one with most inliers decides."""
        best: tuple[int, Floats, int] | None = None
        with time_stage(self.seconds, "ransac"):
            for t, seen in enumerate(matches):
                found = solve_frame(seen, self.options)
                if found is not None and (best is None or found.count > best[0]):
                    best = found.count, found.pose, t
        if best is None:
            return self._conclude(poses, None, [PointMatches.empty()] * len(matches))
        _, pose, t = best
        odometry = np.stack([f.odometry for f in self.frames])
        led = pose @ np.linalg.inv(odometry[t]) @ odometry
        kept = [PointMatches.empty()] * len(matches)
        kept[t] = matches[t][matches[t].errors(pose) < self.options.inlier * matches[t].unit]
        self.stats["decided_by"] = self.frames[t].index
        solution = solve(self.problem(kept), led, FINE_WIDTHS[-1:], steps=1)
        return self._conclude(led, solution, kept)

    def _conclude(
        self, poses: Floats, solution: Solution | None, matches: list[PointMatches]
    ) -> FittedTrajectory:
        if solution is None:
            agreed = self._inliers(matches, poses)
            return FittedTrajectory(poses, None, agreed, np.full((6, 6), np.nan))
        lags = solution.lags
        agreed = self._inliers(matches, poses if lags is None else lags.image_poses(poses))
        self.stats["lag"] = {} if lags is None else lags.find_clear()
        error = map_error(self.scene, poses[-1, :3, 3])
        if not len(self.scene.viewpoints):  # a scan may drift, too; where, its mesh does not say
            error = max(error, UNEXPLAINED * float(np.nan_to_num(solution.cost)))
        return FittedTrajectory(
            poses, solution, agreed, covariance(self.problem(matches), solution, error)
        )


def _threads(matcher: Matcher) -> int:
    """Return frames matched at once: networks have threads of their own."""
    return count_processors() if matcher.name == GuidedMatcher.name else 1
