"""Rooms in OpenStreetMap files: read whatever the order and the ids, written so that they come back."""

from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from placegraph.errors import InputError
from placegraph.io.osm.indoor_osm import (
    IndoorShape,
    encode_rooms,
    format_level,
    parse_levels,
    read_indoor_osm,
    room_names,
)

NODES = """<node id='-1' lat='50.0' lon='10.0'/><node id='-2' lat='50.0' lon='10.0001'/>
<node id='-3' lat='50.0001' lon='10.0001'/><node id='-4' lat='50.0001' lon='10.0'/>
<node id='-5' lat='50.00002' lon='10.00002'/><node id='-6' lat='50.00002' lon='10.00004'/>
<node id='-7' lat='50.00004' lon='10.00004'/>"""
ROOM = (
    "<way id='-10'><nd ref='-1'/><nd ref='-2'/><nd ref='-3'/><nd ref='-4'/><nd ref='-1'/>{}</way>"
)


def tags(**said):
    return "".join(f"<tag k='{k.replace('__', ':')}' v='{v}'/>" for k, v in said.items())


def read(tmp_path, content):
    (tmp_path / "rooms.osm").write_text(f"<osm version='0.6'>{content}</osm>")
    return read_indoor_osm(tmp_path / "rooms.osm")


@pytest.mark.parametrize("turned", [False, True])
def test_order_and_signs_of_ids_do_not_matter(tmp_path, turned):
    room = ROOM.format(tags(indoor="room", level="0-1", repeat_on="3", name="Library"))
    (shape,) = read(tmp_path, room + NODES if turned else NODES + room).shapes
    assert (shape.osm, shape.kind, shape.levels) == ("way/-10", "room", (0, 1, 3))
    np.testing.assert_allclose(shape.parts[0][1], (10.0001, 50.0), atol=1e-9)


def test_osmag(tmp_path):
    areas = ROOM.format(tags(osmAG__type="area", osmAG__areaType="corridor", name="a", level="2"))
    passage = "<way id='-11'><nd ref='-1'/><nd ref='-2'/>{}</way>"
    plan = read(tmp_path, NODES + areas + passage.format(tags(osmAG__type="passage", level="2")))
    assert [(s.kind, s.levels) for s in plan.shapes] == [("corridor", (2,)), ("door", (2,))]
    assert plan.levels == (2,)


@pytest.mark.parametrize(
    ("way", "told"),
    [
        (ROOM.replace("<nd ref='-1'/>{}", "{}"), "outlines that were open, and are closed"),
        (ROOM.replace("<nd ref='-1'/>{}", "<nd ref='-99'/><nd ref='-1'/>{}"), "outlines with missing nodes"),
    ],
)  # fmt: skip
def test_what_is_mended_is_told(tmp_path, way, told):
    plan = read(tmp_path, NODES + way.format(tags(indoor="room")))
    assert plan.left_out == {told: 1}
    assert len(plan.shapes[0].parts[0]) == 5


def test_a_multipolygon_of_pieces_with_a_hole(tmp_path):
    pieces = "<way id='1'><nd ref='-1'/><nd ref='-2'/><nd ref='-3'/></way>"
    pieces += "<way id='2'><nd ref='-1'/><nd ref='-4'/><nd ref='-3'/></way>"
    pieces += "<way id='3'><nd ref='-5'/><nd ref='-6'/><nd ref='-7'/><nd ref='-5'/></way>"
    members = "".join(f"<member type='way' ref='{k}' role=''/>" for k in (1, 2, 3))
    said = tags(type="multipolygon", indoor="area", level="0")
    plan = read(tmp_path, NODES + pieces + f"<relation id='7'>{members}{said}</relation>")
    assert sorted(len(part) for part in plan.shapes[0].parts) == [4, 5]


@pytest.mark.parametrize(
    "content",
    [
        "", NODES, NODES + ROOM.format(tags(building="yes")),
        "<way id='1'><nd ref='5'/><tag k='indoor' v='room'/></way>",
        NODES + "<way id='1'><nd ref='-1'/><nd ref='-2'/><tag k='indoor' v='room'/></way>",
        "<node id='1' lat='1e9' lon='10'/><way id='1'><nd ref='1'/><tag k='indoor' v='room'/></way>",
        "<way", '<!DOCTYPE a [<!ENTITY b "bb"><!ENTITY c "&b;&b;">]><way id="1">&c;</way>',
    ],
)  # fmt: skip
def test_files_without_rooms_are_one_error(tmp_path, content):
    with pytest.raises(InputError, match=r"rooms\.osm"):
        read(tmp_path, content)


