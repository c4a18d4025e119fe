import base64
import json
import zipfile
from io import BytesIO

import numpy as np
import pytest
from PIL import Image

from placegraph.core.geometry import Camera
from placegraph.errors import InputError, RequestError
from placegraph_serve.geopose import gravity_of, image_bytes, read_request, version_of
from placegraph_serve.options import ServeOptions
from placegraph_serve.requests import capture_in, read_depth, read_photo

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


@pytest.mark.parametrize(
    ("size", "kind", "shape"), [((64, 48), "PNG", (64, 48)), ((2560, 1920), "JPEG", (1280, 960))]
)
def test_a_picture_that_lies_on_its_side_is_stood_up(size, kind, shape):
    photo = read_photo(picture(size, kind, exif=exif(orientation=6)), "a", OPTIONS)
    assert photo.size == size[::-1]
    assert photo.rgb.shape == (*shape, 3)
    # turned clockwise: the corner is at the right
    assert photo.rgb[shape[0] // 32, -shape[1] // 16, 0] == pytest.approx(200, abs=20)


def test_the_place_comes_from_exif():
    gps = {1: "N", 2: (43.0, 30.0, 36.0), 3: "W", 4: (7.0, 15.0, 0.0)}
    photo = read_photo(picture(exif=exif(gps=gps)), "a", OPTIONS)
    assert photo.fix[:2] == pytest.approx((-7.25, 43.51))


def test_intrinsics_of_another_shape_are_refused():
    photo = read_photo(picture(), "a", OPTIONS)
    camera = photo.camera(Camera(1280, 720, 900.0, 900.0, 640.0, 360.0), "a")
    assert (camera.width, camera.fx) == (640, 450.0)
    with pytest.raises(
        InputError, match="640 x 360, but the intrinsics are for images of 360 x 640"
    ):
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
        (b"no image at all", InputError, r"as an image \(of an unknown format\)"),
        (picture()[:300], InputError, "cannot be read as an image"),
        (picture((1, 1), "PNG"), InputError, "1 x 1 pixels; send an image of at least 32"),
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
    with pytest.raises(InputError, match="16-bit PNG"):
        read_depth(picture(kind="PNG"), "depth[0]", 1000.0, OPTIONS)


@pytest.fixture
def packed(tmp_path):
    def pack(*entries):
        with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
            for name, content in entries:
                archive.writestr(name, content)
        (tmp_path / "out").mkdir()
        return tmp_path / "a.zip", tmp_path / "out"

    return pack


def test_a_capture_below_one_folder_is_found(walk, tmp_path):
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        for path in walk.rglob("*"):
            archive.write(path, f"walk/{path.relative_to(walk)}")
        archive.writestr("__MACOSX/walk/._a", b"")
    (tmp_path / "out").mkdir()
    assert len(capture_in(tmp_path / "a.zip", tmp_path / "out", ServeOptions())) == 18
    with pytest.raises(RequestError, match="18 frames; send at most 17"):
        capture_in(tmp_path / "a.zip", tmp_path / "out", ServeOptions(images=17))


LINK = zipfile.ZipInfo("rgb")
LINK.external_attr = 0o120777 << 16
OUTSIDE = ("../evil", "/etc/evil", "a/../../evil", "a\\..\\evil", "c:evil")


@pytest.mark.parametrize(
    ("entries", "error", "says"),
    [
        *([[(name, b"x")], InputError, "points outside the ZIP"] for name in OUTSIDE),
        ([(LINK, "/etc")], InputError, "points outside"),
        ([(f"{i}", b"") for i in range(207)], RequestError, "207 files"),
        ([("notes.txt", b"hello")], InputError, "is not a capture of a known"),
    ],
    ids=[*OUTSIDE, "link", "files", "notes"],
)
def test_captures_that_are_refused(packed, tmp_path, entries, error, says):
    with pytest.raises(error, match=says):
        capture_in(*packed(*entries), ServeOptions(images=10))
    assert "capture" in says or not list((tmp_path / "out").iterdir())
    assert not (tmp_path / "evil").exists()


@pytest.mark.parametrize("kind", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_damaged_bytes(packed, kind):
    entry = zipfile.ZipInfo("rgb/0.png")
    entry.compress_type = kind
    file, out = packed((entry, bytes(range(256)) * 20))
    data = bytearray(file.read_bytes())
    data[60:100] = bytes(40)
    file.write_bytes(data)
    with pytest.raises(InputError, match="not a complete ZIP"):
        capture_in(file, out, ServeOptions())


def test_a_bomb_is_not_unpacked(packed, tmp_path):
    file, out = packed(*((f"rgb/{i}.png", bytes(1 << 20)) for i in range(4)))
    assert file.stat().st_size < 10_000
    with pytest.raises(RequestError, match="after unpacking"):
        capture_in(file, out, ServeOptions(unpacked_bytes=3 << 20))
    assert not list((tmp_path / "out").iterdir())


def test_a_length_that_lies(packed):
    file, out = packed(("rgb/0.png", bytes(1 << 20)))
    data = file.read_bytes()
    told = (1 << 20).to_bytes(4, "little")
    file.write_bytes(data.replace(told, (1000).to_bytes(4, "little")))  # in both directories
    with pytest.raises(InputError, match="not a complete ZIP"):
        capture_in(file, out, ServeOptions(unpacked_bytes=2000))


@pytest.mark.parametrize(
    ("accept", "version"),
    [
        ("application/vnd.oscp+json; version=2.0;", 2),
        ("application/vnd.oscp+json;version=1.0", 1),
        ("application/vnd.oscp+json ;  version = 2.0 ", 2),
        ('text/html, Application/VND.oscp+json; charset=utf-8; version="2.0"', 2),
        ("*/*", None),
        ("application/vnd.oscp+json, text/html; version=1", None),
    ],
)
def test_versions_however_they_are_spaced(accept, version):
    assert version_of(accept) == version


def test_a_version_that_is_not_spoken():
    with pytest.raises(RequestError, match=r"ask for 1\.0 or 2\.0") as refused:
        version_of("application/vnd.oscp+json; version=3.0")
    assert refused.value.status == 406


@pytest.mark.parametrize(
    "head", ["", "data:image/jpeg;base64,", "data:application/octet-stream;base64,"]
)
def test_base64_of_all_kinds(head):
    data = bytes(range(256))
    for coded in (base64.b64encode(data), base64.urlsafe_b64encode(data)):
        assert image_bytes(head + coded.decode()) == data
        assert image_bytes(head + coded.decode().rstrip("=")) == data
    assert image_bytes(head + base64.encodebytes(data).decode()) == data
    with pytest.raises(InputError, match="not base64"):
        image_bytes(head + "@@@@")


def test_readings_of_both_versions_are_the_same():
    camera = {"imageBytes": "AAAA", "imageFormat": "JPG", "size": [4, 3]}
    fix, params = {"latitude": 1.5, "longitude": 2.5}, {"model": "PINHOLE"}
    at = {"timestamp": 1608995990000}
    one = {
        "id": "a", "timestamp": "2020-12-26T15:19:50.413Z",
        "sensors": [{"id": "0", "type": "camera", "params": params}],
        "sensorReadings": [
            {"sensorId": "0", "timestamp": "2020-12-26T15:19:50Z", "reading": camera},
            {"sensorId": "9", "reading": [fix]} | at,
        ],
    }  # fmt: skip
    two = {
        "id": "a", "timestamp": 1608995990413, "sensors": [{"id": "0", "type": "camera"}],
        "sensorReadings": {
            "cameraReadings": [camera | {"sensorId": "0", "params": params} | at],
            "geolocationReadings": [fix | {"sensorId": "1"} | at],
        },
    }  # fmt: skip
    for version, body in enumerate((one, two), 1):
        request = read_request(json.dumps(body).encode(), None)
        assert request.version == version
        assert request.camera[0]["image"] == b"\0\0\0"
        assert request.camera[0]["params"] == params
        assert request.camera[0]["when"] == 1608995990.0
        assert request.geolocation[0]["latitude"] == 1.5


SEEN = b'{"sensorReadings": {"cameraReadings": [%s]}}'


@pytest.mark.parametrize(
    ("body", "says"),
    [
        (b"{", "not JSON"),
        (b"[]", "not a JSON object"),
        (b"{}", "sensorReadings: missing"),
        (b'{"sensorReadings": [1]}', "not a list of objects"),
        (b'{"sensorReadings": [], "sensors": 3}', "sensors: not a list"),
        (SEEN % b'{"imageBytes": 7}', "imageBytes: not text"),
        (SEEN % b'{"timestamp": "now"}', "timestamp"),
        (b'{"sensorReadings": [], "priorPoses": [{}]}', "priorPoses: a pose has no position"),
        (SEEN % b'{"params": [1]}', "params: .* is not an object"),
        (SEEN % b'{"imageOrientation": 90}', "imageOrientation: '90' is not an object"),
        (b'{"sensorReadings": [], "id": "\\ud800"}', "not JSON"),  # could not be sent back
        (b'{"sensorReadings": [], "timestamp": 1%s}' % (b"0" * 400), "not JSON"),
    ],
)
def test_bad_requests_name_the_field(body, says):
    with pytest.raises(InputError, match=says):
        read_request(body, None)


def test_gravity_of_an_accelerometer():
    assert gravity_of({"x": 0, "y": 9.8, "z": 0}) == pytest.approx([0, 1, 0])  # held upright
    assert gravity_of({"x": 0, "y": 0, "z": 9.8}) == pytest.approx([0, 0, 1])  # looks down
    assert gravity_of({"x": 0, "y": -9.8, "z": 0}) == pytest.approx([0, 1, 0])  # the other sign
    # screen tipped towards the ceiling: the camera looks below the horizon
    assert gravity_of({"x": 0, "y": 9.0, "z": 3.0})[2] > 0
    assert gravity_of({"x": 0, "y": 0, "z": 0}) is None
