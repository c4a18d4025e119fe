"""Anchors of a map by fitting its outer walls to the footprint of a named building."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geo import Anchor
from placegraph.core.geojson import contains_points
from placegraph.core.geometry import Floats, rotation_z, wrap_angle
from placegraph.errors import OptionError
from placegraph.indoor.map.map_kernels import distance_transform
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.mapping.osm import segment_distances
from placegraph.io.osm.indoor_osm import format_level, parse_levels
from placegraph.world.anchor_points import UNKNOWN_HEIGHT, AnchorFit
from placegraph.world.outlines import (
    DOOR,
    WINDOW,
    Footprint,
    OuterWalls,
    find_footprints,
    find_outer_walls,
)

WALL_THICKNESS, THICKNESS_SIGMA = 0.3, 0.12
"""Thickness of outer walls, and its standard deviation [m]."""
_WALL_SIGMA = 0.35  # standard deviation of a footprint's walls from the building's [m]
_OUTER_SHARE = 0.7  # of a map's outline that is the building's wall, and not a neighbour's
_INNER_DENSITY, _OUTSIDE_DENSITY = 0.03, 1e-4  # of other points, inside and outside [1/m]
_WINDOW_SHARE = 0.95  # of windows that are in walls without a neighbour
_ENTRANCE_SIGMA = 0.7  # distance of a drawn entrance from its door [m]
_GRID_CELL, _MAX_GRID_CELLS = 0.25, 1000  # of shifts [m], and their largest number per axis
_MAX_HEADINGS, _MAX_SHIFTS = 8, 8  # largest numbers that are refined: headings, shifts of each
_MIN_COSINE, _MAX_WALL_DISTANCE = 0.9, 1.0  # of matching walls; distance in [m]
_MIN_WINDOWS = 4  # number of windows that make up for a small share of outer walls
_MAX_LOG_RATIO = 25.0  # largest log-likelihood ratio to the best of fits that are refined

_FOOTPRINT_SIGMA = 0.5  # standard deviation of a footprint's position [m]
_MIN_PROBABILITY = 0.01  # smallest probability of a candidate
_MAX_RESIDUALS = 64  # approximate number of residuals
_MAX_CHI_SQUARED = 25.0  # chi squared (3) from which a candidate contradicts a prior

_SLIDE_STEP, _MAX_SLIDE = 0.5, 100.0
"""Step and largest distance of a slide along an unobservable direction [m]."""
_MIN_HELD_SHARE = 0.9
"""Smallest share of points that still match after a slide."""


class WallFit(NamedTuple):
    """Pose of a map in the plane of a footprint, fitted to its walls."""

    heading: float
    shift: Floats
    """(2,) of the map's origin, east and north of the footprint's base [m]."""
    score: float
    """Log-likelihood."""
    off: Floats
    """(N,) residual of each point of the outer walls [m]; NaN where it is no wall of the building."""
    covariance: Floats
    """(3, 3) east, north [m], heading [rad]."""
    outer: tuple[float, float, float]
    """Shares of the outline in the building's walls, of the outline outside, and of windows in walls."""


def fit_walls(walls: OuterWalls, footprint: Footprint) -> list[WallFit]:
    """Fit outer walls to a footprint; return all distinct poses that may be right."""
    sigma = float(np.hypot(_WALL_SIGMA, footprint.grain / 2.0))
    found: list[WallFit] = []
    for heading in _propose_headings(walls, footprint):
        shifts = _propose_shifts(walls, footprint, heading, sigma)
        found += [_refine(walls, footprint, heading, shift, sigma) for shift in shifts]
    found.sort(key=lambda fit: -fit.score)
    kept: list[WallFit] = []
    middle = walls.points.mean(axis=0)
    for fit in found:
        if fit.score < found[0].score - _MAX_LOG_RATIO:
            break
        if not any(is_same_pose(fit, other, middle) for other in kept):
            kept.append(fit)
    return kept


def is_same_pose(one: WallFit, other: WallFit, middle: Floats, metres: float = 0.6) -> bool:
    """Whether two fits have the middle (2,) of a map within `metres`, and nearly one heading."""
    turn = abs((one.heading - other.heading + np.pi) % (2 * np.pi) - np.pi)
    away = transform_points(middle[None], one.heading, one.shift) - transform_points(
        middle[None], other.heading, other.shift
    )
    return bool(turn < 0.1 and np.linalg.norm(away) < metres)


