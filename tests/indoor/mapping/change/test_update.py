from dataclasses import replace

import numpy as np
import pytest

from placegraph.core.geo import Anchor
from placegraph.core.geometry import rotation_z
from placegraph.errors import MapError, OptionError
from placegraph.indoor.build import build_scene
from placegraph.indoor.map.floor import is_structural
from placegraph.indoor.mapping.change.align import make_rigid, transform_points
from placegraph.indoor.mapping.change.changes import Change, Piece, SceneDiff
from placegraph.indoor.mapping.change.diff import diff
from placegraph.indoor.mapping.change.update import update, update_file
from placegraph.indoor.scene_map import SceneMap
from placegraph_lab.worlds.flat.flat import Flat


def diff_of(*changes):
    return SceneDiff(changes, (), (), np.eye(4), "", "room", "later")


def id_of(scene, name):
    return scene.graph.ids[scene.graph.names.index(name)]


def edges_of(graph):
    return list(zip(graph.sources.tolist(), graph.relations, graph.targets.tolist(), strict=True))


@pytest.fixture
def motion():
    return make_rigid(rotation_z(0.3), np.array([0.6, -0.4, 0.0]))


@pytest.fixture
def found(room, motion):
    lamp, table = id_of(room, "lamp"), id_of(room, "side table")
    box = np.array([[2.0, 2.5, 0.0], [2.4, 2.9, 0.7]])
    row = room.graph.names.index("side table")
    return diff_of(
        Change(
            "moved", "side table", 0.9, "", id=table, after_from_before=motion,
            centre=room.graph.positions[row],
        ),
        Change("vanished", "lamp", 0.9, "", id=lamp, name="lamp"),
        Change(
            "appeared", "crate", 0.9, "", box=box, other="crate-1",
            piece=Piece.box(*box, np.array([250, 0, 0], np.uint8)),
        ),
        Change("relabelled", "desk", 0.9, "", id=id_of(room, "desk"), new_label="workbench"),
    )  # fmt: skip


def test_every_kind_of_change_is_taken_over(room, found, motion):
    new = update(room, found, when="2026-11-21")
    assert len(new) == len(room)
    assert id_of(room, "lamp") not in new.graph.ids
    assert "crate-1" in new.graph.ids
    assert "workbench" in new.graph.labels
    table = id_of(room, "side table")
    was, now = room.row_of(table), new.row_of(table)
    before = room.mesh.vertices[room.mesh.triangles[room.mesh.object_of == was]].reshape(-1, 3)
    after = new.mesh.vertices[new.mesh.triangles[new.mesh.object_of == now]].reshape(-1, 3)
    wanted = transform_points(motion, before.astype(float))
    np.testing.assert_allclose(after.min(axis=0), wanted.min(axis=0), atol=1e-3)
    np.testing.assert_allclose(after.max(axis=0), wanted.max(axis=0), atol=1e-3)
    assert new.attributes[now]["history"].startswith("2026-11-21: moved by ")
    crate = new.row_of("crate-1")
    relations = zip(new.graph.sources.tolist(), new.graph.relations, strict=True)
    assert (crate, "standing on") in relations
    assert new.attributes[crate]["history"] == "2026-11-21: appeared"


def test_what_did_not_change_stays_bit_by_bit(room, found):
    new = update(room, found)
    stirred = {c.id for c in found}
    for id_ in set(room.graph.ids) - stirred:
        was, now = room.row_of(id_), new.row_of(id_)
        assert new.graph.labels[now] == room.graph.labels[was]
        np.testing.assert_array_equal(new.graph.positions[now], room.graph.positions[was])
    kept = set(room.graph.ids) - stirred
    edges = [
        {(g.ids[s], r, g.ids[t]) for s, r, t in edges_of(g) if {g.ids[s], g.ids[t]} <= kept}
        for g in (room.graph, new.graph)
    ]
    assert edges[0] <= edges[1]


def test_the_map_given_is_not_touched(room, found):
    before = room.mesh.vertices.copy(), room.graph, [dict(a) for a in room.attributes]
    update(room, found)
    np.testing.assert_array_equal(room.mesh.vertices, before[0])
    assert room.graph == before[1]
    assert list(room.attributes) == before[2]


HALVES = """
[flat]
height = 2.6
[drawing]
##################
#TT     #        #
#TT     #     BB #
#               B#
#               B#
#       #        #
#tt     #     hh #
#tt     #     hh #
##################
[legend]
T table: label=desk
t roundtable: label=stool
B shelf: label=bookcase
h chair: label=chair
"""


@pytest.fixture(scope="module")
def halves(tmp_path_factory):
    folder = tmp_path_factory.mktemp("halves")
    Flat.parse(HALVES).furnish(np.random.default_rng(1)).write_glb(folder / "halves.glb")
    return build_scene(folder / "halves.glb", None)


