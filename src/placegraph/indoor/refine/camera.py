"""A camera that is not as the capture says, found where its frames fit badly as they are.

Asked only of an answer that is not `OK`, whose refinement was refused, or which a cheap test of the
refinement suspects. From where the modes are, or from the refined pose, unknowns of the camera are
found together with the poses, round by round on frames that were mended by what was found before;
what is not clearly off is taken for right.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from placegraph.core.estimate import PoseEstimate, Status
from placegraph.core.geometry import Floats, between, compose, pose_matrix
from placegraph.indoor.likelihood.observe import spread
from placegraph.indoor.pose.window import Window
from placegraph.indoor.refine.calibrate import (
    COUNT,
    FOCAL,
    IMAGE,
    PLACE,
    SCALE,
    TILT,
    WIDTHS,
    Calibrated,
    calibrate,
)
from placegraph.indoor.refine.mend import Mend, brought, share_view
from placegraph.indoor.refine.refiner import Fitted, Refiner, stages_of
from placegraph.indoor.status import diagnostics_of

if TYPE_CHECKING:
    from placegraph.indoor.refine.correspondences import Sights
    from placegraph.indoor.refine.fit import Problem
    from placegraph.indoor.refine.refinement import Refining

OFF = 0.04
"""Logarithm of a factor from which on a camera is wrong: depth of real sensors is off by 1 to 3 %."""
TILTED = 0.0175
"""Turn [rad] from which on gravity is off."""
CLEAR = 4.0
"""Standard errors that it must be off by, too."""
SUSPECT = 0.02
"""... and from which on one linear step at the refined pose asks for a closer look."""
PLAUSIBLE = 0.25
"""What is off by more is another place."""
ENOUGH = 300
"""Matches below which images tell nothing of their camera."""
DULL = 0.35
"""Correlation of held-back parts of the images with the map at a pose that depth has fitted, below
which depth and images may not be of one place: right ones have 0.4 and more (benchmark)."""
APART = (0.03, 0.012)
"""Way [m] and turn [rad] between depth and images from which on they are not of one view."""
GAIN = 0.04
"""Share of the robust cost that a mended camera must save."""
MODES, FRAMES, READINGS = 4, 5, 500
"""Modes that are tried, by how many frames, with how many readings each."""
TRIAL = (10.0, 10.0, 6.0, 6.0, 4.0)
"""Kernels of a trial [standard deviations]."""
MOST = 12
"""Frames that a camera is told from."""
ROUNDS = 4
SETTLED = 0.003
"""Rounds end where nothing changes by more."""


def scale_off(refiner: Refiner, fitted: Fitted) -> float:
    """Logarithm by which a scale or focal length looks off at fitted poses; 0: none does.

    Of depth one linear step, which tells that something is wrong better than by how much; matches
    take more, since those that are left agree with the poses, and cost little.
    """
    free = [SCALE, FOCAL] if refiner.has_depth else [IMAGE]
    if not refiner.has_depth and sum(map(len, fitted.sights)) < ENOUGH:
        return 0.0
    poses, lags = fitted.poses, fitted.lags
    if lags is not None:
        poses = (lags.of_depth if refiner.has_depth else lags.of_images)(poses)
    problem = refiner.problem(None if refiner.has_depth else fitted.sights)
    widths = TRIAL[:1] if refiner.has_depth else WIDTHS
    found = calibrate(refiner.scene, problem, poses, free, widths)
    off = [found.values[k] for k in free if abs(found.values[k]) > CLEAR * found.errors[k]]
    return float(max(off, key=abs, default=0.0))


def wrong_camera(window: Window, estimate: PoseEstimate, refining: Refining) -> Mend | None:
    """What is wrong with the camera of a window's frames; None: nothing that could be told."""
    if not refining.options.joint or estimate.best is None or not _asked(estimate):
        return None
    depth = any(s.depth is not None for s in window.sightings)
    # depth tells enough at few places, and lags are told from frame to frame
    rows = np.arange(len(window))[-MOST:] if depth else spread(len(window), MOST)
    starts = [start[rows] for start in _starts(window, estimate)]
    case = _Case(_part(window, rows), refining)
    return case.found(starts[0] if len(starts) == 1 else case.nearest(starts))


def _asked(estimate: PoseEstimate) -> bool:
    told = estimate.refinement
    if estimate.status is not Status.OK or told is None or not told.accepted:
        return True
    found = diagnostics_of(estimate).refinement
    return found is not None and bool(found.camera)


def _starts(window: Window, estimate: PoseEstimate) -> list[Floats]:
    """Trajectories (T, 4, 4) to begin from."""
    if estimate.refinement is not None and estimate.refinement.accepted:
        return [estimate.trajectory[-len(window) :]]
    steps = between(window.poses[-1], window.poses)
    modes = estimate.modes[:MODES]
    return [pose_matrix(compose(mode.pose, steps), window.levels) for mode in modes]


def _part(window: Window, rows: NDArray[np.int64]) -> Window:
    return Window(window.query, window.scorer, [window.sightings[i] for i in rows])


def _matched(refiner: Refiner, poses: Floats, *, near: bool) -> list[Sights]:
    """Matches (T,) of the frames with the map, by the guided matcher."""
    return refiner.matched(stages_of(None, near=near)[0], poses)