def transform_points(points: Floats, heading: float, shift: Floats) -> Floats:
    """Transform points (N, 2) of a map [m] to the plane of a footprint."""
    moved: Floats = points @ rotation_z(-heading)[:2, :2].T + shift
    return moved


def _propose_headings(walls: OuterWalls, footprint: Footprint) -> list[float]:
    """Propose headings [rad] that align the normals of walls and footprint, the likeliest first."""
    lengths = np.linalg.norm(footprint.ends - footprint.starts, axis=1)
    both = []
    for normals, weights in (
        (walls.normals, np.ones(len(walls.points))),
        (footprint.normals, lengths),
    ):
        degrees = np.degrees(np.arctan2(normals[:, 1], normals[:, 0])) % 360.0
        both.append(np.fft.rfft(np.bincount(degrees.astype(int) % 360, weights, 360)))
    away = np.minimum(np.arange(360), 360 - np.arange(360))
    blur = np.fft.rfft(np.exp(-0.5 * (away / 3.0) ** 2))
    alike = np.fft.irfft(np.conj(both[0]) * both[1] * blur, 360)
    peak = (alike >= np.roll(alike, 1)) & (alike > np.roll(alike, -1)) & (alike > alike.max() / 3)
    turns = np.flatnonzero(peak)
    return [float(np.radians(-t)) for t in turns[np.argsort(-alike[turns])][:_MAX_HEADINGS]]


def _log_wall(inwards: Floats, sigma: float) -> Floats:
    """Compute the log density of a point of the outline by its depth in the building [m]."""
    peak = np.exp(-0.5 * ((inwards - WALL_THICKNESS) / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi))
    rest = np.where(inwards > 0, _INNER_DENSITY, _OUTSIDE_DENSITY)
    density: Floats = np.log(_OUTER_SHARE * peak + (1 - _OUTER_SHARE) * rest)
    return density


def _propose_shifts(
    walls: OuterWalls, footprint: Footprint, heading: float, sigma: float
) -> list[Floats]:
    """Propose shifts (2,) [m] of the map's origin under a heading, by correlation on a grid."""
    turned = transform_points(walls.points, heading, np.zeros(2))
    centre = (turned.min(axis=0) + turned.max(axis=0)) / 2.0
    corners = np.concatenate([footprint.starts, footprint.ends])
    margin = float(np.linalg.norm(np.ptp(turned, axis=0))) / 2.0 + 2.0
    low, high = corners.min(axis=0) - margin, corners.max(axis=0) + margin
    cell = max(_GRID_CELL, float((high - low).max()) / _MAX_GRID_CELLS)
    nx, ny = np.ceil((high - low) / cell).astype(int).tolist()
    facade = np.zeros((nx, ny), np.bool_)
    share = np.linspace(0, 1, 9)[:, None, None]
    dots = (footprint.starts + share * (footprint.ends - footprint.starts)).reshape(-1, 2)
    facade[tuple(np.floor((dots - low) / cell).astype(int).T)] = True
    reach = int(np.ceil(3.0 / cell))
    distance = np.sqrt(distance_transform(facade, reach)[0]) * cell
    x, y = (low[i] + (np.arange(n) + 0.5) * cell for i, n in enumerate((nx, ny)))
    grid = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    inside = contains_points(grid, footprint.rings).reshape(nx, ny)
    field = _log_wall(np.where(inside, distance, -distance), float(np.hypot(sigma, cell)))
    worst = float(np.log((1 - _OUTER_SHARE) * _OUTSIDE_DENSITY))
    stamp = np.zeros((nx, ny))
    at = np.floor((turned - centre) / cell).astype(int)
    np.add.at(stamp, (at[:, 0] % nx, at[:, 1] % ny), walls.weights)
    score = np.fft.irfft2(np.conj(np.fft.rfft2(stamp)) * np.fft.rfft2(field - worst), s=(nx, ny))
    best, apart = float(score.max()), max(1, round(0.75 / cell))
    found: list[Floats] = []
    while len(found) < _MAX_SHIFTS and score.max() > best - _MAX_LOG_RATIO:
        i, j = np.unravel_index(int(score.argmax()), score.shape)
        found.append(low + cell * (np.array([i, j]) + 0.5) - centre)
        score[max(0, i - apart) : i + apart + 1, max(0, j - apart) : j + apart + 1] = -np.inf
    return found


