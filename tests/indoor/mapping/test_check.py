from dataclasses import replace

import numpy as np
import pytest
from tests.indoor.mapping.parts import only

from placegraph.core.geometry import rotation_from_vector
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.mapping.check import check
from placegraph.indoor.options import PoseSearchOptions
from placegraph.indoor.scene_map import SceneMap


def spoilt(scene, *, mesh=None, ids=None, labels=None, names=None, floor=None, relations=()):
    return SceneMap.create(
        scene.mesh if mesh is None else mesh,
        scene.graph.ids if ids is None else ids,
        scene.graph.labels if labels is None else labels,
        names=scene.graph.names if names is None else names,
        floor=float(scene.floors[0]) if floor is None else floor,
        relations=relations or [(0, "next to", 1)],
        encoded=scene.encoded if mesh is None or len(mesh.textures) > 1 else None,
    )


def transform_mesh(scene, matrix):
    vertices = scene.mesh.vertices.astype(float) @ np.asarray(matrix, float).T
    return replace(scene.mesh, vertices=vertices.astype(np.float32))


def find_findings(findings, words):
    return [f for f in findings if words in f.what]


def test_a_sound_room_has_no_errors_and_no_warnings(room, flat):
    for scene in (room, flat):
        found = check(scene)
        assert [f for f in found if f.severity != "note"] == []
    assert (
        find_findings(check(room), "the back of triangles")
        == find_findings(check(room), "colour")
        == []
    )


def scaled(factor):
    return lambda room: spoilt(room, mesh=transform_mesh(room, factor * np.eye(3)))


def lying(room):
    return spoilt(room, mesh=transform_mesh(room, [[1, 0, 0], [0, 0, 1], [0, -1, 0]]))


def flipped(room):
    return spoilt(room, mesh=replace(room.mesh, triangles=room.mesh.triangles[:, ::-1]))


