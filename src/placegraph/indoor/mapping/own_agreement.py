"""Agreement of a map with its own frames, and how much the map repeats itself."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import chain

import numpy as np

from placegraph.core.geometry import Floats, split_pose
from placegraph.core.threads import count_processors
from placegraph.indoor.likelihood.observe import (
    FINE,
    Background,
    View,
    observe_frame,
    spread,
    views,
)
from placegraph.indoor.likelihood.score import Scorer
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.options import PoseSearchOptions
from placegraph.indoor.pose.agreement import agreement, reach
from placegraph.indoor.pose.estimate import estimate_pose
from placegraph.indoor.pose.local_fit import fit_window
from placegraph.indoor.pose.search import search
from placegraph.indoor.pose.window import PoseQuery, observe
from placegraph.indoor.refine.refinement import image_evidence
from placegraph.indoor.render import Renderer
from placegraph.io.capture.frame import Frame

MOST, SOUGHT = 24, 12
"""Largest numbers of own frames that are compared with a map, and that are searched in it."""
NEIGHBOURS = 4
"""Number of frames before and after a frame that may show what it shows."""
_GRID = 16
_HIDDEN = 0.95
"""Share of the way to a point from which on its ray ends at it."""
_FIRST = 5
"""Number of modes of a search among which other places are looked for."""
NEAR = 0.5
"""Distance from its pose within which a frame is found [m]."""


def measure_own_agreement(scene: Scene, frames: Sequence[Frame], poses: Floats) -> Floats:
    """Measure how well the frames that a map was made of agree with it at their poses (T, 4, 4).

    Returns a row (2 K + 1,) of `Scene.own_agreement`: means and deviations over frames of the K numbers
    of `reach`, NaN where a sense is missing, and how much the map repeats itself: the share of the mean
    texture that single frames find elsewhere, where depth fits best (without colours the probability that
    depth gives to such places). What a frame alone shows agrees with it, but with other frames by any
    share of that, evenly distributed.
    """
    options = PoseSearchOptions(semantic=False, colour=scene.has_colours)
    scorer, count, renderer = Scorer(scene, options.likelihood), len(scene), Renderer(scene)
    nothing = Background(np.full(count, 1.0 / count), np.ones((1, 1)), np.ones(1), 1.0)
    rows = spread(len(frames), MOST)

    def compare(number: int) -> tuple[Floats, list[tuple[float, float]], float]:
        row = rows[number]
        frame, pose = replace(frames[row], gravity=-poses[row, 2, :3]), poses[row]
        seen = observe_frame(frame, None, options)
        view = views([seen], FINE, scorer.model, nothing)
        at = agreement(scorer, split_pose(pose)[0], view, np.zeros((1, 4)))
        rho = np.nan
        if seen.rgb is not None:
            rho = image_evidence(renderer, [frame], [seen.rgb], [pose[None]]).correlation(0)
        sought = number % max(1, len(rows) // SOUGHT) == 0 and (view[0].depth > 0).any()
        elsewhere = [_measure_elsewhere(scorer, frame, view, pose)] if sought else []
        return reach(at, rho), elsewhere, _measure_seen_alone(scene, frames, poses, row)

    first = compare(0)  # makes what the scene derives once
    with ThreadPoolExecutor(count_processors()) as pool:
        compared = pool.map(compare, range(1, len(rows)))
        numbers, found, shown = zip(first, *compared, strict=True)
    elsewhere = [*chain(*found)]
    known = [column[np.isfinite(column)] for column in np.transpose(numbers)]
    means, deviations = (
        np.array([f(k) if len(k) else np.nan for k in known]) for f in (np.mean, np.std)
    )
    alone = float(np.mean(shown))
    means *= 1.0 - 0.5 * alone
    deviations = np.hypot(deviations, alone * means / np.sqrt(12.0))
    wrong, textures = np.mean(elsewhere, axis=0) if elsewhere else (np.nan, np.nan)
    return np.array([*means, *deviations, textures / means[1] if means[1] > 0 else wrong])


def _measure_seen_alone(scene: Scene, frames: Sequence[Frame], poses: Floats, row: int) -> float:
    """Return the share of what a frame shows of the scene that none of its neighbours in time shows."""
    pose, camera = poses[row], frames[row].camera
    columns, lines = np.meshgrid(np.linspace(0.05, 0.95, _GRID), np.linspace(0.05, 0.95, _GRID))
    pixels = np.stack([columns.ravel() * camera.width, lines.ravel() * camera.height], axis=1)
    directions = camera.directions(pixels) @ pose[:3, :3].T
    hits = scene.caster.cast(pose[:3, 3], directions)
    hit = hits.triangle >= 0
    points = pose[:3, 3] + hits.distance[hit, None] * directions[hit]
    alone = np.ones(len(points), np.bool_)
    for other in range(max(0, row - NEIGHBOURS), min(len(frames), row + NEIGHBOURS + 1)):
        if other == row or not len(points):
            continue
        away, camera = points - poses[other, :3, 3], frames[other].camera
        at = away @ poses[other, :3, :3]
        with np.errstate(invalid="ignore", divide="ignore"):
            pixels = camera.project(at)
            inside = (at[:, 2] > 0) & (pixels >= 0).all(axis=1)
            inside &= (pixels < (camera.width, camera.height)).all(axis=1)
        alone &= ~(inside & (scene.caster.cast(poses[other, :3, 3], away).distance > _HIDDEN))
    return float(alone.mean()) if len(points) else 0.0


def _measure_elsewhere(
    scorer: Scorer, frame: Frame, view: Sequence[View], pose: Floats
) -> tuple[float, float]:
    """Return what a frame at a pose (4, 4) finds elsewhere by depth: probability, and largest texture."""
    query = PoseQuery.of(scorer.scene, [frame], options=PoseSearchOptions().only(depth=True))
    window, rng = observe(query), np.random.default_rng(query.seed)
    modes = estimate_pose(window, fit_window(window, search(window, rng), rng)).modes
    at, still = pose[:3, 3], np.zeros((1, 4))
    far = [m for m in modes[:_FIRST] if np.linalg.norm(m.map_from_camera[:3, 3] - at) >= NEAR]
    textures = [agreement(scorer, mode.pose, view, still).texture for mode in far]
    total = sum(mode.probability for mode in modes)
    wrong = sum(mode.probability for mode in far) / total if total else 1.0
    return float(wrong), float(np.nan_to_num(textures).max(initial=0.0))
