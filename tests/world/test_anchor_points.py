"""Anchors from points: exact ones exactly, noisy ones as well as is said, wrong ones named."""

import numpy as np
import pytest

from placegraph.core.geo import Anchor, ecef_from_geodetic
from placegraph.errors import OptionError
from placegraph.world.anchor_points import UNKNOWN_HEIGHT, fit_points

TRUE = Anchor(7.42, 43.73, 50.0, 1.1)


def error(found, true=TRUE):
    """East, north [m], heading [rad] by which an anchor is off."""
    place = true.to_map((found.longitude, found.latitude, true.height))
    east, north = (true.enu_from_map[:3, :3] @ place)[:2]
    return np.array([east, north, (found.heading - true.heading + np.pi) % (2 * np.pi) - np.pi])


def surprise(anchor):
    """Squared Mahalanobis distance of east, north and heading."""
    rows = np.ix_([0, 1, 3], [0, 1, 3])
    return error(anchor) @ np.linalg.solve(anchor.covariance[rows], error(anchor))


@pytest.mark.parametrize("true", [TRUE, Anchor(179.99999, -70, 5, 4.0), Anchor(0, 89.99, 0, 0.2)])
def test_points_without_noise_are_met(true):
    points = np.array([[0, 0, 0], [30, 2, 1], [5, 20, 0.5], [40, 30, 1.0]])
    found = fit_points(points, true.to_earth(points))
    there, here = true.to_earth(points), found.anchors[0].to_earth(points)
    off = np.linalg.norm(ecef_from_geodetic(here) - ecef_from_geodetic(there), axis=1)
    assert off.max() < 1e-3
    assert max(found.anchors[0].residuals) < 1e-3
    assert found.notes == ()


def test_what_is_said_of_the_error_is_true():
    rng, surprises = np.random.default_rng(0), []
    for _ in range(120):
        points = rng.uniform(-10, 10, (rng.integers(3, 9), 3))
        seen = points + np.c_[rng.normal(0, 0.1, (len(points), 2)), np.zeros(len(points))]
        surprises.append(surprise(fit_points(points, TRUE.to_earth(seen)).anchors[0]))
    assert 0.9 < np.mean(np.array(surprises) < 7.81) <= 1.0  # 95 % of chi squared, 3 degrees
    assert np.median(surprises) > 1.0  # nor are they far too careful


def test_wrong_points_have_no_say_and_are_named():
    rng = np.random.default_rng(1)
    points = rng.uniform(-10, 10, (7, 3))
    places = TRUE.to_earth(points)
    places[2, 0] += 2e-4  # 16 m
    found = fit_points(points, places)
    assert np.abs(error(found.anchors[0])).max() < 0.05
    assert found.notes == ("Point 3 is 16.1 m off, and is ignored.",)


FIVE = np.array([[0, 0, 0], [12, 1, 0], [11, 7, 0], [1, 9, 0], [6, 3, 0.0]])


@pytest.mark.parametrize(
    ("change", "note"),
    [
        (lambda p: p * (1, 0, 1) + (0, 1, 0), "Points 1, 2, 3, 4, 5 lie on one line"),
        (lambda p: p[:, [1, 0, 2]], "exchanged"),
        (lambda p: p / (0.3048, 0.3048, 1), "if the map were 0.305 times as large"),
    ],
)
def test_what_looks_odd_is_told(change, note):
    found = fit_points(change(FIVE), TRUE.to_earth(change(FIVE) if "line" in note else FIVE))
    assert any(note in line for line in found.notes)
    swapped = fit_points(FIVE, TRUE.to_earth(FIVE)[:, [1, 0, 2]])
    assert any("0.00 m with longitude and latitude exchanged" in line for line in swapped.notes)


def test_heights_are_optional():
    points = np.array([[0, 0, np.nan], [12, 1, np.nan], [11, 7, np.nan]])
    places = TRUE.to_earth(np.nan_to_num(points))
    places[:, 2] = np.nan
    anchor = fit_points(points, places).anchors[0]
    assert anchor.height == pytest.approx(0, abs=1e-3)
    assert anchor.covariance[2, 2] == pytest.approx(UNKNOWN_HEIGHT**2)


def test_fixes_are_worth_what_they_say():
    rng = np.random.default_rng(2)
    points = np.c_[np.linspace(0, 60, 40), 8 * np.sin(np.arange(40)), np.ones(40)]
    sigma = np.where(np.arange(40) % 4, 2.0, 8.0)
    seen = points + np.c_[rng.normal(size=(40, 2)) * sigma[:, None], np.zeros(40)]
    seen[5] += (60, 40, 0)  # a reflection
    anchor = fit_points(points, TRUE.to_earth(seen), sigma, method="gps").anchors[0]
    off = error(anchor)
    assert np.hypot(*off[:2]) < 2.0
    assert np.hypot(*off[:2]) < 3 * np.sqrt(anchor.covariance[0, 0] + anchor.covariance[1, 1])


def test_fixes_that_err_alike_are_worth_fewer():
    rng, surprises, plain = np.random.default_rng(3), [], []
    for _ in range(60):
        points = np.c_[20 * rng.random((40, 2)), np.ones(40)]
        drift = rng.normal(0, 2.0, (40, 2))
        for k in range(1, 40):
            drift[k] = 0.8 * drift[k - 1] + 0.6 * drift[k]
        places = TRUE.to_earth(points + np.c_[drift, np.zeros(40)])
        for in_time, found in ((True, surprises), (False, plain)):
            fit = fit_points(points, places, np.full(40, 2.0), in_time=in_time)
            found.append(surprise(fit.anchors[0]))
    assert np.mean(np.array(surprises) < 7.81) > 0.85  # 95 % of chi squared, 3 degrees
    assert np.mean(np.array(plain) < 7.81) < 0.7


@pytest.mark.parametrize(
    ("points", "places", "named"),
    [
        ([[0, 0, 0]] * 2, [[7, 43, 0]] * 2, "2 points; at least 3"),
        ([[0, 0, 0]] * 3, [[7, 43, 0]] * 3, "map, so the heading is unknown"),
        ([[0, 0, 0]] * 3, [[43, 170, 0]] * 3, "longitude first"),
        ([[0, np.nan, 0]] * 3, [[7, 43, 0]] * 3, "not a number"),
    ],
)
def test_too_little_is_refused(points, places, named):
    with pytest.raises(OptionError, match=named):
        fit_points(points, places)
