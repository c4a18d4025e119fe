"""Anchors of a map by the GPS fixes of a capture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from placegraph.core.estimate import Status
from placegraph.core.geometry import Floats
from placegraph.errors import InputError, OptionError
from placegraph.indoor.pose.query import Progress
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.capture import Capture, with_poses
from placegraph.io.capture.fixes import FILE, Fix, fixes_of
from placegraph.world.anchor_points import LEAST, Fitted, fit_points

USUAL = 5.0
"""Accuracy of a fix that does not tell its own [m]; 68 % lie within."""
_WITHIN = 1.515  # radius that holds 68 % of a round Gaussian [standard deviations]
_COMMON = 1.5  # what all fixes of an hour share, and none of them averages out [m]
_MATCHES = 0.02  # between a map's viewpoints and the frames that they are of [m]
_TURNS = 3  # viewpoints that tell whether a capture's poses are the map's
_LOST = np.radians(45.0)  # a heading known no better is not known


class _Paired(NamedTuple):
    """Places in the map of the frames that have fixes."""

    points: Floats
    """(N, 3) [m]."""
    lonlath: Floats
    """(N, 3) longitude, latitude [deg], height [m], which may be NaN."""
    accuracy: Floats
    """(N,) standard deviation of each along an axis [m]."""


def fit_capture(
    scene: SceneMap,
    capture: Capture,
    *,
    rough: bool = False,
    seed: int = 0,
    progress: Progress | None = None,
) -> Fitted:
    """Anchor of a map by the GPS fixes of a capture: of `fixes.txt`, else of its images' EXIF.

    Where the map was made of the capture, its own poses are the map's; else its frames are found in
    the map first.

    Parameters
    ----------
    scene
        A map of one scene.
    capture
        Frames of it, or of the way around it.
    rough
        Whether a heading that is hardly known will do, as for the `prior` of `fit_building`.
    seed, progress
        As of `SceneMap.localize`.

    Raises
    ------
    InputError
        Fewer than 3 frames have a fix; a file is broken.
    OptionError
        Frames are not found in the map; fixes lie too close together for a heading.

    """
    fixes = fixes_of(capture)
    if len(fixes) < LEAST:
        raise InputError(
            f"{capture.path or 'The capture'}: {len(fixes)} of {len(capture)} frames have a GPS fix, "
            f"in {FILE} or in the EXIF of their images; {LEAST} are needed. Else give --pair, --pose "
            "or --in."
        )
    poses, how = _poses(scene, capture, seed, progress)
    paired = _paired({row: fix for row, fix in fixes.items() if row in poses}, poses)
    if len(paired.points) < LEAST:
        raise OptionError(
            f"{len(paired.points)} different fixes belong to frames that were found in the map; "
            f"{LEAST} are needed. Else give --pair, --pose or --in."
        )
    found = fit_points(*paired, in_time=True, method="gps")
    anchor = found.anchors[0]
    covariance = anchor.covariance + np.diag([_COMMON**2, _COMMON**2, _COMMON**2, 0.0])
    turn = float(np.sqrt(covariance[3, 3]))
    if turn > _LOST and not rough:
        reach = float(np.ptp(paired.points[:, :2], axis=0).max())
        raise OptionError(
            f"The fixes (±{np.median(paired.accuracy):.0f} m) lie within {reach:.0f} m of the map and tell "
            "no heading: walk farther, around the house too, or give --in and --building."
        )
    return Fitted((replace(anchor, covariance=covariance),), (how, *found.notes))


def _poses(
    scene: SceneMap, capture: Capture, seed: int, progress: Progress | None
) -> tuple[Mapping[int, Floats], str]:
    """Pose (4, 4) in the map of each frame, by its row, and how they are known."""
    for known in _told(capture):
        if _made_of(scene, known):
            poses = {frame.index: frame.odometry for frame in known}
            said = "The map was made of these frames: their poses are its own."
            return {row: poses[f.index] for row, f in enumerate(capture) if f.index in poses}, said
    estimate = scene.localize(capture, seed=seed, progress=progress)
    if estimate.status is not Status.OK:
        raise OptionError(
            f"The frames are not surely found in the map, so their fixes say nothing of it: "
            f"{estimate.reason} Give --pair, --pose or --in."
        )
    found = zip(estimate.frames.tolist(), estimate.trajectory, strict=True)
    return dict(found), f"{len(estimate.frames)} frames were found in the map first."


def _told(capture: Capture) -> list[Capture]:
    """The capture with the poses that a map may have been made by."""
    file = None if capture.path is None else capture.path / "trajectory.tum"
    return [capture] if file is None or not file.exists() else [with_poses(capture, file), capture]


def _made_of(scene: SceneMap, capture: Capture) -> bool:
    """Whether the frames were where the map's viewpoints are."""
    if len(scene.viewpoints) < _TURNS:
        return False
    at = np.array([frame.odometry[:3, 3] for frame in capture])
    away = np.linalg.norm(scene.viewpoints[:, None] - at[None], axis=2).min(axis=1)
    return bool((away < _MATCHES).mean() > 0.95)


def _paired(fixes: Mapping[int, Fix], poses: Mapping[int, Floats]) -> _Paired:
    """Fixes and places; a fix that several frames repeat is one, in their middle."""
    rows: dict[Fix, list[int]] = {}
    for row, fix in fixes.items():
        rows.setdefault(fix, []).append(row)
    points = [np.mean([poses[row][:3, 3] for row in group], axis=0) for group in rows.values()]
    told = np.array(list(rows), np.float64).reshape(-1, 4)
    accuracy = np.where(np.isfinite(told[:, 3]), told[:, 3], USUAL) / _WITHIN
    return _Paired(np.reshape(points, (-1, 3)), told[:, :3], accuracy)
