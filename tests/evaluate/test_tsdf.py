"""Frames with known poses become a coloured mesh."""

import numpy as np
import pytest

from placegraph.errors import InputError, OptionError
from placegraph.evaluate.tsdf import Volume, fuse, parts_of, pinhole, write_ply
from placegraph.formats.frame import Frame
from placegraph.geometry import Camera, level_from_camera, pose_matrix

ROOM = np.array([[-2.0, -1.5, 0.0], [2.0, 1.5, 2.4]])
CAMERA = Camera(80, 60, 60.0, 60.0, 40.0, 30.0)
PAINT = np.array(
    [[200, 0, 0], [0, 200, 0], [0, 0, 200], [200, 200, 0], [0, 200, 200], [200, 0, 200]]
)
"""Of the walls at low x, y, z and at high x, y, z."""


def view(yaw, down=0.0, at=(0.1, 0.0, 1.2)):
    """Frame of a camera in an empty room of six colours, and its pose."""
    level = level_from_camera([0.0, np.cos(down), np.sin(down)])
    pose = pose_matrix([*at, yaw], level)
    v, u = np.mgrid[0:60, 0:80] + 0.5
    rays = CAMERA.directions(np.stack([u, v], axis=-1)) @ pose[:3, :3].T
    with np.errstate(divide="ignore"):
        walls = np.concatenate([(ROOM[0] - at) / rays, (ROOM[1] - at) / rays], axis=-1)
    walls[walls <= 0] = np.inf
    depth = walls.min(axis=-1)
    rgb = PAINT[walls.argmin(axis=-1)].astype(np.uint8)
    return Frame.from_arrays(rgb, CAMERA, depth=depth, gravity=level.T @ [0, 0, -1.0]), pose


@pytest.fixture(scope="module")
def room():
    views = [view(yaw, down) for yaw in np.arange(0, 6.2, 0.7) for down in (-0.5, 0.2, 0.8)]
    frames, poses = zip(*views, strict=True)
    return fuse(frames, np.array(poses), voxel=0.08, truncation=0.2)


def test_a_room_is_found_where_it_is(room):
    mesh = room.mesh(4000, speck=20)
    gap = np.abs(mesh.vertices[:, None] - ROOM).min(axis=(1, 2))
    assert np.quantile(gap, 0.95) < 0.03
    assert np.abs(mesh.bounds() - ROOM).max() < 0.06
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    inward = np.array([0.1, 0.0, 1.2]) - a
    area = np.einsum("ij,ij->i", np.cross(b - a, c - a), inward) / np.linalg.norm(inward, axis=1)
    assert area[area > 0].sum() > 20 * -area[area < 0].sum()  # it faces free space


def test_walls_have_their_colour(room):
    mesh = room.mesh(4000, speck=20)
    gaps = np.abs(mesh.vertices[:, None] - ROOM).reshape(-1, 6)
    middle = np.sort(gaps, axis=1)[:, 1] > 0.3  # not near a corner
    off = np.abs(mesh.colours[middle].astype(int) - PAINT[gaps[middle].argmin(axis=1)])
    assert middle.sum() > 50
    assert np.quantile(off, 0.99) < 12


def test_nothing_seen_is_an_error():
    frame, pose = view(0.0)
    blind = Frame.from_arrays(frame.rgb(), CAMERA, depth=np.zeros((60, 80)))
    with pytest.raises(InputError, match="no depth"):
        fuse([blind], pose[None])
    empty = Volume.around(ROOM, voxel=0.1)
    empty.take(blind, pose)
    with pytest.raises(InputError, match="no surface"):
        empty.mesh()


def test_volumes_are_bounded():
    with pytest.raises(OptionError, match="voxels"):
        Volume.around(np.array([[0.0, 0, 0], [900, 900, 900]]))
    with pytest.raises(OptionError, match="distortion"):
        pinhole(Camera(80, 60, 60.0, 60.0, 40.0, 30.0, (0.1, 0.0, 0.0, 0.0)))


def test_parts_hang_together():
    triangles = np.array([[0, 1, 2], [4, 5, 6], [2, 3, 0], [6, 8, 9]])
    part = parts_of(11, triangles)
    assert part.tolist() == [0, 0, 0, 0, 4, 4, 4, 7, 4, 4, 10]


def test_a_mesh_is_written(room, tmp_path):
    mesh = room.mesh(500, speck=20)
    write_ply(tmp_path / "room.ply", mesh)
    data = (tmp_path / "room.ply").read_bytes()
    head, body = data.split(b"end_header\n")
    assert f"element vertex {len(mesh.vertices)}\n".encode() in head
    assert len(body) == 15 * len(mesh.vertices) + 13 * len(mesh)
    assert np.frombuffer(body, "<f4", 3).tolist() == mesh.vertices[0].tolist()
