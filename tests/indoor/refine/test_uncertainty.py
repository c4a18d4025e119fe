"""Covariances that know what all frames have in common."""

from dataclasses import replace

import numpy as np
import pytest

from placegraph.indoor.refine.joint import Solution, solve
from placegraph.indoor.refine.pixels import Sights
from placegraph.indoor.refine.refiner import DEPTH_WIDTHS
from placegraph.indoor.refine.uncertainty import ALONE, LEAST, common_error, covariance


@pytest.fixture(scope="module")
def problem(kit, hall, walked):
    return kit.problem(hall, walked)


@pytest.fixture(scope="module")
def solution(problem, way):
    return solve(problem, way, DEPTH_WIDTHS)


def pulled(kit, solution, way, metres):
    """A solution whose frames part from their way."""
    apart = np.stack([kit.moved(p, (0, metres * (-1) ** t, 0)) for t, p in enumerate(way)])
    return replace(solution, poses=apart)


def test_frames_that_pull_apart_say_how_far_the_map_is_off(kit, problem, solution, way):
    sizes, turns = [], []
    for metres in (0.0, 0.005, 0.02, 0.1):
        found = covariance(problem, pulled(kit, solution, way, metres))
        assert np.linalg.eigvalsh(found).min() > 0
        sizes.append(np.sqrt(found[0, 0]))
        turns.append(np.sqrt(found[5, 5]))
    assert sizes == sorted(sizes)
    assert turns == sorted(turns)
    assert sizes[0] < 0.02
    assert sizes[-1] > 0.1


def test_never_less_than_the_fits_own(problem, solution):
    more = covariance(problem, solution) - solution.covariance()
    assert np.linalg.eigvalsh(more).min() > 0
    np.testing.assert_allclose(more, np.diag(np.diag(more)), atol=1e-12)
    assert np.sqrt(more[0, 0]) >= LEAST
    assert more[2, 2] < more[0, 0]  # height is known better
    assert np.sqrt(more[3, 3]) <= problem.options.tilt + 1e-9


def test_unexplained_depth_makes_it_grow(problem, solution):
    clean, messy = (common_error(problem, replace(solution, cost=c))[0] for c in (0.05, 0.9))
    assert messy > clean
    unknown, _ = common_error(problem, replace(solution, cost=np.nan))
    assert np.isfinite(unknown)


def test_one_frame_has_no_other_to_part_from(kit, hall, walked, way):
    problem = kit.problem(hall, walked[:1])
    shift, away = common_error(problem, solve(problem, way[:1], DEPTH_WIDTHS))
    assert shift >= ALONE
    assert 0.5 < away < 6.0


def test_matches_that_miss_make_it_grow(kit, hall, walked, way, rng):
    """By as much as they miss at their distance."""
    found = []
    for miss in (0.0, 2.0, 6.0):
        sights = []
        for frame, pose in zip(walked, way, strict=True):
            inside = rng.uniform([-0.5, -0.4, 2.9], [0.5, 0.4, 3.1], (80, 3))
            pixels = frame.camera.project(inside) + miss * rng.normal(size=(80, 2))
            points = inside @ pose[:3, :3].T + pose[:3, 3]
            sights.append(Sights.of(points, pixels, frame.camera, 1.0))
        problem = kit.problem(hall, walked, sights=sights, blind=range(5))
        made = Solution(way, np.eye(30), np.ones(2), np.nan, 1)
        shift, away = common_error(problem, made)
        assert away == pytest.approx(3.0, abs=0.15)
        found.append(shift)
    assert found[0] < found[1] < found[2]
    assert found[2] / found[1] == pytest.approx(3.0, rel=0.25)
    nothing = Sights.none()
    bare = kit.problem(hall, walked, sights=[nothing] * 5, blind=range(5))
    assert common_error(bare, made) == (pytest.approx(LEAST), 1.0)
