"""GeoJSON (RFC 7946): features, collections of them, and tables of GeoPandas."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import MissingExtraError

if TYPE_CHECKING:
    import geopandas as gpd

    from placegraph.core.geometry import Floats

DIGITS = 7
"""Decimals of a degree: a centimetre."""


def feature(geometry: Mapping[str, Any] | None, properties: Mapping[str, Any]) -> dict[str, Any]:
    """One feature; None: it has no place."""
    shape = dict(geometry) if geometry else None
    return {"type": "Feature", "geometry": shape, "properties": dict(properties)}


def collection(features: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """A FeatureCollection."""
    return {"type": "FeatureCollection", "features": list(features)}


def point(lonlat: Floats) -> dict[str, Any]:
    """Geometry of a position (2,) [deg]."""
    return {"type": "Point", "coordinates": _rounded(lonlat)}


def lines(parts: Sequence[Floats]) -> dict[str, Any]:
    """Geometry of one line, or of several, each (n, 2) [deg]."""
    if len(parts) == 1:
        return {"type": "LineString", "coordinates": _rounded(parts[0])}
    return {"type": "MultiLineString", "coordinates": [_rounded(part) for part in parts]}


def areas(rings: Sequence[Floats]) -> dict[str, Any]:
    """Geometry of rings, each (n, 2) [deg] and closed, whose insides and holes are told by nesting."""
    shapes = [
        [_rounded(wound(rings[k], 1.0 if k == polygon[0] else -1.0)) for k in polygon]
        for polygon in nested(rings)
    ]
    if len(shapes) == 1:
        return {"type": "Polygon", "coordinates": shapes[0]}
    return {"type": "MultiPolygon", "coordinates": shapes}


def nested(rings: Sequence[Floats]) -> list[list[int]]:
    """Polygons that closed rings, each (n, 2), make: rows of the outer ring and of its holes."""
    within = [
        {k for k, other in enumerate(rings) if k != i and inside(ring[0], other)}
        for i, ring in enumerate(rings)
    ]
    polygons = {i: [i] for i, around in enumerate(within) if not len(around) % 2}
    for i, around in enumerate(within):
        holders = [k for k in around if k in polygons] if len(around) % 2 else []
        if holders:  # a hole of the innermost that holds it
            polygons[max(holders, key=lambda k: len(within[k]))].append(i)
    return list(polygons.values())


def wound(ring: Floats, sense: float) -> Floats:
    """A closed ring (n, 2) counter-clockwise (1) or clockwise (-1), as RFC 7946 has rings and holes."""
    x, y = (np.asarray(ring, np.float64) - ring[0]).T
    doubled = float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum())
    return ring if doubled * sense >= 0 else ring[::-1]


def inside(at: NDArray[Any], ring: Floats) -> bool:
    """Whether a position (2,) lies in a closed ring (n, 2), by the crossings of a ray to the east."""
    (x, y), (start, end) = at, (ring[:-1], ring[1:])
    spans = (start[:, 1] > y) != (end[:, 1] > y)
    a, b = start[spans], end[spans]
    crossing = a[:, 0] + (y - a[:, 1]) / (b[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0])
    return bool(np.count_nonzero(crossing > x) % 2)


def geopandas_of(features: Mapping[str, Any]) -> gpd.GeoDataFrame:
    """Table of a FeatureCollection, WGS84; `MissingExtraError` without GeoPandas."""
    try:
        import geopandas as gpd
    except ImportError as error:
        raise MissingExtraError(
            "GeoPandas is not installed; `pip install 'placegraph[geopandas]'` brings it."
        ) from error
    return gpd.GeoDataFrame.from_features(features, crs="EPSG:4326")


def _rounded(lonlat: Floats) -> list[Any]:
    rounded: list[Any] = np.round(np.asarray(lonlat, np.float64), DIGITS).tolist()
    return rounded
