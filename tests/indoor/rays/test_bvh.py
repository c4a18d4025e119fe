"""The tree: every triangle in one leaf, every box around what is below, and never too deep."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.indoor.rays import caster as bvh
from placegraph.indoor.rays import trace_kernels as bvh_kernels


def _tree(vertices, triangles):
    return bvh.build_tree(np.asarray(vertices, np.float32), np.asarray(triangles, np.int32))


def _check(tree, vertices, triangles):
    """Walk the whole tree; returns its depth."""
    nodes, links = tree.nodes.reshape(-1, 16), tree.links.reshape(-1, 16)
    rows, corners = tree.rows.reshape(-1, 12)[:, 9], tree.corners.reshape(-1, 12)[:, :9]
    assert sorted(rows) == list(range(len(triangles)))
    corners = corners.reshape(-1, 3, 3)
    np.testing.assert_array_equal(corners, np.asarray(vertices, np.float32)[triangles][rows])
    seen, deepest, waiting = [], 0, [(0, 1)]
    while waiting:
        node, depth = waiting.pop()
        deepest = max(deepest, depth)
        for side in range(2):
            low, high = nodes[node, 6 * side : 6 * side + 6].reshape(2, 3)
            child = links[node, 12 + side]
            if child >= 0:
                waiting.append((child, depth + 1))
                below = nodes[child, :12].reshape(2, 2, 3)
            else:
                first, number = ~child >> 3, (~child & 7) + 1
                below = corners[first : first + number]
                seen.extend(range(first, first + number))
            assert (below >= low).all()
            assert (below <= high).all()
    if len(triangles) == 1:
        assert seen == [0, 0]  # both sides of the root
    else:
        assert sorted(seen) == list(range(len(triangles)))
    return deepest


@given(st.integers(1, 300), st.integers(0, 2**32 - 1), st.sampled_from([0.0, 1e-3, 1.0, 1e6]))
def test_every_triangle_is_in_one_leaf(number, seed, size):
    rng = np.random.default_rng(seed)
    vertices = rng.uniform(-1, 1, (max(3, number // 2), 3)) * size
    triangles = rng.integers(0, len(vertices), (number, 3))
    assert _check(_tree(vertices, triangles), vertices, triangles) <= bvh_kernels.STACK


def test_triangles_all_alike():
    vertices, triangles = np.eye(3), np.tile([0, 1, 2], (1000, 1))
    depth = _check(_tree(vertices, triangles), vertices, triangles)
    assert depth <= 10  # halves of halves


@pytest.mark.parametrize("number", [200, 3000])
def test_triangles_ever_smaller_and_nearer(number):
    """Each split takes off one triangle, as long as they differ: the depth must not follow."""
    scale = 0.97 ** np.arange(number)[:, None, None]
    vertices = (scale * (np.eye(3) + np.array([1.0, 0.0, 0.0]))).reshape(-1, 3)
    triangles = np.arange(3 * number).reshape(-1, 3)
    assert _check(_tree(vertices, triangles), vertices, triangles) <= bvh_kernels.STACK


def test_a_tree_is_better_than_halves(soup, rng):
    """The surface area heuristic pays: boxes of children are small against their parents'."""
    vertices, triangles = soup(5000, rng)
    nodes = _tree(vertices, triangles).nodes.reshape(-1, 16)[:, :12].reshape(-1, 2, 2, 3)
    x, y, z = (nodes[:, :, 1] - nodes[:, :, 0]).astype(float).transpose(2, 0, 1)
    area = (x * y + y * z + z * x).sum()
    assert area < 60 * (10 * 8 + 8 * 3 + 3 * 10)
