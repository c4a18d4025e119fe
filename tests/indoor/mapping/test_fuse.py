from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from placegraph.core.geometry import Camera, level_from_camera, pose_matrix, rotation_z
from placegraph.core.threads import limit_threads
from placegraph.errors import InputError, OptionError
from placegraph.indoor.mapping.fuse import FuseOptions, drop_specks, find_good_poses, fuse
from placegraph.indoor.mapping.fuse_kernels import compute_facets
from placegraph.indoor.rays import RayCaster
from placegraph.io.capture.frame import Frame

CAMERA = Camera(120, 90, 90.0, 90.0, 60.0, 45.0)
ROOM = np.array([[-2.0, -1.5, 0.0], [2.0, 1.5, 2.4]])
PAINT = np.array(
    [[200, 0, 0], [0, 200, 0], [0, 0, 200], [200, 200, 0], [0, 200, 200], [200, 0, 200]]
)
"""Of the walls at low x, y, z and at high x, y, z."""


def rays_of(camera, pose):
    v, u = np.mgrid[0 : camera.height, 0 : camera.width] + 0.5
    return camera.directions(np.stack([u, v], axis=-1)) @ pose[:3, :3].T


def pose_at(at, yaw, down=0.0):
    return pose_matrix([*at, yaw], level_from_camera([0.0, np.cos(down), np.sin(down)]))


def room_view(yaw, down=0.0, at=(0.1, 0.0, 1.2), *, camera=CAMERA, gain=1.0):
    pose = pose_at(at, yaw, down)
    rays = rays_of(camera, pose)
    with np.errstate(divide="ignore"):
        walls = np.concatenate([(ROOM[0] - at) / rays, (ROOM[1] - at) / rays], axis=-1)
    walls[walls <= 0] = np.inf
    rgb = (gain * PAINT[walls.argmin(axis=-1)]).astype(np.uint8)
    return Frame.from_arrays(rgb, camera, depth=walls.min(axis=-1), odometry=pose), pose


def plane_view(distance, *, camera=CAMERA, slope=0.0, noise=None, pose=None):
    pose = np.eye(4) if pose is None else pose
    rays = rays_of(camera, np.eye(4))
    depth = distance / (1.0 - slope * rays[..., 0])
    if noise is not None:
        depth = depth + noise.normal(0, 0.005, depth.shape)
    rgb = np.full((camera.height, camera.width, 3), 100, np.uint8)
    return Frame.from_arrays(rgb, camera, depth=depth, odometry=pose), pose


@pytest.fixture(scope="session")
def views():
    made = [room_view(yaw, down) for yaw in np.arange(0, 6.2, 0.7) for down in (-0.6, 0.2, 0.9)]
    frames, poses = zip(*made, strict=True)
    return frames, np.array(poses)


PLAIN = FuseOptions(gains=False)


@pytest.fixture(scope="module")
def fused(views):
    return fuse(*views, voxel=0.06)


def normals_of(mesh):
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    return np.cross(b - a, c - a)


