"""Nearest points by a grid, against all distances."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from placegraph.io.mesh.nearest_kernels import find_nearest


@given(st.integers(0, 2**32 - 1), st.integers(0, 40), st.integers(0, 40), st.floats(0.05, 3.0))
@settings(max_examples=30)
def test_as_by_all_distances(seed, count, queries, reach):
    rng = np.random.default_rng(seed)
    among = rng.uniform(-2, 2, (count, 3))
    points = rng.uniform(-3, 3, (queries, 3))
    rows = find_nearest(points, among, reach)
    assert len(rows) == queries
    if not count:
        assert (rows == -1).all()
        return
    distances = np.linalg.norm(points[:, None] - among, axis=2)
    expected = np.where(distances.min(axis=1) <= reach, distances.argmin(axis=1), -1)
    assert rows.tolist() == expected.tolist()


def test_damage_is_near_to_nothing_and_the_edge_of_reach_counts():
    among = np.array([[np.nan, 0, 0], [0, 0, 0], [1e300, 0, 0]])
    points = np.array([[0, 0, 0.01], [np.inf, 0, 0], [1e300, 0, 0], [0, 0.2, 0]])
    assert find_nearest(points, among, 0.1).tolist() == [1, -1, -1, -1]
    assert find_nearest(np.array([[0.5, 0, 0]]), np.zeros((1, 3)), 0.5).tolist() == [0]
