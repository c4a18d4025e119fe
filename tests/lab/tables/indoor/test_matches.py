"""Whether a match is right, and what a single view's pose is worth, where the truth is known."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from placegraph.core.geometry import Camera, level_from_camera, pose_matrix
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.refine.matching import Matches
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame
from placegraph_lab.tables.indoor.metrics import position_error, rotation_error
from placegraph_lab.tables.indoor.windows import Window
from placegraph_lab.tables.named import indoor_matchers as script
from placegraph_lab.tables.named.indoor_matchers import (
    Query,
    Start,
    Trial,
    ask,
    judged,
    lift,
    pixel_errors,
    report,
    solve,
    starts,
    summary,
    to_dict,
    turned,
)

CAMERA = Camera(120, 80, 80.0, 80.0, 60.0, 40.0)
TRUTH = pose_matrix([0.0, 0.0, 1.5, 0.0], level_from_camera([0.0, 1.0, 0.0]))
"""At the origin, looking along x."""


def _wall(x, low, high):
    """Corners (4, 3) and triangles of a wall across x from `low` to `high` (y, z)."""
    corners = [(x, y, z) for y in (low[0], high[0]) for z in (low[1], high[1])]
    return np.array(corners, float), np.array([[0, 1, 2], [1, 3, 2]])


@pytest.fixture(scope="module")
def scene():
    """A far wall, a side wall at an angle to it, and a pillar before the far one, a bit to the left."""
    parts = [
        _wall(4.0, (-5, -1), (5, 4)),
        _wall(1.5, (0.3, -1), (0.6, 4)),
        (np.array([[0.5, 2, -1], [0.5, 2, 4], [4, 3, -1], [4, 3, 4.0]]), np.array([[0, 1, 2], [1, 3, 2]])),
    ]  # fmt: skip
    vertices = np.concatenate([v for v, _ in parts])
    rng = np.random.default_rng(0)
    mesh = Mesh(
        vertices=vertices,
        triangles=np.concatenate([t + 4 * i for i, (_, t) in enumerate(parts)]),
        object_of=np.repeat(np.arange(len(parts)), 2),
        colours=rng.integers(0, 256, (len(vertices), 3), dtype=np.uint8),
        uv=np.zeros((len(vertices), 2)),
        texture_of=np.zeros(2 * len(parts), int),
        textures=(np.full((1, 1, 3), 255, np.uint8),),
    )
    ids = ["wall", "pillar", "side"]
    return SceneMap.create(mesh, ids, ids, floor=-1.0)


def _query(scene, starts_, changed=False, coverage=None):
    frame = Frame.from_arrays(np.zeros((80, 120, 3), np.uint8), CAMERA)
    window = Window("seq00", Capture.from_frames([frame]), TRUTH, changed, coverage)
    return Query(window, scene, tuple(starts_))


def _true_matches(scene, start, rng, count=300):
    """Points of a rendered view, and where the query truly sees those points."""
    rendered = rng.uniform(0, (120, 80), (count, 2))
    points = lift(scene, start.map_from_camera, CAMERA, rendered)
    seen = (points - TRUTH[:3, 3]) @ TRUTH[:3, :3]
    at = CAMERA.project(seen)
    keep = np.isfinite(at).all(axis=1)
    keep[keep] &= ((at[keep] > 0) & (at[keep] < (120, 80))).all(axis=1)
    return Matches(at[keep], rendered[keep], np.ones(keep.sum())), points[keep]


@pytest.mark.parametrize("yaw", [0.0, 0.3, -0.5])
def test_true_matches_are_right_and_moved_ones_by_as_much_wrong(scene, rng, yaw):
    start = Start("turned", turned(TRUTH, yaw))
    matches, points = _true_matches(scene, start, rng)
    query = _query(scene, [start])
    errors, lifted = pixel_errors(query, start, matches)
    assert len(matches) > 60
    assert np.allclose(lifted, points)
    assert errors.max() < 1e-3  # turned on its place the camera sees what it saw
    off = Matches(matches.query + np.array([4.0, 0.0]), matches.rendered, matches.confidence)
    found = judged(query, start, off, 0)
    assert found.right == (0, len(off), len(off))


def test_what_is_hidden_from_the_query_is_no_right_match(scene, rng):
    beside = TRUTH.copy()
    beside[1, 3] += 0.6  # looks past the pillar
    start = Start("beside", beside)
    matches, points = _true_matches(scene, start, rng, 2000)
    errors, _ = pixel_errors(_query(scene, [start]), start, matches)
    hidden = np.isinf(errors)
    # behind the pillar, seen from the origin: y / x between 0.3 / 1.5 and 0.6 / 1.5, beyond x = 1.5
    slope = points[:, 1] / points[:, 0]
    behind = (slope > 0.2) & (slope < 0.4) & (points[:, 0] > 1.6)
    clear = (np.abs(slope - 0.2) > 0.01) & (np.abs(slope - 0.4) > 0.01)
    assert behind.sum() > 50
    assert np.array_equal(hidden[clear], behind[clear])
    assert errors[~hidden].max() < 1e-3


def test_the_pose_of_a_view_is_found_among_outliers(scene, rng):
    pytest.importorskip("poselib", reason="needs PoseLib: pip install poselib")
    start = starts(TRUTH, rng)[1]
    matches, points = _true_matches(scene, start, rng)
    pixels = matches.query + rng.normal(scale=0.3, size=matches.query.shape)
    wrong = rng.random(len(pixels)) < 0.4
    pixels[wrong] = rng.uniform(0, (120, 80), (wrong.sum(), 2))
    pose, inliers = solve(CAMERA, pixels, points, 0)
    assert position_error(pose, TRUTH) < 0.03
    assert rotation_error(pose, TRUTH) < 0.5
    assert inliers >= 0.9 * (~wrong).sum()
    again, _ = solve(CAMERA, pixels, points, 0)
    assert np.array_equal(pose, again)
    assert solve(CAMERA, pixels[:5], points[:5], 0) == (None, 0)


class Oracle:
    """Knows the truth, but of every second match only."""

    name = "oracle"

    def __init__(self, scene, starts_, rng):
        self.truth = [_true_matches(scene, s, rng)[0] for s in starts_]

    def match(self, query, views, *, masks=None):
        assert query.shape == (80, 120, 3)
        assert all(v.shape == (80, 120, 3) and m.any() for v, m in zip(views, masks, strict=True))
        found = []
        for matches in self.truth[: len(views)]:
            shown = matches.query.copy()
            shown[::2] += 30.0
            found.append(Matches(shown, matches.rendered, matches.confidence))
        return found


def test_a_trial_counts_what_is_right(scene, rng):
    pytest.importorskip("poselib", reason="needs PoseLib: pip install poselib")
    asked = [Start("true", TRUTH), *starts(TRUTH, rng)[2:4]]
    trial = ask("oracle", Oracle(scene, asked, rng), [_query(scene, asked)])
    assert [f.kind for f in trial.found] == ["true", "turned 15", "turned 15"]
    assert len(trial.seconds) == len(trial.view_seconds) == 1
    for f in trial.found:
        assert f.matches > 60
        assert f.right[1] == f.matches // 2
        assert f.within(0.10, 5.0)
    numbers = summary(trial.found)
    assert numbers["recall"] == [1.0, 1.0]
    assert np.allclose(numbers["right"], 0.5, atol=0.01)
    json.dumps(to_dict(trial), allow_nan=False)
    text = report([Trial.joined("oracle", [trial, trial])])
    assert "#### house, unchanged, view true, 2 pairs" in text
    assert "view turned 45" not in text
    assert "| oracle |" in text


def test_the_script_writes_what_it_prints(measure, monkeypatch, scene, rng, tmp_path):
    pytest.importorskip("poselib", reason="needs PoseLib: pip install poselib")
    asked = [Start("true", TRUTH)]
    options = []

    def make(name, **chosen):
        options.append((name, chosen))
        return Oracle(scene, asked, rng)

    monkeypatch.setattr(script, "matcher", make)
    monkeypatch.setattr(
        script,
        "queries",
        lambda _, place, seed: [_query(scene, asked)] * 2 if (place, seed) == ("house", 3) else [],
    )
    out = tmp_path / "out.json"
    only = "sift ratio=0.8 upright=False; xfeat"
    result = measure("indoor_matchers", "--only", only, "--seed", 3, "--out", out)
    assert result.exit_code == 0, result.output
    assert [name for name, _ in options] == ["sift", "xfeat"]
    assert options[0][1] == {"device": "cpu", "ratio": 0.8, "upright": False}
    assert options[1][1]["weights"].name == "xfeat.pt"
    record = SimpleNamespace(**json.loads(out.read_text()))
    assert [row["matcher"] for row in record.rows] == ["sift ratio=0.8 upright=False", "xfeat"]
    assert record.rows[0]["parts"]["house, unchanged, true"]["pairs"] == 2
    assert "view true, 2 pairs" in result.output
