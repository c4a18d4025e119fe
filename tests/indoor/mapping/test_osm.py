import numpy as np
import pytest

import placegraph as pg
from placegraph.errors import GeoPoseError, InputError, OptionError
from placegraph.indoor.mapping.osm import parse_length
from placegraph.io.osm.indoor_osm import IndoorShape, encode_rooms, read_indoor_osm

EAST, NORTH = 1.0 / 66_400.0, 1.0 / 111_300.0
"""Degrees of a metre at 53.5 degrees, roughly."""


def box(west, south, east, north):
    return [(west, south), (east, south), (east, north), (west, north), (west, south)]


def shape(kind, points, **tags):
    lonlat = np.array(points, float) * (EAST, NORTH) + (9.99, 53.5)
    said = {k.replace("__", ":"): v for k, v in tags.items()}
    return IndoorShape("way/1", kind, (), said, [lonlat])


HALL = [
    shape("room", box(0, 0, 6, 5), level="0;1", name="Library"),
    shape("room", box(6, 0, 10, 5), level="0", room="kitchen", height="3.2"),
    shape("corridor", box(0, 5, 10, 7), level="0-1"),
    shape("room", box(0, 7, 4, 12), level="0", room="office"),
    shape("room", box(4, 7, 10, 12), level="0", room="office"),
    shape("door", [(2.5, 5), (3.5, 5)], level="0", width="1"),
    shape("door", [(7.5, 5), (8.5, 5)], level="0", width="1.2"),
]


@pytest.fixture
def hall(tmp_path):
    (tmp_path / "hall.osm").write_bytes(encode_rooms(HALL, osmag=False, generator="test"))
    return tmp_path / "hall.osm"


def test_a_level_becomes_a_map(hall, tmp_path):
    scene = pg.build_scene(hall, tmp_path / "hall.scene", reader={"level": "0"})
    rooms = {a["room"] for a in scene.attributes if "room" in a}
    assert rooms == {"Library", "kitchen", "corridor", "office 1", "office 2"}
    counts = [scene.graph.labels.count(word) for word in ("floor", "ceiling", "door")]
    assert counts == [5, 5, 2]
    assert scene.floors[0] == 0.0
    tall = scene.graph.positions[:, 2][[a.get("room") == "kitchen" for a in scene.attributes]]
    assert sorted(tall.round(2).tolist()) == [0.0, 3.2]
    (anchor,) = pg.open_map(tmp_path / "hall.scene").anchors
    assert (anchor.level, anchor.heading) == ("0", 0.0)
    assert anchor.has_covariance
    east, north = (np.array((anchor.longitude, anchor.latitude)) - (9.99, 53.5)) / (EAST, NORTH)
    assert (east, north) == pytest.approx((5.0, 6.0), abs=0.05)


def test_walls_are_shared_and_open_where_doors_are(hall):
    scene = pg.build_scene(hall, None, reader={"level": 0.0})
    middle = scene.bounds.mean(axis=0)[:2]
    south = np.array([middle[0] - 5.0, middle[1] - 6.0])

    def cast_distance(at, towards):
        start = np.array([[*(south + at), 1.0]], np.float32)
        way = np.array([[*towards, 0.0]], np.float32)
        return float(scene.caster.cast(start, way).distance[0])

    assert cast_distance((3, 2), (0, 1)) == pytest.approx(
        5.0, abs=0.1
    )  # through the door, to the far wall
    assert cast_distance((1, 2), (0, 1)) == pytest.approx(
        2.95, abs=0.02
    )  # a wall of 0.1 m in the middle
    assert cast_distance((3, 2), (1, 0)) == pytest.approx(2.95, abs=0.02)
    assert cast_distance((3, 2), (-1, 0)) == pytest.approx(
        3.0, abs=0.02
    )  # beyond an outline of one room