def _refine(
    walls: OuterWalls, footprint: Footprint, heading: float, shift: Floats, sigma: float
) -> WallFit:
    """Refine a pose and the thickness of walls by robust least squares."""
    thick, weights = WALL_THICKNESS, np.minimum(walls.weights, walls.step / 2.0)
    for _ in range(8):
        moved = transform_points(walls.points, heading, shift)
        inwards, normal, matched, _ = match_walls(walls, footprint, moved, heading)
        left = inwards - thick
        trust = weights * matched / sigma**2 / (1.0 + (left / (2 * sigma)) ** 2) ** 2
        lever = moved - shift
        turning = normal[:, 0] * lever[:, 1] - normal[:, 1] * lever[:, 0]
        rows = np.column_stack([-normal, -turning, -np.ones(len(left))])
        prior = np.diag([1e-6, 1e-6, 1e-4, 1.0 / THICKNESS_SIGMA**2])
        hessian = (rows * trust[:, None]).T @ rows + prior
        slope = rows.T @ (trust * left) + (
            0.0,
            0.0,
            0.0,
            (thick - WALL_THICKNESS) / THICKNESS_SIGMA**2,
        )
        step = -np.linalg.solve(hessian, slope)
        shift, heading, thick = shift + step[:2], heading + float(step[2]), thick + float(step[3])
        if np.abs(step).max() < 1e-4:
            break
    covariance = np.asarray(np.linalg.inv(hessian)[:3, :3], np.float64)
    return _score(walls, footprint, (heading, shift, thick), sigma, covariance)


def match_walls(
    walls: OuterWalls, footprint: Footprint, moved: Floats, heading: float
) -> tuple[Floats, Floats, NDArray[np.bool_], NDArray[np.int64]]:
    """Match points with walls: depth inwards [m] (N,), normals (N, 2), whether (N,) and which (N,) match."""
    facing = (walls.normals @ rotation_z(-heading)[:2, :2].T) @ footprint.normals.T
    distance = segment_distances(moved, footprint.starts, footprint.ends)
    distance = np.where(facing > _MIN_COSINE, distance, np.inf)
    which = distance.argmin(axis=1)
    normal = footprint.normals[which]
    inwards = -((moved - footprint.starts[which]) * normal).sum(axis=1)
    near = distance[np.arange(len(moved)), which] < _MAX_WALL_DISTANCE
    return inwards, normal, near, which


def _score(
    walls: OuterWalls, footprint: Footprint, pose: tuple[float, Floats, float], sigma: float,
    covariance: Floats,
) -> WallFit:  # fmt: skip
    """Score a pose by walls, windows without a neighbour, and doors at entrances."""
    heading, shift, thick = pose
    moved = transform_points(walls.points, heading, shift)
    inwards, _, near, which = match_walls(walls, footprint, moved, heading)
    inside = contains_points(moved, footprint.rings)
    far = segment_distances(moved, footprint.starts, footprint.ends).min(axis=1)
    depth = np.where(
        near, inwards - thick + WALL_THICKNESS, np.where(inside, np.maximum(far, 0.01), -far)
    )
    lost = near | (far > 3 * sigma) | ~inside
    log = np.where(lost, _log_wall(depth, sigma), np.log((1 - _OUTER_SHARE) * _INNER_DENSITY))
    outer = near & (np.abs(inwards - thick) < 2.5 * sigma)
    windows = walls.kind == WINDOW
    log += windows * np.log(
        np.where(outer & ~footprint.shared[which], _WINDOW_SHARE, 1 - _WINDOW_SHARE)
    )
    score = float(walls.weights @ log)
    score -= 0.5 * ((thick - WALL_THICKNESS) / THICKNESS_SIGMA) ** 2
    score += score_entrances(walls, footprint, moved, outer)
    out = float((~inside & (far > 3 * sigma)).mean())
    seen = float(outer[windows].mean()) if windows.any() else np.nan
    off = np.where(outer, np.abs(inwards - thick), np.nan)
    return WallFit(heading, shift, score, off, covariance, (float(outer.mean()), out, seen))


def score_entrances(
    walls: OuterWalls, footprint: Footprint, moved: Floats, outer: NDArray[np.bool_]
) -> float:
    """Score transformed doors (N, 2) in outer walls (N,) by the entrances of a footprint."""
    if not len(footprint.entrances):
        return 0.0
    doors = walls.kind == DOOR
    away = np.linalg.norm(moved[:, None] - footprint.entrances, axis=2)
    close = np.exp(-0.5 * (np.maximum(away - WALL_THICKNESS, 0.0) / _ENTRANCE_SIGMA) ** 2)
    score = float((walls.weights * doors * outer) @ np.log(0.2 + 3.0 * close.max(axis=1)))
    # an entrance where the map has a wall without a door
    covered = (away[outer] < 0.5).any(axis=0)
    served = (away[doors] < 3 * _ENTRANCE_SIGMA).any(axis=0)
    return score + float(np.log(0.3)) * int((covered & ~served).sum())


