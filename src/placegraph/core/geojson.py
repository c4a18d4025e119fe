"""GeoJSON (RFC 7946): features, collections, tables of GeoPandas, and estimates on Earth."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from math import degrees, isfinite
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geo import EarthPose, no_anchor_error
from placegraph.core.geometry import LocalPlane
from placegraph.errors import GeoPoseError, MissingExtraError

if TYPE_CHECKING:
    import geopandas as gpd

    from placegraph.core.geometry import Floats

DECIMALS = 7
"""Decimals of a degree: a centimetre."""


def make_feature(
    geometry: Mapping[str, Any] | None, properties: Mapping[str, Any]
) -> dict[str, Any]:
    """One feature; None: it has no place."""
    shape = dict(geometry) if geometry else None
    return {"type": "Feature", "geometry": shape, "properties": dict(properties)}


def make_collection(features: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """A FeatureCollection."""
    return {"type": "FeatureCollection", "features": list(features)}


def point_geometry(lonlat: Floats) -> dict[str, Any]:
    """Geometry of a position (2,) [deg]."""
    return {"type": "Point", "coordinates": _rounded(lonlat)}


def line_geometry(parts: Sequence[Floats]) -> dict[str, Any]:
    """Geometry of one line, or of several, each (n, 2) [deg]."""
    if len(parts) == 1:
        return {"type": "LineString", "coordinates": _rounded(parts[0])}
    return {"type": "MultiLineString", "coordinates": [_rounded(part) for part in parts]}


def polygon_geometry(rings: Sequence[Floats]) -> dict[str, Any]:
    """Geometry of rings, each (n, 2) [deg] and closed, whose insides and holes are told by nesting."""
    shapes = [
        [_rounded(orient_ring(rings[k], 1.0 if k == polygon[0] else -1.0)) for k in polygon]
        for polygon in nest_rings(rings)
    ]
    if len(shapes) == 1:
        return {"type": "Polygon", "coordinates": shapes[0]}
    return {"type": "MultiPolygon", "coordinates": shapes}


def nest_rings(rings: Sequence[Floats]) -> list[list[int]]:
    """Polygons that closed rings, each (n, 2), make: rows of the outer ring and of its holes."""
    within = [
        {k for k, other in enumerate(rings) if k != i and is_inside(ring[0], other)}
        for i, ring in enumerate(rings)
    ]
    polygons = {i: [i] for i, around in enumerate(within) if not len(around) % 2}
    for i, around in enumerate(within):
        holders = [k for k in around if k in polygons] if len(around) % 2 else []
        if holders:  # a hole of the innermost that holds it
            polygons[max(holders, key=lambda k: len(within[k]))].append(i)
    return list(polygons.values())


def orient_ring(ring: Floats, sense: float) -> Floats:
    """A closed ring (n, 2) counter-clockwise (1) or clockwise (-1), as RFC 7946 has rings and holes."""
    x, y = (np.asarray(ring, np.float64) - ring[0]).T
    doubled = float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum())
    return ring if doubled * sense >= 0 else ring[::-1]


def is_inside(at: NDArray[Any], ring: Floats) -> bool:
    """Whether a position (2,) lies in a closed ring (n, 2), by the crossings of a ray to the east."""
    (x, y), (start, end) = at, (ring[:-1], ring[1:])
    spans = (start[:, 1] > y) != (end[:, 1] > y)
    a, b = start[spans], end[spans]
    crossing = a[:, 0] + (y - a[:, 1]) / (b[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0])
    return bool(np.count_nonzero(crossing > x) % 2)


def to_geopandas(features: Mapping[str, Any]) -> gpd.GeoDataFrame:
    """Table of a FeatureCollection, WGS84; `MissingExtraError` without GeoPandas."""
    try:
        import geopandas as gpd
    except ImportError as error:
        raise MissingExtraError(
            "GeoPandas is not installed; `pip install 'placegraph[geopandas]'` brings it."
        ) from error
    return gpd.GeoDataFrame.from_features(features, crs="EPSG:4326")


def _rounded(lonlat: Floats) -> list[Any]:
    rounded: list[Any] = np.round(np.asarray(lonlat, np.float64), DECIMALS).tolist()
    return rounded


ELLIPSE_PROBABILITY = 0.95
"""Probability that an ellipse holds, were its mode the right one."""
_TURN = np.linspace(0.0, 2.0 * np.pi, 49)
_CIRCLE = np.stack([np.cos(_TURN), np.sin(_TURN)], axis=1)
_SCALE = float(np.sqrt(-2.0 * np.log(1.0 - ELLIPSE_PROBABILITY)))  # of a Gaussian in the plane


class GeoExport:
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
        poses = earth_poses(self.modes[0])
        if not poses:
            raise no_anchor_error(getattr(self.modes[0], "scene", ""))
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
        features = list(_mode_features(self.modes))
        if self.modes and not features:
            raise no_anchor_error(getattr(self.modes[0], "scene", ""))
        return make_collection(features) | {"status": self.status.name, "reason": self.reason}


def earth_poses(mode: Any) -> tuple[EarthPose, ...]:  # noqa: ANN401  # of any wing
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


def _mode_features(modes: Sequence[Any]) -> Iterator[dict[str, Any]]:
    for rank, mode in enumerate(modes, 1):
        poses = earth_poses(mode)
        for candidate, pose in enumerate(poses, 1):
            known = {"mode": rank, "candidate": candidate} | _properties(mode, pose)
            place = [pose.longitude, pose.latitude]
            where = [*place, pose.height] if isfinite(pose.height) else place
            yield make_feature({"type": "Point", "coordinates": where}, {"kind": "mode"} | known)
            ring = _ellipse(pose)
            if ring:
                held = {"kind": "ellipse", "share": ELLIPSE_PROBABILITY} | known
                yield make_feature({"type": "Polygon", "coordinates": [ring]}, held)
        if poses:
            yield from _evidence_features(rank, mode.evidence)


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
    """Ring of corners [deg] that holds the pose with `ELLIPSE_PROBABILITY`; empty where it is a point."""
    values, axes = np.linalg.eigh(pose.covariance[:2, :2])
    if not values[-1] > 0:
        return []
    # counter-clockwise, as RFC 7946 wants outer rings
    axes[:, 0] *= np.sign(axes[0, 0] * axes[1, 1] - axes[0, 1] * axes[1, 0])
    corners = _CIRCLE * (_SCALE * np.sqrt(np.maximum(values, 0.0))) @ axes.T
    ring = LocalPlane(pose.longitude, pose.latitude).to_lonlat(corners)
    ring[:, 0] += 360.0 * np.round((pose.longitude - ring[:, 0]) / 360.0)  # across the date line
    ring[-1] = ring[0]
    corners_deg: list[list[float]] = np.round(ring, DECIMALS).tolist()
    return corners_deg


def _evidence_features(rank: int, evidence: Sequence[Any]) -> Iterator[dict[str, Any]]:
    for said in evidence:
        plain = said.to_dict()
        known = {"kind": "evidence", "mode": rank}
        known |= {name: plain[name] for name in ("statement", "verdict", "weight", "note")}
        for thing in plain["objects"] or [{}]:
            at = [thing[k] for k in ("longitude", "latitude") if k in thing]
            names = {name: thing[name] for name in ("id", "label", "name") if name in thing}
            yield make_feature({"type": "Point", "coordinates": at} if at else None, known | names)
