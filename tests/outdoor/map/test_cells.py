"""Cells and their graphs (Eq. 1-8), against a brute-force implementation."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.errors import OptionError
from placegraph.outdoor.map.cells import compass

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


# --- brute force ---


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


def graph_of(city, cell):
    """Nodes {id: position} and edges {(source, relation, target)} of a cell, slowly."""
    o, center, half = city.objects, city.cells.center(cell), city.cells.size / 2
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


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"cell_size": 80.0},
        {"cell_size": 40.0, "stride": 20.0, "edge_distance": 25.0},
        {"cell_size": 30.0, "stride": 60.0},
    ],
    ids=str,
)
def test_graphs_are_those_of_brute_force(options, make_city):
    city = make_city(TOWN, **options)
    grid, occupied = city.cells.grid, 0
    for row, column in itertools.product(range(grid.rows), range(grid.columns)):
        cell = f"c{column}r{row}"
        if cell not in city.cells:
            continue
        occupied += 1
        nodes, edges = graph_of(city, cell)
        graph = city.graph(cell)
        assert len(nodes) >= 2
        assert set(graph.ids) == set(nodes)
        for i, name in enumerate(graph.ids):
            np.testing.assert_allclose(graph.positions[i], nodes[name], atol=1e-3)
        assert edges_of(graph) == edges
        assert len(graph.sources) == len(edges), "no edge comes twice"
    assert occupied == len(city.cells) >= 3


def test_every_square_with_two_things_is_a_cell(make_city):
    city = make_city(TOWN)
    o, grid = city.objects, city.cells.grid
    for row, column in itertools.product(range(grid.rows), range(grid.columns)):
        center = np.array([grid.east, grid.north]) + grid.stride * np.array([column, row])
        held = sum(
            np.abs(nearest(o.kind[i], o.parts(i), center)).max() <= 25.0 for i in range(len(o))
        )
        assert (f"c{column}r{row}" in city.cells) == (held >= 2)


def test_every_thing_with_a_neighbour_stands_in_a_cell(make_city):
    city = make_city(TOWN)
    seen = set(itertools.chain.from_iterable(city.graph(cell).ids for cell in city.cells))
    everything = {city.objects.osm(i) for i in range(len(city.objects))}
    assert len(everything - seen) <= 2


# --- relations ---


@pytest.mark.parametrize(
    ("delta", "expected"),
    [
        ((1, 0), "east"), ((-1, 0), "west"), ((0, 1), "north"), ((0, -1), "south"),
        ((3, 2), "east"), ((-3, -2), "west"), ((2, 3), "north"), ((-2, -3), "south"),
        ((1, 1), "north"), ((-1, 1), "north"), ((1, -1), "south"), ((-1, -1), "south"),
    ],
)  # fmt: skip
def test_compass_of_eq_6(delta, expected):
    assert compass(np.array(delta, np.float64)) == expected


OPPOSITE = {"north": "south", "south": "north", "east": "west", "west": "east"}


@given(st.integers(-50, 50), st.integers(-50, 50))
def test_opposite_directions(dx, dy):
    if dx or dy:
        delta = np.array([dx, dy], np.float64)
        assert compass(-delta) == OPPOSITE[compass(delta)]


def test_relations_of_a_real_city_mirror_each_other(real_city):
    cells = list(real_city.cells)
    for cell in cells[:: max(1, len(cells) // 40)]:
        edges = edges_of(real_city.graph(cell))
        for source, relation, target in edges:
            if relation in OPPOSITE:
                assert (target, OPPOSITE[relation], source) in edges
            if relation == "near":
                assert (target, "near", source) in edges


def test_what_stands_in_stands_inside_and_at_along(build_world):
    square = [(0, 0, {}), (60, 0, {}), (60, 60, {}), (0, 60, {})]
    city = build_world(
        [*square, (30, 30, {"amenity": "fountain"}), (70, 8, {"amenity": "bench"})],
        [([0, 1, 2, 3, 0], {"leisure": "park"}), ([0, 1], {"highway": "path"})],
        cell_size=200.0,
    )
    edges = set().union(*(edges_of(city.graph(cell)) for cell in city.cells))
    assert ("node/5", "inside", "way/1") in edges
    assert ("node/6", "along", "way/2") in edges
    assert ("node/5", "along", "way/2") not in edges
    assert ("way/1", "inside", "node/5") not in edges
    assert ("node/6", "inside", "way/1") not in edges


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


def test_a_road_stands_in_each_cell_where_it_is_nearest(build_world):
    road = [(-200, 3, {}), (200, 3, {})]
    benches = [(x, -8, {"amenity": "bench"}) for x in range(-200, 201, 50)]
    city = build_world([*road, *benches], [([0, 1], {"highway": "residential"})])
    found = 0
    for cell in city.cells:
        graph, center = city.graph(cell), city.cells.center(cell)
        if "way/1" not in graph.ids:
            continue
        found += 1
        at = graph.positions[graph.ids.index("way/1")]
        assert at[0] == pytest.approx(center[0], abs=0.01)
        bench = next(i for i, osm in enumerate(graph.ids) if osm != "way/1")
        assert ("way/1", "north", graph.ids[bench]) in edges_of(graph) or abs(
            at[0] - graph.positions[bench][0]
        ) > abs(at[1] - graph.positions[bench][1])
    assert found >= 8


# --- the grid ---


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
        np.testing.assert_allclose(
            real_city.plane.to_plane((cell.longitude, cell.latitude)),
            ((west + east) / 2, (south + north) / 2),
            atol=1e-3,
        )


@pytest.mark.parametrize(
    "name", ["", "c", "c1", "r2", "c1r", "cr1", "c-1r0", "c0r-1", "c01r0", "c1r2 ", "C1R2", "c1.0r2",
             "c٣r١", "c²r1", "c999999999r999999999", "c1r2r3", "moon", "c" * 10_000],
)  # fmt: skip
def test_unknown_cells(name, harbour):
    with pytest.raises(OptionError, match=r"is no cell of this map; cells are named as 'c\d+r\d+'"):
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
    from placegraph.maps import open_map
    from placegraph.outdoor.city import build_city

    again = build_city(hafenstadt.write_osm(tmp_path / "t.osm"), tmp_path / "t.city")
    for other in (again, open_map(harbour_file)):
        assert list(other.cells) == list(harbour.cells)
        cell = next(iter(harbour.cells))
        assert other.graph(cell).ids == harbour.graph(cell).ids


def test_at_is_the_nearest_centre(make_city, rng):
    for options in ({}, {"cell_size": 40.0, "stride": 20.0}, {"cell_size": 30.0, "stride": 60.0}):
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


def test_overlapping_cells_share_their_things(make_city):
    wide = make_city(TOWN, cell_size=60.0, stride=20.0)
    apart = make_city(TOWN, cell_size=60.0)
    assert len(wide.cells) > 4 * len(apart.cells)
    holding = [c for c in wide.cells if any("bakery" in x for x in wide.graph(c).labels)]
    assert len(holding) >= 4


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