@settings(max_examples=60, deadline=None)
@given(st.binary(max_size=200), st.integers(0, 600))
def test_any_bytes_are_rooms_or_one_error(tmp_path_factory, noise, at):
    path = tmp_path_factory.getbasetemp() / "noise.osm"
    whole = f"<osm version='0.6'>{NODES}{ROOM.format(tags(indoor='room'))}</osm>".encode()
    path.write_bytes(whole[:at] + noise + whole[at + len(noise) :])
    with suppress(InputError):
        assert read_indoor_osm(path).shapes


SIDE = st.floats(1.0, 30.0)
METRE = 1.0 / 111_200.0


@settings(max_examples=40, deadline=None)
@given(
    sides=st.lists(st.tuples(SIDE, SIDE), min_size=1, max_size=4),
    names=st.lists(st.text("aäß <&\"'é猫", max_size=6), min_size=4, max_size=4),
    level=st.sampled_from(["0", "-1", "0.5", "12"]),
    osmag=st.booleans(),
)
def test_rooms_come_back_to_the_centimetre(tmp_path_factory, sides, names, level, osmag):
    shapes, west = [], 0.0
    for (wide, deep), name in zip(sides, names, strict=False):
        corners = np.array(
            [(west, 0), (west + wide, 0), (west + wide, deep), (west, deep), (west, 0)]
        )
        said = {"level": level, "name": name.strip()}
        shapes.append(IndoorShape("way/1", "room", (), said, [corners * METRE + (9.0, 3.0)]))
        west += wide
    path = tmp_path_factory.getbasetemp() / ("written.osmag" if osmag else "written.osm")
    path.write_bytes(encode_rooms(shapes, osmag=osmag, generator="test"))
    rooms = read_indoor_osm(path).shapes
    assert {s.levels for s in rooms} == {(float(level),)}
    wanted = room_names(shapes) if osmag else [s.tags["name"] for s in shapes]
    assert [s.tags.get("name", "") for s in rooms] == wanted
    for one, other in zip(shapes, rooms, strict=True):
        assert np.abs(one.parts[0] - other.parts[0]).max() < 0.01 * METRE


def test_doors_are_nodes_of_outlines_or_passages(tmp_path):
    square = np.array([(0, 0), (4, 0), (4, 4), (0, 4), (0, 0)], float)
    rooms = [
        IndoorShape("", "room", (), {"name": name, "level": "0"}, [(square + at) * METRE])
        for name, at in (("a", (0, 0)), ("b", (4, 0)))
    ]
    door = IndoorShape("", "door", (), {"level": "0"}, [np.array([(4.1, 1.0), (4.1, 2.0)]) * METRE])
    (tmp_path / "a.osm").write_bytes(encode_rooms([*rooms, door], osmag=False, generator="test"))
    plan = read_indoor_osm(tmp_path / "a.osm")
    (node,) = [s for s in plan.shapes if s.kind == "door"]
    on = [
        any((part == node.parts[0][0]).all(axis=1).any() for part in s.parts) for s in plan.shapes
    ]
    assert on == [True, True, True]  # both rooms' outlines go through it
    text = encode_rooms([*rooms, door], osmag=True, generator="test").decode()
    assert '<tag k="osmAG:from" v="a"/><tag k="osmAG:to" v="b"/>' in text


@pytest.mark.parametrize(
    ("text", "levels"),
    [
        ("0", (0,)), ("0;1", (0, 1)), ("1; 0 ;1", (0, 1)), ("0-2", (0, 1, 2)), ("-1", (-1,)),
        ("-2--1", (-2, -1)), ("-1-1", (-1, 0, 1)), ("2-0", (0, 1, 2)), ("0.5", (0.5,)),
        ("0.5-2", (0.5, 1, 2)), ("0,3", (0, 3)), ("", ()), ("ground", ()), ("x;2", (2,)),
        ("0-99999", ()), ("0-9999", ()), ("1e9", ()), ("\u0663", ()),
    ],
)  # fmt: skip
def test_levels(text, levels):
    assert parse_levels(text) == levels


def test_a_level_as_text():
    assert [format_level(v) for v in (0.0, -1.0, 0.5)] == ["0", "-1", "0.5"]
