import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.map.relations import (
    CANONICAL,
    find_relations,
    interpret_relation,
    matches_label,
    normalize_relation,
    overlaps_box,
)
from placegraph.indoor.map.rooms import find_rooms

RELATIONS = ("standing on", "inside", "attached to", "above", "next to", "same room")
FLOOR = {"floor": ((0, 0, -0.1), (8, 6, 0))}


HALL = {"hall": ((-20, -20, -3), (20, 20, -2.9))}


def mesh_of(model, rows=None):
    owner = model.object_of if rows is None else np.asarray(rows)[model.object_of]
    return Mesh.plain(model.vertices, model.triangles, owner)


def name_relations(model, rows=None, rooms=None):
    labels = [t.label for t in model.objects]
    if rows is not None:
        labels = [labels[rows.index(i)] for i in range(max(rows) + 1)]
    return {
        f"{labels[a]} {r} {labels[b]}"
        for a, r, b in find_relations(mesh_of(model, rows), labels, rooms)
    }


SEAT = {"sofa": ((1, 1, 0), (3, 2, 0.4)), "back": ((1, 1.8, 0.4), (3, 2, 1.0))}
WALL = {"wall": ((0, 0, 0), (0.1, 6, 2.6)), "other": ((0, 5.9, 0), (8, 6, 2.6))}
NEAR = {"lamp next to fridge", "fridge next to lamp"}


@pytest.mark.parametrize(
    ("parts", "rows", "expected"),
    [
        (FLOOR, None, set()),
        (FLOOR | {
            "table": ((1, 1, 0), (2, 2, 0.7)), "cup": ((1.2, 1.2, 0.7), (1.3, 1.3, 0.8)),
            "rug": ((0.5, 0.5, 0), (3, 3, 0.01)),
        }, None, {"table standing on rug", "cup standing on table", "rug standing on floor"}),
        # feet may float or sink a little
        (FLOOR | {"sofa": ((1, 1, 0.08), (2, 2, 1.0))}, None, {"sofa standing on floor"}),
        (FLOOR | {"sofa": ((1, 1, -0.04), (2, 2, 1.0))}, None, {"sofa standing on floor"}),
        (FLOOR | {"sofa": ((1, 1, 0.2), (2, 2, 1.0))}, None, set()),
        # both begin at the floor: neither carries the other
        (FLOOR | {"table": ((1, 1, 0), (3, 2, 0.75)), "chair": ((2.6, 1.2, 0), (3.3, 1.8, 0.9))}, None,
         {"table standing on floor", "chair standing on floor", "chair next to table",
          "table next to chair"}),
        # level triangles find the seat within the box of an L-shaped sofa
        (SEAT | {"cushion": ((1.5, 1.2, 0.4), (1.9, 1.5, 0.6))}, [0, 0, 1], {"cushion standing on sofa"}),
        # a closed box has no shelf: nothing carries the jar
        (HALL | {
            "cupboard": ((1, 1, 0), (2, 2, 2)), "jar": ((1.3, 1.3, 1.0), (1.5, 1.5, 1.2)),
            "sign": ((1.2, 1.2, 0.5), (1.4, 1.4, 0.5)),
        }, None, {"jar inside cupboard", "sign inside cupboard"}),
        # nothing is inside walls; a handle within the box of a door is no jar in a cupboard
        ({"wall": ((0, 0, 0), (5, 5, 3)), "jar": ((1.3, 1.3, 1.0), (1.5, 1.5, 1.2))}, None, set()),
        (HALL | {
            "front door": ((1, 1, 0), (2, 1.12, 2)), "handle": ((1.1, 1.03, 1), (1.2, 1.09, 1.1)),
            "panel": ((1, 1.06, 0), (2, 1.07, 2)),
        }, [0, 1, 2, 1], {"handle attached to front door"}),
        # one wall in an L: its box holds the room, its triangles do not
        (WALL | {"picture": ((0.12, 2, 1), (0.14, 3, 2))}, [0, 0, 1], {"picture attached to wall"}),
        (WALL | {"picture": ((3.0, 2, 1), (3.02, 3, 2))}, [0, 0, 1], set()),
        (HALL | {"desk": ((1, 1, 0), (3, 2, 0.7)), "shelf": ((1.5, 1, 1.2), (2.5, 1.3, 3.1))}, None,
         {"shelf above desk"}),
        (HALL | {"desk": ((1, 1, 0), (3, 2, 0.7)), "shelf": ((1.5, 1, 3.0), (2.5, 1.3, 3.1))}, None,
         set()),
        # next to ends half a metre away, and where two are hardly beside each other
        (HALL | {"fridge": ((0, 0, 0), (2, 2, 0.5)), "lamp": ((2.4, 0, 0), (3, 2, 0.7))}, None, NEAR),
        (HALL | {"fridge": ((0, 0, 0), (2, 2, 0.5)), "lamp": ((2.6, 0, 0), (3, 2, 0.7))}, None, set()),
        (HALL | {"fridge": ((0, 0, 0), (1, 1, 1.9)), "lamp": ((1.1, 0, 1.8), (2, 1, 2.7))}, None, set()),
        (HALL | {"fridge": ((0, 0, 0), (1, 1, 1.9)), "lamp": ((1.1, 0, 1.4), (2, 1, 2.3))}, None, NEAR),
        # the box of a scanned floor reaches as high as things' feet are sunk
        ({"floor": ((0, 0, -0.04), (8, 6, 0)), "bump": ((7, 5, 0), (7.2, 5.2, 0.12)),
          "sofa": ((1, 1, -0.02), (2, 2, 0.8))}, [0, 0, 1], {"sofa standing on floor"}),
    ],
)  # fmt: skip
def test_relations_of_boxes(parts, rows, expected, boxes):
    assert name_relations(boxes(parts), rows) == expected


