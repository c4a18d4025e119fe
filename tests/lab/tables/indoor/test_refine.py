import json
import math

import numpy as np
import pytest

from placegraph.core.estimate import PoseEstimate, PoseMode, Refinement, Status
from placegraph.core.geometry import (
    Camera,
    level_from_camera,
    pose_matrix,
    rotation_from_vector,
    split_pose,
)
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame
from placegraph_lab.tables.indoor.metrics import position_error, rotation_error
from placegraph_lab.tables.indoor.refine import (
    GICP,
    MATCHERS,
    QUICK,
    ask,
    measure_refined,
    refine_jobs,
    refine_score,
    sigmas_of,
    spread,
)
from placegraph_lab.tables.indoor.windows import Window, disturb_pose
from placegraph_lab.tables.named import indoor_refine as script

JOBS = {job.name: job for job in refine_jobs()}
TRUTH = pose_matrix([1.0, 2.0, 1.6, 0.3], level_from_camera([0.0, 1.0, 0.0]))


def mode(pose, sigma=0.02):
    return PoseMode(pose, split_pose(pose)[0], np.eye(6) * sigma**2, 0.9, "", pose)


class Scene:
    """A map that knows the answers to a window, and writes down what it is asked."""

    def __init__(self, truth):
        self.truth = truth
        self.asked = []

    def localize(self, capture, **options):
        self.asked.append((capture, options))
        coarse = disturb_pose(self.truth, np.random.default_rng(options["seed"]), 0.3, 3.0)
        return self._estimate(coarse)

    def refine(self, capture, map_from_camera, **options):
        self.asked.append((capture, {"start": map_from_camera, **options}))
        return self._estimate(map_from_camera)

    def _estimate(self, coarse):
        said = Refinement(True, "", mode(coarse), coarse[None], {"seconds": {"depth": 0.25}})
        return PoseEstimate(Status.OK, (mode(self.truth),), "", refinement=said)


@pytest.fixture
def window():
    """Two frames with depth."""
    camera = Camera(8, 6, 10.0, 10.0, 4.0, 3.0)
    frames = [
        Frame.from_arrays(
            np.zeros((6, 8, 3), np.uint8), camera, depth=np.ones((6, 8)), stamp=i, index=i
        )
        for i in range(2)
    ]
    return Window("b in a", Capture.from_frames(frames), TRUTH, coverage=0.8)


def test_every_row_has_a_name_of_its_own_and_something_to_refine_by():
    assert len(JOBS) == len(refine_jobs())
    assert all(job.depth or job.by != "none" for job in JOBS.values())
    papers = {"sift, paper's recipe", "xfeat, paper's recipe"}
    assert {job.by for job in JOBS.values()} == {*MATCHERS, *GICP, *papers}
    assert all(not job.depth for job in JOBS.values() if job.by in papers)
    assert not JOBS["house found: semantic + colour, sift"].depth
    assert JOBS["house found: all, none"].depth
    assert all(job.coarse.options.colour for job in JOBS.values() if job.coarse)
    assert not JOBS["a in b disturbed: no depth, xfeat"].depth
    for name in QUICK:
        assert any(j == name or (name[-1] == "*" and j.startswith(name[:-1])) for j in JOBS)


def test_a_found_pose_is_measured_before_and_after(window):
    scene = Scene(TRUTH)
    got = ask(
        JOBS["b in a found: no labels: depth + colour, sift"], scene, window,
        matcher="sift", seed=3, device="cpu",
    )  # fmt: skip
    capture, options = scene.asked[0]
    assert capture is window.capture
    assert options["refine"].images is True
    assert (options["matcher"], options["seed"], options["encoder"]) == ("sift", 3, None)
    assert options["options"].depth
    assert got.before == pytest.approx((0.3, 3.0))
    assert got.after.position == pytest.approx(0.0, abs=1e-9)
    assert (got.after.coverage, got.after.place) == (0.8, "b in a")


def test_a_disturbed_start_is_the_same_for_all_and_the_truth_is_not_told(window):
    scene = Scene(TRUTH)
    for by in ("auto", "none"):
        got = ask(JOBS[f"b in a disturbed: depth, {by}"], scene, window, matcher=by, seed=5)
        assert got.before == pytest.approx((0.2, 10.0))
    (_, first), (_, second) = scene.asked
    assert (first["start"] == second["start"]).all()
    assert (first["options"].images, second["options"].images) == ("auto", False)
    assert position_error(first["start"], TRUTH) == pytest.approx(0.2)
    assert rotation_error(first["start"], TRUTH) == pytest.approx(10.0)


@pytest.fixture
def asked(monkeypatch, shared):  # noqa: ARG001  # the benchmark's data
    """The benchmark, its maps replaced by names and its refiner by one that knows the truth."""
    asked = []

    def fake(job, scene, window, *, matcher, seed, device):
        assert scene == job.place
        asked.append((job.name, window.name, seed))
        return ask(job, Scene(window.truth), window, matcher=matcher, seed=seed, device=device)

    monkeypatch.setattr(script, "ask", fake)
    monkeypatch.setattr("placegraph_lab.tables.indoor.refine.encoder_of", lambda *_: None)
    monkeypatch.setattr(
        "placegraph_lab.tables.indoor.bench.measure_coverage", lambda _, window: window
    )
    monkeypatch.setattr(script.Bench, "scene", lambda _, name: name)
    return asked


