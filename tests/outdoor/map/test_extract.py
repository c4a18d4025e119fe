import itertools
import os
import shutil
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from placegraph.core.geo import Box
from placegraph.core.geometry import LocalPlane
from placegraph.core.mapfile import map_writer, read_header
from placegraph.errors import InputError, MapError, MapLockedError, OptionError, PlacegraphError
from placegraph.maps import open_map
from placegraph.outdoor.city import build_city
from placegraph.outdoor.language.vocabulary import Vocabulary
from placegraph.outdoor.map.extract import TOLERANCE, clip, list_names
from placegraph.outdoor.map.geometry_kernels import compute_centers
from placegraph.outdoor.map.objects import AREA, GRAIN, LINE, POINT, simplify
from placegraph_lab.worlds.town.town import Town

MORE = (
    "toronto_downtown_2020.osm.bz2", "ankara_2019.osm.pbf", "liechtenstein_2021.osm.pbf",
    "andorra_2026.osm.pbf", "vancouver_2015.osm.pbf",
)  # fmt: skip
EXTRACTS = ["monaco_2025.osm.pbf", *(pytest.param(n, marks=pytest.mark.all) for n in MORE)]
BENCH, TREE = {"amenity": "bench"}, {"natural": "tree"}


def rows_by_id(city):
    return {city.objects.osm(i): i for i in range(len(city.objects))}


def labels(city, osm):
    o, i = city.objects, rows_by_id(city)[osm]
    return [o.labels[k] for k in o.label_values[o.label_starts[i] : o.label_starts[i + 1]]]


def names(city, osm):
    o, i = city.objects, rows_by_id(city)[osm]
    return [o.names[k] for k in o.name_values[o.name_starts[i] : o.name_starts[i + 1]]]


def columns(city):
    """Everything an open map holds, as arrays."""
    found = {**vars(city.objects), "center": city.objects.center}
    found["labels"], found["names"] = map(np.array, (city.objects.labels, city.objects.names))
    found["cells"] = city.cells.points
    return found


def test_same_input_same_bytes(hafenstadt, tmp_path):
    osm = hafenstadt.write_osm(tmp_path / "town.osm")
    one, two = tmp_path / "one.city", tmp_path / "two.city"
    build_city(osm, one)
    code = "import sys; from placegraph import build_city; build_city(sys.argv[1], sys.argv[2])"
    subprocess.run(  # noqa: S603  # our own interpreter and code
        [sys.executable, "-c", code, osm, two], check=True, env=os.environ | {"PYTHONHASHSEED": "7"}
    )
    assert one.read_bytes() == two.read_bytes()


def test_order_in_the_file_does_not_matter(write_world, tmp_path):
    nodes = [(50.0 * i, 20.0 * (i % 7), BENCH if i % 2 else TREE) for i in range(60)]
    ways = [([3 * i, 3 * i + 1, 3 * i + 2], {"highway": "path", "name": str(i)}) for i in range(20)]
    path = write_world(nodes, ways)
    one = build_city(path, tmp_path / "one.city")
    head, *things, end = path.read_text("utf-8").splitlines()
    nodes, ways = things[: len(nodes)], things[len(nodes) :]
    path.write_text("\n".join([head, *reversed(nodes), *ways, end]), "utf-8")
    build_city(path, tmp_path / "two.city")
    assert (tmp_path / "one.city").read_bytes() == (tmp_path / "two.city").read_bytes()
    assert len(one.objects) == 80


def test_what_was_built_is_what_is_opened(real_city, tmp_path):
    real_city.save(tmp_path / "again.city")
    opened = open_map(tmp_path / "again.city")
    for name, column in columns(real_city).items():
        np.testing.assert_array_equal(columns(opened)[name], column, strict=True, err_msg=name)
    assert opened.plane == real_city.plane
    assert opened.cells.grid == real_city.cells.grid
    assert (opened.cells.size, opened.cells.edge_distance) == (50.0, 50.0)
    assert (opened.source, opened.left_out) == (real_city.source, real_city.left_out)
    opened.objects.check()


