"""Estimates on Earth as GeoJSON."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import degrees, isfinite
from typing import Any

import numpy as np

from placegraph.core.features import collection, feature
from placegraph.core.features import DIGITS
from placegraph.core.geo import EarthPose, unplaced


SHARE = 0.95
"""Probability that an ellipse holds, were its mode the right one."""
_TURN = np.linspace(0.0, 2.0 * np.pi, 49)
_CIRCLE = np.stack([np.cos(_TURN), np.sin(_TURN)], axis=1)
_SCALE = float(np.sqrt(-2.0 * np.log(1.0 - SHARE)))  # of a Gaussian in the plane
from placegraph.core.geometry import (
    LocalPlane,
)
from placegraph.errors import GeoPoseError


class OnEarth:
    """What an estimate says in the words of geography; mixed into `Estimate`."""

    status: Any
    modes: Sequence[Any]
    reason: str

    def geopose(self) -> dict[str, Any]:
        """OGC GeoPose 1.0 (Basic-Quaternion) of the best mode, with what it is worth beside it.

        ``position`` (lat, lon [deg], h above the ellipsoid [m]) and ``quaternion`` (x, y, z, w: the
        body's axes, x right, y forward, z up, in east, north, up) are the standard's. ``unknown``
        names what of them nobody knows: of a sentence the height and the orientation, written as 0
        and as the identity. ``accuracy`` (position [m], orientation [deg]), ``probability``,
        ``status`` and ``reason`` are this library's.

        Raises
        ------
        GeoPoseError
            Nothing was found, or in a scene map that nobody has placed on Earth.

        """
        if not self.modes:
            raise GeoPoseError(f"There is no pose: {self.reason}")
        poses = poses_of(self.modes[0])
        if not poses:
            raise unplaced(getattr(self.modes[0], "scene", ""))
        return poses[0].geopose() | {"status": self.status.name, "reason": self.reason}

    def geojson(self) -> dict[str, Any]:
        """FeatureCollection of points, ellipses and evidence, told apart by the property ``kind``.

        ``mode``: a point of each mode, and of each candidate of its map's anchor; ``ellipse``: the
        polygon that holds it with 95 %; ``evidence``: each object that a statement named, a point
        where its place is known, else without geometry. ``mode`` counts from 1. ``status`` and
        ``reason`` stand beside the features. Without modes there are none.

        Raises
        ------
        GeoPoseError
            All was found in scene maps that nobody has placed on Earth.

        """
        features = list(_features(self.modes))
        if self.modes and not features:
            raise unplaced(getattr(self.modes[0], "scene", ""))
        return collection(features) | {"status": self.status.name, "reason": self.reason}


def poses_of(mode: Any) -> tuple[EarthPose, ...]:  # noqa: ANN401  # of any wing
    """Where a mode is on Earth, the likeliest first; empty where its map is not placed there.

    A mode says so in `earth`, or by its longitude, latitude and covariance (2, 2).
    """
    earth = getattr(mode, "earth", None)
    if earth:
        return (earth,) if isinstance(earth, EarthPose) else tuple(earth)
    if getattr(mode, "longitude", None) is not None:
        given = mode.longitude, mode.latitude, mode.covariance
        return (EarthPose.of_place(*given, probability=mode.probability),)
    return ()


def _features(modes: Sequence[Any]) -> Iterator[dict[str, Any]]:
    for rank, mode in enumerate(modes, 1):
        poses = poses_of(mode)
        for candidate, pose in enumerate(poses, 1):
            known = {"mode": rank, "candidate": candidate} | _properties(mode, pose)
            place = [pose.longitude, pose.latitude]
            where = [*place, pose.height] if isfinite(pose.height) else place
            yield feature({"type": "Point", "coordinates": where}, {"kind": "mode"} | known)
            ring = _ellipse(pose)
            if ring:
                held = {"kind": "ellipse", "share": SHARE} | known
                yield feature({"type": "Polygon", "coordinates": [ring]}, held)
        if poses:
            yield from _told(rank, mode.evidence)


def _properties(mode: Any, pose: EarthPose) -> dict[str, Any]:  # noqa: ANN401
    heading = pose.heading
    known: dict[str, Any] = {
        "probability": pose.probability,
        "height": pose.height if isfinite(pose.height) else None,
        "heading_deg": degrees(heading) if isfinite(heading) else None,
    }
    known |= {name: getattr(pose, name) for name in ("level", "room", "building", "osm")}
    known |= {name: getattr(mode, name, None) for name in ("scene", "cell")}
    return {name: value for name, value in known.items() if value not in (None, "")}


def _ellipse(pose: EarthPose) -> list[list[float]]:
    """Ring of corners [deg] that holds the pose with `SHARE`; empty where it is a point."""
    values, axes = np.linalg.eigh(pose.covariance[:2, :2])
    if not values[-1] > 0:
        return []
    # counter-clockwise, as RFC 7946 wants outer rings
    axes[:, 0] *= np.sign(axes[0, 0] * axes[1, 1] - axes[0, 1] * axes[1, 0])
    corners = _CIRCLE * (_SCALE * np.sqrt(np.maximum(values, 0.0))) @ axes.T
    ring = LocalPlane(pose.longitude, pose.latitude).to_lonlat(corners)
    ring[:, 0] += 360.0 * np.round((pose.longitude - ring[:, 0]) / 360.0)  # across the date line
    ring[-1] = ring[0]
    corners_deg: list[list[float]] = np.round(ring, DIGITS).tolist()
    return corners_deg


def _told(rank: int, evidence: Sequence[Any]) -> Iterator[dict[str, Any]]:
    for said in evidence:
        plain = said.to_dict()
        known = {"kind": "evidence", "mode": rank}
        known |= {name: plain[name] for name in ("statement", "verdict", "weight", "note")}
        for thing in plain["objects"] or [{}]:
            at = [thing[k] for k in ("longitude", "latitude") if k in thing]
            names = {name: thing[name] for name in ("id", "label", "name") if name in thing}
            yield feature({"type": "Point", "coordinates": at} if at else None, known | names)