def test_levels_are_chosen(hall):
    with pytest.raises(OptionError, match=r"levels 0, 1; choose one"):
        pg.build_scene(hall, None)
    with pytest.raises(OptionError, match="no rooms on level 7"):
        pg.build_scene(hall, None, reader={"level": "7"})
    with pytest.raises(OptionError, match=r"give a number such as 1, -1 or 0\.5\."):
        pg.build_scene(hall, None, reader={"level": "0-1"})
    upstairs = pg.build_scene(hall, None, reader={"level": "1"})
    assert {a["room"] for a in upstairs.attributes if "room" in a} == {"Library", "corridor"}


def test_without_levels_and_from_afar(tmp_path):
    path, notes = tmp_path / "a.osm", []
    path.write_bytes(encode_rooms([shape("room", box(0, 0, 4, 3))], osmag=False, generator="test"))
    scene = pg.build_scene(path, None, notes=notes)
    assert scene.anchors[0].level == "0"
    assert any("no level" in note for note in notes)
    far = [shape("room", box(0, 0, 4, 3)), shape("room", box(9000, 0, 9004, 3))]
    path.write_bytes(encode_rooms(far, osmag=False, generator="test"))
    with pytest.raises(InputError, match="extract one building"):
        pg.build_scene(path, None)


@pytest.mark.parametrize("ending", ["osm", "osmag.xml"])
def test_rooms_come_back_to_the_centimetre(hall, tmp_path, ending):
    scene = pg.build_scene(hall, None, reader={"level": "0"})
    scene.export(tmp_path / f"again.{ending}")
    name = tmp_path / "again.osm"
    (tmp_path / f"again.{ending}").rename(name)
    plan = read_indoor_osm(name)
    assert plan.levels == (0.0,)
    found = [s for s in plan.shapes if s.kind in ("room", "corridor")]
    for one, other in zip([s for s in HALL if s.kind != "door"], found, strict=True):
        corners = one.parts[0][:-1] / (EAST, NORTH)
        there = other.parts[0] / (EAST, NORTH)
        off = np.linalg.norm(corners[:, None] - there[None], axis=2).min(axis=1)
        assert off.max() < 0.015
        assert other.kind == one.kind
    names = [s.tags.get("name", "") for s in found]
    kinds = ["kitchen", "corridor", "office 1", "office 2"] if "osmag" in ending else [""] * 4
    assert names == ["Library", *kinds]
    assert sum(s.kind == "door" for s in plan.shapes) == 2
    again = pg.build_scene(name, None)
    np.testing.assert_allclose(again.bounds, scene.bounds, atol=0.03)


def test_rooms_of_a_furnished_map(demo_world, tmp_path):
    flat = pg.open_map(demo_world / "altbau.scene")
    with pytest.raises(OptionError, match="scene anchor"):
        flat.export(tmp_path / "rooms.osm")
    with pytest.raises(GeoPoseError, match="scene anchor"):
        flat.to_geojson()
    placed = flat.anchored(pg.Anchor(9.99, 53.55, 30.0, 0.3, level="2"))
    placed.export(tmp_path / "rooms.osm")
    plan = read_indoor_osm(tmp_path / "rooms.osm")
    named = {s.tags["name"] for s in plan.shapes if s.kind == "room"}
    assert named == {"kitchen", "hall", "bathroom", "bedroom", "living room"}
    objects = placed.to_geojson()["features"]
    assert [f["properties"]["id"] for f in objects] == list(flat.graph.ids)
    longitude, latitude = np.mean(objects[0]["geometry"]["coordinates"][0][:4], axis=0)
    assert abs(longitude - 9.99) < 3e-4
    assert abs(latitude - 53.55) < 3e-4


def test_lengths():
    said = ["2.8", "2.8 m", "90 cm", "0,9", "3 ft", "", "-1", "high", "0"]
    lengths = [parse_length(text) for text in said]
    assert lengths == [2.8, 2.8, 0.9, 0.9, None, None, None, None, None]