def test_a_lamp_hangs_above_what_lies_under_its_middle(boxes):
    model = boxes({
        "sofa": ((0, 0, 0), (3, 1, 0.8)), "seat": ((0, 0, 0), (0.8, 3, 0.8)),
        "table": ((1.4, 1.4, 0), (2.6, 2.6, 0.4)), "cup": ((1.5, 1.5, 0.4), (1.6, 1.6, 0.5)),
        "lamp": ((1.5, 1.5, 1.8), (2.1, 2.1, 2.2)), "rug": ((0, 0, -0.01), (3, 3, 0)),
    })  # fmt: skip
    found = [line for line in name_relations(model, [0, 0, 1, 1, 2, 3]) if " above " in line]
    assert found == ["lamp above table"]


def test_what_is_built_in_stands_on_nothing(boxes):
    model = boxes(FLOOR | {
        "north wall": ((0, 5.9, 0), (8, 6, 2.6)), "window sill wall": ((8, 0, 0), (8.2, 6, 0.9)),
        "window": ((8.05, 2, 0.9), (8.15, 3, 2)), "door": ((1, 5.85, 0), (2, 5.95, 2)),
        "curtain": ((3, 5.8, 0), (4, 5.82, 2.4)), "glass door": ((4, 3, 0), (5, 3.05, 2)),
        "ceiling": ((0, 0, 2.6), (8, 6, 2.7)), "lamp": ((4, 1, 2.0), (4.3, 1.3, 2.6)),
        "sofa": ((7, 2, 0), (7.9, 3, 0.8)),
    })  # fmt: skip
    found = {line for line in name_relations(model) if " next to " not in line}
    assert found == {
        "north wall standing on floor", "window sill wall standing on floor",
        "window attached to window sill wall", "door attached to north wall",
        "curtain attached to north wall", "glass door standing on floor",
        "lamp attached to ceiling", "sofa standing on floor",
    }  # fmt: skip
    assert {"sofa next to window", "window next to sofa"} <= name_relations(model), (
        "it begins above the seat"
    )


