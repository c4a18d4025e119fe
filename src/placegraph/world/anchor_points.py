"""Anchors from points with known positions in the map and on Earth: pairs, or GPS fixes.

Robust least squares of heading and shift, at scale 1, with gravity along z. Outliers have no weight
(Tukey's biweight, from the best of many two-point starts).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from placegraph.core.estimate import Status
from placegraph.core.geo import Anchor
from placegraph.core.geometry import Floats, rotation_z
from placegraph.errors import InputError, OptionError
from placegraph.indoor.pose.window import Progress
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.capture import Capture, replace_poses
from placegraph.io.capture.fixes import FIXES_FILE, Fix, read_fixes
from placegraph.world.outlines import Footprint

UNKNOWN_HEIGHT = 100.0
"""Standard deviation of an unknown height, which is then 0 [m]."""
MIN_POINTS = 3
"""Smallest number of points: two determine heading and shift, a third checks them."""
_MIN_EXTENT = 0.5  # smallest extent of points that determine a heading [m]
_MIN_WIDTH_RATIO = 0.05  # of width to length, below which points lie on a line
_PRIOR_SIGMA, _PRIOR_WEIGHT = 0.15, 4.0  # of pairs [m], and its weight in coordinates
_MIN_SIGMA = 0.02  # smallest standard deviation of a pair [m]
_TUKEY_LIMIT = 4.7  # of Tukey's biweight, in deviations
_MAX_PAIRS, _MAX_PAIRED_POINTS = 400, 200  # of points that are tried as starts
_MAX_SCALE_ERROR = 0.03
_MAX_NAMED = 3  # points that notes name one by one

DEFAULT_ACCURACY = 5.0
"""Accuracy of a fix without its own [m]; 68 % lie within."""
_RADIUS_68 = 1.515  # radius that holds 68 % of a round Gaussian [standard deviations]
_COMMON_SIGMA = 1.5  # error that all fixes of an hour share [m]
_SAME_VIEWPOINT = 0.02  # distance of a viewpoint of the map from its frame [m]
_MIN_VIEWPOINTS = 3  # to tell whether the poses of a capture are the map's
_MAX_HEADING_SIGMA = np.radians(45.0)  # of a useful heading [rad]


class AnchorFit(NamedTuple):
    """Candidates of an anchor, best first, with notes for the user."""

    anchors: tuple[Anchor, ...]
    notes: tuple[str, ...]
    footprints: tuple[Footprint, ...] = ()
    """Footprints of the buildings that the map was fitted to."""


def fit_points(
    points: ArrayLike,
    lonlath: ArrayLike,
    accuracy: ArrayLike | None = None,
    *,
    in_time: bool = False,
    method: str = "pairs",
) -> AnchorFit:
    """Fit the anchor of a map to at least 3 of its points.

    Parameters
    ----------
    points
        (N, 3) in the map [m]; z may be NaN.
    lonlath
        (N, 3) longitude, latitude [deg, WGS84], height above the ellipsoid [m]; heights may be NaN.
    accuracy
        (N,) standard deviation of each on the ground [m]; None: equal, estimated from residuals.
    in_time
        Whether points follow each other in time, as fixes do, with correlated errors, which reduce
        their weight.
    method
        Name of the method in the anchor.

    Raises
    ------
    OptionError
        There are fewer than 3 points, coordinates are no numbers, or all points coincide.

    """
    here, there = np.array(points, np.float64), np.array(lonlath, np.float64)
    if len(here) != len(there) or len(here) < MIN_POINTS:
        raise OptionError(f"{method}: {len(here)} points; at least {MIN_POINTS} are needed.")
    if not (np.isfinite(here[:, :2]).all() and np.isfinite(there[:, :2]).all()):
        raise OptionError(f"{method}: a coordinate is not a number.")
    if (np.abs(there[:, :2]) > (180.0, 90.0)).any():
        raise OptionError(
            f"{method}: a longitude or latitude is out of range; give longitude first."
        )
    base = Anchor(float(there[0, 0]), float(there[0, 1]), 0.0, 0.0)
    ground = np.where(np.isfinite(there), there, 0.0)
    targets = base.to_map(ground)[:, :2]
    sigma = np.ones(len(here)) if accuracy is None else np.maximum(_MIN_SIGMA, accuracy)
    sources = here[:, :2]
    heading, weights = _fit_heading(
        sources, targets, sigma, has_accuracy=accuracy is not None, method=method
    )
    total = weights.sum()
    middle, aim = (weights @ side / total for side in (sources, targets))
    away = _residuals(sources, targets, heading, weights)
    off = np.linalg.norm(away, axis=1)
    freedom = 2.0 * float((weights > 0).sum()) - 3.0
    left = float(weights @ (off / sigma) ** 2)
    # few points fit by luck: their residuals are combined with a prior
    spread = max(1.0, left / max(freedom, 1.0))
    if accuracy is None:
        spread = (left + _PRIOR_WEIGHT * _PRIOR_SIGMA**2) / (freedom + _PRIOR_WEIGHT)
    if in_time:
        spread *= _count_correlated(away[weights > 0])
    arms = np.square(sources - middle).sum(axis=1)
    precision = weights / weights.max() / sigma**2
    height, of_height = _fit_height(here[:, 2], there[:, 2], sigma, precision)
    covariance = np.diag([spread / precision.sum()] * 2 + [of_height, spread / (precision @ arms)])
    # north differs between the middle of the points and the first of them
    start = replace(base, height=height, heading=heading)
    centred = start.shift_origin(-(start.enu_from_map[:2, :2].T @ aim) @ np.eye(2, 3))
    centred = replace(centred, covariance=covariance, method=method, residuals=tuple(off))
    anchor = replace(centred.shift_origin([*middle, 0.0]), height=height)
    return AnchorFit((anchor,), tuple(_find_faults(sources, targets, sigma, weights, off, there)))


def _fit_heading(
    sources: Floats, targets: Floats, sigma: Floats, *, has_accuracy: bool, method: str
) -> tuple[float, Floats]:
    """Fit the heading [rad] by Tukey's biweight; return it and the weights (N,)."""
    some = np.unique(np.linspace(0, len(sources) - 1, _MAX_PAIRED_POINTS).astype(int))
    i, j = some[np.stack(np.triu_indices(len(some), 1))]
    apart = np.linalg.norm(sources[i] - sources[j], axis=1)
    if apart.max() < _MIN_EXTENT:
        raise OptionError(
            f"{method}: all points lie within {apart.max():.2f} m of the map, so the "
            "heading is unknown. Give points farther apart."
        )
    order = np.argsort(-apart, kind="stable")
    order = order[np.linspace(0, len(order) // 2, min(_MAX_PAIRS, len(order))).astype(int)]
    order = order[apart[order] >= _MIN_EXTENT]
    i, j = i[order], j[order]
    here, there = sources @ (1.0, 1.0j), targets @ (1.0, 1.0j)
    turns = np.exp(1j * np.angle((there[j] - there[i]) / (here[j] - here[i])))[:, None]
    moved = (here - (here[i] + here[j])[:, None] / 2.0) * turns
    left = np.abs(moved - there + (there[i] + there[j])[:, None] / 2.0) / sigma
    half = (len(sources) + 2) // 2 - 1 if len(sources) > MIN_POINTS else len(sources) - 1
    halves = np.partition(left, half, axis=1)[:, half]
    k = int(halves.argmin())
    heading, scale = -float(np.angle(turns[k, 0])), float(halves[k]) / 1.177  # of a Rayleigh
    weights = np.zeros(len(sources))
    weights[[i[k], j[k]]] = 1.0
    floor = 1.0 if has_accuracy else _MIN_SIGMA
    scale = max(scale, floor)
    # larger residuals are outliers; maps are rarely more exact than 0.1 m
    limit = _TUKEY_LIMIT * max(scale, 1.0 if has_accuracy else 0.1)
    for _ in range(20):
        off = _distances(sources, targets, heading, weights) / sigma
        tukey = np.where(off < limit, (1.0 - (off / limit) ** 2) ** 2, 0.0)
        if (tukey > 0).sum() < 2:
            break
        weights = tukey / sigma**2
        heading = _align(sources, targets, weights)
    return heading, weights * sigma**2 / max(float((weights * sigma**2).max()), 1e-12)


def _align(sources: Floats, targets: Floats, weights: Floats) -> float:
    """Compute the heading [rad] that aligns sources with targets, both (N, 2), about weighted means."""
    a, b = (side - weights @ side / weights.sum() for side in (sources, targets))
    cross = weights @ (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    dot = weights @ (a * b).sum(axis=1)
    return float(-np.arctan2(cross, dot))


def _residuals(sources: Floats, targets: Floats, heading: float, weights: Floats) -> Floats:
    """Compute the residuals (N, 2) [m] under a heading."""
    a, b = (side - weights @ side / weights.sum() for side in (sources, targets))
    return np.asarray(a @ rotation_z(-heading)[:2, :2].T - b)


def _distances(sources: Floats, targets: Floats, heading: float, weights: Floats) -> Floats:
    """Compute the lengths of the residuals (N,) [m] under a heading."""
    return np.asarray(np.linalg.norm(_residuals(sources, targets, heading, weights), axis=1))


def _count_correlated(away: Floats) -> float:
    """Estimate how many errors (N, 2) in time are worth one, by their correlation (AR(1))."""
    square = float((away**2).sum())
    if len(away) < MIN_POINTS or square == 0.0:
        return 1.0
    # residuals of n errors correlate less than the errors, by about 3 / n
    next_to = float((away[1:] * away[:-1]).sum()) / square + 3.0 / len(away)
    share = min(max(next_to, 0.0), 0.95)
    return (1.0 + share) / (1.0 - share)


def _fit_height(z: Floats, heights: Floats, sigma: Floats, weights: Floats) -> tuple[float, float]:
    """Fit the height of z = 0 [m] by the median of known differences; return it and its variance."""
    both = np.isfinite(z) & np.isfinite(heights) & (weights > 0)
    if not both.any():
        return 0.0, UNKNOWN_HEIGHT**2
    difference = heights[both] - z[both]
    height = float(np.median(difference))
    spread = 1.4826 * float(np.median(np.abs(difference - height)))
    # heights of GPS are worse than places, by about half
    sure = max(spread, 1.5 * float(np.median(sigma[both])) if (sigma != 1.0).any() else _MIN_SIGMA)
    return height, sure**2 * 1.57 / both.sum()


def _find_faults(
    sources: Floats, targets: Floats, sigma: Floats, weights: Floats, off: Floats, lonlath: Floats
) -> list[str]:
    """Find outliers, points on a line, and exchanged coordinates; return sentences on these."""
    mute = np.flatnonzero(weights < 0.05).tolist()
    notes = [f"Point {k + 1} is {off[k]:.1f} m off, and is ignored." for k in mute]
    if len(mute) > _MAX_NAMED:
        worst = max(float(off[k]) for k in mute)
        told = f"{len(mute)} of {len(off)} points are up to {worst:.0f} m off, and are ignored."
        notes = [told]
    good = weights > 0.05
    a, b = sources[good], targets[good]
    width = np.linalg.svd(a - a.mean(axis=0), compute_uv=False)
    if good.sum() >= 2 and width[1] < max(_MIN_WIDTH_RATIO * width[0], _MIN_SIGMA):
        which = ", ".join(str(k + 1) for k in np.flatnonzero(good).tolist())
        notes.append(
            f"Points {which} lie on one line: nothing checks the map across it; add one beside it."
        )
    elif good.sum() >= MIN_POINTS:
        size = np.sqrt(np.square(b - b.mean(axis=0)).sum() / np.square(a - a.mean(axis=0)).sum())
        if (
            abs(size - 1.0) > _MAX_SCALE_ERROR
            and width[0] * abs(size - 1.0) > 2 * np.median(sigma) * 0.1
        ):
            notes.append(f"The points would fit better if the map were {size:.3f} times as large.")
        notes += _find_exchanged(sources, targets, off, lonlath)
    return notes


def _find_exchanged(sources: Floats, targets: Floats, off: Floats, lonlath: Floats) -> list[str]:
    """Find coordinates that would fit much better than with residuals (N,) [m] if they were exchanged."""
    tried = {"x and y": (sources * (-1.0, 1.0), targets)}
    if (np.abs(lonlath[:, 0]) <= 90.0).all():
        there = np.column_stack([lonlath[:, 1::-1], np.zeros(len(off))])
        base = Anchor(float(there[0, 0]), float(there[0, 1]), 0.0, 0.0)
        tried["longitude and latitude"] = (sources, base.to_map(there)[:, :2])
    notes, every = [], np.ones(len(off))
    for which, sides in tried.items():
        left = float(np.median(_distances(*sides, _align(*sides, every), every)))
        if left < 0.3 * float(np.median(off)) and np.median(off) > 0.5:
            notes.append(f"The points would fit to {left:.2f} m with {which} exchanged.")
    return notes


def fit_capture(
    scene: SceneMap,
    capture: Capture,
    *,
    rough: bool = False,
    seed: int = 0,
    progress: Progress | None = None,
) -> AnchorFit:
    """Fit the anchor of a map to the GPS fixes of a capture: `fixes.txt`, else the EXIF of its images.

    The poses of the capture are used where the map was made of it; otherwise its frames are localized in
    the map first.

    Parameters
    ----------
    scene
        A map of one scene.
    capture
        Frames in it, or of the way around it.
    rough
        Whether an uncertain heading is accepted, as for the `prior` of `fit_building`.
    seed, progress
        See `SceneMap.localize`.

    Raises
    ------
    InputError
        Fewer than 3 frames have a fix; a file is broken.
    OptionError
        Frames are not found in the map; fixes lie too close together for a heading.

    """
    fixes = read_fixes(capture)
    if len(fixes) < MIN_POINTS:
        raise InputError(
            f"{capture.path or 'The capture'}: {len(fixes)} of {len(capture)} frames have a "
            f"GPS fix, in {FIXES_FILE} or in the EXIF of their images; {MIN_POINTS} are "
            "needed. Record more, or give --pair, --pose or --in."
        )
    poses, how = _find_poses(scene, capture, seed, progress)
    # a fix that several frames repeat counts once, at their mean
    rows: dict[Fix, list[int]] = {}
    for row, fix in fixes.items():
        if row in poses:
            rows.setdefault(fix, []).append(row)
    if len(rows) < MIN_POINTS:
        raise OptionError(
            f"{len(rows)} different fixes belong to localized frames, but {MIN_POINTS} are "
            "needed. Record more, or give --pair, --pose or --in."
        )
    points = np.array(
        [np.mean([poses[row][:3, 3] for row in own], axis=0) for own in rows.values()]
    )
    known = np.array(list(rows), np.float64)
    accuracy = np.where(np.isfinite(known[:, 3]), known[:, 3], DEFAULT_ACCURACY) / _RADIUS_68
    found = fit_points(points, known[:, :3], accuracy, in_time=True, method="gps")
    anchor = found.anchors[0]
    covariance = anchor.covariance + np.diag(
        [_COMMON_SIGMA**2, _COMMON_SIGMA**2, _COMMON_SIGMA**2, 0.0]
    )
    turn = float(np.sqrt(covariance[3, 3]))
    if turn > _MAX_HEADING_SIGMA and not rough:
        reach = float(np.ptp(points[:, :2], axis=0).max())
        raise OptionError(
            f"The fixes (±{np.median(accuracy):.0f} m) lie within {reach:.0f} m of the map, "
            "so the heading is unknown; walk farther and around the building, or give --in "
            "and --building."
        )
    return AnchorFit((replace(anchor, covariance=covariance),), (how, *found.notes))


def _find_poses(
    scene: SceneMap, capture: Capture, seed: int, progress: Progress | None
) -> tuple[Mapping[int, Floats], str]:
    """Find the pose (4, 4) of each frame in the map, by row; also return a sentence on their source."""
    file = None if capture.path is None else capture.path / "trajectory.tum"
    posed = [] if file is None or not file.exists() else [replace_poses(capture, file)]
    for known in (*posed, capture) if len(scene.viewpoints) >= _MIN_VIEWPOINTS else ():
        at = np.array([frame.odometry[:3, 3] for frame in known])
        away = np.linalg.norm(scene.viewpoints[:, None] - at[None], axis=2).min(axis=1)
        if (
            away < _SAME_VIEWPOINT
        ).mean() > 0.95:  # the map's viewpoints are where these frames were
            poses = {frame.index: frame.odometry for frame in known}
            how = "The map was built from these frames, so their poses are used directly."
            return {row: poses[f.index] for row, f in enumerate(capture) if f.index in poses}, how
    estimate = scene.localize(capture, seed=seed, progress=progress)
    if estimate.status is not Status.OK:
        raise OptionError(
            "The frames are not reliably localized in the map, so their fixes cannot be "
            f"used: {estimate.reason} Give --pair, --pose or --in."
        )
    found = zip(estimate.frames.tolist(), estimate.trajectory, strict=True)
    return dict(found), f"{len(estimate.frames)} frames were first localized in the map."
