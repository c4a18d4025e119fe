import base64
import io
import json
import re
import zipfile

import numpy as np
import pytest
from PIL import Image

import placegraph as pg
from placegraph.indoor.pose.prior import Prior
from placegraph.io.capture.tum import read_tum
from placegraph_serve.localize import MOST_ALONE, in_radians
from placegraph_serve.options import ServeOptions
from placegraph_serve.places import Dispatcher, Places
from placegraph_serve.requests import PriorPose
from placegraph_serve.workers import answer
from serve_world import serving

ROW = 12


@pytest.fixture(scope="module")
def client(flat):
    with serving(flat) as client:
        yield client


@pytest.fixture(scope="module")
def desks(maps, flat):
    """Dispatchers of one flat, and of all maps."""
    return [Dispatcher(Places(paths), ServeOptions()) for paths in ([flat], [maps, flat])]


@pytest.fixture(scope="module")
def frame(walk):
    return pg.open_capture(walk)[ROW]


@pytest.fixture(scope="module")
def truth(walk):
    return read_tum(walk / "trajectory.tum").poses


def encoded(array, kind="PNG", **more):
    out = io.BytesIO()
    Image.fromarray(array).save(out, kind, **more)
    return out.getvalue()


INTRINSICS = {"fx": 230.0, "cx": 160.0, "cy": 90.0, "width": 320, "height": 180}


def depth_png(frame):
    return encoded(np.nan_to_num(frame.depth() * 1000).astype(np.uint16))


def asked(client, files, **request):
    return client.post("/v1/localize", files=files, data={"request": json.dumps(request)})


def off(mode, truth):
    return np.linalg.norm(np.array(mode["map_from_camera"])[:3, 3] - truth[:3, 3])


def test_a_phones_picture_without_gravity(client, frame, truth):
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = round(230 / np.hypot(320, 180) * 43.267)
    picture = encoded(frame.rgb(), "JPEG", quality=95, exif=exif.tobytes())
    told = asked(client, [("images", ("a.jpg", picture))], pictures=["plan", "overlay"]).json()
    assert told["map"] == "altbau"
    assert off(told["estimate"]["modes"][0], truth[ROW]) < 0.3
    position = told["geopose"]["position"]
    assert (round(position["lon"], 3), round(position["lat"], 3)) == (8.0, 53.0)
    assert told["geojson"]["features"]
    for name in ("plan", "overlay"):
        assert told["pictures"][name].startswith("data:image/png;base64,iVBOR")


@pytest.mark.parametrize("row", [4, 12, 15])
def test_a_guessed_lens_widens_the_covariance_and_the_reason_agrees(client, walk, truth, row):
    """The lens was not given: the pose is as uncertain as the guess makes it, and the reason says so."""
    picture = ("a.png", encoded(pg.open_capture(walk)[row].rgb()))
    told, known = (
        asked(client, [("images", picture)], **more).json()
        for more in ({}, {"intrinsics": INTRINSICS})
    )
    best, sure = told["estimate"]["modes"][0], known["estimate"]["modes"][0]
    spread, least = (
        np.sqrt(np.linalg.eigvalsh(np.array(m["covariance"])[:3, :3])[-1]) for m in (best, sure)
    )
    assert spread > 0.05 > least
    assert "focal length" in told["notes"][0]
    assert not known["notes"]
    metres = re.search(r"known only to (\S+) m", told["estimate"]["reason"])
    assert not metres or float(metres[1]) == pytest.approx(spread, abs=0.05)
    if told["estimate"]["status"] == "OK":
        assert off(best, truth[row]) < 3 * spread


@pytest.mark.parametrize("rows", [(0, 1, 2), (3, 4, 8), (6, 7, 8), (2, 3, 13)])
def test_three_images_without_odometry_are_as_sure_and_right_as_the_best_one(
    client, walk, truth, rows
):
    pictures = [("images", ("i.png", encoded(pg.open_capture(walk)[row].rgb()))) for row in rows]

    def told(*files):
        estimate = asked(client, files, intrinsics=INTRINSICS).json()["estimate"]
        return estimate["status"] == "OK", estimate["modes"][0]["probability"], estimate

    alone = [told(picture)[:2] for picture in pictures]
    is_sure, share, estimate = told(*pictures)
    assert (is_sure, round(share, 2)) >= max((sure, round(p, 2)) for sure, p in alone)
    least = 3 * np.linalg.eigvalsh(np.array(estimate["modes"][0]["covariance"])[:3, :3])[-1] ** 0.5
    # an answer that is not sure may have another place first
    assert not is_sure or off(estimate["modes"][0], truth[rows[estimate["frames"][-1]]]) < max(
        least, 0.1
    )
    assert f"{share:.0%}" in estimate["reason"] or "places" not in estimate["reason"]


