"""What changed, drawn on the plan."""

import numpy as np
import pytest
from PIL import Image

from placegraph.errors import OptionError
from placegraph.indoor.build import build_scene
from placegraph.indoor.mapping.change.align import make_rigid
from placegraph.indoor.mapping.change.changes import Change, Piece, SceneDiff
from placegraph.view.draw.canvas import Stroke, Text
from placegraph.view.scene.change_plans import COLOR, marks_of, write_diff
from placegraph.view.scene.room_plan import RoomPlan


@pytest.fixture(scope="module")
def scene(study, tmp_path_factory):
    folder = tmp_path_factory.mktemp("diff-plan")
    study.furnish(np.random.default_rng(1)).write_glb(folder / "study.glb")
    return build_scene(folder / "study.glb", None)


@pytest.fixture
def changes(scene):
    def row(name):
        return scene.graph.ids[scene.graph.names.index(name)]

    box = np.array([[2.0, 1.0, 0.0], [2.5, 1.4, 0.6]])
    motion = make_rigid(np.eye(3), np.array([0.5, 0.25, 0.0]))
    return {
        "moved": Change("moved", "chair", 0.9, "", id=row("chair"), after_from_before=motion),
        "vanished": Change("vanished", "lamp", 0.9, "", id=row("lamp"), box=box),
        "appeared": Change(
            "appeared", "crate", 0.9, "", box=box,
            piece=Piece.box(*box, np.array([9, 9, 9], np.uint8)),
        ),
        "relabelled": Change("relabelled", "desk", 0.9, "", id=row("desk"), new_label="table", box=box),
    }  # fmt: skip


def test_an_arrow_leads_from_where_it_was_to_where_it_is(scene, changes):
    plan = RoomPlan(scene)
    rows = {id_: i for i, id_ in enumerate(scene.graph.ids)}
    strokes = [m for m in marks_of(plan, changes["moved"], rows) if isinstance(m, Stroke)]
    assert {s.color for s in strokes} <= {COLOR["moved"], "paper"}
    line = next(s for s in strokes if len(s.points) == 2)
    middle = plan.middle(rows[changes["moved"].id])
    np.testing.assert_allclose(line.points, [middle, middle + np.array([0.5, 0.25])], atol=1e-6)


@pytest.mark.parametrize("kind", ["vanished", "appeared", "relabelled"])
def test_every_kind_has_marks_of_its_colour(scene, changes, kind):
    marks = marks_of(RoomPlan(scene), changes[kind], {})
    assert COLOR[kind] in {getattr(m, "color", "") for m in marks}
    words = [m.text for m in marks if isinstance(m, Text)]
    assert words == {"appeared": ["crate"], "relabelled": ["table"]}.get(kind, [])


def test_the_picture_differs_from_that_of_nothing(scene, changes, tmp_path):
    def picture(*some):
        found = SceneDiff(tuple(some), (), (), np.eye(4), "", "study", "later")
        with Image.open(write_diff(scene, found, tmp_path / "d.png", width=600)) as image:
            return np.asarray(image.convert("RGB")).astype(int)

    plain, drawn = picture(), picture(*changes.values())
    assert plain.shape == drawn.shape
    assert np.count_nonzero(np.abs(plain - drawn).sum(axis=2) > 60) > 300


def test_the_width_of_a_picture(scene, tmp_path):
    found = SceneDiff((), (), (), np.eye(4), "")
    with pytest.raises(OptionError):
        write_diff(scene, found, tmp_path / "d.png", width=3)