@pytest.mark.parametrize("extract", EXTRACTS)
def test_bytes_a_cell_and_left_out(extract, shared, tmp_path):
    city = build_city(shared / "data/osm" / extract, tmp_path / "a.city")
    header = read_header(tmp_path / "a.city")
    index = sum(b.length for b in header.blocks if b.name.startswith("view_"))
    size = header.file_size - index
    assert size <= 500 * len(city.cells), f"{size / len(city.cells):.0f} bytes a cell"
    assert size < 0.5 * (shared / "data/osm" / extract).stat().st_size
    assert index <= 300 * len(city.objects), f"{index / len(city.objects):.0f} bytes an object"
    meta = header.meta
    assert meta["left_out"] == city.left_out
    assert all(n > 0 for n in city.left_out.values())
    assert len(city.cells) > 500
    # directions and distances are those of the city, not of some far end of it
    low, high = np.percentile(city.objects.center, (1, 99), axis=0)
    assert (low < 0).all()
    assert (high > 0).all()
    assert np.ptp(city.objects.points, axis=0).max() < 100_000


def test_plane_stands_in_the_city(build_world):
    town = [(20.0 * i, 20.0 * j, BENCH) for i in range(10) for j in range(10)]
    line = [(100.0, -700_000.0, {}), (100.0, 100_000.0, {})]
    city = build_world([*town, *line], [([100, 101], {"power": "line"})])
    assert city.plane.latitude == pytest.approx(50.0, abs=0.05)
    at = city.plane.to_plane(np.array([[10.0, 50.0], [10.01, 50.0]]))
    assert np.ptp(at[:, 0]) == pytest.approx(716.96, abs=1.0)
    assert len(city.objects) == 100
    assert city.left_out == {"things larger than a city": 1}
    assert np.ptp(city.objects.points, axis=0).max() < 1000


def test_a_line_around_the_globe_does_not_fill_the_memory(build_world):
    city = build_world(
        [(0, 0, BENCH), (10, 0, TREE), (-9e6, -5e6, {}), (9e6, 2e6, {})],
        [([2, 3], {"name": "Flight", "highway": "path"})],
    )
    assert sorted(rows_by_id(city)) == ["node/1", "node/2"]
    assert city.locate("There is a bench next to a tree.").best is not None


def test_a_city_on_the_date_line(tmp_path):
    nodes = [
        f'<node id="{i}" version="1" lon="{lon}" lat="-16.8"><tag k="amenity" v="bench"/></node>'
        for i, lon in enumerate((179.9990, 179.9995, 179.9999, -179.9999, -179.9995), 1)
    ]
    path = tmp_path / "taveuni.osm"
    path.write_text(f'<osm version="0.6">{"".join(nodes)}</osm>')
    city = build_city(path, tmp_path / "taveuni.city")
    assert len(city.objects) == 5
    assert np.ptp(city.objects.points, axis=0).max() < 200
    assert abs(city.locate("I am next to a bench.").best.longitude) == pytest.approx(180, abs=0.002)


def test_name_alone_makes_a_label(build_world):
    tags = [
        {"name": "parking lot"}, {"name": "Zzyzx"}, {"name": "bakery", "type": "site"},
        {"name": "Ortsteil", "boundary": "administrative"}, {"source": "survey"}, BENCH,
    ]  # fmt: skip
    city = build_world([(10 * i, 0, t) for i, t in enumerate(tags)])
    assert set(rows_by_id(city)) == {"node/1", "node/2", "node/6"}
    assert "amenity=parking" in labels(city, "node/1")
    assert labels(city, "node/2") == ["name=*"]
    assert names(city, "node/1") == ["parking lot"]
    assert city.locate("I am at Zzyzx.").best is not None


