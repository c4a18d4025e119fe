"""Pictures as somebody sends them."""

from io import BytesIO

import numpy as np
import pytest
from PIL import Image

from placegraph.core.geometry import Camera
from placegraph.errors import InputError, RequestError
from placegraph_serve.options import ServeOptions
from placegraph_serve.requests import read_depth, read_photo

OPTIONS = ServeOptions()


def picture(size=(640, 360), kind="JPEG", mode="RGB", exif=None):
    out = BytesIO()
    image = Image.new(mode, size, 90)
    image.paste(200, (0, 0, size[0] // 2, size[1] // 2))  # the corner that is seen first
    image.save(out, kind, **({"exif": exif} if exif else {}))
    return out.getvalue()


def exif(*, film=None, orientation=1, gps=None):
    made = Image.Exif()
    made[0x0112] = orientation
    if film:
        made.get_ifd(0x8769)[0xA405] = film
    if gps:
        made.get_ifd(0x8825).update(gps)
    return made.tobytes()


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP"])
def test_the_focal_length_comes_from_exif(kind):
    photo = read_photo(picture((4032, 3024), kind, exif=exif(film=26)), "a", OPTIONS)
    assert photo.size == (4032, 3024)
    assert photo.rgb.shape == (960, 1280, 3)
    # 26 mm on film of 43.27 mm across
    assert photo.focal == pytest.approx(26 / 43.267 * 5040, rel=1e-3)
    assert photo.camera(None, "a").fx == pytest.approx(photo.focal * 1280 / 4032)


def test_a_picture_that_lies_on_its_side_is_stood_up():
    photo = read_photo(picture((64, 48), "PNG", exif=exif(orientation=6)), "a", OPTIONS)
    assert photo.size == (48, 64)
    assert photo.rgb[2, -3, 0] == 200  # turned clockwise: the corner is at the right


def test_a_large_picture_on_its_side_is_stood_up_too():
    photo = read_photo(picture((2560, 1920), exif=exif(orientation=6)), "a", OPTIONS)
    assert photo.size == (1920, 2560)
    assert photo.rgb.shape == (1280, 960, 3)
    assert photo.rgb[20, -20, 0] > 180


def test_the_place_comes_from_exif():
    gps = {1: "N", 2: (43.0, 30.0, 36.0), 3: "W", 4: (7.0, 15.0, 0.0)}
    photo = read_photo(picture(exif=exif(gps=gps)), "a", OPTIONS)
    assert photo.fix[:2] == pytest.approx((-7.25, 43.51))


def test_intrinsics_of_another_shape_are_refused():
    photo = read_photo(picture(), "a", OPTIONS)
    camera = photo.camera(Camera(1280, 720, 900.0, 900.0, 640.0, 360.0), "a")
    assert (camera.width, camera.fx) == (640, 450.0)
    with pytest.raises(InputError, match="640 x 360, and intrinsics are of images of 360 x 640"):
        photo.camera(Camera(360, 640, 300.0, 300.0, 180.0, 320.0), "images[0]")


@pytest.mark.parametrize("focal", [4.2, 0.7, 1e-300, 1e7])
def test_focal_lengths_that_are_none_in_pixels_are_refused(focal):
    photo = read_photo(picture(), "a", OPTIONS)
    with pytest.raises(InputError, match="give it in their pixels"):
        photo.camera(Camera(640, 360, focal, focal, 320.0, 180.0), "images[0]")


@pytest.mark.parametrize(
    ("data", "error", "says"),
    [
        (b"", InputError, "is empty"),
        (b"no image at all", InputError, r"as an image \(of no known kind\)"),
        (picture()[:300], InputError, "cannot be read as an image"),
        (picture((1, 1), "PNG"), InputError, "1 x 1 pixels; send an image of 32 or more"),
        (picture((8000, 5000), "PNG", "1"), RequestError, "more than 24 megapixels"),
        (picture(kind="GIF"), InputError, "is GIF; send a JPEG"),
        (bytes(OPTIONS.image_bytes + 1), RequestError, "send at most"),
    ],
    ids=["empty", "text", "half", "one pixel", "40 megapixels", "gif", "bytes"],
)
def test_bad_pictures(data, error, says):
    with pytest.raises(error, match=says):
        read_photo(data, "images[0]", OPTIONS)


def test_depth_of_16_bits():
    out = BytesIO()
    Image.fromarray(np.full((40, 50), 1500, np.uint16)).save(out, "PNG")
    depth = read_depth(out.getvalue(), "depth[0]", 1000.0, OPTIONS)
    assert (depth == 1.5).all()
    with pytest.raises(InputError, match="16 bits"):
        read_depth(picture(kind="PNG"), "depth[0]", 1000.0, OPTIONS)