@pytest.fixture
def call(measure, tmp_path):
    places = ("--cache", tmp_path / "cache", "--out", tmp_path / "out.json")
    return lambda *options: measure("indoor_refine", *places, *options)


def test_the_script_goes_on_where_it_was_cut(asked, call, tmp_path):
    options = ("--only", "house disturbed: depth, auto; house found: all, auto")
    first = call(*options, "--windows", "10,25")
    assert first.exit_code == 0, first.output
    assert len(asked) == 2 * (40 + 8 + 2)  # and one of each length to warm up
    assert {seed for _, _, seed in asked} == {0, 1}
    asked.clear()
    journal = tmp_path / "cache/indoor_refine.jsonl"
    journal.write_text("".join(journal.read_text().splitlines(keepends=True)[:-3]))
    again = call(*options, "--windows", "10,25")
    assert len(asked) == 3 + 1
    heading = "#### House, from 0.2 m and 10 degrees off, 10 frames"
    assert heading in first.stdout
    assert heading in again.stdout
    written = json.loads((tmp_path / "out.json").read_text())
    assert [(r["row"].split(":")[0], r["length"]) for r in written["rows"]] == [
        (f"house {start}", length) for start in ("found", "disturbed") for length in (10, 25)
    ]
    row = written["rows"][2]
    assert row["score"]["after"]["recall"][0] == 1.0
    assert {"unchanged", "changed", "seq00", "seq07"} <= set(row["parts"])
    assert row["normalised_errors"]["refined"]["count"] == 40


LEVEL = level_from_camera([0.0, 1.0, 0.0])


def at(x=0.0, yaw_deg=0.0):
    return pose_matrix([x, 0.0, 1.6, math.radians(yaw_deg)], LEVEL)


def estimate(pose, *, coarse=None, accepted=True, **stats):
    """Estimate at a pose; with `coarse`, one that was refined."""
    said = None
    if coarse is not None:
        said = Refinement(accepted, "So it is.", mode(coarse), coarse[None], stats)
    return PoseEstimate(Status.OK, (mode(pose),), "", refinement=said)


@pytest.fixture
def here():
    """Window of two frames whose last stands at the origin."""
    camera = Camera(8, 6, 10.0, 10.0, 4.0, 3.0)
    image = np.zeros((6, 8, 3), np.uint8)
    frames = [Frame.from_arrays(image, camera, stamp=i, index=i) for i in range(2)]
    return Window("seq01", Capture.from_frames(frames), at(), changed=True)


def test_one_estimate_gives_both_sides(here):
    seconds = {"depth": 0.2, "images": 0.3}
    got = measure_refined(estimate(at(0.01), coarse=at(0.3, 4.0), seconds=seconds), here, seconds=2)
    assert got.before == pytest.approx((0.3, 4.0))
    assert (got.after.position, got.after.rotation) == pytest.approx((0.01, 0.0), abs=1e-6)
    assert (got.accepted, got.reason, got.candidate) == (True, "So it is.", None)
    assert (got.refine_seconds, got.after.seconds) == (0.5, 2)
    assert got.sigmas == pytest.approx((-0.5, 0, 0, 0, 0, 0), abs=1e-6)
    assert not got.harmful
    assert not got.wrongly_refused


def test_what_was_wrongly_refused_is_known_where_the_pose_was_kept(here):
    refused = {"coarse": at(0.3), "accepted": False}
    stats = ({"candidate": at(0.01).tolist()}, {"candidate": at(0.01, 3.0).tolist()}, {})
    better, twisted, silent = (
        measure_refined(estimate(at(0.3), **refused, **more), here, seconds=1) for more in stats
    )
    assert [r.wrongly_refused for r in (better, twisted, silent)] == [True, False, False]
    assert refine_score([better, twisted]).wrongly_refused == 0.5
    assert math.isnan(refine_score([silent]).wrongly_refused)
    assert refine_score([better, silent]).accepted == 0.0


def test_the_spread_of_honest_covariances_is_normal(here, rng):
    mixing = rng.normal(size=(6, 6)) * np.array([[0.02, 0.03, 0.01, 0.01, 0.004, 0.02]]).T
    covariance = mixing @ mixing.T
    results = []
    for off in rng.multivariate_normal(np.zeros(6), covariance, 800):
        pose = at()
        pose[:3, 3] -= off[:3]
        pose[:3, :3] = rotation_from_vector(-off[3:]) @ pose[:3, :3]
        found = PoseMode(pose, split_pose(pose)[0], covariance, 0.9, "", pose)
        assert len(sigmas_of(found, here.truth)) == 6
        results.append(measure_refined(PoseEstimate(Status.OK, (found,), ""), here, seconds=1))
    s = spread(results)
    assert s["count"] == 800
    assert s["rms"] == pytest.approx([1.0] * 6, abs=0.08)
    for row, share in zip(s["within_sigma"].values(), (0.6827, 0.9545, 0.9973), strict=True):
        assert row == pytest.approx([share] * 6, abs=0.05)
    assert s["within_95_percent"] == pytest.approx(0.95, abs=0.02)
