import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from tests.indoor.mapping.parts import lattice

from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.map.rooms import assign_rooms, find_rooms
from placegraph_lab.worlds.flat.flat import Flat

HEIGHT = 2.6


def rooms(model, floor=0.0, labels=None):
    mesh = Mesh.plain(model.vertices, model.triangles, model.object_of)
    return find_rooms(mesh, labels or [t.label for t in model.objects], floor)


def two_rooms(gap=0.0, *, over=None, wall="wall"):
    parts = {
        "floor": ((-0.1, -0.1, -0.1), (8.2, 3.1, 0)),
        f"south {wall}": ((-0.1, -0.1, 0), (8.2, 0, HEIGHT)),
        f"north {wall}": ((-0.1, 3, 0), (8.2, 3.1, HEIGHT)),
        f"west {wall}": ((-0.1, 0, 0), (0, 3, HEIGHT)),
        f"east {wall}": ((8.1, 0, 0), (8.2, 3, HEIGHT)),
        f"middle {wall}": ((4, 0, 0), (4.1, 1.5 - gap / 2, HEIGHT)),
        f"inner {wall}": ((4, 1.5 + gap / 2, 0), (4.1, 3, HEIGHT)),
    }
    if over is not None:
        parts[f"upper {wall}"] = ((4, 1.5 - gap / 2, over), (4.1, 1.5 + gap / 2, HEIGHT))
    return parts


@pytest.fixture(scope="module")
def altbau():
    drawing = Flat.load("altbau")
    interior = drawing.furnish(np.random.default_rng(1))
    assert [t.id for t in interior.objects] == list(range(len(interior.objects)))
    return drawing, interior, find_rooms(interior.mesh(), [t.label for t in interior.objects], 0.0)


def test_each_drawn_room_is_found(altbau):
    drawing, _, found = altbau
    assert len(found) == len(drawing.rooms) == 5
    taken = set()
    for room in drawing.rooms:
        under = found.at([drawing.corner(r + 0.5, c + 0.5) for r, c in room.cells])
        own = int(np.bincount(under[under >= 0]).argmax())
        assert (under == own).mean() > 0.97, room.name
        cell = drawing.metres[0] * drawing.metres[1]
        assert found.areas[own] == pytest.approx(len(room.cells) * cell, rel=0.06)
        taken.add(own)
    assert len(taken) == len(found)


def test_each_thing_is_in_its_drawn_room(altbau):
    _, interior, found = altbau
    number = {
        t.room: r
        for t, r in zip(interior.objects, found.room_of, strict=True)
        if t.label == "floor"
    }
    assert len(set(number.values())) == 5
    wrong = [
        thing.name
        for thing, room in zip(interior.objects, found.room_of.tolist(), strict=True)
        if thing.room in number and "door" not in thing.label and room != number[thing.room]
    ]
    assert wrong == []
    assert sum(t.room in number for t in interior.objects) > 100


def test_a_doorway_ends_a_room(boxes):
    for options in ({"gap": 0.9, "over": 2.1}, {"gap": 1.6, "over": 2.1}, {"gap": 0.9}):
        found = rooms(boxes(two_rooms(**options)))
        assert len(found) == 2, options
        assert found.areas == pytest.approx([12, 12], rel=0.06)
        assert found.at([(1, 1), (7, 1), (-3, 1), (1, 1000)]).tolist() in (
            [0, 1, -1, -1], [1, 0, -1, -1],
        )  # fmt: skip
    for options in ({"gap": 2.4}, {"gap": 2.4, "over": 2.1}):  # a wide opening, even below a beam
        assert len(rooms(boxes(two_rooms(**options)))) == 1, options


def test_a_closed_door_is_wall(boxes):
    walls = {
        "floor": ((0, 0, -0.1), (9, 1.3, 0)),
        "south wall": ((0, 0, 0), (9, 0.1, HEIGHT)), "north wall": ((0, 1.2, 0), (9, 1.3, HEIGHT)),
        "west wall": ((0, 0.1, 0), (0.1, 1.2, HEIGHT)), "east wall": ((8.9, 0.1, 0), (9, 1.2, HEIGHT)),
    }  # fmt: skip
    assert len(rooms(boxes(walls))) == 1
    shut = rooms(boxes(walls | {"glass door": ((4, 0.15, 0), (4.05, 1.15, 2.0))}))
    assert len(shut) == 2


