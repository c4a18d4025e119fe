"""Anchors by the GPS fixes of a capture: of the map's own frames, and of frames that are found in it."""

from dataclasses import replace

import numpy as np
import pytest

from placegraph.core.geo import Anchor
from placegraph.core.geometry import Camera, level_from_camera, pose_matrix
from placegraph.errors import InputError, OptionError
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame
from placegraph.io.capture.tum import write_tum
from placegraph.world import fit_capture

TRUE = Anchor(7.42, 43.73, 50.0, 1.1)
CAMERA = Camera(96, 72, 70.0, 70.0, 48.0, 36.0)


def walk(points, folder):
    """Capture at points (T, 3) [m] of the map."""
    level, image = level_from_camera((0, 1, 0)), np.zeros((72, 96, 3), np.uint8)
    frames = [
        Frame.from_arrays(image, CAMERA, odometry=pose_matrix([*p, 0], level), stamp=i, index=i)
        for i, p in enumerate(points)
    ]
    return replace(Capture.from_frames(frames), path=folder)


def fixes(folder, points, sigma, rng, heights=True):
    """`fixes.txt` of points (T, 3), with noise and one reflection in ten."""
    off = np.c_[rng.normal(0, sigma, (len(points), 2)), np.zeros(len(points))]
    off[::10, :2] += (60.0, -35.0)
    places = TRUE.to_earth(points + off)
    rows = [
        f"{i} {lon:.9f} {lat:.9f} {h if heights else np.nan} {1.515 * sigma}"
        for i, (lon, lat, h) in enumerate(places)
    ]
    (folder / "fixes.txt").write_text("\n".join(rows))


def around(count):
    """A way around a house."""
    turn = np.linspace(0, 2 * np.pi, count)
    return np.c_[14 * np.cos(turn), 11 * np.sin(turn), np.full(count, 1.6)]


def error(anchor, point):
    """How far off [m] the anchor has a point, and the heading [rad]."""
    there = TRUE.to_map(anchor.to_earth(point)) - point
    turn = (anchor.heading - TRUE.heading + np.pi) % (2 * np.pi) - np.pi
    return float(np.hypot(*there[:2])), abs(turn)


@pytest.mark.parametrize("drifted", [False, True])
def test_a_map_made_of_the_capture_is_not_localized_in(maps, tmp_path, drifted):
    points, rng = around(80), np.random.default_rng(5)
    fixes(tmp_path, points, 5.0, rng)
    scene = replace(maps["parlour"], viewpoints=np.round(points[::8], 2))
    capture = walk(points, tmp_path)
    if drifted:
        write_tum(tmp_path / "trajectory.tum", np.arange(80.0), [f.odometry for f in capture])
        capture = walk(points @ np.diag([1.1, 0.9, 1.0]) + (3, 4, 0), tmp_path)
    found = fit_capture(scene, capture)
    (anchor,) = found.anchors
    off, turn = error(anchor, (0, 0, 0))
    sd = np.sqrt(np.diag(anchor.covariance))
    assert off < 3 * np.hypot(*sd[:2]) < 9
    assert turn < 3 * sd[3] < 0.5
    assert anchor.height == pytest.approx(50.0, abs=3 * sd[2])
    assert (anchor.method, len(anchor.residuals)) == ("gps", 80)
    assert "built from these frames, so" in found.notes[0]
    assert "8 of 80 points are up to" in found.notes[1]


def test_other_frames_are_found_in_the_map_first(rooms, tmp_path):
    room = rooms["parlour"]
    film, true = room.film(21, 8), room.walk(21, 8).map_from_camera[:, :3, 3]
    fixes(tmp_path, true, 0.01, np.random.default_rng(6), heights=False)
    stamps = [frame.stamp for frame in film]
    rows = (tmp_path / "fixes.txt").read_text().splitlines()
    rows = [f"{s} {row.partition(' ')[2]}" for s, row in zip(stamps, rows, strict=True)]
    (tmp_path / "fixes.txt").write_text("\n".join(rows))
    found = fit_capture(room.scene, replace(film, path=tmp_path))
    off, _ = error(found.anchors[0], true[-1])
    assert off < 0.1
    assert "were first localized in the map" in found.notes[0]
    assert found.anchors[0].covariance[2, 2] > 50.0**2


def test_too_little_is_refused(maps, tmp_path):
    points, rng = around(40), np.random.default_rng(7)
    scene = replace(maps["parlour"], viewpoints=np.round(points[::4], 2))
    capture = walk(points, tmp_path)
    with pytest.raises(InputError, match=r"0 of 40 frames have a GPS fix, in fixes\.txt or"):
        fit_capture(scene, capture)
    (tmp_path / "fixes.txt").write_text("".join(f"{i} 7.42 43.73 50 5\n" for i in range(40)))
    with pytest.raises(OptionError, match="1 different fixes belong to localized frames, but"):
        fit_capture(scene, capture)
    near = points * (0.05, 0.05, 1.0)
    fixes(tmp_path, near, 5.0, rng)
    near_scene = replace(scene, viewpoints=np.round(near[::4], 2))
    with pytest.raises(OptionError, match="map, so the heading is unknown"):
        fit_capture(near_scene, walk(near, tmp_path))
    (rough,) = fit_capture(near_scene, walk(near, tmp_path), rough=True).anchors
    assert rough.covariance[3, 3] > np.radians(45) ** 2
    assert error(rough, (0, 0, 0))[0] < 4.0
    with pytest.raises(OptionError, match=r"not reliably localized in the map.*Give --pair"):
        fit_capture(maps["parlour"], walk(near, tmp_path)[:4])
