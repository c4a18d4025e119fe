"""GeoJSON (RFC 7946) of maps and estimates, and tables of GeoPandas."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from math import degrees, isfinite
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geo import EarthPose, no_anchor_error
from placegraph.core.geometry import Floats, LocalPlane
from placegraph.errors import GeoPoseError, MissingExtraError

if TYPE_CHECKING:
    import geopandas as gpd


DECIMALS = 7
"""Decimals of degrees: a centimetre."""
_PAIRS = 1 << 20
"""Points times edges of a ring that are compared at once."""


def make_feature(
    geometry: Mapping[str, Any] | None, properties: Mapping[str, Any]
) -> dict[str, Any]:
    """Return a feature; `geometry` is None where its place is unknown."""
    shape = dict(geometry) if geometry else None
    return {"type": "Feature", "geometry": shape, "properties": dict(properties)}


def make_collection(features: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Return a FeatureCollection."""
    return {"type": "FeatureCollection", "features": list(features)}


def point_geometry(lonlat: Floats) -> dict[str, Any]:
    """Return the geometry of a position (2,) [deg]."""
    return {"type": "Point", "coordinates": _rounded(lonlat)}


def line_geometry(parts: Sequence[Floats]) -> dict[str, Any]:
    """Return the geometry of one line, or of several, each (n, 2) [deg]."""
    if len(parts) == 1:
        return {"type": "LineString", "coordinates": _rounded(parts[0])}
    return {"type": "MultiLineString", "coordinates": [_rounded(part) for part in parts]}


def polygon_geometry(rings: Sequence[Floats]) -> dict[str, Any]:
    """Return the geometry of closed rings, each (n, 2) [deg]; rings in rings are holes."""
    shapes = [
        [_rounded(orient_ring(rings[k], 1.0 if k == polygon[0] else -1.0)) for k in polygon]
        for polygon in nest_rings(rings)
    ]
    if len(shapes) == 1:
        return {"type": "Polygon", "coordinates": shapes[0]}
    return {"type": "MultiPolygon", "coordinates": shapes}


def nest_rings(rings: Sequence[Floats]) -> list[list[int]]:
    """Group closed rings, each (n, 2), into polygons: rows of the outer ring and of its holes."""
    outside = [
        {k for k, other in enumerate(rings) if k != i and contains_points(ring[:1], [other])[0]}
        for i, ring in enumerate(rings)
    ]
    polygons = {i: [i] for i, around in enumerate(outside) if not len(around) % 2}
    for i, around in enumerate(outside):
        shells = [k for k in around if k in polygons] if len(around) % 2 else []
        if shells:  # the hole belongs to the innermost
            polygons[max(shells, key=lambda k: len(outside[k]))].append(i)
    return list(polygons.values())


def orient_ring(ring: Floats, sense: float) -> Floats:
    """Return a closed ring (n, 2) counter-clockwise (`sense` 1: shells) or clockwise (-1: holes)."""
    x, y = (np.asarray(ring, np.float64) - ring[0]).T
    doubled_area = float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum())
    return ring if doubled_area * sense >= 0 else ring[::-1]


