"""Renderings by NVIDIA Warp: on its CPU device, and on a GPU where there is one."""

import numpy as np
import pytest

from placegraph.core.geometry import Camera
from placegraph.errors import PlacegraphError
from placegraph.indoor.rays.warp import open_device
from placegraph.indoor.render.renderer import Eye, Renderer, Rendering, camera_rays, pattern
from placegraph.indoor.render.warp import WarpRenderer

pytest.importorskip("warp", reason="needs NVIDIA Warp, the extra gpu")

CAMERA = Camera(90, 61, 70.0, 71.0, 44.0, 31.0, (-0.2, 0.05, 0.001, -0.001))


def drawn_by(renderer, pose, samples):
    eye = Eye(
        camera_rays(CAMERA),
        np.ascontiguousarray(pose[:3, :3], np.float32),
        np.ascontiguousarray(pose[:3, 3], np.float32),
        np.zeros((0, 0), bool),
    )
    return renderer.draw(eye, Rendering.empty(CAMERA), pattern(samples))


def agree(warp, cpu):
    """As alike as two ways of rounding let them be."""
    alike = warp.triangles == cpu.triangles
    assert alike.mean() > 0.998
    assert (warp.objects == cpu.objects).mean() > 0.999
    np.testing.assert_allclose(warp.depth[alike], cpu.depth[alike], rtol=1e-3)
    np.testing.assert_allclose(warp.points[alike], cpu.points[alike], atol=5e-3)
    off = np.abs(warp.colour.astype(int) - cpu.colour).max(axis=-1)[alike]
    assert (off <= 1).mean() > 0.99
    assert off.mean() < 0.2
    for a, b in zip(vars(warp).values(), vars(cpu).values(), strict=True):
        assert (a.dtype, a.shape) == (b.dtype, b.shape)


@pytest.fixture(scope="module")
def poses(walk, truth):
    return truth(walk)[[0, 4, 9]]


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("samples", [1, 4])
def test_warp_draws_what_the_cpu_draws(room, poses, samples):
    warp, cpu = WarpRenderer(room, "cpu"), Renderer(room)
    for pose in poses:
        there = cpu.render(pose, CAMERA, samples=samples)
        assert there.mask.all()
        assert there.colour.std() > 20, "there is something to see"
        agree(drawn_by(warp, pose, samples), there)


def test_where_there_is_nothing(room):
    away = np.eye(4)
    away[:3, 3] = room.bounds[1] + 1.0
    drawn = drawn_by(WarpRenderer(room, "cpu"), away, 4)
    assert not drawn.mask.any()
    assert not drawn.colour.any()
    assert np.isnan(drawn.depth).all()
    assert (drawn.objects == -1).all()


def test_on_a_gpu(room, poses):
    try:
        open_device("cuda")
    except PlacegraphError as error:
        pytest.skip(f"needs a CUDA device: {error}")
    renderer = Renderer(room, device="cuda")
    for pose in poses:
        agree(renderer.render(pose, CAMERA), Renderer(room).render(pose, CAMERA))
