"""The map as a camera sees it: against closed forms, against captures, and against itself."""

import io
import threading
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from placegraph.core.geometry import (
    Camera,
    level_from_camera,
    pose_matrix,
    rotation_from_quaternion,
)
from placegraph.core.threads import limit_threads
from placegraph.errors import OptionError
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.render import SAMPLES, Renderer, camera_rays, render
from placegraph.indoor.scene_map import SceneMap

CAMERA = Camera(64, 48, 50.0, 52.0, 31.0, 25.0)
WIDE = Camera(57, 43, 40.0, 41.0, 28.0, 21.0, (-0.25, 0.06, 0.001, -0.002, -0.008))
"""Distorted, and of a size that is no multiple of a packet's."""
UPRIGHT = level_from_camera((0.0, 1.0, 0.0))


def looking(x=0.0, y=0.0, z=1.0, yaw_deg=0.0):
    return pose_matrix([x, y, z, np.radians(yaw_deg)], UPRIGHT)


def scene_of(*sheets, texture=None):
    vertices, colours = [], []
    for corner, side, other, colour in sheets:
        c, s, o = (np.array(v, float) for v in (corner, side, other))
        vertices += [c, c + s, c + s + o, c + o]
        colours += [colour] * 4
    count = len(sheets)
    triangles = (4 * np.arange(count)[:, None] + [0, 1, 2, 0, 2, 3]).reshape(-1, 3)
    pixels = np.full((1, 1, 3), 255, np.uint8) if texture is None else texture
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "PNG")
    mesh = replace(
        Mesh.plain(vertices, triangles, np.repeat(np.arange(count), 2), colours),
        uv=np.tile(np.float32([(0, 0), (1, 0), (1, 1), (0, 1)]), (count, 1)), textures=(pixels,),
    )  # fmt: skip
    ids = [str(i) for i in range(count)]
    return SceneMap.create(mesh, ids, ids, floor=0.0, encoded=(file.getvalue(),))


WHITE, BLACK = (255, 255, 255), (0, 0, 0)
WALL = ((3, 9, -9), (0, -18, 0), (0, 0, 18), WHITE)
"""The plane x = 3; its texture runs to the right and up, seen from the origin."""


def same(one, other):
    return all(
        np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
        for a, b in zip(vars(one).values(), vars(other).values(), strict=True)
    )


@pytest.mark.parametrize("yaw_deg", [0.0, 33.0, -50.0])
@pytest.mark.parametrize("camera", [CAMERA, WIDE])
def test_depth_of_a_wall(yaw_deg, camera):
    scene, pose = scene_of(WALL), looking(0.5, 0.2, 1.0, yaw_deg)
    drawn = render(scene, pose, camera)
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    forward = camera.directions(np.stack([u, v], -1)) @ pose[0, :3]
    expected = np.where(forward > 0, 2.5 / forward, np.nan)
    seen = drawn.mask
    assert seen.mean() > 0.4
    np.testing.assert_allclose(drawn.depth[seen], expected[seen], rtol=2e-6)
    far = np.abs(drawn.points[seen] - (3.0, 0.2, 1.0))
    np.testing.assert_allclose(drawn.points[seen][:, 0], 3.0, atol=1e-5)
    assert far[:, 1:].max() <= 10.1
    assert (drawn.objects[seen] == 0).all()
    assert set(np.unique(drawn.triangles[seen])) <= {0, 1}
    normals = drawn.normals(scene.mesh, pose)
    np.testing.assert_allclose(normals[seen], np.tile([-1.0, 0.0, 0.0], (seen.sum(), 1)))
    for values, nothing in ((drawn.depth, np.nan), (drawn.objects, -1), (drawn.colour, 0)):
        np.testing.assert_array_equal(np.unique(values[~seen]), [nothing] * bool((~seen).any()))
    assert np.isnan(drawn.points[~seen]).all()
    assert np.isnan(normals[~seen]).all()
    types = [(a.dtype.str[1:], a.shape[2:]) for a in vars(drawn).values()]
    assert types == [("u1", (3,)), ("f4", ()), ("i4", ()), ("i4", ()), ("f4", (3,))]
    assert {a.shape[:2] for a in vars(drawn).values()} == {(camera.height, camera.width)}


@pytest.mark.usefixtures("one_thread")
def test_a_walk_sees_what_its_capture_saw(room, walk, truth):
    camera, ids = walk.depth_camera, np.array([int(i) for i in room.graph.ids])
    for frame, pose in zip(walk, truth(walk), strict=True):
        drawn, depth, labels = render(room, pose, camera), frame.depth(), frame.labels()
        read = np.isfinite(depth)
        error = np.abs(drawn.depth - depth)[read]
        assert drawn.mask.mean() > 0.99
        assert np.quantile(error, 0.9) < 0.03, "what the depth camera's noise leaves"
        seen = np.where(drawn.mask, ids[drawn.objects], -1)
        assert (seen == labels).mean() > 0.995


