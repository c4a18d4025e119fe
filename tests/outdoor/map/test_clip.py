"""Clipping: what is inside stays as it is, nothing outside is left, and areas keep their ground."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.core.geo import Box
from placegraph.outdoor.map.extract import clip
from placegraph.outdoor.map.objects import AREA, LINE, POINT

BOX = Box(0.0, 0.0, 10.0, 10.0)
points = st.tuples(st.integers(-20, 30), st.integers(-20, 30))
shapely = pytest.importorskip("shapely")


def line(*points):
    return np.array(points, float)


def test_a_road_that_comes_back_is_two_pieces():
    one, two = clip(LINE, [line((-5, 5), (5, 5), (5, 15), (8, 15), (8, 5))], BOX)
    np.testing.assert_allclose(one, [(0, 5), (5, 5), (5, 10)])
    np.testing.assert_allclose(two, [(8, 10), (8, 5)])


def test_a_park_around_the_box_becomes_the_box():
    [ring] = clip(AREA, [line((-5, -5), (15, -5), (15, 15), (-5, 15), (-5, -5))], BOX)
    assert set(map(tuple, ring)) == {(0, 0), (10, 0), (10, 10), (0, 10)}
    assert (ring[0] == ring[-1]).all()


def test_what_sticks_out_a_little_stays_whole():
    park = line((5, 5), (10.5, 5), (10.5, 8), (5, 5))
    assert clip(AREA, [park], BOX, spare=1.0) == [park]
    assert clip(AREA, [park], BOX)[0][:, 0].max() == 10.0


@pytest.mark.parametrize("kind", [POINT, LINE, AREA])
def test_what_lies_outside_is_gone(kind):
    assert clip(kind, [line((20, 20), (25, 20), (25, 25), (20, 20))], BOX) == []


@given(st.lists(points, min_size=2, max_size=8))
def test_length_is_that_of_the_part_inside(drawn):
    found = clip(LINE, [line(*drawn)], BOX)
    expected = sum(
        shapely.LineString(pair).intersection(shapely.box(*BOX)).length
        for pair in itertools.pairwise(drawn)
        if pair[0] != pair[1]
    )
    edges = sum(np.hypot(*np.diff(part, axis=0).T).sum() for part in found)
    assert edges == pytest.approx(expected, abs=1e-6)


@given(st.lists(points, min_size=3, max_size=8, unique=True))
def test_ground_is_that_of_the_part_inside(drawn):
    area = shapely.Polygon(drawn)
    if not area.is_valid or not area.area:
        return
    found = clip(AREA, [line(*drawn, drawn[0])], BOX)
    ground = sum(abs(_shoelace(p)) for p in found)
    assert ground == pytest.approx(area.intersection(shapely.box(*BOX)).area, abs=1e-6)


def _shoelace(ring):
    x, y = ring.T
    return 0.5 * (x[:-1] * y[1:] - x[1:] * y[:-1]).sum()
