from dataclasses import replace

import numpy as np
import pytest

from placegraph.core.geometry import rotation_z
from placegraph.errors import OptionError
from placegraph.indoor.build import build_scene
from placegraph_io.dataset.sens import read_sens
from placegraph_lab.tables.indoor.scannet import (
    ScanPair,
    derive_pairs,
    read_pairs,
    read_query,
    register_scans,
    true_poses,
)
from placegraph_lab.tables.indoor.windows import drifting_windows
from placegraph_lab.worlds.flat.flat import Flat

FOUND = ["scene0001_00", "scene0002_00", "scene0001_01", "scene0001_03", "scene0010_00"]
MAP_FROM_QUERY = np.eye(4)
MAP_FROM_QUERY[:3, :3] = rotation_z(np.pi / 2)
MAP_FROM_QUERY[:3, 3] = (2.0, 0.5, 0.0)


def named(pairs):
    return [(pair.map[5:], pair.query[5:]) for pair in pairs]


def test_pairs_are_of_one_room_and_of_different_scans():
    assert named(derive_pairs(FOUND)) == [("0001_00", "0001_01"), ("0001_00", "0001_03")]

    assert derive_pairs(FOUND)[0].name == "scene0001_01 in scene0001_00"
    assert derive_pairs([]) == []


def test_pairs_are_read_with_what_registers_them(tmp_path):
    numbers = " ".join(f"{v:.6f}" for v in MAP_FROM_QUERY.ravel())
    path = tmp_path / "pairs.txt"
    path.write_text(
        f"# mine\nscene0001_00 scene0001_01\n\nscene0001_01 scene0001_00 {numbers} # icp\n"
    )
    plain, registered = read_pairs(path)
    assert plain.map_from_query is None
    assert (registered.map, registered.query) == ("scene0001_01", "scene0001_00")
    np.testing.assert_allclose(registered.map_from_query, MAP_FROM_QUERY, atol=1e-6)


@pytest.fixture
def scans(scannet_world, tmp_path):
    """`scans/` with a query of 23 frames, of which two were not tracked."""
    scan = scannet_world.Scan(tmp_path / "scene0001_01", name="scene0001_01")
    recording = scannet_world.Recording(count=23, lost=(3, 4))
    recording.write_sens(scan.file(".sens"))
    scan.recording = recording
    return scan


PAIR = ScanPair("scene0001_00", "scene0001_01", MAP_FROM_QUERY)


def test_the_truth_is_that_of_the_aligned_map(scans, scannet_world):
    capture = read_sens(scans.folder)
    truth = true_poses(capture, scans.folder, PAIR)
    query_from_scan = np.linalg.inv(scannet_world.SCAN_FROM_MAP)
    expected = MAP_FROM_QUERY @ query_from_scan @ scans.recording.poses[10]
    np.testing.assert_allclose(truth[8], expected, atol=1e-5)
    with pytest.raises(OptionError, match="does not register scans"):
        true_poses(capture, scans.folder, ScanPair(PAIR.map, PAIR.query))


def test_windows_hold_no_truth(scans, rng):
    windows = drifting_windows(PAIR.name, *read_query(scans.folder.parent, PAIR, every=2), 5, rng)
    assert [w.name for w in windows] == [
        "scene0001_01 in scene0001_00 0:11:2", "scene0001_01 in scene0001_00 12:21:2",
    ]  # fmt: skip
    truth = true_poses(read_sens(scans.folder), scans.folder, PAIR)
    for window, last in zip(windows, (10, 20), strict=True):
        np.testing.assert_allclose(window.truth, truth[last - 2])
        poses = window.capture.odometry
        np.testing.assert_allclose(poses[0][:3, 3], 0.0, atol=1e-12)
        true = scans.recording.poses[[frame.index for frame in window.capture]]
        moved = np.linalg.norm(poses[-1, :3, 3]), np.linalg.norm(true[-1, :3, 3] - true[0, :3, 3])
        assert moved[0] == pytest.approx(moved[1], rel=0.1)
        assert abs(moved[0] - moved[1]) > 1e-6  # it drifts
        np.testing.assert_allclose(window.capture.gravity, [[0, 1, 0]] * 5, atol=0.02)
        assert np.abs(window.capture.gravity[:, 0]).max() > 1e-4  # a sensor's, not the truth's
        np.testing.assert_array_equal(
            window.capture[0].rgb(), scans.recording.colour[window.capture[0].index]
        )
    alone = read_query(scans.folder.parent, PAIR)
    assert drifting_windows(PAIR.name, *alone, 5, rng) == []
    with pytest.raises(OptionError, match="length is 0"):
        drifting_windows(PAIR.name, *alone, 0, rng)


LEGEND = """
[legend]
1 room: label=study walls=wallpaper palegoldenrod floor=parquet sienna
S sofa: look=fabric darkred
B shelf: label=bookcase height=2.1
T table: label=desk look=wood burlywood
C cabinet: label=sideboard height=0.8 look=wood peru
"""
HEAD = """
[flat]
name = Room
height = 2.6
[drawing]
"""
BEFORE = """
##########====######
#SSS           BBBB#
#SSS               #
#SSS          1    #
#                  #
#         TTT      #
#         TTT      :
#CCCCCC            #
####################
"""
AFTER = """
##########====######
#              BBBB#
#                  #
#             1    #
#           SSSS   #
#       TTT SSSS   #
#       TTT        :
#CCCCCC            #
####################
"""


@pytest.fixture(scope="module")
def rooms(tmp_path_factory):
    folder = tmp_path_factory.mktemp("room")
    found = []
    for name, drawing in (("before", BEFORE), ("after", AFTER)):
        interior = Flat.parse(HEAD + drawing.strip() + LEGEND).furnish(np.random.default_rng(1))
        interior.write_glb(folder / f"{name}.glb")
        found.append(build_scene(folder / f"{name}.glb", None))
    return found


@pytest.mark.all
def test_a_room_with_furniture_moved_is_found_again(rooms, rng):
    before, after = rooms
    map_from_query = np.eye(4)
    map_from_query[:3, :3] = rotation_z(np.pi / 2 + 0.02)  # alignments err by a degree
    map_from_query[:2, 3] = (-7.0, 4.0)
    inverse = np.linalg.inv(map_from_query)
    points = after.mesh.vertices @ inverse[:3, :3].T + inverse[:3, 3]
    points += rng.normal(0.0, 0.005, points.shape)
    query = replace(after, mesh=replace(after.mesh, vertices=points.astype(np.float32)))
    found = register_scans(before, query, rng)
    error = np.linalg.inv(map_from_query) @ found
    assert np.linalg.norm(error[:3, 3]) < 0.03
    assert np.degrees(np.arccos(np.clip((np.trace(error[:3, :3]) - 1) / 2, -1, 1))) < 0.5