def find_fault(walls: OuterWalls, fit: WallFit) -> str:
    """Return why a fit cannot be right; empty where it can."""
    outer, out, seen = fit.outer
    windows = len(np.unique(walls.opening[walls.kind == WINDOW]))
    if out > 0.05:
        return f"{out:.0%} of its outline would lie outside"
    if windows >= 2 and seen < 0.6:
        return f"{1 - seen:.0%} of its windows would lie in no outer wall"
    if outer < (0.2 if windows >= _MIN_WINDOWS else 0.55):
        return (
            f"only {outer:.0%} of its outline would be outer walls, which is too little for "
            "an alignment"
        )
    return ""


def find_slides(
    walls: OuterWalls, footprint: Footprint, candidates: Sequence[WallFit]
) -> list[WallFit]:
    """Find unobservable directions of fits; return one fit in the middle of each.

    Its covariance spans the way along which the map slides, and its score counts the maps that have room
    there, side by side.
    """
    found: list[WallFit] = []
    middle = walls.points.mean(axis=0)
    angles = np.arctan2(walls.normals[:, 1], walls.normals[:, 0])
    main = float(np.angle(np.exp(4j * angles).sum())) / 4.0
    for fit in candidates:
        for turn in main - fit.heading + np.pi / 2.0 * np.arange(4):
            along = np.array([np.cos(turn), np.sin(turn)])
            width = float(np.ptp(transform_points(walls.points, fit.heading, fit.shift) @ along))
            far = _find_sliding_distance(walls, footprint, fit, along)
            beside = far / width - 1.0
            if beside > 0:
                slid = _fit_middle_of_slide(walls, footprint, fit, along * far, beside)
                if not any(is_same_pose(slid, other, middle, width) for other in found):
                    found.append(slid)
    return found


def _find_sliding_distance(
    walls: OuterWalls, footprint: Footprint, fit: WallFit, along: Floats
) -> float:
    """Find how far [m] a map slides along a direction (2,) without a change of the fit."""
    moved = transform_points(walls.points, fit.heading, fit.shift)
    facing = walls.normals @ rotation_z(-fit.heading)[:2, :2].T @ along
    held = np.isfinite(fit.off) & ((np.abs(facing) < 0.5) | (walls.kind == WINDOW))
    if not held.any():
        return 0.0
    far = 0.0
    while far < _MAX_SLIDE:
        there = moved + (far + _SLIDE_STEP) * along
        _, _, near, _ = match_walls(walls, footprint, there, fit.heading)
        if (
            near[held].mean() < _MIN_HELD_SHARE
            or contains_points(there, footprint.rings).mean() < _MIN_HELD_SHARE
        ):
            break
        far += _SLIDE_STEP
    return far


def _fit_middle_of_slide(
    walls: OuterWalls, footprint: Footprint, fit: WallFit, way: Floats, beside: float
) -> WallFit:
    """Move a fit to the middle of a way (2,) [m] along which `beside` maps have room."""
    shift, covariance = fit.shift + way / 2.0, fit.covariance.copy()
    covariance[:2, :2] += np.outer(way, way) / 12.0
    outer = np.isfinite(fit.off)
    before, after = (
        score_entrances(walls, footprint, transform_points(walls.points, fit.heading, at), outer)
        for at in (fit.shift, shift)
    )
    score = fit.score - before + after + float(np.log(beside))
    return fit._replace(shift=shift, covariance=covariance, score=score)


