import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph_lab.tables.outdoor.nearby import Around, Triples, relations
from placegraph_lab.tables.outdoor.outdoor_kernels import EAST, NORTH, SOUTH, WEST

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
