"""`placegraph scene localize`: frames of a drawn room find their pose on the command line."""

import shutil
import sys
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from tests.cli.failing import fails

from placegraph.cli.scene_localize import pose_words, refinement_words, show
from placegraph.cli.scene_options import chosen_frames, matcher_of
from placegraph.core.estimate import Evidence, ObjectRef, PoseEstimate, PoseMode, Refinement, Status
from placegraph.core.geometry import level_from_camera, pose_matrix, split_pose
from placegraph.errors import InputError, OptionError
from placegraph.indoor.encode.networks import SLOPE
from placegraph.indoor.options import FilterOptions, PoseSearchOptions
from placegraph.indoor.refine import RefineOptions
from placegraph.indoor.refine.matching.sift import SiftMatcher
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.tum import read_tum

FRAMES = 6


def test_json_pictures_and_trajectory(run, room, tmp_path):
    png, gif, tum = (tmp_path / f"a.{ending}" for ending in ("png", "gif", "tum"))
    before = room.map.read_bytes()
    result = run(
        "scene", "localize", room.map, room.walk, "--json",
        "--png", png, "--gif", gif, "--tum", tum,
    )  # fmt: skip
    assert (result.code, result.err) == (0, "")
    told = result.json
    assert told["status"] in {"OK", "AMBIGUOUS"}
    assert told["frames"] == list(range(FRAMES))
    best = told["modes"][0]
    pose, _ = split_pose(room.truth[-1])
    assert (best["x"], best["y"]) == pytest.approx(pose[:2], abs=0.2)
    assert np.cos(np.radians(best["yaw_deg"]) - pose[3]) > np.cos(np.radians(5))
    assert best["evidence"]

    written = read_tum(tum)
    assert written.poses[-1] == pytest.approx(np.array(best["map_from_camera"]), abs=1e-6)
    assert len(written) == FRAMES
    apart = np.linalg.norm(written.poses[:, :3, 3] - room.truth[:, :3, 3], axis=1)
    assert apart.max() < 0.3
    assert written.stamps == pytest.approx(read_tum(room.walk / "odometry.tum").stamps)

    plain = run("scene", "localize", room.map, room.walk, "--json").json
    timed = ("stats", "refinement")
    assert [told[k] for k in told if k not in timed] == [plain[k] for k in plain if k not in timed]
    assert told["refinement"]["reason"] == plain["refinement"]["reason"]
    with Image.open(gif) as image:
        assert image.n_frames == FRAMES + 1, "each frame of the pass, and the result"

    with Image.open(png) as image:
        assert image.width == 1200
    assert room.map.read_bytes() == before


def test_some_frames_as_text(run, room):
    result = run("scene", "localize", room.map, room.walk, "--frames", "2:5", "--quiet")
    assert (result.code, result.err) == (0, "")
    status, _, reason = result.out.splitlines()[0].partition(": ")
    assert status in {"OK", "AMBIGUOUS", "LOST"}
    assert reason
    numbers = result.out.splitlines()[1].split()
    assert numbers[:2] == ["1.", "x"]
    pose, _ = split_pose(room.truth[4])
    assert float(numbers[2]) == pytest.approx(pose[0], abs=0.3)
    assert "yaw" in numbers
    assert "+  " in result.out, "what spoke for it"
    again = run("scene", "localize", room.map, room.walk, "--frames", "2:5", "--quiet")
    assert again.out == result.out, "the same seed gives the same answer"


def test_options_reach_the_filter(run, room):
    at, _ = split_pose(room.truth[0])
    told = run(
        "scene", "localize", room.map, room.walk, "--frames", ":5", "--json", "--no-refine",
        "--near", f"{at[0]:.1f},{at[1]:.1f},{at[2]:.1f}", "--radius", "0.5", "--yaw-deg",
        f"{np.degrees(at[3]):.0f}", "--height", "1.6", "--every", "0.3", "--no-colour",
        "--device", "cpu", "--seed", "7",
    ).json  # fmt: skip
    assert told["frames"] == [0, 2, 4], "0.2 s apart; every 0.3 s"
    pose, _ = split_pose(room.truth[4])
    assert told["modes"][0]["x"] == pytest.approx(pose[0], abs=0.3)
    assert not any(e["statement"] == "colour" for e in told["modes"][0]["evidence"])
    assert told["stats"]["particles"] == [], "fitted from where the prior says"


