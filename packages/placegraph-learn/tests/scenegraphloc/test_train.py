import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from placegraph.core.geometry import Camera
from placegraph.errors import InputError, OptionError
from placegraph_lab.worlds.home.lessons import homes
from placegraph_learn.scenegraphloc import SceneGraphLocEncoder
from placegraph_learn.scenegraphloc.features import ColourFeatures
from placegraph_learn.scenegraphloc.inputs import Room
from placegraph_learn.scenegraphloc.lessons import (
    Lesson,
    Material,
    SurveyedScene,
    Teacher,
    World,
    folder,
    kept_lesson,
    place_capture,
    read_lesson,
    write_lesson,
)
from placegraph_learn.scenegraphloc.network import Widths
from placegraph_learn.scenegraphloc.train import Trainer, TrainOptions, evaluate, train
from placegraph_learn.training import Progress, rows_of

OPTIONS = TrainOptions(epochs=2, batch=3, others=1, points=16, seed=4)
SMALL = Camera(64, 36, 46.0, 46.0, 32.0, 18.0)
TINY = Widths(
    feature=17, embedding=12, hidden=16, gate=4, modality=6, points=(6, 8, 8), graph=8, view=8,
    pose_hidden=6,
)  # fmt: skip


@pytest.fixture(scope="module")
def lessons():
    teacher = Teacher(ColourFeatures())
    return {world.name: teacher.lesson(world) for world in homes(3, seed=3, frames=3, camera=SMALL)}


@pytest.fixture(scope="module")
def learn(lessons):
    def call(at, options=OPTIONS, **more):
        (at / "places").mkdir(parents=True, exist_ok=True)
        for name, lesson in lessons.items():
            if not (at / f"places/{name}.lesson").exists():
                write_lesson(at / f"places/{name}.lesson", lesson)
        worlds = [World(name, lambda: pytest.fail("it is looked at already")) for name in lessons]
        more = {"widths": TINY, "device": "cpu"} | more
        return train(worlds, at / "a.safetensors", folder=at, options=options, **more)

    return call


@pytest.fixture(scope="module")
def trained(learn, tmp_path_factory, make_notes):
    at, notes = tmp_path_factory.mktemp("trained"), make_notes()
    return learn(at, progress=notes), at, notes


def test_what_is_written_serves_as_an_encoder(trained, room, survey):
    weights, at, _ = trained
    found = SceneGraphLocEncoder(at / "a.safetensors")
    assert weights.digest in found.key
    assert found.features.key == "colour-1"
    assert 0.01 <= found.temperature <= 1.0
    assert found.objects(room, [survey]).shape == (len(room), 12)


def test_progress_and_curves_are_told(trained):
    _, at, notes = trained
    assert [p[1:] for p in notes.prepared] == [(1, 3), (2, 3), (3, 3)]
    assert {(e, t) for e, _, t, _ in notes.steps} == {(0, 2), (1, 2)}
    assert [row["epoch"] for row in rows_of(at)] == [1, 2]
    assert rows_of(at) == notes.rows
    assert notes.rows[0].keys() == {"epoch", "loss", "patch", "room", "changed"}


@pytest.mark.parametrize("stop", [(1, 1), pytest.param((0, 2), marks=pytest.mark.all)])
def test_an_interrupted_training_goes_on_as_if_never_interrupted(
    learn, trained, tmp_path, make_notes, stop
):
    with pytest.raises(KeyboardInterrupt):
        learn(tmp_path, progress=make_notes(stop))
    assert not (tmp_path / "a.safetensors").exists()
    learn(tmp_path)
    assert (tmp_path / "a.safetensors").read_bytes() == (trained[1] / "a.safetensors").read_bytes()
    notes = make_notes()
    assert learn(tmp_path, progress=notes).digest == trained[0].digest
    assert not notes.steps  # it is only written again


def test_the_snapshot_is_laid_out_as_the_authors(trained):

    found = torch.load(trained[1] / "snapshot.pth", weights_only=True)
    assert found.keys() == {"epoch", "iteration", "model", "optimizer", "scheduler", "generator"}
    assert (found["epoch"], found["iteration"]) == (2, 4)
    rate = found["optimizer"]["param_groups"][0]["lr"]
    assert abs(rate - 1.1e-3 * 0.97**2) < 1e-12
    weights = SceneGraphLocEncoder(trained[1] / "snapshot.pth", features="colour")
    assert trained[0].digest in weights.key


def _drawn(rng, kinds, name):
    n, edges = 6, [(a, b) for a in range(6) for b in range(6) if a != b]
    chosen = rng.permutation(len(kinds))[:n]

    def near(rows):
        seen = kinds[chosen[rows]] + 0.1 * rng.normal(size=(len(rows), 17))
        return (seen / np.linalg.norm(seen, axis=1, keepdims=True)).astype(np.float32)

    room = Room(
        name, tuple(map(str, range(n))), tuple(f"kind {k}" for k in chosen),
        np.zeros((n, 16, 3), np.float32), np.zeros((n, 3)), np.array(edges),
        np.zeros((n, 41), np.float32), np.zeros((n, 164), np.float32), np.arange(n),
        near(np.arange(n)), np.tile(np.float32([0, 0, 0, 1, 0, 0, 0]), (n, 1)),
    )  # fmt: skip
    halves = [np.repeat([rng.permutation(n)[:2]], 3, axis=0).repeat(2, axis=1) for _ in range(3)]
    features = tuple(near(half.ravel()).reshape(3, 4, 17) for half in halves)
    return Lesson(name, room, None, features, tuple(half.ravel() + 1 for half in halves))


