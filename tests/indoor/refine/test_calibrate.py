"""Cameras that are not as they say, told from readings and matches that are exact but for that."""

from dataclasses import replace

import numpy as np
import pytest

from placegraph.core.geometry import Camera, rotation_from_vector
from placegraph.indoor.refine.calibrate import (
    COUNT,
    FOCAL,
    IMAGE,
    PLACE,
    SCALE,
    TILT,
    TIME,
    calibrate,
    depth_from_camera,
    turned_gravity,
)
from placegraph.indoor.refine.correspondences import Sights
from placegraph.indoor.refine.options import RefineOptions

pytestmark = pytest.mark.usefixtures("one_thread")
LENS = Camera(320, 240, 260.0, 260.0, 160.0, 120.0)


@pytest.fixture
def matched(way, rng):
    """Matches (T,) of the way in the hall, noisy by 0.3 px: `matched(factor)`.

    Images were taken at `factor` times the focal length that their camera says.
    """

    def made(factor=1.0):
        sights = []
        for pose in way:
            inside = rng.uniform([-0.5, -0.4, 1.5], [0.5, 0.4, 5.0], (150, 3))
            inside[:, :2] *= inside[:, 2:]
            centre = np.array([LENS.cx, LENS.cy])
            pixels = (LENS.project(inside) - centre) * factor + centre
            pixels += 0.3 * rng.normal(size=pixels.shape)
            sights.append(Sights.of(inside @ pose[:3, :3].T + pose[:3, 3], pixels, LENS, 1.0))
        return sights

    return made


@pytest.mark.parametrize("factor", [0.85, 1.0, 1.1])
def test_a_focal_length_is_told_by_matches(hall, way, walked, kit, matched, factor):
    """From poses that are off, too: a tenth to 2 in a thousand, linearised anew at each step."""
    problem = kit.problem(hall, walked, sights=matched(factor), blind=range(len(way)))
    found = calibrate(hall, problem, kit.moved(way, (0.1, -0.05, 0.02), (0, 0, 2.0)), [IMAGE])
    assert np.exp(found.values[IMAGE]) == pytest.approx(factor, abs=2e-3)
    assert abs(np.log(factor) - found.values[IMAGE]) < 4 * found.errors[IMAGE]
    assert kit.off(found.poses[-1], way[-1])[0] < 0.01


@pytest.mark.parametrize(("scale", "focal"), [(0.9, 1.0), (1.0, 1.1), (1.1, 0.9), (1.0, 1.0)])
def test_depth_tells_its_scale_from_its_focal_length(
    hall, way, walked, kit, in_memory, scale, focal
):
    told = replace(kit.camera, fx=kit.camera.fx * focal, fy=kit.camera.fy * focal)
    wrong = in_memory(
        walked, camera=lambda _: told, depth_camera=lambda _: told,
        depth=lambda f: f.depth() * np.float32(scale),
    )  # fmt: skip
    problem = kit.problem(hall, wrong)
    found = calibrate(hall, problem, kit.moved(way, (0.1, 0.1, 0.0), (0, 0, 2.0)), [SCALE, FOCAL])
    factors = np.exp(found.values[[SCALE, FOCAL]])
    np.testing.assert_allclose(factors, [1 / scale, 1 / focal], atol=4e-3)
    assert kit.off(found.poses[-1], way[-1])[0] < 0.01


def test_gravity_that_is_off_is_told_by_depth(hall, way, walked, kit):
    """From poses that believe it; of a turn about gravity itself nothing is known."""
    off = np.radians([3.0, 0.0, -2.5])
    problem = kit.problem(hall, walked)
    wrong = replace(problem, gravity=problem.gravity @ rotation_from_vector(off))
    start = way.copy()
    start[:, :3, :3] = way[:, :3, :3] @ rotation_from_vector(off)
    found = calibrate(hall, wrong, start, [SCALE, FOCAL, *TILT])
    np.testing.assert_allclose(
        turned_gravity(wrong.gravity, found.values), problem.gravity, atol=4e-3
    )
    assert np.linalg.norm(found.values[list(TILT)]) > 8 * found.errors[list(TILT)].max()
    assert kit.off(found.poses[-1], way[-1])[0] < 0.01


def test_depth_that_is_late_or_elsewhere_is_told_by_both(
    hall, way, walked, kit, matched, in_memory
):
    images = matched()
    mount = np.zeros(COUNT)
    mount[list(PLACE)] = 0.03, 0.0, -0.05, 0.01, -0.02, 0.0
    # what a camera reads that stands elsewhere: the hall from poses moved by the mount
    drawn = kit.frames(hall, way @ depth_from_camera(mount))
    elsewhere = in_memory(walked, depth=lambda f: drawn[f.index].depth())
    found = calibrate(hall, kit.problem(hall, elsewhere, sights=images), way, PLACE)
    np.testing.assert_allclose(found.values[list(PLACE)], mount[list(PLACE)], atol=5e-3)
    late = in_memory(walked, depth=lambda f: walked[max(f.index - 1, 0)].depth())
    problem = kit.problem(hall, late, RefineOptions(), sights=images, blind=[0])
    found = calibrate(hall, problem, way, [])
    assert found.values[TIME] == pytest.approx(-1.0, abs=0.1)


def test_what_is_not_asked_for_stays(hall, way, walked, kit):
    found = calibrate(hall, kit.problem(hall, walked), way, [SCALE])
    rest = [k for k in range(COUNT) if k not in (SCALE, TIME)]
    assert not found.values[rest].any()
    assert not found.errors[rest].any()
    assert found.errors[SCALE] > 0


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_of_numbers_that_are_not_finite_nothing_is_found(hall, way, walked, kit, matched, value):
    sights = matched(1.1)
    sights[1].rays[0] = value
    problem = kit.problem(hall, walked, sights=sights, blind=range(len(way)))
    with np.errstate(invalid="ignore"):
        found = calibrate(hall, problem, way, [IMAGE])
    np.testing.assert_array_equal(found.poses, way)
    assert not found.values.any()
    assert not found.errors.any()
    assert found.cost == np.inf