@pytest.mark.parametrize("rooms", [[0, 0, 0, -1], [0, 1, 0, -1], [0, -1, 0, -1]])
def test_nothing_is_next_to_what_is_in_another_room(boxes, rooms):
    model = boxes({"bed": ((0, 0, 0), (2, 2, 0.5)), "desk": ((2.3, 0, 0), (3, 2, 0.7)),
                   "door": ((2.1, 2.1, 0), (2.2, 3, 2))} | HALL)  # fmt: skip
    found = {line for line in name_relations(model, rooms=np.array(rooms)) if " next to " in line}
    ends = [("bed", "door"), ("desk", "door"), *([("bed", "desk")] if rooms[1] < 1 else [])]
    assert found == {f"{a} next to {b}" for x, y in ends for a, b in ((x, y), (y, x))}


def test_same_room_connects_all_of_a_room_by_few_edges(boxes, rng):
    low = rng.uniform(0, 30, (60, 3))
    names = {f"thing{chr(65 + i)}": (a, a + 0.3) for i, a in enumerate(low)}
    model = boxes(names | {"floor": ((0, 0, -1), (30, 30, 0))})
    mesh = mesh_of(model)
    rooms = np.append(rng.integers(-1, 4, 60), 0)
    found = find_relations(mesh, [t.label for t in model.objects], rooms)
    assert found == sorted(found)
    edges = [(a, b) for a, r, b in found if r == "same room"]
    assert {(b, a) for a, b in edges} == set(edges)
    assert len(set(edges)) == len(edges) == 2 * sum((rooms[:60] == k).sum() - 1 for k in range(4))
    group = np.arange(61)
    for _ in range(60):
        for a, b in edges:
            group[a] = group[b] = min(group[a], group[b])
    for k in range(4):
        assert len(set(group[:60][rooms[:60] == k])) == 1
    assert all(rooms[a] == rooms[b] >= 0 for a, b in edges)
    assert not any(60 in edge for edge in edges), "the floor is no thing in a room"


@given(
    low=arrays.arrays(float, (7, 3), elements=st.integers(0, 30).map(lambda n: n / 10)),
    size=arrays.arrays(float, (7, 3), elements=st.integers(0, 20).map(lambda n: n / 10)),
)
def test_relations_of_any_boxes_are_sane(low, size, boxes):
    model = boxes(
        {f"thing{chr(97 + i)}": (a, a + b) for i, (a, b) in enumerate(zip(low, size, strict=True))}
    )
    mesh = mesh_of(model)
    found = find_relations(mesh, [t.label for t in model.objects])
    assert found == sorted(found)
    pairs = [(a, b) for a, _, b in found]
    assert len(set(pairs)) == len(pairs), "one relation a pair"
    by_kind = {kind: {(a, b) for a, r, b in found if r == kind} for kind in RELATIONS}
    assert sum(map(len, by_kind.values())) == len(found)
    assert not by_kind["same room"], "no rooms were given"
    for a, b in pairs:
        assert a != b
    for kind in ("standing on", "inside", "above"):
        assert not {(b, a) for a, b in by_kind[kind]} & by_kind[kind]
    assert {(b, a) for a, b in by_kind["next to"]} == by_kind["next to"]
    for kind in ("standing on", "inside", "attached to"):
        sources = [a for a, _ in by_kind[kind]]
        assert len(set(sources)) == len(sources), f"{kind} one thing"


def test_a_diagonal_triangle_passes_a_corner():
    corners = np.array([[[3, 0, 0], [0, 3, 0], [0, 3, 3]]], np.float32)
    assert overlaps_box(corners, np.zeros(3), np.full(3, 1.4)).tolist() == [False]
    assert overlaps_box(corners, np.zeros(3), np.full(3, 1.6)).tolist() == [True]


