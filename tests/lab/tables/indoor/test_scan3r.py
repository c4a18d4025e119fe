import io
import json

import numpy as np
import pytest
from PIL import Image

from placegraph.core.geometry import between, rotation_from_vector
from placegraph.errors import InputError, OptionError
from placegraph.indoor.pose.window import level_poses
from placegraph.io.capture.tum import write_tum
from placegraph_io.dataset.scan3r import read_rooms
from placegraph_lab.tables.indoor import scan3r
from placegraph_lab.tables.indoor.scan3r import (
    cross_temporal_pairs,
    read_pairs,
    read_query,
    scan_folder,
    split_rooms,
)
from placegraph_lab.tables.indoor.windows import Odometry, drifting_windows


def transform(yaw, x, y):
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, 0.1], [0, 0, 0, 1]])


ROOMS = {  # room: type, yaws of its rescans (None: kept back)
    "a0-x": ("train", [0.5]),
    "b0-x": ("validation", [0.1, 0.2, 0.3]),
    "c0-x": ("validation", [1.0]),
    "d0-x": ("validation", [2.0]),
    "e0-x": ("validation", []),
    "f0-x": ("test", [None]),
}


@pytest.fixture
def rooms(tmp_path):
    content = []
    for room, (kind, yaws) in ROOMS.items():
        scans = []
        for i, yaw in enumerate(yaws, 1):
            scan = {"reference": f"{room[0]}{i}-x"}
            if yaw is not None:
                matrix = transform(yaw, i, -i)
                scan |= {"transform": matrix.T.ravel().tolist(), "removed": [4] if i == 2 else []}
            scans.append(scan)
        content.append({"reference": room, "type": kind, "scans": scans})
    path = tmp_path / "3RScan.json"
    path.write_text(json.dumps(content))
    return read_rooms(path)


def named(split):
    return {name: [room.reference for room in found] for name, found in split.items()}


def test_the_rule(rooms, monkeypatch):
    """Rooms of 3RScan's validation with the fewest scans stay it, the others are the test."""
    everything = split_rooms(rooms)
    assert len(everything["validation"]) == 4
    assert not everything["test"]
    monkeypatch.setattr(scan3r, "VALIDATION_ROOMS", 2)
    assert named(split_rooms(rooms)) == {
        "train": ["a0-x"], "validation": ["c0-x", "e0-x"], "test": ["b0-x", "d0-x"],
    }  # fmt: skip


def test_lists_part_the_rooms(rooms, tmp_path):
    (tmp_path / scan3r.LISTS["test"]).write_text("# mine\nb2-x\na0-x\n")
    assert named(split_rooms(rooms, tmp_path)) == {
        "train": [], "validation": ["c0-x", "d0-x", "e0-x"], "test": ["a0-x", "b0-x"],
    }  # fmt: skip
    (tmp_path / scan3r.LISTS["train"]).write_text("b0-x\n")
    with pytest.raises(InputError, match="both name the room b0-x"):
        split_rooms(rooms, tmp_path)


def test_pairs(rooms):
    pairs = cross_temporal_pairs(rooms.rooms)
    assert len(pairs) == 2 + 4 * 3 + 2 + 2
    assert all(pair.map != pair.query for pair in pairs)
    assert {(p.map[0], p.query[0]) for p in pairs} == {(r, r) for r in "abcd"}
    assert {p.name: p.changed for p in pairs if p.room == "b0-x"} == {
        f"b{q} in b{m}": 2 in {q, m} for q in range(4) for m in range(4) if q != m
    }
    one = cross_temporal_pairs(rooms.rooms, np.random.default_rng(0))
    assert [pair.query for pair in one] == list(dict.fromkeys(pair.query for pair in pairs))


def write_sequence(folder, poses):
    folder.mkdir(parents=True)
    intrinsics = "20 0 11.5 0 0 20 7.5 0 0 0 1 0 0 0 0 1"
    lines = [
        f"m_{kind}{side} = {n}"
        for kind in ("color", "depth")
        for side, n in (("Width", 24), ("Height", 16))
    ]
    lines += [f"m_calibration{kind}Intrinsic = {intrinsics}" for kind in ("Color", "Depth")]
    (folder / "_info.txt").write_text("\n".join([*lines, f"m_frames.size = {len(poses)}"]))
    for i, pose in enumerate(poses):
        file = io.BytesIO()
        Image.new("RGB", (24, 16)).save(file, "JPEG")
        (folder / f"frame-{i:06d}.color.jpg").write_bytes(file.getvalue())
        np.savetxt(folder / f"frame-{i:06d}.pose.txt", pose)