@dataclass(eq=False)
class _Case:
    """Frames whose camera is looked into, and what has been found of it."""

    window: Window
    refining: Refining
    mend: Mend = field(default_factory=Mend.nothing)

    def __post_init__(self) -> None:
        self.depth = self._refiner(self.window).has_depth

    def _refiner(self, window: Window, readings: int | None = None) -> Refiner:
        """Of frames as they are mended so far."""
        frames = self.mend.frames([s.frame for s in window.sightings])
        seen = [
            replace(s, frame=f, depth=brought(f, s.depth))
            for s, f in zip(window.sightings, frames, strict=True)
        ]
        mended = Window(window.query, window.scorer, seen)
        options = self.refining.options
        options = replace(options, readings=readings or options.readings)
        return Refiner.of(mended, options, None)

    def nearest(self, starts: list[Floats]) -> Floats:
        """The start (T, 4, 4) from which frames fit best, were the camera another."""
        rows = spread(len(self.window), FRAMES)
        refiner = self._refiner(_part(self.window, rows), READINGS)
        free = [SCALE, FOCAL] if self.depth else [IMAGE]
        best, cost = starts[0], np.inf
        for start in starts:
            sights = None if self.depth else _matched(refiner, start[rows], near=False)
            problem = refiner.problem(sights)
            fit = calibrate(refiner.scene, problem, start[rows], free, TRIAL)
            if fit.cost < cost and np.abs(fit.values).max() < PLAUSIBLE:
                best, cost = fit.poses[-1] @ np.linalg.inv(start[rows[-1]]) @ start, fit.cost
        return best

    def found(self, poses: Floats) -> Mend | None:
        """What is clearly off, from poses (T, 4, 4) nearby; None: nothing."""
        coloured = self.window.scene.coloured and self.window.sightings[0].rgb is not None
        for number in range(ROUNDS):
            refiner, sights = self._refiner(self.window), None
            if coloured and (number or not self.depth):
                sights = _matched(refiner, poses, near=self.depth or number > 0)
            free = [SCALE, FOCAL, *TILT] if self.depth else []
            if sights is not None and sum(map(len, sights)) >= ENOUGH:
                free.append(IMAGE)
            if not free:
                return None
            poses, moved = self._settled(refiner, refiner.problem(sights), poses, free)
            if number and moved < SETTLED:
                break
        values = np.abs(self.mend.values[[SCALE, FOCAL, IMAGE, *TILT]])
        return self.mend if self.mend.values.any() and values.max() < PLAUSIBLE else None

    def _settled(
        self, refiner: Refiner, problem: Problem, poses: Floats, free: list[int]
    ) -> tuple[Floats, float]:
        """Poses fitted with what is clearly off, which is taken over; and how much that changed."""
        before, kept, least = self.mend.values, list(free), np.full(COUNT, OFF)
        tilt = list(TILT)
        least[tilt] = TILTED
        while True:
            fit = calibrate(refiner.scene, problem, poses, kept)
            off, errors = np.abs(before + fit.values), fit.errors.copy()
            off[tilt], errors[tilt] = np.linalg.norm(off[tilt]), errors[tilt].max()
            sure = off / np.maximum(least, CLEAR * errors)
            weak = min((sure[k] for k in kept), default=1.0)
            if weak >= 1.0:
                break
            kept = [k for k in kept if sure[k] > weak]  # the three of a tilt go together
        usual = [k for k in kept if before[k] or k in TILT]  # poses lean without a cost, too
        if usual != kept:
            plain = calibrate(refiner.scene, problem, poses, usual)
            if fit.cost > (1.0 - GAIN) * plain.cost:
                fit, kept = plain, usual
        if IMAGE in free and self.depth and not before[list(PLACE)].any():
            fit, kept = self._offset(refiner, problem, fit, kept)
        values, errors = before.copy(), self.mend.errors.copy()
        out = [k for k in free if k not in kept]
        values[kept] += fit.values[kept]
        errors[kept] = fit.errors[kept]
        values[out] = errors[out] = 0.0
        frame = self.window.sightings[0].frame
        if IMAGE not in free and self.depth and share_view(frame.camera, frame.depth_camera):
            values[IMAGE], errors[IMAGE] = values[FOCAL], errors[FOCAL]
        self.mend = Mend(values, errors)
        return fit.poses, float(np.abs(values - before).max())

    def _offset(
        self, refiner: Refiner, problem: Problem, fit: Calibrated, kept: list[int]
    ) -> tuple[Calibrated, list[int]]:
        """The fit with depth of another place than the images, where that is clear."""
        apart = calibrate(refiner.scene, problem, fit.poses, [*kept, *PLACE])
        place, errors = apart.values[list(PLACE)], apart.errors[list(PLACE)]
        away = np.linalg.norm(place[:3]) > APART[0] or np.linalg.norm(place[3:]) > APART[1]
        clear = (np.abs(place) > CLEAR * errors).any()
        if away and clear and apart.cost < (1.0 - GAIN) * fit.cost:
            return apart, [*kept, *PLACE]
        return fit, kept