poses = st.builds(
    lambda at, turn: (at, rotation_from_quaternion(turn)),
    st.tuples(*[st.floats(0.02, 0.98)] * 3),
    st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1),
)


@settings(max_examples=25)
@given(poses, st.sampled_from([CAMERA, WIDE]))
def test_points_project_to_their_pixels(room, where, camera):
    share, rotation = where
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, room.bounds[0] + np.array(share) * np.ptp(room.bounds, 0)
    drawn = render(room, pose, camera, samples=1)
    seen = drawn.mask & (drawn.depth > 0.05)
    inside = (drawn.points[seen] - pose[:3, 3]) @ rotation
    np.testing.assert_allclose(inside[:, 2], drawn.depth[seen], rtol=1e-5, atol=1e-6)
    v, u = np.nonzero(seen)
    uv = camera.project(inside)
    np.testing.assert_allclose(uv, np.stack([u, v], -1) + 0.5, atol=2e-3)
    rows = drawn.triangles[seen]
    np.testing.assert_array_equal(drawn.objects[seen], room.mesh.object_of[rows])
    corner = room.mesh.vertices[room.mesh.triangles[rows, 0]]
    normal = drawn.normals(room.mesh, pose)[seen]
    there = np.isfinite(normal).all(axis=1)
    assert np.abs(((drawn.points[seen] - corner) * normal)[there].sum(axis=1)).max(initial=0) < 1e-3
    towards = ((pose[:3, 3] - drawn.points[seen]) * normal)[there].sum(axis=1)
    assert towards.min(initial=0) > -1e-5
    assert (drawn.mask == np.isfinite(drawn.depth)).all()


def test_nothing_to_see(room):
    for x, yaw in ((room.bounds[1, 0] + 2.0, 0.0), (9e5, 90.0)):
        drawn = render(room, looking(x, yaw_deg=yaw), CAMERA)
        assert not drawn.mask.any()
        assert not drawn.colour.any()
        assert np.isnan(drawn.points).all()
        assert (drawn.objects == -1).all()


def test_colours_of_corners_are_blended():
    mesh = scene_of(WALL).mesh
    corners = [[0, 0, 0], [240, 0, 0], [240, 200, 0], [0, 200, 0]]
    mesh = Mesh.plain(mesh.vertices, mesh.triangles, colours=corners)
    drawn = render(SceneMap.create(mesh, ["0"], ["wall"], floor=0.0), looking(), CAMERA)
    y, z = drawn.points[..., 1], drawn.points[..., 2]
    expected = np.stack([240 * (9 - y) / 18, 200 * (z + 9) / 18, 0 * y], axis=-1)
    assert np.abs(drawn.colour - expected).max() < 0.51


def test_texels_are_blended():
    texels = np.zeros((1, 8, 3), np.uint8)
    texels[0, :, 0] = [0, 32, 64, 96, 128, 160, 192, 224]
    wall = ((3, 2, 0), (0, -4, 0), (0, 0, 2), WHITE)
    drawn = render(scene_of(wall, texture=texels), looking(), CAMERA)
    across = 8 * (2 - drawn.points[..., 1]) / 4 - 0.5
    inner = drawn.mask & (across > 0.01) & (across < 6.99)
    assert inner.sum() > 500
    assert np.abs(drawn.colour[inner][:, 0] - 32 * across[inner]).max() < 0.51
    seam = drawn.mask & (across < -0.01)
    assert seam.any()
    assert np.abs(drawn.colour[seam][:, 0] - (-across[seam] * 224)).max() < 0.6


@pytest.mark.parametrize("yaw_deg", [0.0, 60.0])
def test_fine_textures_become_their_mean(yaw_deg):
    row, column = np.mgrid[:512, :512]
    texture = np.repeat(((row + column) % 2 * 255).astype(np.uint8)[..., None], 3, axis=2)
    scene = scene_of(((3, 9, -9), (0, -18, 0), (0, 0, 18), WHITE), texture=texture)
    drawn = render(scene, looking(2.7 if yaw_deg else -9.0, 0, 0, yaw_deg), CAMERA, samples=1)
    # on the slope all but the near pixels, which are narrower than a texel
    covers = drawn.mask & (drawn.depth > (2.0 if yaw_deg else 0.0))
    assert covers.sum() > 200
    values = drawn.colour[covers][:, 0].astype(float)
    assert abs(values.mean() - 127.5) < 3.0
    assert np.quantile(np.abs(values - 127.5), 0.95) < 40.0


def test_stripes_stay_on_a_slope():
    stripes = np.zeros((1280, 256, 3), np.uint8)
    stripes[:, 128:] = 255
    floor = ((0, 4, 0), (0, -8, 0), (40, 0, 0), WHITE)
    drawn = render(scene_of(floor, texture=stripes), looking(0.0, 0.0, 1.0), CAMERA, samples=1)
    far = drawn.mask & (drawn.depth > 6.0) & (drawn.depth < 12.0)
    side = np.where(drawn.points[..., 1] < 0, 255, 0)
    clear = far & (np.abs(drawn.points[..., 1]) > 0.35) & (np.abs(drawn.points[..., 1]) < 3.0)
    assert clear.sum() > 50
    assert np.abs(drawn.colour[clear][:, 0] - side[clear].astype(float)).max() < 30


