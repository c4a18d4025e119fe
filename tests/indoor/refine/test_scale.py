"""Depth or images of another scale, told from what exact renderings leave behind."""

import numpy as np
import pytest

from placegraph.indoor.refine.joint import solve
from placegraph.indoor.refine.refiner import DEPTH_WIDTHS
from placegraph.indoor.refine.scale import CLEAR, OFF, Scale, scales

pytestmark = pytest.mark.usefixtures("one_thread")


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