def test_furniture_divides_no_room(boxes):
    parts = two_rooms(gap=3.0)
    shelf = {"shelf": ((2, 0, 0), (2.4, 2.1, 2.2))}
    assert len(rooms(boxes(parts | shelf))) == 1
    assert len(rooms(boxes(parts | {"room wall": shelf["shelf"]}))) == 2


def test_walls_without_names_are_walls_if_they_are_tall(boxes):
    for name in ("unknown", "brickwork"):
        assert len(rooms(boxes(two_rooms(gap=0.9, wall=name)))) == 2
    low = two_rooms(gap=0.9, wall="unknown")
    low["middle unknown"] = ((4, 0, 0), (4.1, 1.05, 1.2))
    low["inner unknown"] = ((4, 1.95, 0), (4.1, 3, 1.2))
    assert len(rooms(boxes(low))) == 1, "a low thing without a name is furniture"


def test_a_closet_belongs_to_its_room(boxes):
    parts = two_rooms(gap=3.0) | {
        "closet wall": ((0, 1.4, 0), (1.0, 1.5, HEIGHT)), "front wall": ((1.0, 0.7, 0), (1.1, 1.5, HEIGHT)),
    }  # fmt: skip
    found = rooms(boxes(parts))
    assert len(found) == 1
    assert found.at([(0.5, 0.7)]).tolist() == [0]


def test_what_is_in_which_room(boxes):
    parts = two_rooms(gap=0.9, over=2.1) | {
        "sofa": ((0.2, 0.2, 0), (2, 1, 0.8)), "bed": ((6, 1, 0), (8, 3, 0.5)),
        "lamp": ((6.5, 1.5, 2), (6.8, 1.8, 2.5)), "picture": ((3.95, 0.3, 1.2), (3.99, 0.9, 1.8)),
        "clock": ((4.11, 0.3, 1.2), (4.15, 0.9, 1.8)), "window": ((8.1, 1, 1), (8.2, 2, 2)),
        "car": ((20, 1, 0.2), (24, 3, 1.5)), "roof lamp": ((1, 1, 4), (1.2, 1.2, 4.2)),
    }  # fmt: skip
    model = boxes(parts)
    found = rooms(model)
    room = dict(zip([t.label for t in model.objects], found.room_of.tolist(), strict=True))
    west, east = room["sofa"], room["bed"]
    assert {west, east} == {0, 1}
    assert [room[k] for k in ("picture", "west wall")] == [west] * 2
    assert [room[k] for k in ("clock", "lamp", "window", "east wall")] == [east] * 4
    assert [room[k] for k in ("floor", "car", "roof lamp")] == [-1] * 3
    attributes = found.attributes()
    assert attributes[list(room).index("sofa")] == {"room": str(west + 1)}
    assert attributes[0] == {}


def test_a_scan_with_holes_is_one_room(rng):
    points, faces = lattice(59, 59)
    floor, wall = (
        np.insert(points * size, k, 0.0, axis=1) for k, size in ((2, (5, 4)), (1, (5, 2.4)))
    )
    vertices = np.concatenate([floor, wall, wall + np.array([0, 4, 0])])
    vertices += rng.normal(0, 0.02, vertices.shape)
    triangles = np.concatenate([faces + k * len(points) for k in range(3)])
    object_of = np.repeat([0, 1, 1], len(faces))
    kept = rng.random(len(triangles)) > 1 / 3
    mesh = Mesh.plain(vertices, triangles[kept], object_of[kept])
    found = find_rooms(mesh, ["floor", "unknown"], 0.0)
    assert len(found) == 1
    assert found.areas[0] == pytest.approx(20, rel=0.1)


def test_rooms_turn_with_the_map(boxes):
    model = boxes(two_rooms(gap=0.9, over=2.1))
    for degrees in (10, 45):
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        mesh = Mesh.plain(model.vertices @ turn.T + (3, -7, 5), model.triangles, model.object_of)
        found = find_rooms(mesh, [t.label for t in model.objects], 5.0)
        assert found.areas == pytest.approx([12, 12], rel=0.06), degrees


