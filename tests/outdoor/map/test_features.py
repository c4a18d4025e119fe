"""A city as GeoJSON, and as a table of GeoPandas."""

import json

import pytest

import placegraph as pg
from placegraph.core.geojson import areas
from placegraph.errors import OptionError


def ring(low, high):
    return [(low, low), (high, low), (high, high), (low, high), (low, low)]


def test_objects_are_where_the_map_has_them(harbour):
    found = json.loads(json.dumps(harbour.to_geojson()))
    objects = harbour.objects
    assert len(found["features"]) == len(objects)
    kinds = {"Point": 0, "LineString": 1, "MultiLineString": 1, "Polygon": 2, "MultiPolygon": 2}
    for row, one in enumerate(found["features"]):
        assert one["properties"]["osm"] == objects.osm(row)
        assert kinds[one["geometry"]["type"]] == objects.kind[row]
        if one["geometry"]["type"] == "Point":
            east, north = harbour.plane.to_plane(one["geometry"]["coordinates"])
            assert abs(east - objects.center[row, 0]) < 0.02
            assert abs(north - objects.center[row, 1]) < 0.02
        key, _, value = one["properties"]["label"].partition("=")
        assert one["properties"]["tags"][key] == value


def test_cells(harbour):
    cells = harbour.to_geojson("cells")["features"]
    assert [c["properties"]["cell"] for c in cells] == list(harbour.cells)
    with pytest.raises(OptionError, match="cells"):
        harbour.to_geojson("roads")


def test_rings_are_told_apart_by_nesting():
    """An island in a lake on an island: two areas, one with a hole, wound as RFC 7946 says."""
    import numpy as np

    rings = [np.array(ring(k, 9.0 - k)) for k in (2.0, 0.0, 1.0)]
    shape = areas(rings)
    assert shape["type"] == "MultiPolygon"
    assert sorted(len(polygon) for polygon in shape["coordinates"]) == [1, 2]
    outer, hole = max(shape["coordinates"], key=len)
    assert outer[0] == [0.0, 0.0]
    assert hole[0] == [1.0, 1.0]
    assert (outer[1], hole[1]) == ([9.0, 0.0], [1.0, 8.0])  # counter-clockwise, and clockwise


def test_a_table(harbour):
    pytest.importorskip("geopandas", reason="the extra `geopandas` is not installed")
    table = harbour.to_geopandas()
    assert table.crs.to_epsg() == 4326
    assert len(table) == len(harbour.objects)
    assert table.geometry.is_valid.all()


def test_without_geopandas(harbour, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "geopandas", None)
    with pytest.raises(pg.errors.MissingExtraError, match=r"placegraph\[geopandas\]"):
        harbour.to_geopandas()
