import itertools
import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.errors import MapError, OptionError
from placegraph.maps import open_map
from placegraph.outdoor.city import build_city
from placegraph.outdoor.map.cells import Grid, find_visible
from placegraph.outdoor.map.directions_kernels import name_direction
from placegraph.outdoor.map.geometry_kernels import nearest_on_parts

TOWN = """
[town]
metres = 10
[drawing]
 ####   |  \"\"\"\"\"\"   ####
 #K##   |  \"\"\"F\"\"   #  #
 ####   |  \"\"b\"\"\"   ####
        |
-----1--+------------------
        |       b
  CCC   |  ***
  CCC   |        S
≈≈≈≈≈≈≈≈|≈≈≈≈≈≈≈≈≈≈≈≈≈≈≈≈≈≈≈
~~~~~~~~|~~~~~~~~~~~~~~~~~~
≈≈≈≈≈≈≈≈|≈≈≈≈≈≈≈≈≈≈≈≈≈≈≈≈≈≈≈
        |
[legend]
K: shop=bakery name=Kern
F: amenity=fountain
b: amenity=bench
S: railway=tram_stop
C area: amenity=place_of_worship building=church name=St. Marien
1 road: highway=primary name=Lange Straße
"""


def nearest(kind, parts, p):
    """Vector from p to the nearest point of a thing."""
    best, inside = np.array([np.inf, np.inf]), False
    for part in parts:
        part = np.asarray(part, np.float64)  # noqa: PLW2901
        for a, b in itertools.pairwise(part) if len(part) > 1 else [(part[0], part[0])]:
            d = b - a
            t = np.clip((p - a) @ d / max(d @ d, 1e-12), 0, 1)
            best = min(best, a + t * d - p, key=np.linalg.norm)
            if (a[1] > p[1]) != (b[1] > p[1]):
                inside ^= a[0] + (p[1] - a[1]) / (b[1] - a[1]) * d[0] > p[0]
    return np.zeros(2) if kind == 2 and inside else best


def graph_of(city, center):
    """Nodes {id: position} and edges {(source, relation, target)} of a square, slowly."""
    o, half = city.objects, city.cells.size / 2
    at = {}
    for i in range(len(o)):
        offset = nearest(o.kind[i], o.parts(i), center)
        if np.abs(offset).max() <= half:
            at[i] = center + offset
    edges = set()
    for source, target in itertools.permutations(at, 2):
        dx, dy = at[source] - at[target]
        apart = math.hypot(dx, dy)
        said = set()
        if 0 < apart <= city.cells.edge_distance:
            if abs(dx) > abs(dy):
                said.add("east" if dx > 0 else "west")
            else:
                said.add("north" if dy > 0 else "south")
        if apart <= 10:
            said.add("near")
        stands = o.center[source] if o.kind[source] == o.kind[target] == 2 else at[source]
        gap = np.linalg.norm(nearest(o.kind[target], o.parts(target), stands))
        box = [np.ptp(np.concatenate(o.parts(i)), axis=0).prod() for i in (source, target)]
        larger = o.kind[source] == 2 and box[0] > box[1]
        if o.kind[target] == 2 and gap == 0 and not larger:
            said.add("inside")
        if o.kind[target] == 1 and o.kind[source] != 1 and gap <= 15:
            said.add("along")
        edges |= {(o.osm(source), relation, o.osm(target)) for relation in said}
    return {o.osm(i): p for i, p in at.items()}, edges


def edges_of(graph):
    return {
        (graph.ids[s], relation, graph.ids[t])
        for s, t, relation in zip(graph.sources, graph.targets, graph.relations, strict=True)
    }


OVERLAPPING, APART = {"cell_size": 40.0, "stride": 20.0}, {"cell_size": 30.0, "stride": 60.0}


@pytest.mark.parametrize(
    "options", [{}, {"cell_size": 80.0}, OVERLAPPING | {"edge_distance": 25.0}, APART], ids=str
)
def test_graphs_are_those_of_brute_force(options, make_city):
    city = make_city(TOWN, **options)
    grid, occupied, relations = city.cells.grid, 0, set()
    for row, column in itertools.product(range(grid.rows), range(grid.columns)):
        cell = f"c{column}r{row}"
        center = np.array([grid.east, grid.north]) + grid.stride * np.array([column, row])
        nodes, edges = graph_of(city, center)
        assert (cell in city.cells) == (len(nodes) >= 2)
        if cell not in city.cells:
            continue
        occupied += 1
        graph = city.graph(cell)
        relations |= set(graph.relations)
        assert set(graph.ids) == set(nodes)
        for i, name in enumerate(graph.ids):
            np.testing.assert_allclose(graph.positions[i], nodes[name], atol=1e-3)
        assert edges_of(graph) == edges
        assert len(graph.sources) == len(edges), "no edge comes twice"
    assert occupied == len(city.cells) >= 3
    assert relations >= {*OPPOSITE, "near", "along"}