def test_all_names_count(build_world):
    tags = {
        "shop": "bakery", "name": "Bäckerei Kern", "name:en": "Kern's Bakery", "alt_name": "Kern",
        "name:fr": "Boulangerie Kern;Chez Kern", "brand": "Kernbrot", "name:etymology": "nut",
        "name:pronunciation": "kɛʁn", "old_name": "Bäckerei Kern",
    }  # fmt: skip
    city = build_world([(0, 0, tags), (15, 0, BENCH)])
    found = names(city, "node/1")
    assert found[0] == "Bäckerei Kern"
    assert set(found[1:]) == {"Boulangerie Kern", "Chez Kern", "Kern", "Kern's Bakery", "Kernbrot"}
    assert len(found) == 6
    for name in found:
        estimate = city.locate(f"I am next to {name}.")
        assert estimate.evidence[0].objects[0].id == "node/1", name


@pytest.mark.parametrize(
    ("tags", "found"),
    [
        ({"amenity": "post_box", "operator": "USPS"}, ("USPS",)),
        ({"amenity": "bank", "name": "Chase", "operator": "JPMorgan"}, ("Chase",)),
        ({"highway": "primary", "operator": "The City"}, ()),
        ({"name": "Ерму", "int_name": "Ermou", "name:sr-Latn": "Ermu"}, ("Ерму", "Ermou", "Ermu")),
        (
            {"shop": "yes", "name": "Elm", "addr:housenumber": "1,3", "addr:street": "Main St"},
            ("Elm", "1 Main St"),
        ),
        ({"building": "yes", "addr:housenumber": "1"}, ()),
        ({"highway": "primary", "name": "Elm", "ref": "A1;B 20"}, ("Elm", "A1", "B 20")),
        ({"highway": "primary", "ref": "99"}, ()),
        ({"highway": "bus_stop", "name": "Elm", "ref": "5123"}, ("Elm",)),
        (
            {"addr:housename": "The Oaks", "addr:housenumber": "2", "addr:place": "Elm"},
            ("The Oaks", "2 Elm"),
        ),
    ],
)
def test_who_runs_it_and_where_it_stands_are_names(tags, found):
    assert list_names(tags) == found


@given(
    st.dictionaries(
        st.sampled_from(["name", "alt_name", "brand", "name:de", "name:zh", "shop", "note"]),
        st.text(max_size=12),
        max_size=6,
    )
)
def test_names_are_clean(tags):
    found = list_names(tags)
    assert len(set(found)) == len(found)
    assert all(name and name == name.strip() and ";" not in name for name in found)
    if any(part.strip() for part in tags.get("name", "").split(";")):
        assert found[0] in tags["name"]


@pytest.mark.parametrize(
    "name", ["=", "a=b", "*", "\u200d", "🥐", "x" * 255, "a\u0301", "[bold]", "%s {0}", "«»"]
)
def test_odd_names_and_values_survive(name, build_world, tmp_path):
    tags = {"shop": "bakery", "name": name, "amenity": name}
    city = build_world([(0, 0, tags), (5, 0, {"shop": name, "name": "b"}), (9, 9, BENCH)])
    assert names(open_map(tmp_path / "world.city"), "node/1") == [name.strip()]
    assert city.locate("I am next to a bench.").best is not None


