"""NVIDIA Warp on its CPU device: the same hits as compiled Python, and starts without a word."""

import subprocess
import sys

import numpy as np
import pytest

from placegraph.errors import MissingExtraError, OptionError
from placegraph.indoor.rays import RayCaster, warp
from placegraph.indoor.rays.warp import WarpCaster

pytest.importorskip("warp", reason="needs NVIDIA Warp, the extra gpu")

ROOM = (0.0, 0.0, 0.0), (10.0, 8.0, 3.0)


def test_warp_agrees_on_soup(soup, anyhow, tiles, differing, rng):
    mesh = soup(5000, rng)
    gpu, cpu = WarpCaster(*mesh, device="cpu"), RayCaster(*mesh)
    for rays in (anyhow(30_000, rng, *ROOM), tiles(20, rng, *ROOM)):
        a, b = gpu.cast(*rays), cpu.cast(*rays)
        assert differing(a, b) <= 1e-4
        same = (a.triangle == b.triangle) & (a.triangle >= 0)
        np.testing.assert_allclose(a.u[same], b.u[same], atol=1e-3)
        np.testing.assert_allclose(a.v[same], b.v[same], atol=1e-3)


def test_warp_agrees_on_the_house(house, anyhow, tiles, differing, rng):
    vertices, triangles = house
    gpu, cpu = WarpCaster(vertices, triangles, device="cpu"), RayCaster(vertices, triangles)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    for rays in (anyhow(20_000, rng, low, high), tiles(15, rng, low, high)):
        assert differing(gpu.cast(*rays), cpu.cast(*rays)) <= 1e-4


def test_rays_that_are_none_hit_nothing(box):
    room = WarpCaster(*box((0, 0, 0), (4, 4, 3)), device="cpu")
    origins, directions = np.ones((6, 3)), np.tile([0.5, 0.0, 0.0], (6, 1))
    directions[1], directions[2, 1], origins[3, 2], origins[4, 0] = 0.0, np.nan, np.inf, 1e300
    hits = room.cast(origins, directions)
    np.testing.assert_allclose(hits.distance, [6, np.inf, np.inf, np.inf, np.inf, 6])
    assert (hits.triangle[1:5] == -1).all()
    assert len(room.cast(np.zeros((0, 3)), np.zeros((0, 3))).triangle) == 0


@pytest.mark.parametrize("device", ["tpu", "cpu:1", "cuda:x", "cuda:", ""])
def test_devices_that_are_none(box, device):
    with pytest.raises(OptionError, match="device is"):
        WarpCaster(*box((0, 0, 0), (1, 1, 1)), device=device)


def test_a_gpu_that_is_not_there(box, monkeypatch):
    monkeypatch.setattr(warp, "_has_driver", lambda: False)
    with pytest.raises(OptionError, match="no CUDA driver; choose 'cpu' or 'auto'"):
        WarpCaster(*box((0, 0, 0), (1, 1, 1)))


def test_without_warp(box, monkeypatch):
    monkeypatch.setitem(sys.modules, "warp", None)
    with pytest.raises(MissingExtraError, match=r"install `placegraph\[gpu\]`"):
        WarpCaster(*box((0, 0, 0), (1, 1, 1)), device="cpu")


def test_warp_starts_without_a_word():
    """No banner, no notes on compilation; and what the caller had set holds again afterwards."""
    program = """
import numpy as np, warp
from placegraph.indoor.rays.warp import _QUIET, WarpCaster
before = [getattr(warp.config, name, None) for name in _QUIET]
caster = WarpCaster(np.eye(3), [[0, 1, 2]], device="cpu")
assert caster.cast(np.zeros(3), np.ones((1, 3))).triangle == [0]
assert [getattr(warp.config, name, None) for name in _QUIET] == before
"""
    command = [sys.executable, "-W", "error", "-c", program]
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
    complaints = [line for line in done.stderr.splitlines() if "NVIDIA CUDA driver" not in line]
    assert (done.returncode, done.stdout, complaints) == (0, "", [])