@pytest.mark.parametrize(
    ("delta", "expected"),
    [
        ((1, 0), "east"), ((-1, 0), "west"), ((0, 1), "north"), ((0, -1), "south"),
        ((3, 2), "east"), ((-3, -2), "west"), ((2, 3), "north"), ((-2, -3), "south"),
        ((1, 1), "north"), ((-1, 1), "north"), ((1, -1), "south"), ((-1, -1), "south"),
    ],
)  # fmt: skip
def test_compass_of_eq_6(delta, expected):
    assert name_direction(np.array(delta, np.float64)) == expected


OPPOSITE = {"north": "south", "south": "north", "east": "west", "west": "east"}


def test_relations_of_a_real_city_mirror_each_other(real_city):
    cells = list(real_city.cells)
    for cell in cells[:: max(1, len(cells) // 40)]:
        edges = edges_of(real_city.graph(cell))
        for source, relation, target in edges:
            if relation in OPPOSITE:
                assert (target, OPPOSITE[relation], source) in edges
            if relation == "near":
                assert (target, "near", source) in edges


def test_the_smaller_area_is_inside_the_larger(build_world):
    def square(middle, half):
        return [(middle + x * half, y * half, {}) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]

    city = build_world(
        [*square(0, 90), *square(5, 20)],
        [([0, 1, 2, 3, 0], {"leisure": "park"}), ([4, 5, 6, 7, 4], {"natural": "water"})],
        cell_size=200.0,
    )
    edges = set().union(*(edges_of(city.graph(cell)) for cell in city.cells))
    assert ("way/2", "inside", "way/1") in edges
    assert ("way/1", "inside", "way/2") not in edges


def test_houses_that_share_a_wall_are_not_inside_each_other(build_world):
    corners = [(x, y, {}) for x in (0, 12, 24) for y in (0, 10)]
    city = build_world(
        corners,
        [([0, 2, 3, 1, 0], {"building": "house"}), ([2, 4, 5, 3, 2], {"building": "house"})],
        cell_size=100.0,
    )
    relations = [relation for cell in city.cells for relation in city.graph(cell).relations]
    assert set(relations) == {"west", "east"}


def test_cells_as_a_mapping(real_city):
    cells = real_city.cells
    names = list(cells)
    assert len(names) == len(cells) == len(set(names))
    for name in names[::97]:
        cell = cells[name]
        assert cell.id == name
        assert name in cells
        assert cells.get(name) == cell
        assert cells.at(cell.longitude, cell.latitude) == name
        west, south, east, north = cells.bounds(name)
        assert east - west == pytest.approx(cells.size)
        assert north - south == pytest.approx(cells.size)
        center = real_city.plane.to_plane((cell.longitude, cell.latitude))
        np.testing.assert_allclose(center, ((west + east) / 2, (south + north) / 2), atol=1e-3)


@pytest.mark.parametrize(
    "name", ["", "c", "c1", "r2", "c1r", "cr1", "c-1r0", "c0r-1", "c01r0", "c1r2 ", "C1R2", "c1.0r2",
             "c٣r١", "c²r1", "c999999999r999999999", "c1r2r3", "moon", "c" * 10_000],
)  # fmt: skip
def test_unknown_cells(name, harbour):
    with pytest.raises(
        OptionError, match=r"is not a cell of this map; cell names look like 'c\d+r\d+'"
    ):
        harbour.graph(name)
    for ask in (harbour.cells.center, harbour.cells.bounds, harbour.cells.__getitem__):
        with pytest.raises(OptionError):
            ask(name)
    assert name not in harbour.cells
    assert harbour.cells.get(name) is None
    assert None not in harbour.cells


def test_a_column_beyond_the_grid_is_not_the_next_row(harbour):
    grid = harbour.cells.grid
    name = next(n for n in harbour.cells if n.startswith("c0r") and n != "c0r0")
    wrapped = f"c{grid.columns}r{int(name.removeprefix('c0r')) - 1}"
    assert wrapped not in harbour.cells


def test_ids_are_stable_over_opening_and_building(harbour, harbour_file, hafenstadt, tmp_path):
    again = build_city(hafenstadt.write_osm(tmp_path / "t.osm"), tmp_path / "t.city")
    for other in (again, open_map(harbour_file)):
        assert list(other.cells) == list(harbour.cells)
        cell = next(iter(harbour.cells))
        assert other.graph(cell).ids == harbour.graph(cell).ids


def test_at_is_the_nearest_centre(make_city, rng):
    for options in ({}, OVERLAPPING, APART):
        city = make_city(TOWN, **options)
        cells = city.cells
        centers = {name: cells.center(name) for name in cells}
        for p in rng.uniform(-160, 160, (200, 2)):
            name = cells.at(*city.plane.to_lonlat(p))
            distances = {n: np.abs(c - p).max() for n, c in centers.items()}
            closest = min(distances, key=distances.get)
            if name is None:
                covering = round((p[0] - cells.grid.east) / cells.grid.stride)
                assert (
                    distances[closest] > cells.size / 2 - 1e-6
                    or closest != f"c{covering}r"
                    or cells.size > cells.grid.stride
                )
            else:
                assert distances[name] == pytest.approx(distances[closest])
                assert distances[name] <= cells.size / 2
                west, south, east, north = cells.bounds(name)
                assert west <= p[0] <= east
                assert south <= p[1] <= north
            assert cells.nearest(p) in cells
            if name is not None:
                assert cells.nearest(p) == name


@pytest.mark.parametrize("lonlat", [(0.0, 0.0), (-170.0, -80.0), (179.9, 89.9)])
def test_far_away_no_cell_covers_anything_but_one_is_nearest(lonlat, harbour):
    assert harbour.cells.at(*lonlat) is None
    assert harbour.cells.nearest(harbour.plane.to_plane(lonlat)) in harbour.cells


def test_a_map_of_one_thing_has_no_cells(build_world):
    city = build_world([(0, 0, {"amenity": "bench"})])
    assert len(city.cells) == 0
    assert list(city.cells) == []
    assert city.cells.at(10.0, 50.0) is None
    with pytest.raises(OptionError):
        city.graph("c0r0")


def test_two_things_in_one_place_have_no_direction(build_world):
    city = build_world([(0, 0, {"amenity": "bench"}), (0, 0, {"natural": "tree"})])
    [cell] = city.cells
    assert {relation for _, relation, _ in edges_of(city.graph(cell))} == {"near"}


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
        columns = (self.kind, self.part_starts, self.point_starts, self.points)
        return find_visible(*columns, grid=grid, radius=radius, rows=rows)

    def nearest(self, row, position):
        kind = self.kind[row]
        columns = (self.part_starts, self.point_starts, self.points)
        return nearest_on_parts(*columns, kind, row, *map(float, position))


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
    row, column = np.divmod(np.arange(grid.rows * grid.columns), grid.columns)
    origin = np.array([grid.east, grid.north])
    return dict(enumerate(origin + grid.stride * np.column_stack([column, row])))


@given(things, grids, st.sampled_from([3.0, 20.0, 75.0]))
def test_sightings_are_those_of_brute_force(drawn, grid, radius):
    world = Things(*drawn)
    seen = world.seen(grid, radius)
    assert (np.diff(seen.points) > 0).all()
    assert seen.starts[-1] == len(seen.objects) == len(seen.offsets)
    found = {}
    for at, (start, end) in zip(seen.points, pairwise(seen.starts), strict=True):
        assert (np.diff(seen.objects[start:end]) > 0).all()
        for e in range(start, end):
            found[int(at), int(seen.objects[e])] = seen.offsets[e]
    for at, p in positions(grid).items():
        for row, (kind, parts) in enumerate(world.things):
            d = np.hypot(*nearest(kind, parts, p))
            if abs(d - radius) < 1e-3:
                continue
            assert ((at, row) in found) == (d <= radius), (at, row, d)
            if d > radius:
                continue
            offset = found[at, row].astype(np.float64)
            assert np.hypot(*offset) == pytest.approx(d, abs=1e-3)
            if d > 0:  # the nearest point lies on the thing
                assert np.hypot(*nearest(LINE, parts, p + offset)) < 1e-3


@given(things, spot)
def test_nearest_is_that_of_brute_force(drawn, at):
    world = Things(*drawn)
    p = np.add(at, (0.25, 0.375))
    for row, (kind, parts) in enumerate(world.things):
        east, north, d2 = world.nearest(row, p)
        assert np.sqrt(d2) == pytest.approx(np.hypot(*nearest(kind, parts, p)), abs=1e-3)
        assert east**2 + north**2 == pytest.approx(d2, abs=1e-3)


@given(things, grids)
def test_rows_restrict_to_these_things(drawn, grid):
    world = Things(*drawn)
    rows = np.arange(0, len(drawn), 2)
    seen, everything = world.seen(grid, 30.0, rows), world.seen(grid, 30.0)
    assert set(seen.objects.tolist()) == set(rows.tolist()) & set(everything.objects.tolist())


def test_a_long_road_is_seen_where_it_is_nearest():
    road = Things((LINE, [[(-5000, 7), (5000, 7)]]))
    seen = road.seen(Grid(-200.0, 0.0, 50.0, 9, 1), 10.0)
    np.testing.assert_array_equal(seen.points, np.arange(9))
    np.testing.assert_allclose(seen.offsets, np.tile((0.0, 7.0), (9, 1)), atol=1e-4)


def test_more_sightings_than_expected():
    crowd = Things(*((POINT, [[(i % 7, i % 5)]]) for i in range(100)))
    seen = crowd.seen(Grid(-20.0, -20.0, 1.0, 50, 50), 100.0)
    assert len(seen.objects) == 100 * 2500


def test_on_the_radius_counts():
    seen = Things((POINT, [[(30, 40)]])).seen(Grid(0.0, 0.0, 10.0, 1, 1), 50.0)
    assert len(seen.objects) == 1


def test_more_ground_than_so_few_things_are_looked_through_for():
    corners = 2e5 * np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]])
    zigzag = 2e4 * (np.arange(1000)[:, None] // [1, 2] % 2)
    wide = Grid(0.0, 0.0, 20.0, 10_001, 10_001)
    for kind, line in ((AREA, corners), (LINE, corners), (LINE, zigzag)):
        with pytest.raises(MapError, match="too large an area"):
            Things((kind, [line])).seen(wide, 38.0)
