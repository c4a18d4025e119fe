"""Nearest points seen from a grid, against brute force."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.errors import MapError
from placegraph.outdoor.map.cells import Grid, sightings
from placegraph.outdoor.map.geometry_kernels import nearest_on_parts

POINT, LINE, AREA = 0, 1, 2


class Things:
    """Columns of objects, each a kind and a list of lines or rings."""

    def __init__(self, *things):
        self.things = [
            (kind, [np.array(p, np.float32).reshape(-1, 2) for p in parts])
            for kind, parts in things
        ]
        flat = [part for _, parts in self.things for part in parts]
        self.kind = np.array([kind for kind, _ in self.things], np.uint8)
        self.part_starts = self.starts([len(parts) for _, parts in self.things])
        self.point_starts = self.starts([len(part) for part in flat])
        self.points = np.concatenate([*flat, np.zeros((0, 2), np.float32)])

    @staticmethod
    def starts(lengths):
        return np.concatenate(([0], np.cumsum(np.array(lengths, np.int32)))).astype(np.int32)

    def seen(self, grid, radius, rows=None):
        return sightings(
            self.kind,
            self.part_starts,
            self.point_starts,
            self.points,
            grid=grid,
            radius=radius,
            rows=rows,
        )

    def nearest(self, row, position):
        kind = self.kind[row]
        columns = (self.part_starts, self.point_starts, self.points)
        return nearest_on_parts(*columns, kind, row, *map(float, position))


def inside(rings, p):
    """Even-odd rule, by brute force."""
    crossed = 0
    for ring in rings:
        for (x0, y0), (x1, y1) in pairwise(ring):
            if (y0 > p[1]) != (y1 > p[1]):
                crossed += x0 + (p[1] - y0) / (y1 - y0) * (x1 - x0) > p[0]
    return crossed % 2 == 1


def distance(parts, at):
    """Distance of a position to lines, by brute force."""
    best = np.inf
    for part in (p.astype(np.float64) for p in parts):
        best = min(best, np.hypot(*(part - at).T).min())
        a, d = part[:-1], np.diff(part, axis=0)
        length2 = (d**2).sum(axis=1)
        t = np.clip(((at - a) * d).sum(axis=1) / np.maximum(length2, 1e-12), 0, 1)
        if len(a):
            best = min(best, np.hypot(*(a + t[:, None] * d - at).T).min())
    return best


def expected(thing, p):
    kind, parts = thing
    rings = [part.astype(np.float64) for part in parts]
    return 0.0 if kind == AREA and inside(rings, p) else distance(parts, p)


spot = st.tuples(st.integers(-60, 60), st.integers(-60, 60))
point = st.tuples(st.just(POINT), st.lists(spot, min_size=1, max_size=1).map(lambda p: [p]))
line = st.tuples(
    st.just(LINE), st.lists(st.lists(spot, min_size=2, max_size=6), min_size=1, max_size=2)
)
ring = st.lists(spot, min_size=3, max_size=6).map(lambda r: [*r, r[0]])
area = st.tuples(st.just(AREA), st.lists(ring, min_size=1, max_size=3))
things = st.lists(st.one_of(point, line, area), min_size=1, max_size=5)
grids = st.builds(
    Grid,
    st.integers(-50, 30).map(lambda n: n + 0.25),  # off the corners: ties are another matter
    st.integers(-50, 30).map(lambda n: n + 0.375),
    st.sampled_from([5.0, 12.5, 40.0]),
    st.integers(1, 9),
    st.integers(1, 9),
)


def positions(grid):
    return {
        row * grid.columns + column: np.array(
            [grid.east + grid.stride * column, grid.north + grid.stride * row]
        )
        for row in range(grid.rows)
        for column in range(grid.columns)
    }


@given(things, grids, st.sampled_from([3.0, 20.0, 75.0]))
def test_sightings_are_those_of_brute_force(drawn, grid, radius):
    world = Things(*drawn)
    seen = world.seen(grid, radius)
    found = {}
    for i, at in enumerate(seen.points):
        for e in range(seen.starts[i], seen.starts[i + 1]):
            found[int(at), int(seen.objects[e])] = seen.offsets[e]
    for at, p in positions(grid).items():
        for row, thing in enumerate(world.things):
            d = expected(thing, p)
            if abs(d - radius) < 1e-3:
                continue
            assert ((at, row) in found) == (d <= radius), (at, row, d)
            if d > radius:
                continue
            offset = found[at, row].astype(np.float64)
            assert np.hypot(*offset) == pytest.approx(d, abs=1e-3)
            if d > 0:  # the nearest point lies on the thing
                assert distance(thing[1], p + offset) < 1e-3


@given(things, grids)
def test_sightings_are_sorted_and_each_thing_comes_once(drawn, grid):
    seen = Things(*drawn).seen(grid, 30.0)
    assert (np.diff(seen.points) > 0).all()
    assert (np.diff(seen.starts) > 0).all()
    assert seen.starts[-1] == len(seen.objects) == len(seen.offsets)
    for a, b in pairwise(seen.starts):
        assert (np.diff(seen.objects[a:b]) > 0).all()


@given(things, spot)
def test_nearest_is_that_of_brute_force(drawn, at):
    world = Things(*drawn)
    p = np.add(at, (0.25, 0.375))
    for row, thing in enumerate(world.things):
        east, north, d2 = world.nearest(row, p)
        assert np.sqrt(d2) == pytest.approx(expected(thing, p), abs=1e-3)
        assert east**2 + north**2 == pytest.approx(d2, abs=1e-3)


@given(things, grids)
def test_rows_restrict_to_these_things(drawn, grid):
    world = Things(*drawn)
    rows = np.arange(0, len(drawn), 2)
    seen, everything = world.seen(grid, 30.0, rows), world.seen(grid, 30.0)
    assert set(seen.objects.tolist()) == set(rows.tolist()) & set(everything.objects.tolist())


SQUARE = [(0, 0), (100, 0), (100, 100), (0, 100), (0, 0)]
HOLE = [(40, 40), (60, 40), (60, 60), (40, 60), (40, 40)]


def test_inside_an_area_and_in_its_hole():
    seen = Things((AREA, [SQUARE, HOLE])).seen(Grid(-15.0, 50.5, 10.0, 15, 1), 4.0)
    offsets = dict(zip(seen.points.tolist(), seen.offsets.tolist(), strict=True))
    # 0, 1 and 12 lie outside, 6 and 7 in the hole, 5 m from its walls
    assert set(offsets) == {2, 3, 4, 5, 8, 9, 10, 11}
    assert all(offset == [0.0, 0.0] for offset in offsets.values())
    seen = Things((AREA, [SQUARE, HOLE])).seen(Grid(50.0, 50.0, 10.0, 1, 1), 15.0)
    assert np.hypot(*seen.offsets[0]) == pytest.approx(10.0)


def test_a_long_road_is_seen_where_it_is_nearest():
    road = Things((LINE, [[(-5000, 7), (5000, 7)]]))
    seen = road.seen(Grid(-200.0, 0.0, 50.0, 9, 1), 10.0)
    np.testing.assert_array_equal(seen.points, np.arange(9))
    np.testing.assert_allclose(seen.offsets, np.tile((0.0, 7.0), (9, 1)), atol=1e-4)


def test_nothing_in_reach():
    seen = Things((POINT, [[(0, 0)]])).seen(Grid(100.0, 100.0, 10.0, 3, 3), 50.0)
    assert len(seen.points) == len(seen.objects) == 0
    np.testing.assert_array_equal(seen.starts, [0])


def test_more_sightings_than_expected():
    crowd = Things(*((POINT, [[(i % 7, i % 5)]]) for i in range(100)))
    seen = crowd.seen(Grid(-20.0, -20.0, 1.0, 50, 50), 100.0)
    assert len(seen.objects) == 100 * 2500


def test_on_the_radius_counts():
    seen = Things((POINT, [[(30, 40)]])).seen(Grid(0.0, 0.0, 10.0, 1, 1), 50.0)
    assert len(seen.objects) == 1


def test_more_ground_than_so_few_things_are_looked_through_for():
    """A few bytes can draw a park of 200 km, or a line that crosses it a thousand times."""
    corners = 2e5 * np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]])
    zigzag = 2e4 * (np.arange(1000)[:, None] // [1, 2] % 2)
    wide = Grid(0.0, 0.0, 20.0, 10_001, 10_001)
    for kind, line in ((AREA, corners), (LINE, corners), (LINE, zigzag)):
        with pytest.raises(MapError, match="more ground"):
            Things((kind, [line])).seen(wide, 38.0)