def test_presets_reach_the_filter_and_the_refinement(run, room, monkeypatch):
    asked = []

    def localize(*_, options, refine, **__):
        asked.append((options, refine))
        raise OptionError("enough")

    monkeypatch.setattr(SceneMap, "localize", localize)
    for more in (
        ["--preset", "paper", "--height", "1.4", "--no-depth"],
        ["--preset", "coarse"],
        ["--preset", "coarse", "--no-refine"],
        ["--preset", "published"],
        [],
        ["--preset", "papers"],
    ):
        assert run("scene", "localize", room.map, room.walk, *more).code != 0
    paper = replace(FilterOptions.paper(), heights=(1.4,), depth=False)
    assert asked == [
        (paper, RefineOptions.paper()),
        (FilterOptions.coarse(), RefineOptions.paper()),
        (FilterOptions.coarse(), False),
        (FilterOptions.published(), False),
        (PoseSearchOptions(), RefineOptions()),
    ]


def test_depth_by_a_network(run, room, tmp_path, monkeypatch):
    asked = []

    def localize(_, capture, *, options, refine, **__):
        asked.append((capture[0].depth().mean(), options.likelihood.depth_slope, refine.depth))
        raise OptionError("enough")

    network = SimpleNamespace(
        metric=True, size=lambda *_: (16, 9), depth=lambda _: np.full((9, 16), 2.0)
    )
    monkeypatch.setattr(SceneMap, "localize", localize)
    monkeypatch.setattr("placegraph.indoor.encode.networks.depth_network", lambda *_: network)
    images = tmp_path / "walk"
    shutil.copytree(room.walk, images, ignore=shutil.ignore_patterns("depth"))
    asking = ("scene", "localize", room.map)
    given = ("--depth-network", "net.tflite")
    assert "enough" in run(*asking, images, *given).err
    assert asked == [(2.0, SLOPE, False)]
    fails(run(*asking, room.walk, *given), 7, "measured depth; remove the depth")
    fails(run(*asking, images, *given, "--no-depth"), 7, "--no-depth")


def test_the_papers_six_views_are_rendered_and_matched(run, room, monkeypatch):
    pytest.importorskip("cv2", reason="needs OpenCV: pip install 'placegraph[sift]'")
    monkeypatch.setitem(sys.modules, "romatch.models.model_zoo", None)
    few = replace(FilterOptions(), answer="mle")  # the recipe's own start takes a minute
    monkeypatch.setattr(FilterOptions, "paper", lambda: few)
    seen, match = [], SiftMatcher.match

    def counted(self, query, views, **more):
        seen.append(len(views))
        return match(self, query, views, **more)

    monkeypatch.setattr(SiftMatcher, "match", counted)
    ask = ("scene", "localize", room.map, room.walk, "--frames", "1:4", "--preset", "paper")
    result = run(*ask, "--json")
    assert (result.code, result.err) == (0, "")
    assert seen == [6, 6, 6]
    assert result.json["refinement"]["stats"]["matcher"] == "sift"


def off(told, truth):
    """How far the answered pose lies from a true one [m]."""
    return np.linalg.norm(np.array(told["map_from_camera"])[:3, 3] - truth[:3, 3])


def test_a_pose_is_refined_and_every_frame_with_it(run, room, tmp_path):
    tum, look = tmp_path / "a.tum", tmp_path / "look.png"
    ask = ("scene", "localize", room.map, room.walk, "--frames", "1:6")
    result = run(*ask, "--json", "--tum", tum, "--overlay", look)
    assert (result.code, result.err) == (0, "")
    told, refinement = result.json, result.json["refinement"]
    assert refinement["accepted"], refinement["reason"]
    assert refinement["stats"]["matcher"] == "guided"
    best, coarse = told["modes"][0], refinement["coarse"]
    assert np.shape(best["covariance"]) == np.shape(coarse["covariance"]) == (6, 6)
    assert off(best, room.truth[-1]) < max(0.04, off(coarse, room.truth[-1]))
    moved = np.subtract(best["map_from_camera"], coarse["map_from_camera"])[:3, 3]
    assert np.linalg.norm(moved) == pytest.approx(refinement["stats"]["shift_m"], abs=1e-4)

    written = read_tum(tum)
    assert written.poses == pytest.approx(np.array(told["trajectory"]), abs=1e-6)
    assert written.stamps == pytest.approx(read_tum(room.walk / "odometry.tum").stamps[1:])
    # plain walls alone are seen: how high the camera is they do not tell, and the answer knows it
    apart = np.linalg.norm(written.poses[:, :2, 3] - room.truth[1:, :2, 3], axis=1)
    high = np.abs(written.poses[:, 2, 3] - room.truth[1:, 2, 3])
    assert high.max() < 3.0 * np.sqrt(best["covariance"][2][2])
    assert apart.max() < 0.06, "all frames are refined, not the last alone"
    assert refinement["reason"] in tum.read_text(encoding="utf-8").splitlines()[0]
    with Image.open(look) as sheet:
        rows = sheet.height / (90 + 20)
    assert 3.0 <= rows < 4.0, "query and map, lines, and the same before"

    without = run(*ask, "--json", "--no-refine", "--overlay", look).json
    assert without["refinement"] is None
    assert without["modes"][0]["map_from_camera"] == coarse["map_from_camera"]
    with Image.open(look) as sheet:
        assert sheet.height / (90 + 20) < 3.0, "nothing was before"