def test_no_rooms(boxes):
    outside = boxes({"tree": ((0, 0, 0), (1, 1, 5)), "floor": ((0, 0, -0.1), (0.9, 0.9, 0))})
    for model, floor in ((outside, 0.0), (outside, 90.0)):
        found = rooms(model, floor)
        assert len(found) == 0
        assert found.room_of.tolist() == [-1, -1]
        assert found.at([(0.5, 0.5)]).tolist() == [-1]
        assert repr(found) == "Rooms(none)"
    far = boxes(
        {"floor": ((0, 0, -0.1), (9, 9, 0)), "star": ((1e5, 1e5, 0), (1e5 + 1, 1e5 + 1, 1))}
    )
    assert len(rooms(far)) == 0, "the grid would be too coarse for rooms"


def test_rooms_that_the_source_names_are_kept(boxes):
    model = boxes(two_rooms(gap=0.9, over=2.1) | {"sofa": ((0.2, 0.2, 0), (2, 1, 0.8))})
    mesh = Mesh.plain(model.vertices, model.triangles, model.object_of)
    labels = [t.label for t in model.objects]
    blank = [{"colour": "red"}] * len(labels)
    room_of, told = assign_rooms(mesh, labels, 0.0, blank)
    assert told[-1] == {"colour": "red", "room": str(room_of[-1] + 1)}
    assert told[0] == {"colour": "red"}, "the floor is in both"
    named = [*blank[:-2], {"room": "study"}, {"room": "attic", "colour": "blue"}]
    room_of, told = assign_rooms(mesh, labels, 0.0, named)
    assert room_of.tolist() == [-1] * (len(labels) - 2) + [1, 0]
    assert told == named


@given(
    corners=arrays.arrays(float, (6, 2, 3), elements=st.integers(-20, 40).map(lambda n: n / 10)),
    floor=st.integers(-20, 20).map(lambda n: n / 10),
)
def test_any_boxes_have_sane_rooms(corners, floor, boxes):
    names = ("floor", "wall", "door", "unknown", "table", "ceiling")
    model = boxes(dict(zip(names, np.sort(corners, axis=1), strict=True)))
    found = rooms(model, floor)
    assert np.all(np.diff(found.areas) <= 0)
    assert np.all(found.areas >= 1.99)
    assert found.room_of.max() < len(found)
    counted = np.bincount(found.cells[found.cells >= 0], minlength=len(found))
    assert counted * found.cell**2 == pytest.approx(found.areas)


def test_the_house_has_two_rooms_behind_its_folding_doors(house):
    found = rooms(house)
    assert len(found) == 3
    row = {t.name: room for t, room in zip(house.objects, found.room_of.tolist(), strict=True)}
    open_plan, bedroom = row["SofaC_01_001"], row["Bed_01_001"]
    study = row["ChairD_01_003"]
    assert [open_plan, bedroom, study] == [0, 1, 2]
    for name in ("KitchenTable_01_001", "BalconyTable_01_001", "TV_01_001", "Refrigerator_01_001"):
        assert row[name] == open_plan, name
    for name in ("NightStand_01_001", "Wardrobe_01_001", "TV_02_001", "ReadingDesk_01_001"):
        assert row[name] == bedroom, name
    for name in ("PortraitC_01", "PortraitE_01", "PortraitE_02", "PortraitA_01"):
        assert row[name] == study, name
    assert row["HouseWallB_01_001"] == row["RoomWall_01_001"] == -1


def test_an_l_is_one_room():
    drawing = (
        ["#" * 22] + ["#" + " " * 10 + "#" * 11] * 10 + ["#" + " " * 20 + "#"] * 10 + ["#" * 22]
    )
    text = "[flat]\nmetres = 0.25\n[drawing]\n" + "\n".join(drawing) + "\n[legend]\n1 room:\n"
    interior = Flat.parse(text).furnish(np.random.default_rng(1))
    found = find_rooms(interior.mesh(), [t.label for t in interior.objects], 0.0)
    assert found.areas == pytest.approx([18.75], rel=0.06)
