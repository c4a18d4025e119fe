"""Bad input: the coarse estimate or a typed error, never a wrong pose that is called OK."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from placegraph.core.estimate import Status
from placegraph.errors import InputError, OptionError
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.options import PoseSearchOptions
from placegraph.indoor.refine import RefineOptions
from placegraph.indoor.refine.matching import matcher
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.capture import Capture, open_capture

pytestmark = pytest.mark.usefixtures("one_thread")
FIVE = slice(0, 5)
WITHOUT_DEPTH = PoseSearchOptions().only(semantic=True, colour=True)
SAME = pytest.mark.all  # what others show already


def honest(estimate, truth, kit, metres=0.3, degrees=5.0):
    """Right, or not called OK; and where nothing was refined, the coarse pose as it was."""
    told = estimate.refinement
    if told is not None and not told.accepted:
        np.testing.assert_array_equal(estimate.best.map_from_camera, told.coarse.map_from_camera)
        assert told.reason.startswith("Not refined")
    if estimate.status is Status.OK:
        off = kit.off(estimate.best.map_from_camera, truth)
        assert off[0] < metres, estimate.reason
        assert off[1] < degrees, estimate.reason
    assert np.isfinite(estimate.trajectory).all()
    return estimate


# ------------------------------------------------------------------------------ no overlap


@pytest.mark.parametrize("yaw", [0.0, *(pytest.param(y, marks=SAME) for y in (90.0, 180.0, 270.0))])
def test_a_start_in_another_room(flat_world, flat_walk, truth, kit, yaw):
    """What the frames saw is not there: not OK, and not moved to wherever it fits."""
    x, y = flat_world.drawing.position("2")
    start = kit.standing(x, y, yaw, z=1.6)
    right = truth(flat_walk)[4]
    assert kit.off(start, right)[0] > 1.5
    estimate = honest(flat_world.scene.refine(flat_walk, start, frames=FIVE), right, kit)
    assert kit.off(estimate.best.map_from_camera, start)[0] < 1.0


def test_a_map_without_the_place(flat, walk, exact, kit):
    for start in (exact.poses[4], kit.standing(3.0, 3.0, 45.0, z=1.6)):
        estimate = flat.refine(walk, start, frames=FIVE)
        assert estimate.status is not Status.OK, estimate.reason
    assert flat.localize(walk, frames=FIVE).status is not Status.OK


def test_a_start_off_the_map(room, walk, kit):
    estimate = room.refine(walk, kit.standing(80.0, 80.0, 10.0), frames=FIVE)
    assert estimate.status is Status.LOST
    assert not estimate.refinement.accepted


def test_a_start_inside_a_wall_or_upside_down(room, walk, exact, kit):
    for start in (
        kit.standing(0.05, 1.0, 0.0),
        kit.moved(exact.poses[4], turn_deg=(180.0, 0.0, 0.0)),
    ):
        honest(room.refine(walk, start, frames=FIVE), exact.poses[4], kit)


# ------------------------------------------------------------------------- maps that say little


def white(scene):
    mesh = Mesh.plain(scene.mesh.vertices, scene.mesh.triangles, scene.mesh.object_of)
    return SceneMap.create(mesh, scene.graph.ids, scene.graph.labels, floor=0.0)


def test_a_map_without_texture(room, walk, exact, kit):
    bare = white(room)
    start = kit.moved(exact.poses[4], (0.08, -0.08, 0), (0, 0, 4.0))
    estimate = honest(bare.refine(walk, start, frames=FIVE), exact.poses[4], kit)
    assert estimate.refinement.accepted  # depth needs no colours
    assert kit.off(estimate.best.map_from_camera, exact.poses[4])[0] < 0.03
    blind = RefineOptions(depth=False, images=True)
    estimate = honest(bare.refine(walk, start, frames=FIVE, options=blind), exact.poses[4], kit)
    assert not estimate.refinement.accepted
    semantic = PoseSearchOptions().only(semantic=True)
    estimate = bare.localize(walk, frames=FIVE, options=semantic)
    assert estimate.refinement is None or not estimate.refinement.accepted


def test_a_map_of_one_object(room, walk, exact, kit):
    """A sofa is no place: wherever around it fits best is not believed."""
    row = room.graph.labels.index("sofa")
    mesh = room.mesh
    rows = mesh.triangles[mesh.object_of == row]
    used, triangles = np.unique(rows, return_inverse=True)
    sofa = SceneMap.create(
        Mesh.plain(mesh.vertices[used], triangles.reshape(-1, 3)), ["0"], ["sofa"], floor=0.0
    )
    estimate = sofa.localize(walk, frames=FIVE)
    assert estimate.status is not Status.OK
    assert "depth readings lie on the map's surfaces" in estimate.reason
    start = kit.moved(exact.poses[4], (0.1, 0.1, 0))
    honest(sofa.refine(walk, start, frames=FIVE), exact.poses[4], kit)


# ----------------------------------------------------------------------------------- images


def spoilt(kind):
    noise = np.random.default_rng(0)

    def made(frame):
        rgb = frame.rgb()
        if kind == "noise":
            return noise.integers(0, 255, rgb.shape).astype(np.uint8)
        if kind == "swapped":
            return np.ascontiguousarray(rgb[..., ::-1])
        if kind == "burnt":
            return np.clip(rgb.astype(int) * 4 + 120, 0, 255).astype(np.uint8)
        return np.full_like(rgb, {"black": 0, "blank": 128, "white": 255}[kind])

    return made


@pytest.mark.parametrize(
    ("kind", "seed"),
    [
        ("black", 0),
        ("burnt", 0),
        ("noise", 0),
        *(pytest.param(k, 0, marks=SAME) for k in ("blank", "white", "swapped")),
        # before one wall: other draws end at other heights
        *(pytest.param("burnt", seed, marks=SAME) for seed in (1, 3)),
    ],
)
def test_images_that_show_nothing(room, walk, exact, kit, in_memory, kind, seed):
    capture = in_memory(walk[:5], rgb=spoilt(kind))
    estimate = honest(room.localize(capture, seed=seed), exact.poses[4], kit)
    away = estimate.best.map_from_camera[:3, 3] - exact.poses[4][:3, 3]
    assert np.hypot(*away[:2]) < 0.05  # depth is left; the height nothing holds here
    assert abs(away[2]) < 3.0 * np.sqrt(estimate.best.covariance[2, 2])
    blind = room.localize(capture, options=WITHOUT_DEPTH)
    honest(blind, exact.poses[4], kit, 0.5, 8.0)
    if kind in {"black", "blank", "white", "noise"}:
        assert blind.refinement is None or not blind.refinement.accepted


# ----------------------------------------------------------------------------- cameras, depth


def with_camera(capture, change):
    frames = []
    for f in capture:
        cameras = {
            n: change(getattr(f, n)) for n in ("camera", "depth_camera", "label_camera")
        }  # fmt: skip
        frames.append(replace(f, **cameras))
    return Capture.from_frames(frames)


BY_IMAGES = 0.6
"""A fault that is known: images alone, by a focal length 30 % too short, may be OK and so far off [m]."""


@pytest.mark.parametrize(
    ("factor", "depth"),
    [
        (0.7, True),
        (0.7, False),
        *(pytest.param(by, d, marks=SAME) for by in (1.3, 2.0) for d in (True, False)),
    ],
)
def test_a_wrong_focal_length(room, walk, exact, kit, factor, depth):
    wrong = with_camera(
        walk[:5], lambda c: replace(c, fx=c.fx * factor, fy=c.fy * factor)
    )  # fmt: skip
    options = PoseSearchOptions() if depth else WITHOUT_DEPTH
    far = BY_IMAGES if factor == 0.7 and not depth else 0.3
    honest(room.localize(wrong, options=options), exact.poses[4], kit, far)


def test_a_swapped_size_is_refused(walk, tmp_path):
    """Width for height: the images do not fit, and say so when they are read."""
    folder = shutil.copytree(walk.path, tmp_path / "walk")
    camera = json.loads((folder / "camera.json").read_text())
    camera["width"], camera["height"] = camera["height"], camera["width"]
    (folder / "camera.json").write_text(json.dumps(camera))
    with pytest.raises(InputError, match=r"90 x 160"):
        open_capture(folder)[0].rgb()


@pytest.mark.parametrize(
    "factor",
    [0.8, 3.281, *(pytest.param(by, marks=SAME) for by in (0.2, 1 / 3.281, 1.25, 5.0))],
)
def test_depth_in_another_unit_is_never_a_pose(room, walk, exact, kit, in_memory, factor):
    capture = in_memory(walk[:5], depth=lambda f: f.depth() * np.float32(factor))
    honest(room.localize(capture), exact.poses[4], kit)
    start = kit.moved(exact.poses[4], (0.05, 0.05, 0))
    honest(room.refine(capture, start), exact.poses[4], kit)


def test_depth_that_is_all_zero_is_none(room, walk, exact, kit, in_memory):
    capture = in_memory(walk[:5], depth=lambda f: np.zeros_like(f.depth()))
    start = kit.moved(exact.poses[4], (0.05, 0.05, 0))
    estimate = honest(room.refine(capture, start), exact.poses[4], kit)
    assert "depth" not in estimate.refinement.reason


# --------------------------------------------------------------------------------- motion


def test_one_frame(room, walk, exact, kit):
    for row in (0, 9):
        honest(room.localize(walk, frames=[row]), exact.poses[row], kit)


def test_a_camera_that_stands_still(room, walk, exact, kit):
    """The same moment five times: no more is known than from one."""
    still = [replace(walk[4], stamp=float(i), index=i) for i in range(5)]
    estimate = honest(room.localize(still), exact.poses[4], kit)
    alone = room.localize(walk, frames=[4])
    if estimate.refinement.accepted and alone.refinement.accepted:
        for pose in estimate.trajectory:
            assert kit.off(pose, estimate.best.map_from_camera)[0] < 0.01


def jumped(frame):
    """Odometry that jumps by a metre and 40 degrees at the third frame."""
    if frame.index < 2:
        return frame.odometry
    jump = np.eye(4)
    angle = np.radians(40.0)
    jump[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    jump[:3, 3] = 1.0, 0.4, 0.0
    return jump @ frame.odometry


@pytest.mark.parametrize("made", [jumped, lambda _: np.eye(4)], ids=["jumps", "stands still"])
def test_odometry_that_is_wrong(room, walk, exact, kit, in_memory, made):
    capture = in_memory(walk[:5], odometry=made)
    estimate = room.localize(capture)
    if made is not jumped:
        assert estimate.status is not Status.OK
        assert "odometry stands still" in estimate.reason
    if estimate.refinement is not None and estimate.refinement.accepted:
        honest(estimate, exact.poses[4], kit)
    refined = room.refine(capture, kit.moved(exact.poses[4], (0.05, 0.05, 0)))
    honest(refined, exact.poses[4], kit)


def test_what_contradicts_the_odometry_is_not_ok(room, walk, located, monkeypatch):
    """The filter may still say so: the frames, each where it fits, part from their way."""
    assert located.status is Status.OK
    for module in ("refine.confidence", "status"):
        monkeypatch.setattr(f"placegraph.indoor.{module}.BENT", 1e-6)
    after = room.localize(walk, frames=FIVE)
    assert after.status is Status.AMBIGUOUS
    assert "odometry" in after.reason
    assert not after.refinement.accepted


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_odometry_that_is_no_number_is_refused(walk, in_memory, value):
    def made(frame):
        pose = frame.odometry.copy()
        pose[0, 3] = value
        return pose

    with pytest.raises(OptionError, match="odometry"):
        in_memory(walk[:2], odometry=made)


# --------------------------------------------------------------------------------- weights


@pytest.mark.parametrize("content", [b"", b"no weights", b"PK\x03\x04" + bytes(200)])
def test_damaged_weights_are_named(tmp_path, room, walk, exact, content):
    pytest.importorskip("kornia", reason="needs kornia: pip install 'placegraph[xfeat]'")
    file = tmp_path / "xfeat.pt"
    file.write_bytes(content)
    with pytest.raises(InputError, match=r"xfeat\.pt"):
        room.refine(walk, exact.poses[0], frames=[0], matcher=matcher("xfeat", weights=file))
