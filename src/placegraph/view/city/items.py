"""A city as a display list: which objects stand in a rectangle, and how they are painted."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from placegraph.core.geometry import Floats
from placegraph.outdoor.map.objects import CityObjects
from placegraph.view.city.coast import sea
from placegraph.view.draw.canvas import Area, Bounds, Dot, Line, MapItem
from placegraph.view.draw.clip import clip_line, clip_ring
from placegraph.view.draw.style import AREA, LINE, PAINTS, paint_of

if TYPE_CHECKING:
    from placegraph.outdoor.city import CityMap


def labels_of(objects: CityObjects, row: int) -> list[str]:
    """Labels of an object, most specific first."""
    start, end = objects.label_starts[row : row + 2]
    return [objects.labels[k] for k in objects.label_values[start:end]]


def common_name(label: str) -> str:
    """Words for a label: ``amenity=post_box`` is a post box, ``building=yes`` a building."""
    key, _, value = label.partition("=")
    return (key if value in ("yes", "*", "") else value).replace("_", " ")


def extents(objects: CityObjects) -> Floats:
    """Bounding boxes (N, 4) of the objects: west, south, east, north [m]."""
    starts = objects.point_starts[objects.part_starts[:-1]]
    if not len(starts):
        return np.zeros((0, 4))
    low = np.minimum.reduceat(objects.points, starts)
    high = np.maximum.reduceat(objects.points, starts)
    return np.concatenate([low, high], axis=1).astype(np.float64)


def city_bounds(objects: CityObjects) -> Bounds:
    """Rectangle that holds all but the outermost hundredth of a city: west, south, east, north."""
    west, south = np.percentile(objects.center, 0.5, axis=0).tolist()
    east, north = np.percentile(objects.center, 99.5, axis=0).tolist()
    margin = 30.0 + 0.02 * max(east - west, north - south)
    return west - margin, south - margin, east + margin, north + margin


def rows_within(objects: CityObjects, bounds: Bounds) -> list[int]:
    """Rows of the objects whose bounding boxes touch a rectangle, large ones first."""
    boxes = extents(objects)
    west, south, east, north = bounds
    hit = (
        (boxes[:, 0] <= east)
        & (boxes[:, 2] >= west)
        & (boxes[:, 1] <= north)
        & (boxes[:, 3] >= south)
    )
    spread = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
    rows = np.flatnonzero(hit)
    return [int(row) for row in rows[np.lexsort((rows, -spread[rows]))]]


def map_items(city: CityMap, bounds: Bounds, scale: float) -> list[MapItem]:
    """Objects in a rectangle, cut to it, for a map drawn at `scale` [px/m]; large ones first."""
    objects = city.objects
    found = (item_of(objects, row, bounds) for row in rows_within(objects, bounds))
    items = [item for item in found if item and PAINTS[item.paint].since <= scale]
    water = sea(objects, bounds)
    return [Area(water, "sea"), *items] if water else items


def item_of(
    objects: CityObjects, row: int, bounds: Bounds, paint: str | None = None
) -> MapItem | None:
    """One object, cut to a rectangle; None where nothing of it is to be drawn there."""
    kind = int(objects.kind[row])
    paint = paint_of(labels_of(objects, row), kind) if paint is None else paint
    if not paint:
        return None
    if kind == AREA:
        rings = [clip_ring(ring, bounds) for ring in objects.parts(row) if len(ring) > 2]
        rings = [ring for ring in rings if len(ring) > 3]
        return Area(rings, paint, row) if rings else None
    if kind == LINE:
        parts = [p for part in objects.parts(row) for p in clip_line(part, bounds)]
        return Line(parts, paint, row) if parts else None
    west, south, east, north = bounds
    x, y = objects.center[row].tolist()
    if not (west <= x <= east and south <= y <= north):
        return None
    return Dot(objects.center[row], paint, row)
