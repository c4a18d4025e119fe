import json
import re
import sys

import numpy as np
import pytest

from placegraph.core.geojson import polygon_geometry
from placegraph.errors import MissingExtraError, OptionError
from placegraph.outdoor.city import build_city
from placegraph.outdoor.map.city import find_oddities

BENCH, TREE = {"amenity": "bench", "name": "B"}, {"natural": "tree", "name": "T"}


def found(city):
    """Findings, each a sentence or two of which the last says what to do."""
    lines = find_oddities(city)
    assert all((line.endswith(".") and line[0].isupper()) or line[0].isdigit() for line in lines)
    return " ".join(lines)


def test_sound_maps(real_city):
    assert find_oddities(real_city) == []


def mixed(n=20):
    kinds = ("bench", "cafe", "bar", "fountain", "pharmacy")
    return [(5.0 * i, 0.0, {"amenity": kinds[i % 5], "name": f"N{i}"}) for i in range(n)]


def test_a_mixed_world_is_sound(build_world):
    assert find_oddities(build_world(mixed())) == []


@pytest.mark.parametrize(
    ("things", "finding"),
    [
        ([*mixed(), (70_000, 0, BENCH)], r"spans 70 km.*map projection. Split the extract"),
        ([(0, 0, BENCH), (900, 900, TREE)], "No cell contains two objects"),
        ([(e, n, {"amenity": t["amenity"]}) for e, n, t in mixed(100)], "have a name"),
        ([(5 * i, 0, BENCH) for i in range(20)], "100% of the objects are amenity=bench"),
    ],
    ids=["too wide", "no cells", "no names", "all alike"],
)
def test_oddities(things, finding, build_world):
    assert re.search(finding, found(build_world(things)))


def test_twice(tmp_path):
    tag = '<tag k="amenity" v="bench"/><tag k="name" v="B"/>'
    nodes = "".join(
        f'<node id="{i}" version="1" lon="10" lat="50.000{i}">{tag}</node>' for i in (1, 1, 2, 2)
    )
    path = tmp_path / "overlapping.osm"
    path.write_text(f'<osm version="0.6">{nodes}</osm>')
    assert "2 objects occur twice" in found(build_city(path, tmp_path / "a.city"))


def test_clipped(write_world, tmp_path):
    ways = [([0, 1, 500 + i], {"highway": "path"}) for i in range(10)]
    path = write_world(mixed(), ways)
    finding = r"10 elements of the extract lack members, because.*Clip it with complete ways"
    assert re.search(finding, found(build_city(path, tmp_path / "a.city")))


def test_objects_are_where_the_map_has_them(harbour):
    found = json.loads(json.dumps(harbour.to_geojson()))
    objects = harbour.objects
    assert len(found["features"]) == len(objects)
    kinds = {"Point": 0, "LineString": 1, "MultiLineString": 1, "Polygon": 2, "MultiPolygon": 2}
    for row, one in enumerate(found["features"]):
        assert one["properties"]["osm"] == objects.osm(row)
        assert kinds[one["geometry"]["type"]] == objects.kind[row]
        if one["geometry"]["type"] == "Point":
            at = harbour.plane.to_plane(one["geometry"]["coordinates"])
            np.testing.assert_allclose(at, objects.center[row], atol=0.02)
        key, _, value = one["properties"]["label"].partition("=")
        assert one["properties"]["tags"][key] == value


def test_cells(harbour):
    cells = harbour.to_geojson("cells")["features"]
    assert [c["properties"]["cell"] for c in cells] == list(harbour.cells)
    with pytest.raises(OptionError, match="cells"):
        harbour.to_geojson("roads")


def test_rings_are_told_apart_by_nesting():
    corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1), (0, 0)])
    rings = [k + (9.0 - 2.0 * k) * corners for k in (2.0, 0.0, 1.0)]
    shape = polygon_geometry(rings)
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
    monkeypatch.setitem(sys.modules, "geopandas", None)
    with pytest.raises(MissingExtraError, match=r"placegraph\[geopandas\]"):
        harbour.to_geopandas()