def test_a_short_training_tells_patches_of_rooms_never_learned(rng):
    kinds = rng.normal(size=(9, 17))
    kinds /= np.linalg.norm(kinds, axis=1, keepdims=True)
    drawn = [_drawn(rng, kinds, f"room {i}") for i in range(20)]
    options = TrainOptions(batch=6, others=2, points=16, rate=1e-2, seed=1, elastic=False)
    trainer = Trainer(drawn[:14], Widths.small(17), options, "cpu")
    untrained = evaluate(trainer.network, drawn[14:], "cpu")
    loss = [trainer.epoch(Progress()) for _ in range(8)]
    after = evaluate(trainer.network, drawn[14:], "cpu")
    assert loss[-1] < loss[0] - 0.5
    assert untrained.patch < 0.35  # a sixth by chance
    assert after.patch > 0.55


def test_changed_homes_have_targets_by_id(lessons):
    for lesson in lessons.values():
        marks = lesson.marks[0]
        now, then = lesson.targets(0), lesson.targets(0, earlier=True)
        assert np.array_equal(now, marks - 1)
        known = then >= 0
        assert [lesson.room.ids[k] for k in now[known]] == [
            lesson.earlier.ids[k] for k in then[known]
        ]


def test_lessons_are_kept_whole_and_made_again_if_damaged(lessons, tmp_path):
    lesson, path = next(iter(lessons.values())), tmp_path / "a.lesson"
    write_lesson(path, lesson)
    again, whole = read_lesson(path), path.read_bytes()
    assert again.name == lesson.name
    for name in ("points", "edges", "views", "poses", "owner", "relations"):
        assert np.array_equal(getattr(again.room, name), getattr(lesson.room, name))
    assert again.earlier.ids == lesson.earlier.ids
    assert all(np.array_equal(a, b) for a, b in zip(again.marks, lesson.marks, strict=True))
    assert all(np.array_equal(a, b) for a, b in zip(again.features, lesson.features, strict=True))
    assert kept_lesson(path, lambda: pytest.fail("it is kept")).name == lesson.name
    path.write_bytes(whole[: len(whole) // 2])
    assert kept_lesson(path, lambda: lesson) is lesson
    assert path.read_bytes() == whole


@pytest.mark.parametrize("spoil", ["cut", "key", "no generator"])
def test_a_damaged_snapshot_is_named(learn, trained, tmp_path, spoil):
    at = shutil.copytree(trained[1], tmp_path / "copy")
    path = at / "snapshot.pth"
    found = torch.load(path, weights_only=True)
    if spoil == "key":
        del found["model"]["sg_encoder.fusion.weight"]
    elif spoil == "no generator":
        del found["generator"]
    torch.save(found, path)
    if spoil == "cut":
        path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(InputError, match=r"snapshot\.pth"):
        learn(at)


def test_what_cannot_be_trained_is_refused(tmp_path, learn, trained):
    for wrong in ({"epochs": 0}, {"batch": 0}, {"rate": 0.0}, {"decay": 1.5}, {"others": -1}):
        with pytest.raises(OptionError, match=next(iter(wrong))):
            replace(OPTIONS, **wrong)
    worlds, out = homes(3), tmp_path / "a.safetensors"
    for given, path, words in (
        (worlds[:2], out, "at least two"),
        ([*worlds[:2], worlds[0]], out, "rename"),
        (worlds, tmp_path / "a.pth", "safetensors"),
    ):
        with pytest.raises(OptionError, match=words):
            train(given, path, folder=tmp_path)
    with pytest.raises(OptionError, match="features of 3 numbers"):
        learn(tmp_path, widths=Widths.small(3))
    with pytest.raises(OptionError, match="another folder"):
        learn(trained[1], replace(OPTIONS, rate=0.5))
    with pytest.raises(OptionError, match="homes"):
        homes(0)


def test_maps_of_a_folder_come_with_their_captures(room, walk, tmp_path):
    for name in ("room", "bare", "single"):  # without captures, one is passed over
        room.save(tmp_path / f"{name}.scene")
    for at in ("room/one", "room/two", "single"):
        shutil.copytree(walk.path, tmp_path / at)
    (tmp_path / "room" / "notes").mkdir()
    world, single = folder(tmp_path)
    material = world.make()
    assert [len(c) for c in (*material.now.captures, *material.pictures)] == [10, 10]
    lesson = Teacher(ColourFeatures()).lesson(world)
    assert len(lesson.marks) == 10
    assert lesson.earlier is None
    assert (np.concatenate(lesson.marks) > 0).mean() > 0.9  # the poses are in the map
    material = single.make()  # its one capture serves for both
    assert [f.index for f in material.now.captures[0]] == [0, 2, 4, 6, 8]
    assert [f.index for f in material.pictures[0]] == [1, 3, 5, 7, 9]


def test_folders_without_maps_and_captures_outside_are_named(room, survey, tmp_path):
    with pytest.raises(OptionError, match="scene build"):
        folder(tmp_path)
    far = survey.odometry.copy()
    far[:, :3, 3] += 500.0

    def lost():

        return Material(SurveyedScene(room, (survey,)), (place_capture(survey, far),))

    with pytest.raises(OptionError, match="poses in the map's frame"):
        Teacher(ColourFeatures()).lesson(World("lost", lost))
