"""A focal length that is wrong, told from matches that are exact but for it."""

from dataclasses import replace

import numpy as np
import pytest

from placegraph.geometry import Camera
from placegraph.indoor.refine.intrinsics import (
    CLEAR,
    ENOUGH,
    OFF,
    TRIED,
    Scale,
    better_focal,
    scales,
)
from placegraph.indoor.refine.match import Sights
from placegraph.indoor.refine.refiner import DEPTH_WIDTHS
from placegraph.indoor.refine.solve import solve

pytestmark = pytest.mark.usefixtures("one_thread")
LENS = Camera(320, 240, 260.0, 260.0, 160.0, 120.0)


@pytest.fixture
def matched(hall, way, walked, kit, rng):
    """The way in the hall, known by matches alone: `matched(count=, factor=, noise=)`.

    Images were taken at `factor` times the focal length that their camera says.
    """
    blind = kit.problem(hall, walked, blind=range(len(way)))

    def made(count=150, factor=1.0, noise=0.0):
        sights = []
        for pose in way:
            inside = rng.uniform([-0.5, -0.4, 1.5], [0.5, 0.4, 5.0], (count, 3))
            inside[:, :2] *= inside[:, 2:]
            centre = np.array([LENS.cx, LENS.cy])
            pixels = (LENS.project(inside) - centre) * factor + centre
            pixels += noise * rng.normal(size=pixels.shape)
            points = inside @ pose[:3, :3].T + pose[:3, 3]
            sights.append(Sights.of(points, pixels, LENS, 1.0))
        return replace(blind, sights=sights)

    return made


@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_one_ten_percent_off_is_found(matched, way, factor):
    assert factor in TRIED
    assert better_focal(matched(factor=factor, noise=0.3), way) == factor


@pytest.mark.parametrize("noise", [0.0, 0.3, 1.0])
def test_the_right_one_is_left_alone(matched, way, noise):
    assert better_focal(matched(noise=noise), way) == 1.0


def test_few_matches_tell_nothing(matched, way):
    few = (ENOUGH - 1) // len(way)
    assert better_focal(matched(count=few, factor=1.1), way) == 1.0


def test_a_pose_that_is_off_is_no_focal_length(matched, way, kit):
    """Poses are fitted anew for each."""
    off = kit.moved(way, (0.05, -0.04, 0.02), (0, 0, 1.0))
    assert better_focal(matched(noise=0.3), off) == 1.0
    assert better_focal(matched(factor=1.1, noise=0.3), off) == 1.1


# ---- Depth or images of another scale, told from what exact renderings leave behind


@pytest.fixture
def stretched(kit, in_memory):
    """Scales found at fitted poses, or at the true ones, with depth `factor` times as long."""

    def told(scene, capture, poses, factor, *, fit=True):
        capture = in_memory(capture, depth=lambda f: f.depth() * np.float32(factor))
        problem = kit.problem(scene, capture)
        return scales(scene, problem, solve(problem, poses, DEPTH_WIDTHS).poses if fit else poses)

    return told


@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_depth_a_tenth_off_is_found(stretched, hall, walked, way, factor):
    """In a hall whose both ends the way sees, wherever the fit has drifted."""
    depth = stretched(hall, walked, way, factor)["depth"]
    assert depth.wrong
    assert depth.share == pytest.approx(1.0 / factor - 1.0, abs=0.01)


@pytest.mark.parametrize("factor", [0.8, 0.9, 1.1, 1.25])
def test_at_the_true_pose_it_is_exact(stretched, room, exact, factor):
    """One linear step: depth is linear in its scale."""
    depth = stretched(room, exact.capture, exact.poses, factor, fit=False)["depth"]
    assert depth.share == pytest.approx(1.0 / factor - 1.0, abs=1e-3)


def test_right_depth_is_left_alone(stretched, hall, walked, way, room, exact):
    for world in ((hall, walked, way), (room, exact.capture, exact.poses)):
        found = stretched(*world, 1.0)
        assert set(found) == {"depth", "image"}
        for scale in found.values():
            assert not scale.wrong
            assert abs(scale.share) < 1e-3


def test_no_depth_no_scale(hall, walked, way, kit):
    assert scales(hall, kit.problem(hall, walked, blind=range(len(way))), way) == {}


def test_what_is_unsure_is_not_wrong():
    assert Scale(-2 * OFF, OFF / CLEAR).wrong
    assert not Scale(2 * OFF, 2.1 * OFF / CLEAR).wrong
    assert not Scale(0.9 * OFF, 1e-6).wrong