def test_senses_that_are_off_are_off_for_the_refinement_too(run, room):
    def stats(*options):
        result = run("scene", "localize", room.map, room.walk, "--frames", ":4", "--json", *options)
        return result.json["refinement"]["stats"]

    both = stats()
    assert "depth_cost" in both
    assert set(both["held_back"]) == {"depth", "images"}
    images = stats("--no-depth")
    assert images["matches"] > 0
    assert "depth_cost" not in images
    assert "depth" not in images.get("held_back", ())
    depth = stats("--no-colour")
    assert "matches" not in depth
    assert set(depth["held_back"]) == {"depth"}


def test_a_person_reads_what_became_of_it(run, room):
    ask = ("scene", "localize", room.map, room.walk, "--frames", "2:6")
    lines = run(*ask, "--quiet").out.splitlines()
    (line,) = [line for line in lines if line.startswith("Refined by depth")]
    assert "The pose moved by" in line
    assert line.endswith("°.")
    lines = run(*ask, "--quiet", "--no-depth", "--no-colour").out.splitlines()
    (line,) = [line for line in lines if line.startswith("Not refined: ")]
    assert line.endswith("The coarse pose stands.")
    assert "efined" not in run(*ask, "--quiet", "--no-refine").out


def test_steps_are_told(run, room, monkeypatch):
    told = []

    @contextmanager
    def progress_of(*, hidden):
        assert not hidden
        yield lambda step, *_: told.append(step)

    monkeypatch.setattr("placegraph.cli.scene_localize.progress_of", progress_of)
    run("scene", "localize", room.map, room.walk, "--frames", ":3", "--no-depth")
    assert told.index("matching images") < told.index("checking") < told.index("drawing")


def test_an_image_feature_matcher(run, room):
    pytest.importorskip("cv2", reason="needs OpenCV")
    told = run(
        "scene", "localize", room.map, room.walk, "--frames", ":2", "--json", "--no-depth",
        "--matcher", "sift",
    ).json  # fmt: skip
    assert told["refinement"]["stats"]["matcher"] == "sift"


def test_weights_reach_the_matcher(tmp_path):
    pytest.importorskip("kornia", reason="needs kornia")
    with pytest.raises(InputError, match=r"a\.pt"):
        matcher_of("xfeat", tmp_path / "a.pt", "cpu")


class Rows(list):
    """A capture that is only as long."""

    path = "walk"

    def __getitem__(self, which):
        found = super().__getitem__(which)
        return Rows(found) if isinstance(which, slice) else found


@pytest.mark.parametrize(
    ("text", "rows"),
    [
        (None, range(25)), (":", range(25)), ("10:20", range(10, 20)), ("-5:", range(20, 25)),
        (":-20", range(5)), ("::10", [0, 10, 20]), ("1:9:4", [1, 5]), ("7", [7]), ("-1", [24]),
        ("-3", [22]), ("20:99", range(20, 25)), (" 3 : 5 ", [3, 4]),
    ],
)  # fmt: skip
def test_frames(text, rows):
    assert list(chosen_frames(Rows(range(25)), text)) == list(rows)


@pytest.mark.parametrize(
    "text", ["", "a", "1:b", "1:2:3:4", "1.5", "5:5", "9:3", "30:", "25", "-26", "::0", "9:3:-1"]
)
def test_no_frames(text):
    with pytest.raises(OptionError, match="--frames"):
        chosen_frames(Rows(range(25)), text)


def estimate_of(status, *probabilities, evidence=()):
    pose = np.array([1.25, -2.5, 1.6, np.pi / 2])
    matrix = pose_matrix(pose, level_from_camera((0.0, 1.0, 0.0)))
    covariance = np.diag([9e-4, 16e-4, 1e-4, 1e-5, 1e-5, np.radians(2.0) ** 2])
    modes = tuple(
        PoseMode(matrix, pose, covariance, p, "study", matrix, explain=lambda: evidence)
        for p in probabilities
    )
    return PoseEstimate(status, modes, "Because [of/] that.")


