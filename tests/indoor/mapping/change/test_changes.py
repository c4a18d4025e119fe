import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.io.damage import any_json, refusing

from placegraph.core.geometry import rotation_z
from placegraph.errors import InputError, OptionError
from placegraph.indoor.mapping.change.align import make_rigid
from placegraph.indoor.mapping.change.changes import Change, Piece, SceneDiff, read_diff


@pytest.fixture
def found():
    box = np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 0.5]])
    motion = make_rigid(rotation_z(0.5), np.array([1.0, 0.0, 0.0]))
    changes = (
        Change(
            "moved", "chair", 0.9, "seen", id="7", name="chair 2", after_from_before=motion,
            centre=np.zeros(3), box=box,
        ),
        Change("vanished", "lamp", 0.8, "seen", id="3", box=box),
        Change(
            "appeared", "unknown", 0.7, "seen", box=box,
            piece=Piece.box(*box, np.array([200, 10, 10], np.uint8)),
        ),
        Change("relabelled", "desk", 0.6, "seen", id="4", other="n4", new_label="table"),
    )  # fmt: skip
    return SceneDiff(changes, ("1",), ("2",), np.eye(4), "given", "a.glb", "walk")


def test_what_is_written_is_read_back(found, tmp_path):
    found.save(tmp_path / "d.json")
    again = read_diff(tmp_path / "d.json")
    assert again.to_dict() == found.to_dict()
    assert [c.kind for c in again] == [c.kind for c in found]
    assert again.of("moved")[0].shift_m == pytest.approx(1.0)
    assert again.of("moved")[0].turn_deg == pytest.approx(np.degrees(0.5))
    assert "1 moved, 1 appeared, 1 vanished, 1 relabelled" in repr(again)


def test_a_box_is_closed_and_wound_outwards():
    piece = Piece.box(np.zeros(3), np.array([1.0, 2.0, 3.0]), np.array([1, 2, 3], np.uint8))
    a, b, c = np.moveaxis(piece.vertices[piece.triangles], 1, 0)
    volume = np.einsum("nk,nk->n", a, np.cross(b, c)).sum() / 6.0
    assert volume == pytest.approx(6.0)


def test_changes_that_contradict_themselves_are_refused():
    with pytest.raises(OptionError, match="needs a motion"):
        Change("moved", "chair", 0.5, "")
    with pytest.raises(OptionError, match="needs a surface"):
        Change("appeared", "chair", 0.5, "")
    with pytest.raises(OptionError, match="between 0 and 1"):
        Change("vanished", "chair", 1.5, "")
    with pytest.raises(OptionError, match=r"choose one of moved, appeared, vanished, relabelled\."):
        Change("flew", "chair", 0.5, "")


def test_files_that_are_no_diffs_end_in_one_error(tmp_path):
    path = tmp_path / "d.json"
    for text in ("", "{", "[]", "{}", '{"version": 9}', '{"version": 1, "changes": [1]}', "null"):
        path.write_text(text)
        with pytest.raises(InputError, match=r"d\.json"):
            read_diff(path)
    with pytest.raises(InputError, match="does not exist"):
        read_diff(tmp_path / "none.json")


@given(data=st.data())
def test_a_damaged_diff_is_read_or_refused(data, tmp_path_factory):
    box = np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 0.5]])
    piece = Piece.box(*box, np.array([200, 10, 10], np.uint8))
    told = SceneDiff(
        (Change("appeared", "x", 0.7, "", box=box, piece=piece),), (), (), np.eye(4), "", "", ""
    ).to_dict()
    where = data.draw(st.sampled_from([told, told["changes"][0], told["changes"][0]["piece"]]))
    where[data.draw(st.sampled_from(sorted(where)))] = data.draw(any_json())
    path = tmp_path_factory.mktemp("junk") / "d.json"
    path.write_text(json.dumps(told))
    with refusing("d.json"):
        read_diff(path)