def fit_building(
    scene: Scene, path: Path, name: str, level: str = "", *, prior: Anchor | None = None
) -> AnchorFit:
    """Fit anchors of a map of one scene to the footprint of a named building.

    Parameters
    ----------
    scene
        Map of one scene.
    path, name, level
        Building and floor; see `find_footprints`.
    prior
        Rough anchor of the map, as by the fixes of a capture: it tells the heading, the height, and
        the place along a building that extends at both ends.

    Raises
    ------
    InputError, MapError
        The file cannot be read.
    OptionError
        The map has no outer walls, no building has the name, or the map does not fit one that has
        it, or not at the prior.

    """
    walls = find_outer_walls(scene)
    found, good = [], []
    for footprint in find_footprints(path, name, level):
        tried = fit_walls(walls, footprint)
        held = [fit for fit in tried if not find_fault(walls, fit)]
        found += tried
        good += [(footprint, fit) for fit in (*held, *find_slides(walls, footprint, held))]
    if not good:
        best = max(found, key=lambda fit: fit.score, default=None)
        why = (
            "no wall has a direction of the building's" if best is None else find_fault(walls, best)
        )
        raise OptionError(
            f"The map does not fit the building {name!r}: {why}. Name another building, or give "
            "--pair or --pose."
        )
    scores = np.array([fit.score for _, fit in good])
    anchors = [_make_anchor(footprint, fit, level) for footprint, fit in good]
    notes = []
    if prior is not None:
        anchors, logs = _apply_prior(anchors, prior, walls.points.mean(axis=0))
        scores = scores + logs
    shares = np.exp(scores - scores.max())
    shares /= shares.sum()
    order = [
        k for k in np.argsort(-shares, kind="stable").tolist() if shares[k] >= _MIN_PROBABILITY
    ]
    if len(order) > 1:
        notes.append(
            f"The walls fit in {len(order)} ways; add --capture, --pose or --pair to tell which."
        )
    levels = good[order[0]][0].levels
    if level and levels and not set(parse_levels(level)) & set(levels):
        notes.append(f"The building has levels {levels[0]:g} to {levels[-1]:g}, not {level}.")
    shown = {good[k][0].osm: good[k][0] for k in order}
    told = (replace(anchors[k], probability=min(1.0, float(shares[k]))) for k in order)
    return AnchorFit(tuple(told), tuple(notes), tuple(shown.values()))


def _make_anchor(footprint: Footprint, fit: WallFit, level: str) -> Anchor:
    turned = rotation_z(-fit.heading)[:2, :2]
    covariance = np.zeros((4, 4))
    rows = np.ix_([0, 1, 3], [0, 1, 3])
    covariance[rows] = fit.covariance
    covariance += np.diag([_FOOTPRINT_SIGMA**2, _FOOTPRINT_SIGMA**2, UNKNOWN_HEIGHT**2, 0.0])
    there = replace(footprint.base, heading=fit.heading).shift_origin(
        [*(-(turned.T @ fit.shift)), 0.0]
    )
    levels, off = footprint.levels, fit.off[np.isfinite(fit.off)]
    told = level or (format_level(levels[0]) if len(levels) == 1 else "")
    return replace(
        there, height=0.0, covariance=covariance,
        building=footprint.name.split(";")[0], osm=footprint.osm, level=told, method="building",
        residuals=tuple(off[:: max(1, len(off) // _MAX_RESIDUALS)].tolist()),
    )  # fmt: skip


def _apply_prior(
    anchors: Sequence[Anchor], prior: Anchor, middle: Floats
) -> tuple[list[Anchor], Floats]:
    """Fuse candidates with a prior at the middle (2,) of the map [m]; return them and log densities (N,)."""
    rows, back = np.ix_([0, 1, 3], [0, 1, 3]), np.array([-middle[0], -middle[1], 0.0])
    there, found, logs, squares, away = prior.shift_origin(back), [], [], [], []
    for anchor in anchors:
        here = anchor.shift_origin(back)
        place = there.enu_from_map[:3, :3] @ there.to_map(
            (here.longitude, here.latitude, there.height)
        )
        off = np.array([*place[:2], wrap_angle(here.heading - there.heading)])
        own = here.covariance[rows]
        gain = np.linalg.solve(own + there.covariance[rows], own).T
        squares.append(float(off @ np.linalg.solve(own + there.covariance[rows], off)))
        logs.append(-0.5 * (squares[-1] + np.linalg.slogdet(own + there.covariance[rows])[1]))
        away.append(off)
        covariance = np.zeros((4, 4))
        covariance[rows] = own - gain @ own
        covariance[2, 2] = there.covariance[2, 2]
        east, north, turn = (-gain @ off).tolist()
        lon, lat, _ = replace(here, heading=0.0).to_earth((east, north, 0.0)).tolist()
        moved = replace(
            here, longitude=lon, latitude=lat, heading=here.heading + turn, covariance=covariance,
            method=f"{anchor.method} and {prior.method}",
        )  # fmt: skip
        found.append(replace(moved.shift_origin(-back), height=prior.height))
    best = int(np.argmin(squares))
    if squares[best] > _MAX_CHI_SQUARED:
        metres, turn = np.hypot(*away[best][:2]), np.degrees(abs(away[best][2]))
        raise OptionError(
            f"The walls fit the building {metres:.1f} m and {turn:.0f}° from the pose by "
            f"{prior.method}; remove one of the two."
        )
    return found, np.array(logs)
