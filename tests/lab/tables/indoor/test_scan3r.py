import io
import json

import numpy as np
import pytest
from PIL import Image

from placegraph.errors import InputError, OptionError
from placegraph_io.dataset.scan3r import read_rooms
from placegraph_lab.tables.indoor import scan3r
from placegraph_lab.tables.indoor.scan3r import (
    cross_temporal_pairs,
    read_query,
    scan_folder,
    split_rooms,
)
from placegraph_lab.tables.indoor.windows import drifting_windows


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