def test_windows(rooms, tmp_path):
    lying = np.array([[0, 0, 1, 0.0], [0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    lying[:3, 1] = np.cross(lying[:3, 2], lying[:3, 0])
    poses = [transform(0.1 * i, 0.2 * i, 0.3) @ lying for i in range(23)]
    poses[3] = np.full((4, 4), -np.inf)
    write_sequence(tmp_path / "scenes" / "c1-x" / "sequence", poses)
    (pair,) = (p for p in cross_temporal_pairs(rooms.rooms) if p.query == "c1-x")
    windows = drifting_windows(
        pair.name, *read_query(tmp_path, pair, every=2), 5, np.random.default_rng(0)
    )
    indices = [[f.index for f in w.capture] for w in windows]
    assert indices == [[0, 2, 4, 6, 8], [10, 12, 14, 16, 18]]
    for window in windows:
        last = window.capture[-1].index
        assert np.allclose(window.truth[:3, 3], (transform(1.0, 1, -1) @ poses[last])[:3, 3])
        assert np.allclose(window.capture[0].odometry[:3, 3], 0)  # nothing of the truth is left
        moved = window.capture[-1].odometry[:3, 3] - window.capture[0].odometry[:3, 3]
        assert np.linalg.norm(moved) == pytest.approx(1.6, abs=0.2)
    with pytest.raises(OptionError, match="every"):
        read_query(tmp_path, pair, every=0)
    with pytest.raises(InputError, match="contains no scan c0-x"):
        scan_folder(tmp_path, "c0-x")


def odometry_of(name, rooms, tmp_path, count=6):
    """Capture of a scan that lies on its side, its truth, and windows of three frames of it."""
    lying = np.array([[0, 0, 1, 0.0], [0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    lying[:3, 1] = np.cross(lying[:3, 2], lying[:3, 0])
    poses = np.array([transform(0.1 * i, 0.2 * i, 0.3) @ lying for i in range(count)])
    write_sequence(tmp_path / "c1-x/sequence", poses)
    (pair,) = (p for p in cross_temporal_pairs(rooms.rooms) if p.query == "c1-x")
    capture, truth = read_query(tmp_path, pair)
    windows = drifting_windows(
        pair.name, capture, truth, 3, np.random.default_rng(0),
        odometry=Odometry.of_name(name), recording=pair.query,
    )  # fmt: skip
    return poses, capture, truth, windows


def relative(poses):
    return np.linalg.inv(poses[0]) @ poses[1:]


def test_exact_odometry_is_the_truth_in_a_frame_of_its_own(rooms, tmp_path):
    _, _, truth, windows = odometry_of("exact", rooms, tmp_path)
    for window, rows in zip(windows, (slice(3), slice(3, 6)), strict=True):
        own = window.capture.odometry
        np.testing.assert_allclose(relative(own), relative(truth[rows]), atol=1e-9)
        assert np.abs(own[0, :3, 3]).max() < 1e-9 < np.abs(truth[rows][0, :3, 3]).max()
        down = np.einsum("tij,tj->ti", truth[rows][:, :3, :3], window.capture.gravity)
        np.testing.assert_allclose(down, np.tile([0, 0, -1.0], (3, 1)), atol=1e-9)
    *_, drifting = odometry_of("drift", rooms, tmp_path / "other")
    for one, other in zip(windows, drifting, strict=True):
        turned = np.arccos((one.capture.gravity * other.capture.gravity).sum(axis=1))
        assert 1e-4 < turned.max() < 0.02
        assert (
            np.abs(relative(one.capture.odometry) - relative(other.capture.odometry)).max() > 1e-4
        )


def test_odometry_of_a_slam_system(rooms, tmp_path):
    """In a tilted frame, of images as they are stored; lost frames are left out."""
    poses, *_ = odometry_of("exact", rooms, tmp_path / "exact")
    tilted = np.eye(4)
    tilted[:3, :3] = rotation_from_vector(np.array([0.7, -0.4, 2.0]))
    bent = poses.copy()
    bent[:, 2, 3] += 0.03 * np.arange(len(poses))  # it climbs, and nobody did
    kept = [0, 1, 2, 4, 5]
    (tmp_path / "slam").mkdir()
    write_tum(tmp_path / "slam/c1-x.tum", kept, (tilted @ bent)[kept])
    for given in (tmp_path / "slam", tmp_path / "slam/c1-x.tum"):
        _, capture, truth, windows = odometry_of(str(given), rooms, tmp_path / given.name / "scan")
        assert [[f.index for f in w.capture] for w in windows] == [kept[:3]]
        np.testing.assert_allclose(windows[0].truth, truth[2])
        level = level_poses(windows[0].capture.odometry, windows[0].capture.gravity)
        exact = level_poses(truth[:3], windows[0].capture.gravity)
        climbed = (level - exact)[:, 2]
        np.testing.assert_allclose(np.diff(climbed), 0.03, atol=1e-6)
        steps, right = (between(p[:-1], p[1:])[:, [0, 1, 3]] for p in (level, exact))
        np.testing.assert_allclose(steps, right, atol=1e-6)
        assert windows[0].capture.gravity == pytest.approx(capture.gravity[:3], abs=1e-6)
    with pytest.raises(InputError, match="exact, drift, a trajectory"):
        Odometry.of_name(str(tmp_path / "none"))
    before = Odometry.of_name(str(tmp_path / "slam")).digest()
    write_tum(tmp_path / "slam/c1-x.tum", kept, poses[kept])
    assert Odometry.of_name(str(tmp_path / "slam")).digest() != before


def test_a_list_of_pairs(rooms, tmp_path):
    path = tmp_path / "pairs.txt"
    path.write_text("b2-x b0-x  # the first\n\nc0-x c1-x\n")
    found = read_pairs(path, rooms)
    assert [(pair.map, pair.query, pair.room) for pair in found] == [
        ("b2-x", "b0-x", "b0-x"), ("c0-x", "c1-x", "c0-x"),
    ]  # fmt: skip
    (same,) = (p for p in cross_temporal_pairs(rooms.rooms) if p.query == "c1-x")
    np.testing.assert_allclose(found[1].map_from_query, same.map_from_query)
    for text, why in (
        ("", "holds no pair"), ("b0-x", "line 1: a line is"), ("\nb0-x b0-x", "line 2"),
        ("b0-x c0-x", "are not two aligned scans"), ("f0-x f1-x", "are not two aligned scans"),
        ("q0-x q1-x", "line 1"),
    ):  # fmt: skip
        path.write_text(text)
        with pytest.raises(InputError, match=why):
            read_pairs(path, rooms)
