"""Polycam's raw export: y up, landscape images of a telephone held in any way."""

import json

import numpy as np
import pytest

from placegraph.errors import InputError, OptionError
from placegraph.io.capture.capture import open_capture


def write(path, world, save, *, kind="", without=()):
    for i in range(len(world)):
        stem = f"{int(world.stamps[i] * 1e6)}"
        folder = path / "keyframes"
        c, pose = world.cameras[i], world.arkit(i)
        content = {"fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy, "width": 96, "height": 72}
        content |= {f"t_{r}{k}": pose[r, k] for r in range(3) for k in range(4)}
        content |= {"blur_score": 100.0, "timestamp": int(stem)}
        save(folder / f"{kind}images" / f"{stem}.jpg", world.rgb[i], quality=97)
        if "cameras" not in without:
            file = folder / f"{kind}cameras" / f"{stem}.json"
            file.parent.mkdir(exist_ok=True)
            file.write_text(json.dumps(content))
        if "depth" not in without:
            save(folder / "depth" / f"{stem}.png", world.units(i))
        if "confidence" not in without:
            save(folder / "confidence" / f"{stem}.png", (world.sure[i] * 127).astype(np.uint8))
    return path


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_however_the_telephone_is_held(turns, recorded, save, tmp_path):
    world = recorded(turns=turns, refocus=0.01)
    capture = open_capture(write(tmp_path, world, save))
    world.check(capture)
    np.testing.assert_allclose(capture.stamps, world.stamps)
    assert capture.depth_camera.width == (36 if turns % 2 else 48)
    focal = [f.camera.fy if turns % 2 else f.camera.fx for f in capture]
    np.testing.assert_allclose(focal, [c.fx for c in world.cameras])
    said = " ".join(capture.notes)
    assert "uncorrected" in said
    assert (f"turned by {turns * 90} degrees" in said) == bool(turns)


def test_corrected_poses_and_images_are_preferred(recorded, save, tmp_path):
    world = recorded(turns=1)
    write(tmp_path, recorded(turns=1, seed=9), save)
    write(tmp_path, world, save, kind="corrected_")
    capture = open_capture(tmp_path / "keyframes")
    world.check(capture)
    assert "uncorrected" not in " ".join(capture.notes)


def test_frames_without_depth_are_counted(recorded, save, tmp_path):
    world = recorded(turns=1)
    write(tmp_path, world, save)
    next((tmp_path / "keyframes/depth").iterdir()).unlink()
    next((tmp_path / "keyframes/cameras").iterdir()).unlink()
    capture = open_capture(tmp_path)
    assert sum(capture.left_out.values()) == len(world) - len(capture)
    assert set(capture.left_out) <= {"no depth", "no camera"}


def test_without_confidence_every_reading_counts(recorded, save, tmp_path):
    world = recorded(turns=1)
    world.check(open_capture(write(tmp_path, world, save, without=("confidence",))), sure=False)


def test_no_depth_at_all(recorded, save, tmp_path):
    write(tmp_path, recorded(turns=1), save, without=("depth",))
    with pytest.raises(InputError, match=r"depth holds no image; only captures of LiDAR"):
        open_capture(tmp_path)


def test_no_images(recorded, save, tmp_path):
    write(tmp_path, recorded(turns=1), save)
    for file in (tmp_path / "keyframes/images").iterdir():
        file.unlink()
    with pytest.raises(InputError, match="images holds no image"):
        open_capture(tmp_path)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"t_03": float("nan")}, "not finite"), ({"t_00": 5.0}, "no rotation"),
        ({"t_12": None}, "t_12 is not a list of 1 numbers"), ({"fx": 0}, "greater than 0"),
        ({"fx": "wide"}, "fx is not"), ({"width": 0}, "greater than 0"),
        ({"height": 10**400}, "beyond all bounds"), ({"width": float("nan")}, "whole numbers"),
    ],
)  # fmt: skip
def test_wrong_cameras(change, says, recorded, save, tmp_path):
    write(tmp_path, recorded(turns=1), save)
    file = next((tmp_path / "keyframes/cameras").iterdir())
    file.write_text(json.dumps(json.loads(file.read_text()) | change))
    with pytest.raises(InputError, match=says) as caught:
        open_capture(tmp_path)
    assert file.name in str(caught.value)


@pytest.mark.parametrize("text", ["", "[]", "{", "{}"])
def test_what_is_no_camera(text, recorded, save, tmp_path):
    write(tmp_path, recorded(turns=1), save)
    next((tmp_path / "keyframes/cameras").iterdir()).write_text(text)
    with pytest.raises(InputError, match=r"\.json"):
        open_capture(tmp_path)


def test_depth_of_another_size(recorded, save, tmp_path):
    world = recorded(turns=1)
    write(tmp_path, world, save)
    files = sorted((tmp_path / "keyframes/depth").iterdir())
    save(files[1], np.zeros((18, 24), np.uint16))
    capture = open_capture(tmp_path)
    capture[0].depth()
    with pytest.raises(InputError, match=r"24 x 18 pixels, but its camera says 48 x 36"):
        capture[1].depth()
    save(files[0], np.zeros((36, 36), np.uint16))
    with pytest.raises(InputError, match="not the view of the colour images"):
        open_capture(tmp_path)


def test_options_of_others(recorded, save, tmp_path):
    write(tmp_path, recorded(turns=1), save)
    with pytest.raises(OptionError, match="scale: not an option of Polycam"):
        open_capture(tmp_path, scale=2.0)
    with pytest.raises(OptionError, match="labels: not an option of Polycam"):
        open_capture(tmp_path, labels="instances")