@pytest.mark.parametrize(("west", "east"), [("101", "102"), ("kitchen", "101")])
def test_rooms_keep_the_names_they_had(halves, west, east):
    middle = halves.graph.positions[:, 0].mean()
    loose = ~is_structural(halves.graph.labels)
    named = [
        {"room": west if at[0] < middle else east} if free else {}
        for at, free in zip(halves.graph.positions, loose, strict=True)
    ]
    scene = replace(halves, attributes=tuple(named))
    chair, row = id_of(scene, "chair"), scene.graph.names.index("chair")
    stool = id_of(scene, "stool")
    over = Change(
        "moved", "chair", 0.9, "", id=chair, centre=scene.graph.positions[row],
        after_from_before=make_rigid(np.eye(3), np.array([-2.5, 0.0, 0.0])),
    )  # fmt: skip
    slight = make_rigid(np.eye(3), np.full(3, 0.02))
    little = Change("moved", "stool", 0.9, "", id=stool, after_from_before=slight)
    new = update(scene, diff_of(over, little))
    rooms = {id_: a.get("room") for id_, a in zip(new.graph.ids, new.attributes, strict=True)}
    was = {id_: a.get("room") for id_, a in zip(scene.graph.ids, scene.attributes, strict=True)}
    assert was[chair] == east
    assert rooms == {**was, chair: west}
    bare = replace(halves, attributes=({},) * len(halves))
    assert {a.get("room") for a in update(bare, diff_of()).attributes} >= {"1", "2"}


def test_relations_that_say_nothing_of_place_outlive_a_motion(room, found):
    table, desk, lamp = (room.graph.names.index(n) for n in ("side table", "desk", "lamp"))
    told = [
        (desk, "bigger than", table), (table, "smaller than", desk), (table, "same material", desk),
        (table, "left", desk), (table, "higher than", desk), (desk, "bigger than", lamp),
        (desk, "more comfortable than", table), (table, "same room", desk),
    ]  # fmt: skip
    edges = sorted(told + [edge for edge in edges_of(room.graph) if edge[1] != "same room"])
    sources, relations, targets = zip(*edges, strict=True)
    graph = replace(
        room.graph, sources=np.array(sources), relations=relations, targets=np.array(targets)
    )
    new = update(replace(room, graph=graph), found)
    between = {new.row_of(id_of(room, "side table")), new.row_of(id_of(room, "desk"))}
    kept = {r for s, r, t in edges_of(new.graph) if {s, t} == between}
    lasting = ["bigger than", "more comfortable than", "same material", "smaller than"]
    assert sorted(kept - {"next to", "same room"}) == lasting
    assert new.graph.relations.count("bigger than") == 1


def test_an_update_undoes_its_own_diff(room, found):
    new = update(room, found, take=["moved", "vanished"])
    back = diff(room, new)
    assert {c.kind for c in back} == {"moved", "vanished"}
    assert {c.id for c in back} == {c.id for c in found if c.kind in {"moved", "vanished"}}
    anchored = room.anchored(Anchor(7.42, 43.73, 50, 0.7))
    same = update(anchored, diff_of())
    assert len(diff(room, same)) == 0
    assert same.graph.ids == room.graph.ids
    assert same.anchors == anchored.anchors  # it stays where it stands


def test_what_is_unsure_is_left_alone_unless_it_is_named(room):
    lamp = id_of(room, "lamp")
    unsure = diff_of(Change("vanished", "lamp", 0.3, "", id=lamp))
    assert lamp in update(room, unsure).graph.ids
    assert lamp not in update(room, unsure, least_confidence=0.2).graph.ids
    assert lamp not in update(room, unsure, take=[lamp]).graph.ids


def test_it_is_written_and_opened_and_changes_a_file_never_in_place(room, found, tmp_path):
    path, out = tmp_path / "room.scene", tmp_path / "new.scene"
    room.save(path)
    bytes_before = path.read_bytes()
    new = update_file(path, found, out)
    assert SceneMap.open(out).graph == new.graph
    with pytest.raises(OptionError, match="--in-place"):
        update_file(path, found, path)
    assert path.read_bytes() == bytes_before
    update_file(path, found, path, in_place=True)
    assert path.read_bytes() != bytes_before
    assert (tmp_path / "room.scene.bak").read_bytes() == bytes_before


def test_a_failure_leaves_the_map_and_its_backup(room, found, tmp_path, monkeypatch):
    path = tmp_path / "room.scene"
    room.save(path)
    whole = path.read_bytes()

    def fail(*_):
        raise MapError("disk full")

    monkeypatch.setattr("placegraph.indoor.mapping.change.update.save_scene", fail)
    with pytest.raises(MapError, match="disk full"):
        update_file(path, found, path, in_place=True)
    assert path.read_bytes() == whole
    assert (tmp_path / "room.scene.bak").read_bytes() == whole


def test_foreign_diffs_and_empty_maps_are_refused(room):
    with pytest.raises(OptionError, match="use the map that the diff was made from,"):
        update(room, diff_of(Change("vanished", "x", 0.9, "", id="nobody")))
    with pytest.raises(OptionError, match="neither a kind of change"):
        update(room, diff_of(), take=["flown"])
    everything = [Change("vanished", "x", 0.9, "", id=id_) for id_ in room.graph.ids]
    with pytest.raises(OptionError, match="it would remove every object"):
        update(room, diff_of(*everything))
