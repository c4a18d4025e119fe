"""`placegraph scene anchor`: a map on Earth by pairs, by a pose, and what info and check say of it."""

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import placegraph as pg
from placegraph.core.geo import Anchor
from placegraph.indoor.map.mesh import Mesh

TRUE = Anchor(7.42, 43.73, 50.0, 1.1)


@pytest.fixture
def scene(tmp_path):
    corners = np.array([[0, 0, 0], [5, 0, 0], [5, 4, 0], [0, 4, 0]], np.float32)
    triangles = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    pg.SceneMap.create(Mesh.plain(corners, triangles), ["1"], ["floor"], floor=0.0).save(
        tmp_path / "a.scene"
    )
    return tmp_path / "a.scene"


def pairs(points):
    """Options of points and their places."""
    for point in points:
        place = TRUE.to_earth([*point, 0.0][:3])
        said = ",".join(f"{v:.9f}" for v in place[: len(point)])
        yield from ("--pair", f"{','.join(map(str, point))}={said}")


def test_by_pairs_into_another_file(run, scene, tmp_path):
    out, before = tmp_path / "b.scene", scene.read_bytes()
    points = [(0, 0, 0), (5, 0, 0), (5, 4, 1), (0, 4, 1)]
    plan = tmp_path / "plan.png"
    result = run("scene", "anchor", scene, *pairs(points), "--level", "2", "-o", out, "--png", plan)
    assert (result.code, result.err) == (0, "")
    assert "100%" in result.out
    assert scene.read_bytes() == before
    with Image.open(plan) as image:
        assert image.width == 1200
    (anchor,) = pg.open_map(out).anchors
    assert np.allclose(anchor.to_earth((5, 4, 1)), TRUE.to_earth((5, 4, 1)), atol=1e-5)
    assert (anchor.level, anchor.method) == ("2", "pairs")
    told = json.loads(run("scene", "info", out, "--json").out)["anchors"]
    assert told[0]["heading_deg"] == pytest.approx(np.degrees(1.1), abs=0.01)
    assert "anchors" in run("scene", "info", out).out


def test_by_the_fixes_of_the_capture_that_it_was_made_of(run, scene, tmp_path):
    folder = tmp_path / "walk"
    (folder / "rgb").mkdir(parents=True)
    at = [(1, 1, 1), (4, 1, 1), (4, 3, 1), (1, 3, 1)]
    for i in range(4):
        Image.new("RGB", (32, 24)).save(folder / "rgb" / f"{i}.png")
    (folder / "camera.json").write_text(
        '{"width": 32, "height": 24, "fx": 30, "fy": 30, "cx": 16, "cy": 12}'
    )
    rows = [f"{i} {x} {y} {z} 0.5 -0.5 0.5 -0.5" for i, (x, y, z) in enumerate(at)]
    (folder / "odometry.tum").write_text("\n".join(rows))
    before = scene.read_bytes()
    result = run("scene", "anchor", scene, "--capture", folder)
    assert (result.code, scene.read_bytes()) == (3, before)
    assert "0 of 4 frames have a GPS fix" in " ".join(result.err.split())
    fixes = [
        f"{i} {lon:.9f} {lat:.9f} {h} 0.1" for i, (lon, lat, h) in enumerate(TRUE.to_earth(at))
    ]
    (folder / "fixes.txt").write_text("\n".join(fixes))
    replace(pg.open_map(scene), viewpoints=np.array(at, float)).save(scene)
    told = json.loads(run("scene", "anchor", scene, "--capture", folder, "--json").out)
    assert told["anchors"][0]["heading_deg"] == pytest.approx(np.degrees(1.1), abs=0.1)
    assert told["anchors"][0]["method"] == "gps"
    assert "built from these frames, so" in told["notes"][0]


def test_by_a_pose_in_place_and_off_again_where_north_is_0(run, scene):
    result = run("scene", "anchor", scene, "--pose", "7.42,43.73,50,90", "--json")
    told = json.loads(result.out)["anchors"][0]
    assert (told["height_m"], told["heading_deg"], told["sd_deg"]) == (50, 90, 2)
    assert pg.open_map(scene).anchors[0].heading == pytest.approx(np.pi / 2)
    run("scene", "anchor", scene, "--remove", "--quiet")
    assert pg.open_map(scene).anchors == ()
    run("scene", "anchor", scene, "--pose", "7,43,0,359.999", "--quiet")
    assert json.loads(run("scene", "info", scene, "--json").out)["anchors"][0]["heading_deg"] == 0
    assert " 0.0°" in run("scene", "anchor", scene, "--pose", "7,43,0,359.999").out


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ([], "one of"),
        (["--pose", "7,43,0,0", "--remove"], "one of"),
        (["--in", "town.osm", "--building", "x", "--remove"], "only --remove"),
        (["--in", "town.osm"], "--in needs --building"),
        (["--pose", "7,43"], "give longitude, latitude, height"),
        (["--pose", "7,99,0,0"], "latitude is 99"),
        (["--pair", "0,0"], "give x and y in the map"),
        (["--pair", "0,0=7,43"], "at least 3"),
        (["--pose", "7,43,0,0", "--accuracy=-1,2"], "give metres and degrees"),
        (["--pose", "7,43,0,0", "--level", "top"], "--level is 'top'; give an OpenStreetMap level"),
    ],
)
def test_bad_options_leave_the_map_alone(run, scene, options, named):
    before = scene.read_bytes()
    result = run("scene", "anchor", scene, *options)
    assert result.code == 7
    assert named in result.err
    assert scene.read_bytes() == before


def test_a_height_is_asked_for_where_nobody_says_it(run, scene):
    for known, asked in (([], True), (["--height", "6.4"], False)):
        told = run("scene", "anchor", scene, *pairs([(0, 0), (5, 0), (5, 4)]), *known, "--json")
        assert any("give --height" in note for note in json.loads(told.out)["notes"]) == asked


def test_check_says_what_is_odd_of_an_anchor(run, scene):
    likely = Anchor(
        7.42, 43.73, 0, 1, np.diag([1, 1, 1e4, 0.01]), probability=0.6, residuals=(2.0, 4.0)
    )
    map_ = pg.open_map(scene)
    map_.anchored(likely, Anchor(7.42, 43.73, 0, 4, probability=0.4)).save(scene)
    said = run("scene", "check", scene).out
    for words in (
        "best of 2 candidates has probability 60%",
        "residuals of 3.2 m on average",
        "height on Earth is unknown",
    ):
        assert words in " ".join(said.split())
    map_.anchored(Anchor(7.42, 43.73, 0, 1)).save(scene)
    assert "has no covariance" in run("scene", "check", scene).out
