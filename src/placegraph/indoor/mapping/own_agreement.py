"""Agreement of a map with the frames that it was made of, and how much it repeats itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from placegraph.core.geometry import Floats, split_pose
from placegraph.indoor.likelihood.observe import (
    FINE,
    Background,
    observe_frame,
    spread,
    views,
)
from placegraph.indoor.likelihood.score import Scorer
from placegraph.indoor.localize import localize_capture
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.options import PoseSearchOptions
from placegraph.indoor.pose.agreement import REACH, agreement, reach
from placegraph.indoor.refine.refinement import image_evidence
from placegraph.indoor.render import Renderer
from placegraph.io.capture.frame import Frame

MOST, SOUGHT = 24, 12
"""Largest numbers of own frames that are compared with a map, and that are searched in it."""
NEAR = 0.5
"""Distance from its pose within which a frame is found [m]."""


def measure_own_agreement(scene: Scene, frames: Sequence[Frame], poses: Floats) -> Floats:
    """Measure how well the frames that a map was made of agree with it at their poses (T, 4, 4).

    Returns a row (2 K + 1,) of `Scene.own_agreement`: means and deviations over frames of the K numbers
    of `reach`, NaN where a sense is missing, and the probability that depth gives to wrong places.
    """
    options = PoseSearchOptions(semantic=False, colour=scene.has_colours)
    scorer, count, renderer = Scorer(scene, options.likelihood), len(scene), Renderer(scene)
    nothing = Background(np.full(count, 1.0 / count), np.ones((1, 1)), np.ones(1), 1.0)
    found = np.full((0, REACH), np.nan)
    for row in spread(len(frames), MOST):
        frame = replace(frames[row], gravity=-poses[row, 2, :3])
        seen = observe_frame(frame, None, options)
        view = views([seen], FINE, scorer.model, nothing)
        at = agreement(scorer, split_pose(poses[row])[0], view, np.zeros((1, 4)))
        rho = np.nan
        if seen.rgb is not None:
            rho = image_evidence(renderer, [frame], [seen.rgb], [poses[row : row + 1]]).correlation(
                0
            )
        found = np.vstack([found, reach(at, rho)])
    known = [column[np.isfinite(column)] for column in found.T]
    means, deviations = ([f(k) if len(k) else np.nan for k in known] for f in (np.mean, np.std))
    return np.array([*means, *deviations, _measure_repetition(scene, frames, poses)])


def _measure_repetition(scene: Scene, frames: Sequence[Frame], poses: Floats) -> float:
    """Return the mean probability of wrong places by the depth of single frames at poses (T, 4, 4)."""
    options, wrong = PoseSearchOptions().only(depth=True), []
    for row in spread(len(frames), SOUGHT):
        frame = replace(frames[row], gravity=-poses[row, 2, :3])
        found = localize_capture(scene, [frame], options=options, refine=False)
        at = np.array([mode.map_from_camera[:3, 3] for mode in found.modes]).reshape(-1, 3)
        shares = np.array([mode.probability for mode in found.modes])
        near = np.linalg.norm(at - poses[row, :3, 3], axis=1) < NEAR
        wrong.append(1.0 - float(shares[near].sum() / shares.sum()) if len(shares) else 1.0)
    return float(np.mean(wrong)) if wrong else np.nan