def test_kinds_and_geometry(build_world):
    square = [(0, 0, {}), (100, 0, {}), (100, 100, {}), (0, 100, {})]
    hole = [(40, 40, {}), (60, 40, {}), (60, 60, {}), (40, 60, {})]
    city = build_world(
        [*square, *hole, (200, 0, BENCH)],
        [
            ([0, 1, 2, 3, 0], {}),
            ([4, 5, 6, 7, 4], {}),
            ([0, 1, 2], {"highway": "residential"}),
            ([0, 1, 2, 3, 0], {"highway": "residential"}),
            ([4, 5, 6, 7, 4], {"natural": "water"}),
        ],
        [([(0, "outer"), (1, "inner")], {"leisure": "park"})],
    )
    o, row = city.objects, rows_by_id(city)
    kinds = {"node/9": POINT, "way/3": LINE, "way/4": LINE, "way/5": AREA, "relation/1": AREA}
    assert {k: o.kind[i] for k, i in row.items()} == kinds
    assert [len(part) for part in o.parts(row["relation/1"])] == [5, 5]
    bench = o.center[row["node/9"]]
    np.testing.assert_allclose(o.center[row["relation/1"]] - bench, (-150, 50), atol=1)
    np.testing.assert_allclose(o.center[row["way/5"]] - bench, (-150, 50), atol=1)
    np.testing.assert_allclose(o.center[row["way/3"]] - bench, (-100, 0), atol=1)


def test_an_edited_vocabulary_is_used(write_world, tmp_path):
    class Benches:
        keys = frozenset({"amenity"})

        def labels_of(self, tags):
            return ("amenity=bench",) if tags.get("amenity") == "bench" else ()

    path = write_world([(0, 0, BENCH), (5, 5, TREE), (9, 9, {"amenity": "cafe"})])
    for vocabulary, count in ((Benches(), 1), (Vocabulary.default(), 3)):
        city = build_city(path, tmp_path / "b.city", vocabulary=vocabulary)
        assert len(city.objects) == count


@pytest.mark.parametrize("name", ["cell_size", "stride", "edge_distance"])
@pytest.mark.parametrize("value", [0.0, -50.0, 0.5, 1e5, float("nan"), float("inf")])
def test_sizes_out_of_range(name, value, harbour_file, hafenstadt, tmp_path):
    osm = hafenstadt.write_osm(tmp_path / "town.osm")
    before = harbour_file.read_bytes()
    with pytest.raises(OptionError, match=name):
        build_city(osm, harbour_file, **{name: value})
    assert harbour_file.read_bytes() == before


def test_nothing_worth_naming(write_world, tmp_path):
    path = write_world([(0, 0, {"source": "survey"}), (5, 5, {})])
    for text in (path.read_text(), '<osm version="0.6"/>'):
        path.write_text(text)
        with pytest.raises(InputError, match="Choose a larger extract, or extend the vocabulary"):
            build_city(path, tmp_path / "a.city")
    assert not (tmp_path / "a.city").exists()


