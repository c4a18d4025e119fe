"""Anchors of a map by itself: its outer walls fitted to the footprint of a named building."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from placegraph.core.geo import Anchor
from placegraph.core.geometry import Floats, rotation_z, wrap
from placegraph.errors import OptionError
from placegraph.indoor.map.scene import Scene
from placegraph.io.osm.indoor_osm import level_text, levels_of
from placegraph.world.anchor_points import UNKNOWN_HEIGHT, Fitted
from placegraph.world.footprints import Footprint, footprints
from placegraph.world.outer_walls import outer_walls
from placegraph.world.slides import between
from placegraph.world.wall_fit import Fit, fits, wrong

_DRAWN = 0.5  # of the whole footprint, as pictures from above are placed [m]
_LEAST = 0.01  # probability of a candidate that is told
_KEPT = 64  # residuals, about
_CONTRADICTS = 25.0  # chi squared of 3 from which on a candidate is not where a prior has it


def fit_building(
    scene: Scene, path: Path, name: str, level: str = "", *, prior: Anchor | None = None
) -> Fitted:
    """Anchors of a map of one scene by the footprint of a named building.

    Parameters
    ----------
    scene
        Whose floor is fitted.
    path, name, level
        As of `footprints`.
    prior
        Where the map roughly stands, as by the fixes of a capture: says which turn is likely, how
        high, and where along a building that goes on at both ends.

    Raises
    ------
    InputError, MapError
        The file cannot be read.
    OptionError
        The map has no outer walls, no building has the name, the map fits none that has, or
        not where the prior has it.

    """
    walls = outer_walls(scene)
    found, good = [], []
    for footprint in footprints(path, name, level):
        tried = fits(walls, footprint)
        held = [fit for fit in tried if not wrong(walls, fit)]
        found += tried
        good += [(footprint, fit) for fit in (*held, *between(walls, footprint, held))]
    if not good:
        best = max(found, key=lambda fit: fit.score, default=None)
        why = "no wall has its directions" if best is None else wrong(walls, best)
        raise OptionError(
            f"The map does not fit the building {name!r}: {why}. Name another building, or give "
            "--pair or --pose."
        )
    scores = np.array([fit.score for _, fit in good])
    anchors = [_anchor(footprint, fit, level) for footprint, fit in good]
    notes = []
    if prior is not None:
        anchors, logs = _joined(anchors, prior, walls.points.mean(axis=0))
        scores = scores + logs
    shares = np.exp(scores - scores.max())
    shares /= shares.sum()
    order = [k for k in np.argsort(-shares, kind="stable").tolist() if shares[k] >= _LEAST]
    if len(order) > 1:
        notes.append(
            f"The walls fit in {len(order)} ways; --capture, --pose or --pair beside --in would tell "
            "which."
        )
    levels = good[order[0]][0].levels
    if level and levels and not set(levels_of(level)) & set(levels):
        notes.append(f"The building has levels {levels[0]:g} to {levels[-1]:g}, not {level}.")
    shown = {good[k][0].osm: good[k][0] for k in order}
    told = (replace(anchors[k], probability=min(1.0, float(shares[k]))) for k in order)
    return Fitted(tuple(told), tuple(notes), tuple(shown.values()))


def _anchor(footprint: Footprint, fit: Fit, level: str) -> Anchor:
    turned = rotation_z(-fit.heading)[:2, :2]
    covariance = np.zeros((4, 4))
    rows = np.ix_([0, 1, 3], [0, 1, 3])
    covariance[rows] = fit.covariance
    covariance += np.diag([_DRAWN**2, _DRAWN**2, UNKNOWN_HEIGHT**2, 0.0])
    there = replace(footprint.base, heading=fit.heading).shifted([*(-(turned.T @ fit.shift)), 0.0])
    levels, off = footprint.levels, fit.off[np.isfinite(fit.off)]
    told = level or (level_text(levels[0]) if len(levels) == 1 else "")
    return replace(
        there, height=0.0, covariance=covariance,
        building=footprint.name.split(";")[0], osm=footprint.osm, level=told, method="building",
        residuals=tuple(off[:: max(1, len(off) // _KEPT)].tolist()),
    )  # fmt: skip


def _joined(
    anchors: Sequence[Anchor], prior: Anchor, middle: Floats
) -> tuple[list[Anchor], Floats]:
    """Candidates as a prior corrects them at the middle (2,) of the map [m], and log density (N,) of each."""
    rows, back = np.ix_([0, 1, 3], [0, 1, 3]), np.array([-middle[0], -middle[1], 0.0])
    there, found, logs, squares, away = prior.shifted(back), [], [], [], []
    for anchor in anchors:
        here = anchor.shifted(back)
        place = there.enu_from_map[:3, :3] @ there.to_map(
            (here.longitude, here.latitude, there.height)
        )
        off = np.array([*place[:2], wrap(here.heading - there.heading)])
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
        found.append(replace(moved.shifted(-back), height=prior.height))
    best = int(np.argmin(squares))
    if squares[best] > _CONTRADICTS:
        metres, turn = np.hypot(*away[best][:2]), np.degrees(abs(away[best][2]))
        raise OptionError(
            f"The walls fit the building {metres:.1f} m and {turn:.0f}° from where it stands "
            f"by {prior.method}; leave one of the two out."
        )
    return found, np.array(logs)