def test_a_mode_in_words(capsys):
    words = pose_words(estimate_of(Status.OK, 0.93).modes[0])
    assert words == (
        "x 1.250 m  y -2.500 m  z 1.600 m  yaw 90.00°   93.0%  ±5.0 cm ±2.00°  in study"
    )
    show(estimate_of(Status.LOST))
    assert capsys.readouterr().out == "LOST: Because [of/] that.\n"


def test_much_evidence_and_many_modes(capsys):
    chairs = (ObjectRef(str(k), "chair", "") for k in range(9))
    evidence = [
        Evidence(f"chair {k}", "for" if k else "against", 9.0 - k, (chair,))
        for k, chair in enumerate(chairs)
    ]
    evidence.append(Evidence("depth", "silent", 0.1, note="62% of [the/] readings"))
    show(estimate_of(Status.AMBIGUOUS, 0.6, 0.3992, 0.0004, evidence=evidence))
    out = capsys.readouterr().out
    for words in ("2. x", "-  chair 0", "+  chair 5", "3 more objects", "62% of [the/] readings"):
        assert words in out
    assert "3. x" not in out
    assert "chair 6" not in out


@pytest.mark.parametrize(
    ("accepted", "reason", "stats", "line"),
    [
        (
            True, "Refined by depth.", {"shift_m": 0.0321, "turn_deg": 0.413},
            "Refined by depth. The pose moved by 3.2 cm and 0.41°.",
        ),
        (
            False, "Not refined: Bad.", {"shift_m": 0.25, "turn_deg": 3.0},
            "Not refined: Bad. The pose given stands; the rejected pose lies 25.0 cm and 3.00° from it.",
        ),
        (False, "Not refined: dark.", {"shift_m": 0.001, "turn_deg": 0.04},
         "Not refined: dark. The pose given stands."),
        (False, "Not refined: PoseLib is missing.", {},
         "Not refined: PoseLib is missing. The pose given stands."),
    ],
)  # fmt: skip
def test_a_refinement_in_words(accepted, reason, stats, line):
    coarse = estimate_of(Status.OK, 0.93).modes[0]
    found = Refinement(accepted, reason, coarse, coarse.map_from_camera[None], stats)
    assert refinement_words(found, "pose given") == line


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (("--frames", "9:"), "--frames"), (("--frames", "x"), "--frames"),
        (("--near", "1"), "--near"), (("--near", "1,b"), "--near"), (("--near", "1,2,3,4"), "--near"),
        (("--near", "nan,2"), "--near is"), (("--near", "1,2", "--radius", "0"), "--radius"),
        (("--near", "1,2", "--radius", "inf"), "--radius"), (("--yaw-deg", "90"), "--near"),
        (("--radius", "2"), "only to --near"),
        (("--height", "nan"), "heights"), (("--device", "abacus"), "device"),
        (("--no-semantic", "--no-depth", "--no-colour"), "leave one on"),
        (("--matcher", "orb"), "choose one of auto, guided"), (("--weights", "a.pt"), "--weights"),
        (("--matcher", "guided", "--weights", "a.pt"), "guided has none"),
        (("--no-refine", "--matcher", "sift"), "--no-refine"),
        (("--no-refine", "--weights", "a.pt"), "--no-refine"),
        (("--preset", "published", "--matcher", "sift"), "--matcher"),
    ],
)  # fmt: skip
def test_bad_options(options, word, run, room):
    fails(run("scene", "localize", room.map, room.walk, *options, "--quiet"), 7, word)


def test_pictures_that_cannot_be_written(run, room, tmp_path):
    for option in ("--png", "--gif", "--tum", "--overlay"):
        out = tmp_path / "no" / "a"
        ask = ("scene", "localize", room.map, room.walk, "--frames", "0", "--quiet", "--no-refine")
        fails(run(*ask, option, out), 3, out)


def test_info_draws_the_room(run, room, tmp_path):
    result = run("scene", "info", room.map, "--png", tmp_path / "room.png")
    assert (result.code, result.err) == (0, "")
    with Image.open(tmp_path / "room.png") as image:
        assert image.size[0] == 1200
    fails_to_write = run("scene", "info", room.map, "--png", tmp_path / "no" / "room.png")
    fails(fails_to_write, 3, "room.png")
