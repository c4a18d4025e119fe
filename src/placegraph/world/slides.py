"""Poses between the ends of a building, where nothing but its neighbours holds a map.

A map that fits in a corner of a long building fits beside it as well, as one flat of many: walls along
the way stay walls, windows stay outside, and only the wall across leaves the building's. Where on
the way, nobody says.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from placegraph.core.geometry import Floats, rotation_z
from placegraph.world.footprints import Footprint, within
from placegraph.world.outer_walls import WINDOW, OuterWalls
from placegraph.world.wall_fit import Fit, against, at_entrances, moved_by, same

_STEP, _FARTHEST = 0.5, 100.0
"""Along a slide [m]."""
_SHARE = 0.9
"""Of points that are to stay as they are."""


def between(walls: OuterWalls, footprint: Footprint, fits: Sequence[Fit]) -> list[Fit]:
    """Poses beside those that fit: for each way along which a map slides, one in its middle.

    Its covariance holds the way, and its score counts how many such maps would lie there, side by side.
    """
    found: list[Fit] = []
    middle = walls.points.mean(axis=0)
    angles = np.arctan2(walls.normals[:, 1], walls.normals[:, 0])
    main = float(np.angle(np.exp(4j * angles).sum())) / 4.0
    for fit in fits:
        for turn in main - fit.heading + np.pi / 2.0 * np.arange(4):
            along = np.array([np.cos(turn), np.sin(turn)])
            width = float(np.ptp(moved_by(walls.points, fit.heading, fit.shift) @ along))
            far = _far(walls, footprint, fit, along)
            beside = far / width - 1.0
            if beside > 0:
                slid = _slid(walls, footprint, fit, along * far, beside)
                if not any(same(slid, other, middle, width) for other in found):
                    found.append(slid)
    return found


def _far(walls: OuterWalls, footprint: Footprint, fit: Fit, along: Floats) -> float:
    """How far [m] a map slides along a direction (2,)."""
    moved = moved_by(walls.points, fit.heading, fit.shift)
    facing = walls.normals @ rotation_z(-fit.heading)[:2, :2].T @ along
    held = np.isfinite(fit.off) & ((np.abs(facing) < 0.5) | (walls.kind == WINDOW))
    if not held.any():
        return 0.0
    far = 0.0
    while far < _FARTHEST:
        there = moved + (far + _STEP) * along
        _, _, near, _ = against(walls, footprint, there, fit.heading)
        if near[held].mean() < _SHARE or within(there, footprint.rings).mean() < _SHARE:
            break
        far += _STEP
    return far


def _slid(walls: OuterWalls, footprint: Footprint, fit: Fit, way: Floats, beside: float) -> Fit:
    """The pose in the middle of a way (2,) [m], for so many maps `beside` each other."""
    shift, covariance = fit.shift + way / 2.0, fit.covariance.copy()
    covariance[:2, :2] += np.outer(way, way) / 12.0
    outer = np.isfinite(fit.off)
    before, after = (
        at_entrances(walls, footprint, moved_by(walls.points, fit.heading, at), outer)
        for at in (fit.shift, shift)
    )
    score = fit.score - before + after + float(np.log(beside))
    return fit._replace(shift=shift, covariance=covariance, score=score)