def test_page_and_server_take_the_same_number_of_images(client, frame):
    page = client.get("/inside.js").text
    assert f"[...files].slice(0, {MOST_ALONE})" in page
    pictures = [("images", ("i.png", encoded(frame.rgb())))] * (MOST_ALONE + 1)
    refused = asked(client, pictures)
    assert (refused.status_code, refused.json()["code"]) == (422, "option")
    assert f"the limit without it is {MOST_ALONE}" in refused.json()["detail"]


def test_images_of_a_way_with_depth(client, walk, truth):
    capture = pg.open_capture(walk)[10:]
    files = [("images", ("i", encoded(f.rgb()))) for f in capture]
    files += [("depth", ("d", depth_png(f))) for f in capture]
    known = {"intrinsics": INTRINSICS, "odometry": capture.odometry.tolist()}
    known["gravity"] = capture.gravity.tolist()
    told = asked(client, files, **known).json()
    assert told["estimate"]["status"] == "OK"
    assert off(told["estimate"]["modes"][0], truth[-1]) < 0.05
    fewer = asked(client, files, **known | {"gravity": known["gravity"][1:]})
    assert fewer.json()["detail"] == "gravity: 7 for 8 images; send one per image."


def test_a_capture_in_a_zip(client, walk, truth, tmp_path):
    with zipfile.ZipFile(tmp_path / "walk.zip", "w") as archive:
        for path in walk.rglob("*"):
            if path.is_file() and path.name != "trajectory.tum":
                archive.write(path, path.relative_to(walk))
    data = (tmp_path / "walk.zip").read_bytes()
    told = asked(client, {"capture": ("walk.zip", data)}, map="altbau").json()
    assert told["estimate"]["status"] == "OK"
    assert off(told["estimate"]["modes"][0], truth[-1]) < 0.05
    half = asked(client, {"capture": ("walk.zip", data[: len(data) // 2])})
    assert (half.status_code, half.json()["code"]) == (400, "input")
    assert "not a complete ZIP" in half.json()["detail"]
    assert "/tmp" not in half.text  # noqa: S108  # where it lay is nobody's business


@pytest.mark.parametrize(
    ("files", "request_", "status", "says"),
    [
        ({}, "{}", 400, "images: send one or more"),
        ({"images": encoded(np.zeros((5000, 8000), bool))}, "{}", 413, "megapixels"),
        ({"images": b"x"}, "{", 400, "request: not JSON"),
        ({"images": b"x"}, "[" * 100, 413, "nested"),
        ({"images": b"x"}, '{"intrinsics": {"fx": -1}}', 422, "intrinsics.fx"),
        ({"images": b"x"}, '{"map": "paris"}', 400, "cannot be read as an image"),
        ({"images": b"x", "capture": b"y"}, "{}", 400, "or else one `capture`"),
    ],
)
def test_bad_uploads(client, files, request_, status, says):
    sent = {name: (name, data) for name, data in files.items()} or {"other": ("a", b"")}
    answer = client.post("/v1/localize", files=sent, data={"request": request_})
    assert answer.status_code == status
    assert says in answer.json()["detail"]


def test_a_prior_is_given_in_degrees_and_in_part():
    given = PriorPose(x=1, y=2, yaw_deg=90, turn_deg=180).model_dump()
    assert Prior(**in_radians(given)) == Prior(1.0, 2.0, yaw=np.pi / 2, turn=np.pi)


def test_a_plan_of_a_scene(client):
    answer = client.get("/v1/maps/altbau/plan.png")
    assert answer.headers["content-type"] == "image/png"
    assert Image.open(io.BytesIO(answer.content)).width > 300
    assert client.get("/v1/maps/paris/plan.png").json()["code"] == "map_unknown"


def oscp(frame, version, *, depth=False, **more):
    data = base64.b64encode(encoded(frame.rgb(), "JPEG", quality=95)).decode()
    down = frame.gravity
    params = {"model": "PINHOLE", "modelParams": [230, 230, 160, 90]}
    camera = {"sequenceNumber": 0, "imageFormat": "JPG", "size": [320, 180], "imageBytes": data,
              "imageOrientation": {"mirrored": False, "rotation": 0}}  # fmt: skip
    felt = {"x": -down[0] * 9.8, "y": down[1] * 9.8, "z": down[2] * 9.8}
    when = {"timestamp": 1608995990381, "privacy": {}}
    sensors = [
        {"id": "0", "type": "camera", "params": params},
        {"id": "1", "type": "accelerometer"},
    ]
    if version == 1:
        readings = [{"sensorId": "0", "reading": camera} | when,
                    {"sensorId": "1", "reading": felt} | when]  # fmt: skip
    else:
        readings = {"cameraReadings": [{"sensorId": "0"} | camera | when],
                    "accelerometerReadings": [{"sensorId": "1"} | felt | when]}  # fmt: skip
    if depth:
        data = base64.b64encode(depth_png(frame)).decode()
        readings["cameraReadings"] += [{"sensorId": "0", "imageFormat": "DEPTH16"} | when]
        readings["cameraReadings"][1] |= {"imageBytes": data, "size": [320, 180]}
    return {"id": "q", "timestamp": 1608995990413, "type": "geopose", "sensors": sensors,
            "sensorReadings": readings} | more  # fmt: skip


@pytest.mark.parametrize("version", [1, 2])
def test_a_geopose_of_a_picture(client, frame, truth, flat, version):
    accept = f"application/vnd.oscp+json ;version= {version}.0;"
    answer = client.post("/geopose", json=oscp(frame, version), headers={"Accept": accept})
    told = answer.json()
    assert answer.headers["content-type"] == f"application/vnd.oscp+json; version={version}.0"
    assert (told["id"], told["type"], told["source"]) == ("q", "geopose", "images")
    assert ("pose" in told) == (version == 1)
    there = pg.open_map(flat).anchors[0].pose(truth[ROW]).geopose()
    for name in ("lat", "lon"):
        assert told["geopose"]["position"][name] == pytest.approx(there["position"][name], abs=5e-6)
    dot = sum(told["geopose"]["quaternion"][a] * there["quaternion"][a] for a in "xyzw")
    assert abs(dot) > 0.99
    assert told["accuracy"]["position"] > 0
    assert told["status"] == "OK"
    assert told["modes"][0]["building"] == "Haus"


def test_a_pose_of_before_helps(client, frame, truth, flat):
    there = pg.open_map(flat).anchors[0].pose(truth[ROW]).geopose()
    prior = {"id": "p", "timestamp": 1, "type": "geopose",
             "accuracy": {"position": 0.3, "orientation": 5}, "geopose": there}  # fmt: skip
    alone = client.post("/geopose", json=oscp(frame, 2)).json()
    helped = client.post("/geopose", json=oscp(frame, 2, priorPoses=[prior])).json()
    assert helped["modes"][0]["probability"] >= alone["modes"][0]["probability"]
    assert helped["geopose"]["position"]["lat"] == pytest.approx(there["position"]["lat"], abs=5e-6)


@pytest.mark.parametrize(
    ("north", "swap", "says"),
    [(0.05, False, "5.6 km from map"), (1e-4, False, ""), (1e-4, True, "swapped, it lies there")],
)
def test_a_geolocation_far_from_the_map_is_left_out_and_told(
    client, frame, flat, north, swap, says
):
    here = pg.open_map(flat).anchors[0]
    near = (here.latitude + north, here.longitude)
    latitude, longitude = near[::-1] if swap else near
    request = oscp(frame, 2)
    request["sensorReadings"]["geolocationReadings"] = [
        {"sensorId": "2", "timestamp": 1608995990381, "accuracy": 10,
         "latitude": latitude, "longitude": longitude}
    ]  # fmt: skip
    told = client.post("/geopose", json=request).json()
    assert told["source"] == "images"
    assert told["geopose"]["position"]["lat"] == pytest.approx(here.latitude, abs=1e-3)
    assert len(told["notes"]) == bool(says)
    assert all(says in note and "was ignored" in note for note in told["notes"])


@pytest.fixture
def example(shared):
    return json.loads((shared / "conformance/geopose/gpp-request.example.json").read_text())


def test_the_protocols_own_example(client, shared, example):
    """It has no picture: what is left is where its geolocation says."""
    jsonschema = pytest.importorskip("jsonschema")
    schema = json.loads((shared / "conformance/geopose/gpp-request.schema.json").read_text())
    wrong = [list(e.path) for e in jsonschema.Draft7Validator(schema).iter_errors(example)]
    assert all(path[-1] == "timestamp" for path in wrong)  # text, where its schema wants numbers
    for stamp in (None, 1608995990413):
        if stamp:
            for entry in (example, *example["sensorReadings"]):
                entry["timestamp"] = stamp
            jsonschema.validate(example, schema)
        told = client.post("/geopose", json=example).json()
        assert told["id"] == example["id"]
        assert told["timestamp"] == example["sensorReadings"][0]["timestamp"]
        assert told["geopose"]["position"] == {"lat": 47.61155, "lon": -122.33705555555555, "h": 0}
        assert told["geopose"]["quaternion"] == {"x": 0, "y": 0, "z": 0, "w": 1}
        assert (told["status"], told["source"]) == ("LOST", "geolocation")
        assert "imageBytes is empty" in told["reason"]
        assert told["accuracy"]["orientation"] == 180


def test_the_example_with_a_picture_of_the_flat(client, example, frame):
    reading = example["sensorReadings"][0]["reading"]
    reading["imageBytes"] = base64.b64encode(encoded(frame.rgb(), "JPEG")).decode()
    told = client.post("/geopose", json=example).json()
    assert (told["status"], told["source"]) == ("AMBIGUOUS", "geolocation")  # no intrinsics
    assert told["modes"][0]["position"]["lat"] == pytest.approx(53.0, abs=1e-3)
    assert "was ignored" in told["notes"][0]


@pytest.mark.parametrize("channels", [4, 1])
def test_plain_pixels(client, frame, channels):
    request = oscp(frame, 2, depth=True)
    rgb = frame.rgb()
    rgba = np.concatenate([rgb, np.full((*rgb.shape[:2], 1), 255, np.uint8)], axis=2)
    data = (rgba if channels == 4 else rgb.mean(axis=2).astype(np.uint8)).tobytes()
    reading = request["sensorReadings"]["cameraReadings"][0]
    reading["imageBytes"] = base64.b64encode(data).decode()
    assert client.post("/geopose", json=request).json()["source"] == "images"
    reading["size"] = [320, 179]
    wrong = client.post("/geopose", json=request)
    assert wrong.json()["code"] == "input"
    assert "not JPEG, PNG or pixels of 320 x 179" in wrong.json()["detail"]


@pytest.mark.parametrize("several", [False, True])
@pytest.mark.parametrize("image", ["grey", "noise"])
def test_an_image_of_nothing_gives_the_fix_or_no_pose(desks, frame, image, several):
    pixels = np.full((180, 320, 3), 120, np.uint8)
    if image == "noise":
        pixels = np.random.default_rng(0).integers(0, 256, pixels.shape, np.uint8)
    request = oscp(frame, 2)
    reading = request["sensorReadings"]["cameraReadings"][0]
    reading["imageBytes"] = base64.b64encode(encoded(pixels)).decode()

    def asked():
        return answer(desks[several], "geopose", {"body": json.dumps(request), "version": 2})

    body, told = asked()
    assert (body, told["status"]) == (None, 422)
    request["sensorReadings"]["geolocationReadings"] = [
        {"sensorId": "2", "timestamp": 1, "accuracy": 15, "latitude": 53.0, "longitude": 8.0}
    ]
    told = json.loads(asked()[0])
    assert (told["source"], told["accuracy"]["position"]) == ("geolocation", 15)
    assert told["geopose"]["position"] == {"lat": 53.0, "lon": 8.0, "h": 0.0}


def test_a_map_that_stands_nowhere_has_no_geopose(demo_world, frame):
    desk = Dispatcher(Places([demo_world / "altbau.scene"]), ServeOptions())
    body, told = answer(desk, "geopose", {"body": json.dumps(oscp(frame, 2)), "version": 2})
    assert (body, told["status"], told["code"]) == (None, 409, "geopose")
    assert "placegraph scene anchor" in told["mend"]


def test_no_image_and_no_fix(client):
    answer = client.post("/geopose", json={"sensorReadings": []})
    assert (answer.status_code, answer.json()["code"]) == (422, "no_pose")


def test_a_camera_is_followed(client, walk, truth):
    begun = client.post("/v1/sessions", json={"camera": INTRINSICS})
    assert begun.status_code == 201
    session = begun.json()["session"]
    with client.websocket_connect(f"/v1/sessions/{session}") as socket:
        for f in pg.open_capture(walk):
            images = {"image": encoded(f.rgb()), "depth": depth_png(f)}
            step = {name: base64.b64encode(png).decode() for name, png in images.items()}
            step |= {"odometry": f.odometry.tolist(), "gravity": f.gravity.tolist()}
            socket.send_json(step | {"stamp": f.stamp})
            told = socket.receive_json()
        assert told["estimate"]["status"] == "OK"
        assert off(told["estimate"]["modes"][0], truth[-1]) < 0.15
        wide = INTRINSICS | {"fx": 3 * INTRINSICS["fx"]}
        socket.send_json(step | {"stamp": f.stamp + 1.0, "camera": wide})
        assert "camera differs" in socket.receive_json()["detail"]
        socket.send_json({"text": "hello"})
        assert socket.receive_json()["mend"] == "Give one in base64, JPEG or PNG."
    assert client.delete(f"/v1/sessions/{session}").status_code == 204
    assert client.post(f"/v1/sessions/{session}", json={}).json()["code"] == "session_unknown"
    assert "camera: missing" in client.post("/v1/sessions", json={}).json()["detail"]
