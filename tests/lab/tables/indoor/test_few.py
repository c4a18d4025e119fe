"""`indoor_few` on a short walk through a drawn corridor of equal doors."""

import json
import shutil
from functools import partial

import numpy as np
import pytest

from placegraph.indoor.build import build_scene
from placegraph.indoor.map.textures import Detail
from placegraph.indoor.mapping.from_capture import FromCapture
from placegraph_lab.tables.indoor.windows import measure_coverage
from placegraph_lab.tables.named import indoor_few as script
from placegraph_lab.tables.named.indoor_few import Answer, Row, pool_rows
from placegraph_lab.tables.runner import Run
from placegraph_lab.worlds.flat.repeating import WORLDS, record_world

SHORT = 12  # frames of the walk


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    """Capture folder of a short walk."""
    return record_world("doors", tmp_path_factory.mktemp("doors"), frames=SHORT)


@pytest.fixture(scope="module")
def maps(tmp_path_factory):
    """Folder for maps."""
    return tmp_path_factory.mktemp("maps")


@pytest.fixture(autouse=True)
def _short(monkeypatch, walk):
    """Ask the short walk; its first frames make a coarse map, and the last show another end."""
    pytest.importorskip("cv2")
    copy = partial(shutil.copytree, walk, dirs_exist_ok=True)
    coarse = partial(build_scene, detail=Detail(error=0.03, baked=0.04))
    monkeypatch.setattr(script, "build_scene", coarse)
    monkeypatch.setattr(script, "FromCapture", partial(FromCapture, voxel=0.05))
    monkeypatch.setattr(script, "record_world", lambda _, folder, **_seed: copy(folder))
    monkeypatch.setattr(script, "LEFT_OUT", {"doors": ((slice(0, 4, 1), slice(SHORT - 2, SHORT)),)})


def test_present_and_absent_windows_of_a_drawn_corridor(measure, maps, tmp_path):
    options = ("--sets", "doors", "--frames", "1,3", "--senses", "both", "--half", "all")
    where = ("--windows", "2", "--cache", maps, "--out", tmp_path / "out.json")
    done = measure("indoor_few", *options, *where)
    assert done.exit_code == 0, done.output
    present, absent = json.loads((tmp_path / "out.json").read_text())["rows"]
    assert (present["part"], absent["part"]) == ("present", "absent")
    assert {n: len(found) for n, found in present["answers"].items()} == {"1": 2, "3": 2}
    assert {n: len(found) for n, found in absent["answers"].items()} == {"1": 2, "3": 0}
    assert all(a["position"] is not None for n in present["answers"].values() for a in n)
    assert all(a["position"] is None for a in absent["answers"]["1"])
    assert "| doors, a part not in its map |" in done.stdout


def test_left_out_parts_are_not_in_the_map_and_the_others_are(maps):
    known = script.Maps(Run("indoor_few", maps, maps), fresh=False)
    source, scene = known.source("doors"), known.scene("doors", 0, 4, 1)
    frames = [slice(0, 4), slice(SHORT - 2, SHORT)]
    seen = [
        [measure_coverage(scene, w).coverage for w in source.windows(rows, 1, 9)] for rows in frames
    ]
    assert min(seen[0]) > 0.7
    assert max(seen[1]) < 0.01


def test_windows_are_drawn_from_the_frames_asked_alone(walk):
    source = script.Source.open("doors", walk)
    windows = source.windows(slice(1, None, 2), 3, 2)
    assert [[f.index for f in w.capture] for w in windows] == [[1, 3, 5], [7, 9, 11]]
    assert np.array_equal(windows[1].truth, source.truth[11])
    assert not np.allclose(windows[1].capture[-1].odometry, source.truth[11])
    assert source.windows(slice(1, None, 2), 7, 2) == []


@pytest.mark.parametrize("name", list(WORLDS))
def test_the_same_seed_draws_the_same_world(name):
    one, same, other = (WORLDS[name](np.random.default_rng(seed)).rows for seed in (1, 1, 2))
    assert one == same
    assert one != other


def _answer(position, status="OK"):
    return Answer("w", 1, position, 1.0, status, 0.9, 5.0, "")


def test_false_answers_are_certain_and_far_off():
    answers = tuple(_answer(*a) for a in ((0.05,), (0.3,), (0.7,), (0.7, "LOST"), (np.inf,)))
    row = Row("here", "present", "both", {1: answers, 2: ()})
    assert row.shares("right") == [0.2, None]
    assert row.false == [2, 0]
    both = pool_rows([row, row, Row("there", "absent", "both", {1: answers, 2: ()})], "present")
    assert [len(r.answers[1]) for r in both] == [10]
