"""Triangles in an order that compresses."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from placegraph.core.mapfile import pack
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.map.mesh_order import from_high_water, high_water, ordered

soups = st.integers(0, 60).flatmap(
    lambda n: st.lists(st.integers(0, max(n - 1, 0)), min_size=0, max_size=3 * n if n else 0)
)


@given(soups)
def test_any_triangles_come_back(rows):
    triangles = np.array(rows[: len(rows) // 3 * 3], np.int32).reshape(-1, 3)
    back = from_high_water(high_water(triangles))
    np.testing.assert_array_equal(back, triangles)
    assert back.dtype == np.int32


@given(soups, st.integers(0, 2**32 - 1))
def test_the_surface_is_the_same_and_numbers_are_dense(rows, seed):
    triangles = np.array(rows[: len(rows) // 3 * 3], np.int32).reshape(-1, 3)
    rng = np.random.default_rng(seed)
    count = int(triangles.max(initial=-1)) + 3
    mesh = Mesh.plain(
        rng.normal(size=(count, 3)), triangles, rng.integers(0, 4, len(triangles)),
        rng.integers(0, 255, (count, 3)),
    )  # fmt: skip
    after = ordered(mesh)
    assert len(after) == len(mesh)
    assert len(after.vertices) == len(np.unique(triangles))

    def told(m):
        corners = np.concatenate([m.vertices[m.triangles], m.colours[m.triangles]], axis=2)
        return sorted(
            (o, *c) for o, c in zip(m.object_of, corners.reshape(len(m), 18), strict=True)
        )

    assert told(after) == told(mesh)
    seen = after.triangles.ravel()
    firsts = np.sort(np.unique(seen, return_index=True)[1])
    np.testing.assert_array_equal(seen[firsts], np.arange(len(after.vertices)))


def test_it_is_worth_it(rng):
    n = 60
    x, y = (a.ravel() for a in np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij"))
    a = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    triangles = np.concatenate(
        [np.stack([a, a + n + 1, a + n + 2], 1), np.stack([a, a + n + 2, a + 1], 1)]
    )
    shuffled = rng.permutation((n + 1) ** 2)
    points = np.stack([x, y, 0 * x], axis=1)[np.argsort(shuffled)]
    triangles = shuffled[triangles][rng.permutation(len(triangles))].astype(np.int32)
    size = {
        name: len(pack(codes)[2])
        for name, codes in (
            ("as it was", triangles),
            ("ordered", high_water(ordered(Mesh.plain(points, triangles)).triangles)),
        )
    }
    assert size["ordered"] < size["as it was"] / 3


def test_a_fan_of_many_triangles_takes_no_time():
    rim = np.arange(1, 40_001, dtype=np.int32)
    triangles = np.stack([0 * rim, rim, np.roll(rim, -1)], axis=1)
    points = np.random.default_rng(0).normal(size=(40_001, 3))
    assert len(ordered(Mesh.plain(points, triangles))) == 40_000