def _before_a_wall():
    tilt = 0.2
    scene = scene_of(WALL, ((2, -1.5, -8), (0, -9, 0), (0, 16 * tilt, 16), BLACK))
    pose = looking(0.0, 0.0, 0.0)
    fine = Camera(64 * 8, 48 * 8, 400.0, 416.0, 248.0, 200.0)
    black = render(scene, pose, fine, samples=1).objects == 1
    return SimpleNamespace(
        scene=scene, pose=pose, share=black.reshape(48, 8, 64, 8).mean(axis=(1, 3))
    )


@pytest.mark.parametrize("samples", SAMPLES)
def test_edges_become_smooth(samples):
    world = _before_a_wall()
    drawn = render(world.scene, world.pose, CAMERA, samples=samples)
    shades = len(np.unique(drawn.colour[..., 0]))
    off = np.abs((1.0 - world.share) - drawn.colour[..., 0] / 255.0)
    if samples == 1:
        assert shades == 2
        assert off.max() > 0.4
    else:
        assert shades > samples / 2
        assert off.max() < 1.01 / np.sqrt(samples)
        assert off[off > 0].mean() < 0.5 / np.sqrt(samples)
    stairs = render(world.scene, world.pose, CAMERA, samples=1)
    for name in ("depth", "objects", "triangles", "points"):
        np.testing.assert_array_equal(getattr(drawn, name), getattr(stairs, name))
    flat = (world.share == 0) | (world.share == 1)
    np.testing.assert_array_equal(drawn.colour[flat], stairs.colour[flat])


def test_where_the_map_ends_nothing_is_mixed_in():
    scene = scene_of(((2, -1.5, -8), (0, -9, 0), (0, 3, 16), (200, 100, 50)))
    drawn = render(scene, looking(), CAMERA, samples=16)
    assert 0 < drawn.mask.mean() < 1
    assert (drawn.colour[drawn.mask] == (200, 100, 50)).all()
    assert (drawn.colour[~drawn.mask] == 0).all()
    # where two things end together, edges are drawn anew
    stripe = ((1.9, -1.5, -8), (0, -0.2, 0), (0, 3, 16), (200, 100, 250))
    drawn = render(scene_of(((2, -1.5, -8), (0, -9, 0), (0, 3, 16), (200, 100, 50)), stripe),
                   looking(), CAMERA, samples=16)  # fmt: skip
    blue = drawn.colour[drawn.mask][:, 2]
    assert ((blue > 60) & (blue < 240)).any()
    assert (drawn.colour[drawn.mask][:, :2] == (200, 100)).all()


def test_threads_draw_the_same(room, walk, truth):
    pose, renderer = truth(walk)[4], Renderer(room)
    drawn = []
    for threads in (1, 2):
        with limit_threads(threads):
            drawn.append(renderer.render(pose, WIDE))
    asked = [threading.Thread(target=lambda: drawn.append(renderer.render(pose, WIDE)))
             for _ in range(3)]  # fmt: skip
    for thread in asked:
        thread.start()
    for thread in asked:
        thread.join()
    assert len(drawn) == 5
    assert all(same(drawn[0], other) for other in drawn[1:])


def test_rays_of_a_camera():
    rays = camera_rays(WIDE)
    assert rays is camera_rays(WIDE), "kept"
    points = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=-1)
    v, u = np.mgrid[: WIDE.height, : WIDE.width] + 0.5
    np.testing.assert_allclose(WIDE.project(points), np.stack([u, v], -1), atol=1e-3)
    folded = Camera(64, 48, 20.0, 20.0, 32.0, 24.0, (-2.0, 0.0, 0.0, 0.0))
    assert np.isfinite(camera_rays(folded)).all()
    assert render(scene_of(WALL), looking(), folded).mask.any()


@pytest.mark.parametrize(
    "pose",
    [
        np.eye(3), np.full((4, 4), np.nan), np.diag([1.0, 1.0, -1.0, 1.0]), 2 * np.eye(4),
        np.diag([1.0, 1.0, 1.0, 2.0]), np.ones((4, 4)), "north", None,
        pose_matrix([2e6, 0, 0, 0], UPRIGHT),
    ],
)  # fmt: skip
def test_poses_that_are_none(room, pose):
    with pytest.raises(OptionError, match="map_from_camera"):
        render(room, pose, CAMERA)


@pytest.mark.parametrize(
    ("option", "values"), [("samples", [0, 3, 32, -1, 4.5]), ("device", ["abacus", "cuda"])]
)
def test_options_out_of_range(room, option, values):
    for value in values:
        with pytest.raises(OptionError, match=f"{option} is"):
            render(room, np.eye(4), CAMERA, **{option: value})
