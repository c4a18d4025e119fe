import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph_lab.tables.outdoor.nearby import Around, Bins, Triples, relations
from placegraph_lab.tables.outdoor.outdoor_kernels import EAST, NORTH, SOUTH, WEST
from placegraph_lab.tables.outdoor.places import AREA, read_raw
from placegraph_lab.tables.outdoor.queries import load


def own(city, i):
    return city.segments[city.segment_starts[i] : city.segment_starts[i + 1]]


def walked_distance(city, i, viewpoint):
    """Distance to an object by walking along it in steps of at most 20 cm."""
    best = np.inf
    for a, b in own(city, i).reshape(-1, 2, 2):
        t = np.linspace(0.0, 1.0, int(np.hypot(*(b - a)) / 0.2) + 2)[:, None]
        best = min(best, np.hypot(*(a + t * (b - a) - viewpoint).T).min())
    return best


@given(x=st.floats(0.05, 0.95), y=st.floats(0.05, 0.95))
def test_nearest_points_are_those_of_brute_force(town, x, y):
    bins = load(town)
    city = bins.city
    ends = city.segments.reshape(-1, 2)
    viewpoint = ends.min(0) + (x, y) * np.ptp(ends, axis=0)
    around = bins.around(viewpoint[None], 25.0)
    distance = dict(
        zip(around.objects.tolist(), np.hypot(*(around.points - viewpoint).T), strict=True)
    )
    for i in range(len(city)):
        expected = walked_distance(city, i, viewpoint)
        if i in distance and distance[i] != pytest.approx(expected, abs=0.3):
            # an area around the viewpoint stands at its centroid
            assert city.kind[i] == AREA
            assert distance[i] == pytest.approx(np.hypot(*(city.center[i] - viewpoint)))
        elif i not in distance and city.kind[i] != AREA:
            assert expected > 24.7


def park(half):
    corners = [(-half, -half), (half, -half), (half, half), (-half, half)]
    return [(e, n, {}) for e, n in corners], [([0, 1, 2, 3, 0], {"leisure": "park"})]


def test_an_area_around_the_viewpoint_stands_at_its_centroid(write_world):
    nodes, ways = park(200.0)
    bins = Bins.of(read_raw(write_world(nodes, ways)))
    center = bins.city.center[0]
    near = bins.around(center[None] + [[20.0, 0.0]], 25.0)
    assert near.objects.tolist() == [0]
    assert near.points[0] == pytest.approx(center)
    assert bins.around(center[None] + [[30.0, 0.0]], 25.0).objects.tolist() == []
    outside = bins.around(center[None] + [[210.0, 5.0]], 25.0)
    assert outside.points[0] - center == pytest.approx([200.0, 5.0], abs=0.02)


METRES = st.floats(-100.0, 100.0, allow_subnormal=False)


@pytest.mark.parametrize(
    ("delta", "expected"),
    [
        ((0.0, 5.0), NORTH), ((4.9, 5.0), NORTH), ((5.0, 5.0), NORTH), ((-5.0, 5.0), NORTH),
        ((5.0, -5.0), SOUTH), ((5.1, 5.0), EAST), ((-5.1, -5.0), WEST),
    ],
)  # fmt: skip
def test_direction_of_a_seen_from_b(delta, expected):
    assert relations(delta) == expected


@given(st.lists(st.tuples(METRES, METRES), min_size=1, max_size=12))
def test_pairs_are_those_of_brute_force(points):
    points = np.array(points)
    around = Around(np.array([0, 0, len(points)]), np.arange(len(points), dtype=np.int32), points)
    triples = Triples.of(around, 30.0)
    assert triples.starts[1] == 0
    columns = (triples.source, triples.target, triples.relation)
    found = {(a, b): r for a, b, r in zip(*(c.tolist() for c in columns), strict=True)}
    expected = {
        (a, b): int(relations(points[a] - points[b]))
        for a, b in itertools.permutations(range(len(points)), 2)
        if 1.0 <= np.sqrt(((points[a] - points[b]) ** 2).sum()) <= 30.0
    }
    assert found == expected
