from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from tests.indoor.mapping.parts import only

from placegraph.core.geometry import rotation_z
from placegraph.errors import OptionError
from placegraph.indoor.build import build_scene, scene_of_model
from placegraph.indoor.map.floor import is_structural
from placegraph.indoor.mapping.change.align import make_rigid, transform_points
from placegraph.indoor.mapping.change.changes import DiffOptions
from placegraph.indoor.mapping.change.diff import diff
from placegraph.indoor.mapping.change.update import update
from placegraph.indoor.scene_map import SceneMap
from placegraph_lab.worlds.flat.flat import Flat


def built(interior, folder, name):
    interior.write_glb(folder / f"{name}.glb")
    return build_scene(folder / f"{name}.glb", None)


def with_mesh(scene, mesh, *, ids=None, labels=None, floor=None):
    graph = scene.graph
    return SceneMap.create(
        mesh, ids or graph.ids, labels or graph.labels, names=graph.names,
        floor=float(scene.floors[0]) if floor is None else floor,
        encoded=scene.encoded, source="later",
    )  # fmt: skip


@pytest.fixture(scope="module")
def later(room, room_world, tmp_path_factory):
    interior = room_world.interior.move_object("chair", (0.5, -0.6), 0.6).without("lamp")
    scene = built(interior, tmp_path_factory.mktemp("later"), "later")
    truth = make_rigid(rotation_z(0.6), np.zeros(3))
    middle = room_world.interior.find_object("chair").bounds.mean(axis=0)
    truth[:3, 3] = middle + np.array([0.5, -0.6, 0.0]) - truth[:3, :3] @ middle
    return SimpleNamespace(scene=scene, motion=truth, middle=middle, found=diff(room, scene))


def by_name(found, kind):
    return {change.name or change.label: change for change in found.of(kind)}


def test_a_map_differs_from_itself_by_nothing(room):
    found = diff(room, room)
    assert len(found) == 0
    assert "doubtful" not in found.alignment
    assert not found.unseen
    assert found.same == room.graph.ids
    np.testing.assert_allclose(found.b_from_a, np.eye(4), atol=1e-3)


def test_what_moved_and_what_vanished_is_named(room, later):
    found = later.found
    assert set(by_name(found, "moved")) == {"chair"}
    assert set(by_name(found, "vanished")) == {"lamp"}
    assert len(found) == 2
    chair = by_name(found, "moved")["chair"]
    moved = (
        transform_points(m, later.middle[None]) for m in (chair.after_from_before, later.motion)
    )
    assert np.linalg.norm(np.subtract(*moved)) < 0.03
    assert chair.turn_deg == pytest.approx(np.degrees(0.6), abs=3.0)
    assert chair.shift_m == pytest.approx(np.hypot(0.5, 0.6), abs=0.05)
    assert 0.5 < chair.confidence < 1.0
    assert diff(room, later.scene).to_dict() == found.to_dict()


def test_the_other_way_round_the_lamp_appears(room, later):
    found = diff(later.scene, room)
    assert set(by_name(found, "appeared")) == {"lamp"}
    lamp = by_name(found, "appeared")["lamp"]
    row = room.graph.names.index("lamp")
    np.testing.assert_allclose(lamp.box.mean(axis=0), room.graph.positions[row], atol=0.02)
    assert len(lamp.piece.triangles) == np.count_nonzero(room.mesh.object_of == row)


def test_maps_may_have_other_axes_and_other_ids(room, later):
    b_from_a = make_rigid(rotation_z(1.4), np.array([3.0, -2.0, 0.4]))
    mesh = later.scene.mesh
    there = replace(
        mesh, vertices=transform_points(b_from_a, mesh.vertices.astype(float)).astype(np.float32)
    )
    ids = [f"n{i}" for i in range(len(later.scene))]
    other = with_mesh(later.scene, there, ids=ids, floor=0.4)
    found = diff(room, other)
    np.testing.assert_allclose(found.b_from_a, b_from_a, atol=0.02)
    assert set(by_name(found, "moved")) == {"chair"}
    assert set(by_name(found, "vanished")) == {"lamp"}
    assert len(found) == 2
    assert by_name(found, "moved")["chair"].other.startswith("n")
    given = diff(room, other, options=DiffOptions(b_from_a=b_from_a))
    assert {c.id for c in given} == {c.id for c in found}
    assert given.alignment.startswith("given")


def test_a_transform_that_does_not_fit_is_refused(room, later):
    wrong = make_rigid(np.eye(3), np.array([30.0, 0.0, 0.0]))
    with pytest.raises(OptionError, match="b_from_a: it aligns only"):
        diff(room, later.scene, options=DiffOptions(b_from_a=wrong))
    with pytest.raises(OptionError, match="not rigid"):
        DiffOptions(b_from_a=np.diag([2.0, 2.0, 2.0, 1.0]))