def contains_points(points: Floats, rings: Iterable[Floats]) -> NDArray[np.bool_]:
    """Return whether points (N, 2) lie within closed rings, each (n, 2), by the even-odd rule."""
    inside = np.zeros(len(points), np.bool_)
    for ring in rings:
        (x0, y0), (x1, y1) = ring[:-1].T, ring[1:].T
        some = max(1, _PAIRS // (len(ring) + 1))
        for start in range(0, len(points), some):
            x, y = points[start : start + some, :1], points[start : start + some, 1:]
            spans = (y0 > y) != (y1 > y)
            with np.errstate(divide="ignore", invalid="ignore"):
                crossing = x0 + (y - y0) / (y1 - y0) * (x1 - x0)
            inside[start : start + some] ^= (spans & (crossing > x)).sum(axis=1) % 2 == 1
    return inside


def to_geopandas(features: Mapping[str, Any]) -> gpd.GeoDataFrame:
    """Return the table of a FeatureCollection, WGS84; `MissingExtraError` without GeoPandas."""
    try:
        import geopandas as gpd
    except ImportError as error:
        raise MissingExtraError(
            "GeoPandas is not installed; run `pip install 'placegraph[geopandas]'`."
        ) from error
    return gpd.GeoDataFrame.from_features(features, crs="EPSG:4326")


def _rounded(lonlat: Floats) -> list[Any]:
    rounded: list[Any] = np.round(np.asarray(lonlat, np.float64), DECIMALS).tolist()
    return rounded


ELLIPSE_PROBABILITY = 0.95
"""Probability inside the ellipse of a mode, given the mode."""
_TURN = np.linspace(0.0, 2.0 * np.pi, 49)
_CIRCLE = np.stack([np.cos(_TURN), np.sin(_TURN)], axis=1)
_SCALE = float(np.sqrt(-2.0 * np.log(1.0 - ELLIPSE_PROBABILITY)))  # of a Gaussian in the plane


class GeoExport:
    """Export of estimates as OGC GeoPose and GeoJSON, mixed into `Estimate`."""

    status: Any
    modes: Sequence[Any]
    reason: str

    def geopose(self) -> dict[str, Any]:
        """Return the OGC GeoPose 1.0 (Basic-Quaternion) of the best mode, with its accuracy.

        ``position`` (lat, lon [deg], h above the ellipsoid [m]) and ``quaternion`` (x, y, z, w: the
        body's axes, x right, y forward, z up, in east, north, up) belong to the standard. This library
        adds ``accuracy`` (position [m], orientation [deg]: it reaches every mode of the likeliest that
        hold 95 %), ``probability``, ``status``, ``reason`` and ``unknown``, which names ``height`` and
        ``orientation`` where they are unknown (after a sentence) and written as 0 and the identity.

        Raises `GeoPoseError`: there is no mode, or its scene map has no anchor.
        """
        if not self.modes:
            raise GeoPoseError(f"There is no pose. {self.reason}")
        if not earth_poses(self.modes[0]):
            raise no_anchor_error(getattr(self.modes[0], "scene", ""))
        poses = [pose for mode in self.modes for pose in earth_poses(mode)]
        document = poses[0].geopose() | {"accuracy": reach_accuracy(poses)}
        return document | {"status": self.status.name, "reason": self.reason}

    def geojson(self) -> dict[str, Any]:
        """Return a FeatureCollection whose features have the property ``kind``.

        ``mode``: the point of each mode and candidate anchor; ``ellipse``: its 95 % region;
        ``evidence``: each object of a statement, without geometry where its place is unknown. The
        property ``mode`` counts from 1. The collection also has ``status`` and ``reason``. It is empty
        without modes.

        Raises `GeoPoseError`: no mode lies in a map with an anchor.
        """
        features = list(_mode_features(self.modes))
        if self.modes and not features:
            raise no_anchor_error(getattr(self.modes[0], "scene", ""))
        return make_collection(features) | {"status": self.status.name, "reason": self.reason}


def earth_poses(mode: Any) -> tuple[EarthPose, ...]:  # noqa: ANN401  # of any wing
    """Return the poses of a mode on Earth, the likeliest first; empty where its map has no anchor.

    They come from `earth`, or from the mode's longitude, latitude and covariance (2, 2).
    """
    earth = getattr(mode, "earth", None)
    if earth:
        return (earth,) if isinstance(earth, EarthPose) else tuple(earth)
    if getattr(mode, "longitude", None) is not None:
        given = mode.longitude, mode.latitude, mode.covariance
        return (EarthPose.from_place(*given, probability=mode.probability),)
    return ()


def reach_accuracy(poses: Sequence[EarthPose]) -> dict[str, float | None]:
    """Return the accuracy (position [m], orientation [deg] or None) of the first pose for all of them.

    The likeliest poses that hold `ELLIPSE_PROBABILITY` together count: from the first to each of
    them, and its own accuracy there. A pose that holds this much alone keeps `EarthPose.accuracy`.
    """
    best, held, reach = poses[0], 0.0, {"position": 0.0, "orientation": 0.0}
    plane = LocalPlane(best.longitude, best.latitude)
    for pose in [best, *sorted(poses[1:], key=lambda pose: -pose.probability)]:
        if held >= ELLIPSE_PROBABILITY:
            break
        held += pose.probability
        up = np.nan_to_num(pose.height - best.height)
        metres = np.hypot(np.linalg.norm(plane.to_plane([pose.longitude, pose.latitude])), up)
        turn = 2.0 * np.arccos(min(abs(float(pose.quaternion @ best.quaternion)), 1.0))
        for name, distance in (("position", metres), ("orientation", np.degrees(turn))):
            own = pose.accuracy[name]
            there = np.nan if own is None else distance + own
            reach[name] = float(np.maximum(reach[name], there))  # NaN where one is unknown
    return {name: value if isfinite(value) else None for name, value in reach.items()}


def _mode_features(modes: Sequence[Any]) -> Iterator[dict[str, Any]]:
    poses = [(rank, mode, earth_poses(mode)) for rank, mode in enumerate(modes, 1)]
    rings = iter(_ellipses([pose for *_, found in poses for pose in found]))
    for rank, mode, found in poses:
        for candidate, pose in enumerate(found, 1):
            known = {"mode": rank, "candidate": candidate} | _properties(mode, pose)
            place = [pose.longitude, pose.latitude]
            where = [*place, pose.height] if isfinite(pose.height) else place
            yield make_feature({"type": "Point", "coordinates": where}, {"kind": "mode"} | known)
            if ring := next(rings):
                held = {"kind": "ellipse", "share": ELLIPSE_PROBABILITY} | known
                yield make_feature({"type": "Polygon", "coordinates": [ring]}, held)
        if found:
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


def _ellipses(poses: Sequence[EarthPose]) -> list[list[list[float]]]:
    """Return the ring [deg] that holds each pose with `ELLIPSE_PROBABILITY`; empty for a point."""
    covariances = np.array([pose.covariance[:2, :2] for pose in poses]).reshape(-1, 2, 2)
    values, axes = np.linalg.eigh(covariances)
    # counter-clockwise, as RFC 7946 wants outer rings
    axes[..., 0] *= np.sign(np.linalg.det(axes))[:, None]
    corners = _CIRCLE * (_SCALE * np.sqrt(np.maximum(values, 0.0)))[:, None] @ axes.swapaxes(1, 2)
    planes = [LocalPlane(pose.longitude, pose.latitude) for pose in poses]
    degrees = np.array([plane.metres_per_degree for plane in planes]).reshape(-1, 1, 2)
    origins = np.array([(p.longitude, p.latitude) for p in planes]).reshape(-1, 1, 2)
    rings = np.round(origins + corners / degrees, DECIMALS)
    rings[:, -1] = rings[:, 0]
    return [r if v > 0 else [] for r, v in zip(rings.tolist(), values[:, -1], strict=True)]


def _evidence_features(rank: int, evidence: Sequence[Any]) -> Iterator[dict[str, Any]]:
    for item in evidence:
        plain = item.to_dict()
        properties = {"kind": "evidence", "mode": rank}
        properties |= {name: plain[name] for name in ("statement", "verdict", "weight", "note")}
        for obj in plain["objects"] or [{}]:
            lonlat = [obj[k] for k in ("longitude", "latitude") if k in obj]
            names = {name: obj[name] for name in ("id", "label", "name") if name in obj}
            point = {"type": "Point", "coordinates": lonlat} if lonlat else None
            yield make_feature(point, properties | names)
