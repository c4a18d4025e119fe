"""Requests of the GeoPose protocol, as clients really send them."""

import base64
import json

import pytest

from placegraph.errors import InputError, RequestError
from placegraph_serve.geopose import gravity_of, image_bytes, read_request, version_of


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
    fix = {"latitude": 1.5, "longitude": 2.5}
    one = {
        "id": "a",
        "timestamp": "2020-12-26T15:19:50.413Z",
        "sensors": [{"id": "0", "type": "camera", "params": {"model": "PINHOLE"}}],
        "sensorReadings": [
            {"sensorId": "0", "timestamp": "2020-12-26T15:19:50Z", "reading": camera},
            {"sensorId": "9", "timestamp": 1608995990000, "reading": [fix]},
        ],
    }
    two = {
        "id": "a",
        "timestamp": 1608995990413,
        "sensors": [{"id": "0", "type": "camera"}],
        "sensorReadings": {
            "cameraReadings": [
                camera | {"sensorId": "0", "timestamp": 1608995990000,
                          "params": {"model": "PINHOLE"}}
            ],
            "geolocationReadings": [fix | {"sensorId": "1", "timestamp": 1608995990000}],
        },
    }  # fmt: skip
    first, second = (read_request(json.dumps(told).encode(), None) for told in (one, two))
    assert (first.version, second.version) == (1, 2)
    for told in (first, second):
        assert told.camera[0]["image"] == b"\0\0\0"
        assert told.camera[0]["params"] == {"model": "PINHOLE"}
        assert told.camera[0]["when"] == 1608995990.0
        assert told.geolocation[0]["latitude"] == 1.5


@pytest.mark.parametrize(
    ("body", "says"),
    [
        (b"{", "not JSON"),
        (b"[]", "no object"),
        (b"{}", "sensorReadings: missing"),
        (b'{"sensorReadings": [1]}', "no list of objects"),
        (b'{"sensorReadings": [], "sensors": 3}', "sensors: no list"),
        (b'{"sensorReadings": {"cameraReadings": [{"imageBytes": 7}]}}', "imageBytes: no text"),
        (b'{"sensorReadings": {"cameraReadings": [{"timestamp": "now"}]}}', "timestamp"),
        (b'{"sensorReadings": [], "priorPoses": [{}]}', "priorPoses: a pose has no position"),
        (b'{"sensorReadings": {"cameraReadings": [{"params": [1]}]}}', "params: .* is no object"),
        (
            b'{"sensorReadings": {"cameraReadings": [{"imageOrientation": 90}]}}',
            "imageOrientation: '90' is no object",
        ),
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