def test_another_label_is_told(room):
    row = room.graph.labels.index("desk")
    labels = [("workbench" if i == row else label) for i, label in enumerate(room.graph.labels)]
    found = diff(room, with_mesh(room, room.mesh, labels=labels))
    assert [(c.kind, c.label, c.new_label) for c in found] == [("relabelled", "desk", "workbench")]


def test_what_has_no_name_in_one_map_is_not_relabelled(room, later):
    words = ("unknown", "object", "Thing", "object 7")
    labels = [words[i % len(words)] for i in range(len(later.scene))]
    for ids in (None, [f"n{i}" for i in range(len(labels))]):
        nameless = with_mesh(later.scene, later.scene.mesh, ids=ids, labels=labels)
        found = diff(room, nameless)
        assert {(c.kind, c.label) for c in found} == {("moved", "chair"), ("vanished", "lamp")}
        assert not any(c.new_label for c in found)
    assert sorted(c.kind for c in diff(nameless, room)) == ["appeared", "moved"]


def test_what_has_its_id_near_by_is_not_gone(room):
    mesh, rng = room.mesh, np.random.default_rng(5)
    built_in = is_structural(room.graph.labels)
    loose = ~built_in[mesh.object_of]
    keep = ~loose | (rng.uniform(size=len(mesh)) < 0.35)
    for row in np.flatnonzero(~built_in):
        keep[np.flatnonzero(mesh.object_of == row)[0]] = True
    blur = np.zeros(len(mesh.vertices), np.bool_)
    blur[mesh.triangles[loose]] = True
    vertices = mesh.vertices + (blur[:, None] * rng.normal(0.0, 0.03, (len(blur), 3)))
    texture_of, used = mesh.texture_of[keep], mesh.object_of[keep]
    part = replace(
        mesh, vertices=vertices.astype(np.float32), triangles=mesh.triangles[keep],
        object_of=used, texture_of=texture_of,
    )  # fmt: skip
    told = zip(room.graph.labels, built_in, strict=True)
    labels = [label if b else "unknown" for label, b in told]
    assert not diff(room, with_mesh(room, part, labels=labels)).of("vanished")


def test_ids_of_another_numbering_say_nothing(room):
    count = len(room)
    shuffled = [room.graph.ids[(i + 3) % count] for i in range(count)]
    found = diff(room, with_mesh(room, room.mesh, ids=shuffled, labels=["unknown"] * count))
    assert len(found) == 0


def test_what_is_built_in_does_not_vanish(room):
    centres = room.mesh.vertices[room.mesh.triangles].mean(axis=1)
    over = room.mesh.object_of == room.graph.labels.index("ceiling")
    under = room.mesh.object_of == room.graph.labels.index("floor")
    for gone in (over, under & (centres[:, 0] > 0.2)):
        assert len(diff(room, only(room, ~gone))) == 0
    assert all(c.confidence < 0.5 for c in diff(only(room, ~under), room))


def test_what_the_other_map_does_not_cover_is_unseen_not_vanished(room):
    centres = room.mesh.vertices[room.mesh.triangles].mean(axis=1)
    spanning = [room.graph.labels.index(label) for label in ("floor", "ceiling")]
    half = only(room, (centres[:, 0] > 3.1) & ~np.isin(room.mesh.object_of, spanning))
    found = diff(room, half, options=DiffOptions(b_from_a=np.eye(4)))
    far = {id_ for id_, at in zip(room.graph.ids, room.graph.positions, strict=True) if at[0] < 2}
    assert far <= set(found.unseen)
    assert not {c.id for c in found} & far


HALL = """
[flat]
height = 2.6
[drawing]
{walls}
#SSS{gap}#
#SSS{gap}#
#SSS{gap}#
#   {gap}#
#   {gap}#
#LL {gap}#
#LL {gap}#
#   {gap}#
#BBB{gap}#
#BBB{gap}#
#   {gap}#
{walls}
[legend]
S sofa: look=fabric darkred
B shelf: label=bookcase
L lamp:
"""


def hall(folder, width):
    drawn = HALL.format(walls="#" * (width + 5), gap=" " * width)
    return built(Flat.parse(drawn).furnish(np.random.default_rng(3)), folder, "hall")


def test_a_room_that_shares_three_walls_with_another_is_doubtful(room, tmp_path):
    other = hall(tmp_path, 15)
    for one, two in ((room, other), (other, room)):
        found = diff(one, two)
        assert len(found) > 5
        assert "therefore uncertain" in found.alignment
        assert all(c.confidence < 0.5 for c in found)
        assert update(one, found).graph.ids == one.graph.ids


def test_two_places_are_not_laid_on_each_other(room, boxes, tmp_path):
    long = {"floor": ((0, 0, -0.1), (30, 2, 0)), "wall": ((0, 2, 0), (30, 2.1, 5))}
    with pytest.raises(OptionError, match="cannot be aligned"):
        diff(room, scene_of_model(boxes(long)))
    # floors and ceilings agree, of any two rooms, and here a corner too
    with pytest.raises(OptionError, match=r"cannot be aligned.*4\d% of their walls"):
        diff(room, hall(tmp_path, 22))
