"""Images as they are stored, or as a telephone shows them."""

import os
import tracemalloc

import numpy as np
import pytest
from PIL import Image

from placegraph.errors import InputError
from placegraph.io.capture import images
from placegraph.io.capture.images import read_integers, read_rgb
from placegraph.io.capture.json_files import read_json
from placegraph.io.capture.tum import read_tum
from placegraph.io.mesh.gltf import read_glb
from placegraph.io.mesh.ply import read_ply


@pytest.fixture
def photo(tmp_path):
    """File of 6 x 4 pixels, red at its left, that EXIF says to show turned clockwise."""
    colours = np.zeros((4, 6, 3), np.uint8)
    colours[:, 0, 0] = 255
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(colours).save(tmp_path / "a.png", exif=exif)
    return tmp_path / "a.png"


def test_intrinsics_say_whether_an_image_is_turned(photo):
    stored = read_rgb(photo, (6, 4))
    assert stored[:, 0, 0].min() == 255
    shown = read_rgb(photo, (4, 6))
    assert shown[0, :, 0].min() == 255
    np.testing.assert_array_equal(np.rot90(stored, -1), shown)
    Image.new("RGB", (6, 4)).save(photo)
    with pytest.raises(InputError, match="6 x 4 pixels, but its camera has 4 x 6"):
        read_rgb(photo, (4, 6))


def test_more_pixels_than_a_frame_has_are_refused_before_they_are_read(tmp_path, monkeypatch):
    monkeypatch.setattr(images, "MAX_PIXELS", 40 * 30 - 1)
    Image.new("L", (40, 30)).save(tmp_path / "a.png")
    monkeypatch.setattr(Image.Image, "load", None)
    for read in (read_rgb, lambda *given: read_integers(*given, ("L",))):
        with pytest.raises(InputError, match=r"a\.png has 40 x 30 pixels; the limit is"):
            read(tmp_path / "a.png", (40, 30))


def test_more_pixels_than_bytes_can_hold_are_refused_before_they_are_read(tmp_path, monkeypatch):
    monkeypatch.setattr(images, "FREE_PIXELS", 40 * 30 - 90)
    monkeypatch.setattr(images, "PIXELS_A_BYTE", 1)
    path = tmp_path / "a.png"
    Image.new("RGB", (40, 30)).save(path)
    with pytest.raises(InputError, match=r"a\.png declares 40 x 30 pixels in 83 bytes"):
        read_rgb(path, (40, 30))
    path.write_bytes(path.read_bytes() + bytes(9))
    assert read_rgb(path, (40, 30)).shape == (30, 40, 3)
    with path.open("rb") as source:
        assert read_rgb(path, (40, 30), source).shape == (30, 40, 3)


@pytest.mark.parametrize(
    ("mode", "each"), [("RGB", 3), ("RGBA", 3), ("P", 3), ("L", 4), ("I;16", 4)]
)
def test_of_a_large_image_no_second_copy_is_held(tmp_path, mode, each):
    large, path = (1500, 3001), tmp_path / "a.png"
    image = Image.new("L", large)
    image.paste(200, (0, 2000, 1500, 3001))
    image.convert(mode).save(path)
    tracemalloc.start()
    read = read_rgb(path, large) if each == 3 else read_integers(path, large, (mode,))
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < each * 1500 * 3001 + 16e6
    assert (read[1999].max(), read[2000].min(), read[-1].max()) == (0, 200, 200)


@pytest.mark.parametrize("name", ["odometry.tum", "camera.json", "rgb/0.png", "mesh.ply", "a.glb"])
def test_a_pipe_is_refused_wherever_a_file_belongs(tmp_path, name):
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    os.mkfifo(path)
    readers = {".tum": read_tum, ".json": read_json, ".ply": read_ply, ".glb": read_glb}
    read = readers.get(path.suffix, lambda at: read_rgb(at, (4, 3)))
    with pytest.raises(InputError, match="is not a regular file"):
        read(path)
