import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from placegraph.indoor.mapping.outlines import area, find_outlines, make_polygons, triangulate


def closed(*points):
    return np.array([*points, points[0]], float)


def covered(points, triangles):
    return sum(area(closed(*points[t])) for t in triangles)


SQUARE = closed((0, 0), (10, 0), (10, 8), (0, 8))
HOLES = [closed((2, 2), (4, 2), (4, 4), (2, 4)), closed((6, 2), (8, 2), (8, 4), (6, 5))]


@pytest.mark.parametrize("rings", [[SQUARE], [SQUARE[::-1]], [HOLES[0], SQUARE, HOLES[1]]])
def test_triangles_fill_a_polygon_and_give_it_back(rings):
    (polygon,) = make_polygons(rings)
    points, triangles = triangulate(polygon)
    wanted = sum(area(ring) for ring in polygon)
    assert covered(points, triangles) == pytest.approx(wanted)
    assert all(area(closed(*points[t])) > 0 for t in triangles)
    found = find_outlines(points, triangles)
    assert sorted(area(r) for r in found) == pytest.approx(sorted(area(r) for r in polygon))


def test_a_bow_is_two_triangles():
    found = make_polygons([closed((0, 0), (4, 4), (4, 0), (0, 4))])
    assert [area(ring) for (ring,) in found] == pytest.approx([4.0, 4.0])
    eight = make_polygons(
        [closed((0, 0), (2, 2), (4, 0), (4, 4), (2, 2), (0, 4))]
    )  # through one node twice
    assert [area(ring) for (ring,) in eight] == pytest.approx([4.0, 4.0])


POINT = st.tuples(st.integers(0, 40), st.integers(0, 40))


@settings(max_examples=50, deadline=None)
@given(st.lists(POINT, min_size=3, max_size=12))
def test_any_outline_ends_in_simple_polygons_or_none(points):
    for polygon in make_polygons([closed(*points)]):
        corners, triangles = triangulate(polygon)
        wanted = sum(area(ring) for ring in polygon)
        assert covered(corners, triangles) <= wanted * 1.001 + 1e-6
