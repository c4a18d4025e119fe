"""A city's objects and cells as GeoJSON."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal

from placegraph.core.geojson import areas, collection, feature, lines, point
from placegraph.errors import OptionError
from placegraph.outdoor.map.city import City
from placegraph.outdoor.map.objects import AREA, LINE


def features(city: City, what: Literal["objects", "cells"]) -> dict[str, Any]:
    """FeatureCollection of a city: `CityMap.to_geojson` says more."""
    if what not in ("objects", "cells"):
        raise OptionError(f"what is {what!r}; it is 'objects' or 'cells'.")
    return collection(_objects(city) if what == "objects" else _cells(city))


def _objects(city: City) -> Iterator[dict[str, Any]]:
    objects = city.objects
    for row in range(len(objects)):
        start, end = objects.label_starts[row : row + 2]
        tags = [objects.labels[k].partition("=") for k in objects.label_values[start:end]]
        said = {
            "osm": objects.osm(row),
            "label": objects.label(row),
            "name": objects.name(row),
            "tags": {key: value for key, _, value in reversed(tags)},
        }
        parts = [city.plane.to_lonlat(part) for part in objects.parts(row)]
        kind = objects.kind[row]
        if kind == AREA:
            parts = [part for part in parts if len(part) > 3] or parts
        shape = point(parts[0][0])
        if kind == AREA and len(parts[0]) > 3:
            shape = areas(parts)
        elif kind in (LINE, AREA) and len(parts[0]) > 1:
            shape = lines(parts)
        yield feature(shape, said)


def _cells(city: City) -> Iterator[dict[str, Any]]:
    for cell in city.cells:
        west, south, east, north = city.cells.bounds(cell)
        corners = [(west, south), (east, south), (east, north), (west, north), (west, south)]
        yield feature(areas([city.plane.to_lonlat(corners)]), {"cell": cell})