def test_a_room_is_found_where_it_is_in_its_colours(fused):
    gaps = np.abs(fused.vertices[:, None] - ROOM).reshape(-1, 6)
    assert np.quantile(gaps.min(axis=1), 0.95) < 0.06 / 5
    inward = np.array([0.1, 0.0, 1.2]) - fused.vertices[fused.triangles[:, 0]]
    facing = (normals_of(fused) * inward).sum(axis=1)
    assert (facing < 0).mean() < 0.01
    area = 0.5 * np.linalg.norm(normals_of(fused), axis=1).sum()
    size = ROOM[1] - ROOM[0]
    whole = 2 * (size[0] * size[1] + size[1] * size[2] + size[2] * size[0])
    assert 0.85 * whole < area < 1.02 * whole
    middle = np.sort(gaps, axis=1)[:, 1] > 0.2  # not near an edge of the room
    off = np.abs(fused.colours[middle].astype(int) - PAINT[gaps[middle].argmin(axis=1)])
    assert middle.sum() > 2000
    assert np.quantile(off, 0.99) <= 2
    edges = np.sort(fused.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    assert (count > 2).mean() < 1e-3
    assert (count == 1).mean() < 0.05
    assert (fused.triangles.min(), fused.triangles.max()) == (0, len(fused.vertices) - 1)


@settings(max_examples=5)
@given(
    distance=st.floats(0.6, 3.0), slope=st.floats(-1.0, 1.0), turn=st.floats(-3.0, 3.0),
    seed=st.integers(0, 9),
)  # fmt: skip
def test_a_plane_is_flat(distance, slope, turn, seed):
    voxel = 0.04
    pose = np.eye(4)
    pose[:3, :3] = rotation_z(turn) @ pose_at([0, 0, 0], turn)[:3, :3]
    pose[:3, 3] = 3 * turn
    noise = np.random.default_rng(seed)
    views = [plane_view(distance, slope=slope, noise=noise, pose=pose) for _ in range(4)]
    mesh = fuse([f for f, _ in views], [p for _, p in views], voxel=voxel)
    points = (mesh.vertices - pose[:3, 3]) @ pose[:3, :3]
    off = (points[:, 2] - slope * points[:, 0] - distance) / np.hypot(1, slope)
    assert np.sqrt((off**2).mean()) < voxel / 5
    assert ((normals_of(mesh) @ pose[:3, :3])[:, 2] < 0).mean() > 0.99


def test_a_ball_is_round():
    radius, frames, poses = 0.5, [], []
    for yaw in np.arange(0, 6.2, 0.6):
        pose = pose_at([-2 * np.cos(yaw), -2 * np.sin(yaw), 0.0], yaw)
        rays = rays_of(CAMERA, pose)
        a, b = (rays**2).sum(axis=-1), rays @ pose[:3, 3]
        root = b * b - a * (4 - radius**2)
        with np.errstate(invalid="ignore"):
            depth = (-b - np.sqrt(root)) / a
        frames.append(Frame.from_arrays(np.full((90, 120, 3), 50, np.uint8), CAMERA, depth=depth))
        poses.append(pose)
    mesh = fuse(frames, np.array(poses), voxel=0.04)
    off = np.linalg.norm(mesh.vertices, axis=1) - radius
    assert np.abs(np.median(off)) < 0.04 / 10
    assert np.quantile(np.abs(off), 0.95) < 0.04 / 4
    outward = (normals_of(mesh) * mesh.vertices[mesh.triangles[:, 0]]).sum(axis=1)
    assert (outward > 0).mean() > 0.99


def test_a_furnished_room_is_where_its_mesh_is(room, walk, truth):
    mesh = fuse(walk.frames, truth(walk), voxel=0.04)
    rows = np.random.default_rng(0).permutation(len(mesh.triangles))[:2000]
    points = mesh.vertices[mesh.triangles[rows]].mean(axis=1)
    out = normals_of(mesh)[rows]
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    hits = RayCaster(room.mesh.vertices, room.mesh.triangles).cast(points + 0.15 * out, -out)
    off = np.abs(hits.distance - 0.15)
    assert np.median(off) < 0.01
    assert (off < 0.05).mean() > 0.9
    assert mesh.stats.agreement < 0.02
    assert len(mesh.stats.residuals) == len(walk.frames)


def test_threads_change_nothing(views):
    frames, poses = views[0][:4], views[1][:4]
    with limit_threads(1):
        one = fuse(frames, poses, voxel=0.08)
    with limit_threads(2):
        two = fuse(frames, poses, voxel=0.08)
    for name in ("vertices", "triangles", "colours"):
        assert np.array_equal(getattr(one, name), getattr(two, name)), name


def test_frames_without_colour_add_surface_and_no_colour(views, fused):
    frames = [
        f if i % 2 else Frame.from_arrays(None, f.camera, depth=f.depth(), odometry=f.odometry)
        for i, f in enumerate(views[0])
    ]
    found = fuse(frames, views[1], voxel=0.06)
    np.testing.assert_array_equal(found.vertices, fused.vertices)
    painted = found.colours.any(axis=1)
    assert painted.mean() > 0.5
    off = np.abs(found.colours[painted].astype(int) - fused.colours[painted])
    assert np.median(off) <= 2


def test_frames_that_cannot_be_used_are_counted(views):
    frames, poses = list(views[0][:8]), views[1][:8].copy()
    poses[1, 0, 3] = np.nan
    poses[3, :3, 3] += 9.0
    poses[5, :3, :3] *= 2.0
    blind = Frame.from_arrays(frames[6].rgb(), frames[6].camera)
    dark = Frame.from_arrays(frames[7].rgb(), frames[7].camera, depth=np.zeros((90, 120)))
    left_out, told = Counter(), []
    found = fuse(
        [*frames[:6], blind, dark], poses, voxel=0.08, left_out=left_out,
        progress=lambda done, total: told.append((done, total)),
    )  # fmt: skip
    assert left_out["frames with a broken pose"] == 3
    assert left_out["frames without depth"] == 2
    assert told == [(n + 1, 8) for n in range(8)]
    assert found.stats.frames == 3
    assert np.flatnonzero(np.isfinite(found.stats.residuals)).tolist() == [0, 2, 4]


def test_nothing_to_fuse_is_an_error(views):
    frame = views[0][0]
    blind = Frame.from_arrays(frame.rgb(), frame.camera)
    with pytest.raises(InputError, match="1 frames without depth"):
        fuse([blind], np.eye(4)[None])
    with pytest.raises(InputError, match="no frame"):
        fuse([])
    with pytest.raises(InputError, match="no surface"):
        fuse([frame], np.eye(4)[None], options=replace(PLAIN, least=1e9))


def test_a_broken_image_is_an_error_that_names_it(room_world, render):
    walk = render(room_world, "broken", 5, frames=3)
    broken = sorted((walk.path / "depth").iterdir())[1]
    broken.write_bytes(broken.read_bytes()[:100])
    with pytest.raises(InputError, match=broken.name):
        fuse(walk.frames)


@pytest.mark.parametrize(
    ("options", "what"),
    [
        ({"voxel": 0.0}, "voxel"), ({"voxel": np.nan}, "voxel"), ({"voxel": 5.0}, "voxel"),
        ({"truncation": 0.01}, "truncation"), ({"reach": 0.0}, "reach"),
    ],
)  # fmt: skip
def test_options_out_of_range_are_refused(views, options, what):
    with pytest.raises(OptionError, match=what):
        fuse(views[0][:2], **({"poses": views[1][:2]} | options))


def test_memory_is_bounded(views):
    frames, poses = views[0][:3], views[1][:3]
    small = FuseOptions(memory=0.004)
    found = fuse(frames, poses, voxel=0.02, options=small)
    assert found.stats.voxel > 0.02
    assert found.stats.memory <= 0.004e9
    assert "2 cm" in found.stats.coarser
    with pytest.raises(OptionError, match="was reached at frame 1 of 3"):
        fuse(frames, poses, voxel=0.02, options=replace(small, coarsen=False))
    with pytest.raises(OptionError, match="memory"):
        FuseOptions(memory=100.0)


def test_changes_of_exposure_vanish():
    made = [
        room_view(yaw, 0.2, gain=0.6 + 0.4 * (n % 2))
        for n, yaw in enumerate(np.arange(0, 6.2, 0.3))
    ]
    frames, poses = zip(*made, strict=True)
    spread = {}
    for gains in (False, True):
        found = fuse(frames, np.array(poses), voxel=0.08, options=FuseOptions(gains=gains))
        far = np.abs(found.vertices[:, None] - ROOM).reshape(-1, 6)
        wall = (far.argmin(axis=1) == 0) & (np.sort(far, axis=1)[:, 1] > 0.3)
        spread[gains] = np.std(found.colours[wall, 0].astype(float))
    assert spread[True] < 3 < spread[False]
    assert found.stats.gains[1::2].mean() < found.stats.gains[::2].mean()
    assert np.exp(np.log(found.stats.gains).mean()) == pytest.approx(1.0)


def test_bad_poses_show_in_the_agreement(views):
    frames, poses = views
    rng = np.random.default_rng(1)
    shaken = poses.copy()
    shaken[:, :3, 3] += rng.normal(0, 0.1, (len(poses), 3))
    good, bad = (fuse(frames, p, voxel=0.06).stats for p in (poses, shaken))
    assert good.agreement < 0.01 < bad.agreement
    assert good.apart < bad.apart


WIDE = (-0.28, 0.09, 0.0, 0.0, -0.015)


def test_a_wall_behind_a_wide_lens_is_flat():
    camera = Camera(120, 90, 90.0, 90.0, 60.0, 45.0, WIDE)
    frame, pose = plane_view(1.5, camera=camera, slope=0.4)
    mesh = fuse([frame], pose[None], voxel=0.04)
    off = (mesh.vertices[:, 2] - 0.4 * mesh.vertices[:, 0] - 1.5) / np.hypot(1, 0.4)
    assert np.sqrt((off**2).mean()) < 0.04 / 5
    assert (mesh.colours == 100).all()


def test_slips_are_told_from_walks_and_turns():
    walk = np.tile(np.eye(4), (9, 1, 1))
    walk[:, 0, 3] = 0.3 * np.arange(9)
    assert find_good_poses(walk).all()
    apart = walk.copy()
    apart[4:, 1, 3] += 5.0  # another recording begins
    assert find_good_poses(apart).all()
    slipped = walk.copy()
    slipped[4, 1, 3] += 5.0
    assert np.flatnonzero(~find_good_poses(slipped)).tolist() == [4]
    assert find_good_poses(walk[:2]).all()
    assert find_good_poses(walk[:0]).shape == (0,)


EYE = np.array([90.0, 90.0, 60.0, 45.0])


def test_readings_between_two_surfaces_are_dropped():
    frame, _ = plane_view(1.0)
    depth = frame.depth().copy()
    depth[:, 60:] = 3.0
    depth[:, 60] = 2.0  # a mean of both sides
    kept = {edges: compute_facets(depth, EYE, 9.0, edges)[..., 4] for edges in (True, False)}
    assert (kept[True][:, 60] == 0).all()
    assert (kept[True][:, :58] > 0).all()
    assert (kept[True][:, 63:] > 0).all()
    assert (kept[True] > 0).sum() < (kept[False] > 0).sum()


def test_small_holes_are_bridged_and_specks_are_not_believed():
    frame, _ = plane_view(1.5, slope=0.3)
    whole = frame.depth()
    depth = whole.copy()
    depth[20:22, :] = np.nan
    depth[60:, :] = np.nan
    depth[70, 70] = 1.0
    facets = compute_facets(depth, EYE, 9.0, True)
    assert np.abs(facets[20:22, 5:-5, 4] - whole[20:22, 5:-5]).max() < 1e-3
    assert (facets[62:, :, 4] == 0).all()
    assert (compute_facets(whole, EYE, 1.0, True)[..., 4] == 0).all()


def test_small_parts_are_dropped_and_counted():
    points = np.array(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [5, 0, 0], [5.1, 0, 0], [5, 0.1, 0.0]]
    )
    triangles = np.array([[0, 1, 2], [4, 5, 6], [1, 3, 2]])
    colours = np.arange(21, dtype=np.uint8).reshape(7, 3)
    left_out = Counter()
    kept, rows, shades = drop_specks(points, triangles, colours, 0.1, left_out)
    assert rows.tolist() == [[0, 1, 2], [1, 3, 2]]
    assert kept.tolist() == points[:4].tolist()
    assert shades.tolist() == colours[:4].tolist()
    assert list(left_out.values()) == [1]