def test_the_house_as_one_would_say_it(house):
    mesh = mesh_of(house)
    labels, names = [t.label for t in house.objects], [t.name for t in house.objects]
    edges = find_relations(mesh, labels, find_rooms(mesh, labels, 0.0).room_of)
    found = {f"{names[a]} {r} {names[b]}" for a, r, b in edges}
    for line in (
        "Sofa standing on Carpet", "CoffeeTable standing on Carpet", "Tablet standing on CoffeeTable",
        "Tableware standing on KitchenTable", "Bed next to NightStand", "NightStand next to Bed",
        "Rangehood above CookingBench", "CookingBench standing on KitchenCabinet",
        "Chandelier_01_004 above CoffeeTable", "Door attached to HouseWall", "Handle attached to Door",
        "RoomWindow attached to HouseWall", "TV_02 attached to RoomWall", "Chair next to KitchenTable",
        "Sofa next to CoffeeTable", "ReadingDesk next to RoomWindow", "Vase standing on Board",
    ):  # fmt: skip
        first, relation = line.split(" ", 1)
        assert any(e.startswith(first) and f" {relation}" in e for e in found), line
    for first, wrong in (
        ("RoomWindow", "standing on"), ("Ceiling", "standing on"), ("Handle", "inside"),
        ("Chandelier", "above Sofa"), ("Chandelier", "next to Refrigerator"),
        ("PortraitE_02", "next to TV_02"), ("DeskPortrait", "above Carpet"),
    ):  # fmt: skip
        assert not [e for e in found if e.startswith(first) and f" {wrong}" in e], (first, wrong)


SUBSET = (
    "supported by|left|right|front|behind|close by|inside|bigger than|smaller than|higher than|"
    "lower than|same symmetry as|same as|attached to|standing on|lying on|hanging on|connected to|"
    "leaning against|part of|belonging to|build in|standing in|cover|lying in|hanging in"
)


def matches_relation(query, relation):
    return normalize_relation(relation) in interpret_relation(query)


def test_all_names_of_3dssg_and_ours_are_known_and_mean_themselves():
    assert set(SUBSET.split("|")) | set(RELATIONS) == set(CANONICAL)
    for relation in (*CANONICAL, "same material", "taped to"):
        assert matches_relation(relation.upper().replace(" ", "_"), relation.replace(" ", "-"))


@pytest.mark.parametrize(
    ("asked", "relations"),
    [
        ("next to", "next to|close by|leaning against|beside"),
        ("is right next to", "next to|close by|leaning against"), ("near", "next to|close by"),
        ("on", "standing on|lying on|supported by|attached to|hanging on|cover"),
        ("on the top of", "standing on|lying on"),
        ("lying on", "standing on|lying on|supported by"),
        ("in", "inside|standing in|lying in|hanging in"),
        ("mounted on", "attached to|hanging on|build in|part of"), ("above", "above|over"),
        ("to the left of", "left|left of"), ("to the right of", "right|right of"),
        ("in front of", "front"), ("in the same room as", "same room"),
    ],
)  # fmt: skip
def test_what_is_asked_for_matches(asked, relations):
    for relation in relations.split("|"):
        assert matches_relation(asked, relation), relation


def test_what_is_asked_for_does_not_match():
    others = {"under": "above", "left of": "right", "inside": "standing on", "on": "above",
              "next to": "same room", "near": "left", "standing on": "attached to",
              "above": "higher than", "in": "in the same room as", "right of": "front"}  # fmt: skip
    for asked, relation in others.items():
        assert not matches_relation(asked, relation), relation


@pytest.mark.parametrize(
    ("asked", "label", "fits"),
    [("chair", "DeskChair", True), ("chairs", "desk chair", True), ("Desk chairs", "chair", True),
     ("desk chair", "kitchen_chair", False), ("shelves", "shelf", True), ("stove", "stoves", True),
     ("boxes", "box", True), ("glass", "glasses", True), ("knives", "knife", True),
     ("lamp", "lampshade", False), ("coffee table", "table", True), ("table", "table lamp", False),
     ("", "anything", True), ("sofa", "", False), ("berry", "berries", True)],
)  # fmt: skip
def test_labels(asked, label, fits):
    assert matches_label(asked, label) is fits


@given(st.text(max_size=30), st.sampled_from(sorted(CANONICAL)))
def test_any_text_has_a_reading(asked, relation):
    assert interpret_relation(asked)
    assert matches_relation(asked, asked)
    name, turned = normalize_relation(relation)
    assert normalize_relation(name) == (name, False)
    assert normalize_relation(relation) in interpret_relation(relation)
    assert not turned or (name, not turned) not in interpret_relation(relation)
