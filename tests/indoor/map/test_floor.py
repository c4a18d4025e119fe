from dataclasses import replace

import numpy as np
import pytest
from tests.indoor.mapping.parts import lattice

from placegraph.indoor.build import scene_of_model
from placegraph.indoor.map.floor import (
    find_floor_height,
    is_floor,
    is_nameless,
    is_structural,
    labels_agree,
    split_label,
)
from placegraph.indoor.map.mesh import Mesh

ROOM = {
    "slab": ((0, 0, -0.2), (5, 4, 0.1)),
    "wall": ((0, 0, 0.1), (0.1, 4, 2.7)),
    "roof": ((0, 0, 2.7), (5, 4, 2.9)),
    "table": ((1, 1, 0.75), (3, 2, 0.8)),
}


def height(model):
    mesh = Mesh.plain(model.vertices, model.triangles, model.object_of)
    return find_floor_height(mesh, [t.label for t in model.objects])


@pytest.mark.parametrize("label", ["slab", "floor", "Floor", "kitchen_floor", "ground"])
def test_the_upper_side_of_the_slab(label, boxes):
    parts = {label if name == "slab" else name: box for name, box in ROOM.items()}
    assert height(boxes(parts)) == pytest.approx(0.1, abs=1e-6)


def test_a_floor_that_looks_down():
    square = np.array([[0, 0, 0.5], [5, 0, 0.5], [5, 4, 0.5], [0, 4, 0.5]])
    points = np.concatenate([square, square + np.array([0, 0, 2.5])])
    down = np.array([[0, 2, 1], [0, 3, 2], [4, 6, 5], [4, 7, 6]])
    for triangles in (down, down[:, ::-1]):
        for label in ("thing", "floor"):
            mesh = Mesh.plain(points, triangles, [0, 0, 1, 1])
            assert find_floor_height(mesh, [label, "thing"]) == 0.5


def test_a_label_wins_over_a_larger_surface(boxes):
    model = boxes({"carpark": ((0, 0, -0.5), (9, 9, 0)), "floor": ((1, 1, 0.9), (3, 3, 1.0))})
    assert height(model) == pytest.approx(1.0, abs=1e-6)


def test_a_floor_that_stands_upright_tells_no_height(boxes):
    standing = {"floor": ((0, 0, 0), (0.1, 4, 5)), "slab": ((0, 0, -0.2), (5, 4, 0.1))}
    assert height(boxes(standing)) == pytest.approx(0.1, abs=1e-6)
    assert height(boxes({"floor": standing["floor"]})) is None
    corners = np.array([[-500, -500, 2], [500, -500, 2], [0, 900, 2]])  # one giant triangle
    assert find_floor_height(Mesh.plain(corners, [[0, 1, 2]]), ["x"]) == 2.0
    assert find_floor_height(Mesh.plain(corners[:, [0, 2, 1]], [[0, 1, 2]]), ["x"]) is None


def test_furniture_alone_is_no_floor(boxes):
    walls = {"wall": ROOM["wall"], "north wall": ((0, 3.9, 0), (5, 4, 2.7))}
    assert height(boxes(walls)) is None
    assert height(boxes(walls | {"shelf": ((1, 1, 1.5), (3, 3, 1.6))})) is None
    assert height(boxes({"ceiling": ROOM["roof"]} | walls)) is None
    assert height(boxes({"plate": ((0, 0, 0), (0.3, 0.3, 0.1))} | walls)) is None


def test_scans_are_noisy_and_reach_below_the_floor(rng):
    points, triangles = lattice(79, 59)  # 7.9 x 5.9 m
    z = rng.normal(1.0, 0.02, (80, 60))
    z[30:50, 20:30] = 1.75
    z[10:12, 10:12] = -0.4
    z[0, :] = z[-1, :] = 3.5
    mesh = Mesh.plain(np.column_stack([points * (7.9, 5.9), z.ravel()]), triangles)
    assert find_floor_height(mesh, ["unknown"]) == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize(
    ("label", "words"),
    [
        ("HouseWall", ["house", "wall"]), ("house_wall", ["house", "wall"]), ("TV", ["tv"]),
        ("TVCabinet", ["tv", "cabinet"]), ("floor lamp", ["floor", "lamp"]), ("", []), ("42", []),
        ("Fußboden", ["fußboden"]), ("wall-1", ["wall"]),
    ],
)  # fmt: skip
def test_words_of_labels(label, words):
    assert split_label(label) == words


def test_the_last_word_says_what_is_built_in():
    assert all(map(is_floor, ["floor", "Floor", "LivingRoomFloor", "wet floor 2"]))
    assert not any(map(is_floor, ["floor lamp", "floorboard", "", "FloorMat"]))
    built_in = is_structural(["HouseWall", "wall clock", "floor", "", "RoomWindow"])
    assert built_in.tolist() == [True, False, True, False, True]


def test_the_shared_house(house):
    nameless = replace(house, objects=tuple(replace(t, label="thing") for t in house.objects))
    assert height(nameless) == pytest.approx(0.0, abs=0.01)
    assert scene_of_model(house).floors.tolist() == [0.0]


@pytest.mark.parametrize("label", ["", "unknown", "Object", "object 3", "17", "Mesh_01", "none"])
def test_words_that_name_nothing(label):
    assert is_nameless(label)
    assert labels_agree(label, "chair")
    assert labels_agree("chair", label)
    for word in ("chair", "unknown chair", "other furniture", "椅子"):
        assert not is_nameless(word)
        assert labels_agree(word, word.upper())
        assert not labels_agree(word, "lamp")