@pytest.mark.parametrize(
    ("spoil", "options", "words", "severity", "mend"),
    [
        (scaled(1000.0), {"spacing": 250.0}, "millimetres", "error", "--scale 0.001"),
        (scaled(100.0), {"spacing": 25.0}, "centimetres", "error", "--scale 0.01"),
        (scaled(3.28), {"spacing": 0.82}, "feet", "error", "--scale 0.3048"),
        (lying, {}, "on its side", "error", "--up y"), (flipped, {}, "the back of triangles", "note", ""),
        (lambda room: spoilt(room, floor=-1.0), {}, "hardly any level", "error", "--floor 0.00"),
        (lambda room: room, {"heights": (3.5,)}, "no place is free", "error", "--floor"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_told_with_its_mend(room, spoil, options, words, severity, mend):
    (finding,) = find_findings(check(spoil(room), options=PoseSearchOptions(**options)), words)
    assert finding.severity == severity
    assert mend in (finding.remedy or "")


def test_a_floor_that_stands_upright_is_told(room):
    lying = spoilt(room, mesh=transform_mesh(room, [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]))
    (finding,) = find_findings(check(lying), "the floor is vertical")
    assert finding.severity == "error"
    assert "along x" in finding.what
    labels = list(room.graph.labels)
    wall = labels.index("wall")
    labels[wall] = "floor"
    (finding,) = find_findings(check(spoilt(room, labels=labels)), "floor is vertical")
    assert finding.severity == "warning"
    assert finding.objects == (room.graph.ids[wall],)


def test_parts_of_things_do_not_tell_the_unit(room):
    vertices = room.mesh.vertices.astype(float)
    for row, label in enumerate(room.graph.labels):
        if label in {"sofa", "chair", "side table"}:
            own = np.unique(room.mesh.triangles[room.mesh.object_of == row])
            vertices[own, 2] = 0.45 + 0.36 * vertices[own, 2]
    cut = replace(room.mesh, vertices=vertices.astype(np.float32))
    labels = ["plaster" if w == "wall" else w for w in room.graph.labels]
    assert find_findings(check(spoilt(room, mesh=cut, labels=labels)), "high") == []
    low = {"sofa", "chair", "side table", "desk", "sideboard"}
    labels = ["wardrobe" if w in low else "plaster" for w in room.graph.labels]
    assert find_findings(check(spoilt(room, labels=labels)), "high") == []  # one kind, mislabelled


def test_kinds_of_things_that_agree_tell_the_unit(room):
    (finding,) = find_findings(check(scaled(0.35)(room)), "high")
    assert "objects 0.3" in finding.what
    assert "as high as" in finding.what


@pytest.mark.parametrize(("degrees", "severity"), [(0.4, None), (2.0, "warning"), (6.0, "error")])
def test_a_tilted_floor_is_told(room, degrees, severity):
    rotation = rotation_from_vector([np.radians(degrees), 0.0, 0.0])
    found = find_findings(check(spoilt(room, mesh=transform_mesh(room, rotation))), "slopes")
    assert [f.severity for f in found] == ([severity] if severity else [])
    if severity:
        assert f"{degrees:.1f} degrees" in found[0].what


def test_holes_are_told_with_where_they_are(room):
    labels = np.array(room.graph.labels)[room.mesh.object_of]
    (open_above,) = find_findings(check(only(room, labels != "ceiling")), "leave the map")
    assert open_above.severity == "note"
    assert "no ceiling" in open_above.what
    bare = only(room, ~np.isin(labels, ("ceiling", "wall")))
    (open_around,) = find_findings(check(bare), "leave the map")
    assert open_around.severity == "warning"
    assert "around" in open_around.what


def test_double_triangles_twins_and_giants_are_told(room):
    mesh = room.mesh
    chair = room.graph.labels.index("chair")
    again = mesh.object_of == chair
    twice = replace(
        mesh,
        triangles=np.concatenate([mesh.triangles, mesh.triangles[again]]),
        object_of=np.concatenate([mesh.object_of, np.full(again.sum(), len(room), np.int32)]),
        texture_of=np.concatenate([mesh.texture_of, mesh.texture_of[again]]),
    )
    scene = spoilt(
        room, mesh=twice, ids=[*room.graph.ids, "again"],
        labels=[*room.graph.labels, "chair"], names=[*room.graph.names, "again"],
    )  # fmt: skip
    found = check(scene)
    (twins,) = find_findings(found, "same space")
    assert set(twins.objects) == {room.graph.ids[chair], "again"}
    assert find_findings(found, "coincide with another one, so")
    one = SceneMap.create(
        replace(mesh, object_of=np.zeros(len(mesh), np.int32)),
        ["0"], ["scan"], floor=0.0, encoded=room.encoded,
    )  # fmt: skip
    (giant,) = find_findings(check(one), "lacks the separate objects that localization needs")
    assert giant.severity == "error"


def test_words_are_checked(room):
    count = len(room)
    unlabelled = check(spoilt(room, labels=["object"] * count))
    assert [f.severity for f in find_findings(unlabelled, "no meaningful label")] == ["warning"]
    assert "--labels" in find_findings(unlabelled, "no meaningful label")[0].remedy
    names = ["thing"] * count
    assert (
        len(find_findings(check(spoilt(room, names=names)), "are used by several")[0].objects) <= 20
    )
    ids = ["Chair", "chair", *map(str, range(count - 2))]
    alike = find_findings(check(spoilt(room, ids=ids)), "case or spaces")[0]
    assert set(alike.objects) == {"Chair", "chair"}


def test_what_lies_far_off_is_told(room):
    vertices = room.mesh.vertices.copy()
    lamp = room.graph.labels.index("lamp")
    own = np.unique(room.mesh.triangles[room.mesh.object_of == lamp])
    vertices[own] += (60.0, 0.0, 0.0)
    found = find_findings(
        check(spoilt(room, mesh=replace(room.mesh, vertices=vertices))), "far from the rest"
    )
    assert [f.objects for f in found] == [(room.graph.ids[lamp],)]


def test_a_map_without_colours_is_told(room):
    white = Mesh.plain(room.mesh.vertices, room.mesh.triangles, room.mesh.object_of)
    (finding,) = find_findings(check(spoilt(room, mesh=white)), "has no colours")
    assert finding.severity == "warning"
    grey = replace(white, colours=np.full_like(white.colours, 170))
    (finding,) = find_findings(check(spoilt(room, mesh=grey)), "a single colour")
    assert finding.severity == "note"


def test_costs_are_told_where_they_are_high(room):
    assert find_findings(check(room, size=50_000_000, seconds=9.0), "50 MB")
    assert find_findings(check(room, size=50_000_000, seconds=9.0), "9.0 s")
    assert not find_findings(check(room, size=1000, seconds=0.1), "MB")


def test_findings_come_worst_first_and_as_plain_words(room):
    scene = spoilt(room, mesh=transform_mesh(room, 1000.0 * np.eye(3)), labels=["x"] * len(room))
    found = check(scene, options=PoseSearchOptions(spacing=250.0))
    order = [("error", "warning", "note").index(f.severity) for f in found]
    assert order == sorted(order)
    assert all(isinstance(f.to_dict()["objects"], list) for f in found)