def test_a_map_is_replaced_only_by_a_whole_one(hafenstadt, tmp_path):
    osm, out = hafenstadt.write_osm(tmp_path / "town.osm"), tmp_path / "a.city"
    build_city(osm, out)
    before, whole = out.read_bytes(), osm.read_bytes()
    for end in (0, 100, len(whole) // 2, len(whole) - 20):
        osm.write_bytes(whole[:end])
        with pytest.raises(InputError, match=r"town\.osm"):
            build_city(osm, out)
        assert out.read_bytes() == before
    osm.write_bytes(whole)
    city = build_city(osm, out, cell_size=25.0)
    assert len(open_map(out).cells) == len(city.cells)
    assert out.read_bytes() != before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.city", "town.osm"]


@pytest.mark.parametrize("names", [("a\0.osm", "a.city"), ("a.osm", "a\0.city")])
def test_a_name_that_is_none_is_refused(names, tmp_path):
    with pytest.raises(MapError, match="not a valid file name"):
        build_city(*(tmp_path / name for name in names))


def test_the_extract_is_not_overwritten(hafenstadt, tmp_path):
    osm = hafenstadt.write_osm(tmp_path / "town.osm")
    before = osm.read_bytes()
    link = tmp_path / "link.city"
    link.symlink_to(osm)
    for out in (osm, link, str(osm), tmp_path / "." / "town.osm"):
        with pytest.raises(OptionError, match=r"town\.osm"):
            build_city(osm, out)
        assert osm.read_bytes() == before


def test_a_map_cannot_be_written_where_somebody_else_writes(hafenstadt, tmp_path):
    osm, out = hafenstadt.write_osm(tmp_path / "town.osm"), tmp_path / "a.city"
    with map_writer(out), pytest.raises(MapLockedError, match=r"a\.city"):
        build_city(osm, out)
    assert not out.exists()


@pytest.mark.parametrize("out", ["missing/a.city", "folder"])
def test_a_map_cannot_be_written_just_anywhere(out, hafenstadt, tmp_path):
    osm = hafenstadt.write_osm(tmp_path / "town.osm")
    (tmp_path / "folder").mkdir()
    with pytest.raises(MapError, match=out.split("/", maxsplit=1)[0]):
        build_city(osm, tmp_path / out)


def test_a_city_is_no_extract(harbour_file, tmp_path):
    with pytest.raises(InputError, match="unknown ending"):
        build_city(harbour_file, tmp_path / "a.city")
    shutil.copy(harbour_file, tmp_path / "a.osm.pbf")
    with pytest.raises(InputError, match="cannot be read"):
        build_city(tmp_path / "a.osm.pbf", tmp_path / "a.city")


def test_progress_is_told(hafenstadt, tmp_path):
    told = []
    osm = hafenstadt.write_osm(tmp_path / "town.osm")
    build_city(osm, tmp_path / "a.city", progress=lambda step, n: told.append((step, n)))
    assert told
    assert all(isinstance(step, str) and n >= 0 for step, n in told)


@settings(max_examples=12)
@given(st.text(alphabet='#"≈~*-|+ .bS', min_size=1, max_size=60))
def test_any_town_builds(tmp_path_factory, drawing):
    folder = tmp_path_factory.getbasetemp()
    legend = "b: amenity=bench\nS: railway=tram_stop name=Halt\n"
    try:
        osm = Town.parse(f"[drawing]\n{drawing}\n[legend]\n{legend}").write_osm(folder / "any.osm")
        city = build_city(osm, folder / "any.city")
    except PlacegraphError:
        return
    city.objects.check()
    assert np.isfinite(city.objects.points).all()
    for cell in city.cells:
        assert len(city.graph(cell)) >= 2


def parts_of(draw_lines):
    starts = np.concatenate(([0], np.cumsum([len(p) for p in draw_lines]))).astype(np.int64)
    return np.concatenate([np.array(p, float).reshape(-1, 2) for p in draw_lines]), starts


def distance_to(line, point):
    """Distance of a point to a polyline, by brute force."""
    a, b = line[:-1], line[1:]
    d = b - a
    length2 = np.maximum((d**2).sum(1), 1e-12)
    t = np.clip(((point - a) * d).sum(1) / length2, 0, 1)
    return np.hypot(*(a + t[:, None] * d - point).T).min(initial=np.hypot(*(line[0] - point)))


corners = st.tuples(st.integers(-40, 40), st.integers(-40, 40))
lines = st.lists(st.lists(corners, min_size=1, max_size=12), min_size=1, max_size=4)


@given(lines, st.sampled_from([0.0, 0.75, 3.0, 20.0]), st.booleans())
def test_simplified_lines_stay_within_the_tolerance(drawn, tolerance, rings):
    if rings:
        drawn = [[*line, line[0]] for line in drawn]
    before, starts = parts_of(drawn)
    after, bounds = simplify(before, starts, tolerance)
    assert len(bounds) == len(starts)
    assert bounds[-1] == len(after)
    for part in range(len(drawn)):
        old, new = before[starts[part] : starts[part + 1]], after[bounds[part] : bounds[part + 1]]
        np.testing.assert_array_equal(old[[0, -1]], new[[0, -1]])
        assert {*map(tuple, new)} <= {*map(tuple, old)}
        assert max(distance_to(new, p) for p in old) <= tolerance + 1e-9
        if tolerance == 0.0 and len(old) > 1:
            assert all(distance_to(new, p) < 1e-9 for p in old)


def test_stored_shapes_are_those_of_the_extract(build_world, rng):
    line = np.cumsum(rng.normal(0, 5, (200, 2)), axis=0)
    nodes = [(e, n, {}) for e, n in line]
    city = build_world(nodes, [(range(200), {"highway": "path"})])
    [stored] = city.objects.parts(0)
    assert len(stored) < 200
    lonlat = city.plane.to_lonlat(stored)
    back = LocalPlane(10.0, 50.0).to_plane(lonlat)
    bound = TOLERANCE + GRAIN * np.sqrt(0.5) + 0.02
    assert max(distance_to(back, p) for p in line) < bound


def center(kind, *lines):
    flat, starts = parts_of(lines)
    return compute_centers(
        np.array([kind], np.uint8),
        np.array([0, len(lines)], np.int32),
        starts.astype(np.int32),
        flat.astype(np.float32),
    )[0]


def test_centers():
    square = [(0, 0), (10, 0), (10, 10), (0, 10), (0, 0)]
    np.testing.assert_allclose(center(AREA, square), (5, 5))
    np.testing.assert_allclose(center(AREA, square[::-1]), (5, 5), atol=1e-5)
    np.testing.assert_allclose(center(LINE, [(0, 0), (10, 0), (10, 30)]), (10, 10), atol=1e-5)
    np.testing.assert_allclose(center(POINT, [(3, 4)]), (3, 4))
    np.testing.assert_allclose(center(LINE, [(3, 4), (3, 4)]), (3, 4))
    np.testing.assert_allclose(center(AREA, [(3, 4), (3, 4), (3, 4), (3, 4)]), (3, 4))
    flat = [(0, 0), (10, 0), (5, 0), (0, 0)]  # an area of no area
    assert 0 <= center(AREA, flat)[0] <= 10


def test_a_hole_moves_the_centre_away():
    outer = [(0, 0), (10, 0), (10, 10), (0, 10), (0, 0)]
    hole = [(6, 6), (6, 9), (9, 9), (9, 6), (6, 6)]
    east, north = center(AREA, outer, hole)
    assert east == pytest.approx(north)
    assert east == pytest.approx((100 * 5 - 9 * 7.5) / 91, abs=1e-3)


@pytest.mark.parametrize("stray", [[], [(-900_000.0, 0.0, BENCH), (900_000.0, 0.0, BENCH)]])
def test_what_is_larger_than_a_city_is_left_out(build_world, stray):
    town = [(20.0 * i, 20.0 * j, BENCH) for i in range(3) for j in range(3)]
    corners = [(-7e4, -1e5, {}), (7e4, -1e5, {}), (7e4, 1e5, {}), (-7e4, 1e5, {})]
    ways = [([9, 10, 11, 12, 9], {"leisure": "park"}), ([9, 11], {"highway": "primary"})]
    city = build_world([*town, *corners, *stray], ways)
    assert city.left_out == {"things larger than a city": 2}
    assert len(city.objects) == 9 + len(stray)
    assert city.locate("I am next to a bench.").best is not None


def test_of_many_large_things_the_largest_are_left_out(build_world):
    sizes = [20_000.0] * 20 + [200.0]
    nodes = [(s * x, s * y, {}) for s in sizes for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))]
    nodes += [(5.0, 5.0, BENCH)]
    ways = [
        ([4 * i, 4 * i + 1, 4 * i + 2, 4 * i + 3, 4 * i], {"leisure": "park"})
        for i in range(len(sizes))
    ]
    city = build_world(nodes, ways, cell_size=1000.0)
    assert city.left_out["things larger than a city"] >= 10
    assert "way/21" in rows_by_id(city)
    assert city.locate("I am next to a bench.").best is not None


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
