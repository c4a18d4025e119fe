"""Cities of the tables by name, by the path of an extract, and by an area of the paper."""

import json

import numpy as np
import pytest

from placegraph.errors import InputError, OptionError
from placegraph_lab.tables.outdoor import extracts
from placegraph_lab.tables.outdoor.extracts import (
    AREAS,
    EXTRACTS,
    Area,
    extract_of,
    extracts_of,
    tile,
)
from placegraph_lab.tables.outdoor.nearby import Bins
from placegraph_lab.tables.outdoor.places import read_raw
from placegraph_lab.tables.outdoor.queries import SIGHT
from placegraph_lab.worlds.town.town import Town


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    """A town of 480 m with a thing on every second square of 10 m, as an OSM file."""
    rng = np.random.default_rng(0)
    page = [
        "".join(
            rng.choice(list("bwlph ktB"), p=[0.06] * 5 + [0.5] + [0.06, 0.07, 0.07])
            for _ in range(48)
        )
        for _ in range(48)
    ]
    kinds = ("amenity=bench", "amenity=waste_basket", "highway=street_lamp", "amenity=post_box",
             "emergency=fire_hydrant", "amenity=kiosk", "natural=tree", "shop=bakery")  # fmt: skip
    legend = "\n".join(f"{g}: {tags}" for g, tags in zip("bwlphktB", kinds, strict=True))
    drawn = "\n".join(page)
    town = Town.parse(
        f"[town]\nname = T\ncenter = 8.404 49.009\nmetres = 10.0\n[drawing]\n{drawn}\n[legend]\n{legend}\n"
    )
    return town.write_osm(tmp_path_factory.mktemp("town") / "town.osm")


@pytest.fixture
def preset(monkeypatch):
    """A square of 300 m in the middle of the town, with 20 cells, instead of Karlsruhe's."""
    tiny = Area(8.404, 49.009, 0.09, 20)
    monkeypatch.setitem(extracts.AREAS, "karlsruhe", tiny)
    return tiny


def test_names_and_paths(town, tmp_path):
    data = tmp_path / "osm"
    assert [e.name for e in extracts_of("", data)] == list(EXTRACTS)
    found = extracts_of(f"monaco, {town},karlsruhe={town}", data)
    assert [(e.path, e.area) for e in found] == [
        (data / EXTRACTS["monaco"], None), (town, None), (town, AREAS["karlsruhe"]),
    ]  # fmt: skip
    assert len({e.key for e in found}) == 3
    copy = tmp_path / "monaco.osm"
    copy.write_bytes(town.read_bytes())
    assert not extract_of(str(copy), data).is_trained
    assert extract_of(str(copy), data).key != "monaco"


@pytest.mark.parametrize(
    ("cities", "words"),
    [
        ("karlsruh", "'karlsruh': it is neither a file nor one of vancouver"),
        ("karlsruhe=nowhere.osm", "no extract 'nowhere.osm'"),
        ("berlin={town}", "no area of 'berlin'; choose from karlsruhe, sydney, toronto"),
        ("{town},{town}", "Two extracts are called 'town.osm'"),
    ],
)
def test_what_is_no_city(town, tmp_path, cities, words):
    with pytest.raises(OptionError, match=words):
        extracts_of(cities.format(town=town), tmp_path)
    with pytest.raises(OptionError, match="names 2 cities"):
        extract_of("monaco,toronto", tmp_path)


def test_areas_are_those_of_the_paper():
    """Widths and heights in metres by the haversine, not by the library's plane."""
    for area, (km2, cells) in zip(
        AREAS.values(), ((173.5, 1000), (12145.0, 486), (630.2, 479)), strict=True
    ):
        west, south, east, north = np.radians(area.bounds)
        height = 6371.0 * (north - south)
        width = 6371.0 * (east - west) * np.cos(0.5 * (south + north))
        assert (height * width, area.cells) == (pytest.approx(km2, rel=0.01), cells)


def test_an_area_is_cut_out_and_has_as_many_cells(preset, town, tmp_path):
    extract = extract_of(f"karlsruhe={town}", tmp_path)
    city, again = extract.open(tmp_path), extract.open(tmp_path)
    assert len(city.cells) == preset.cells == len(again.cells)
    assert city.cells.points.tolist() == again.cells.points.tolist()
    west, south, east, north = preset.bounds
    whole, part = read_raw(town, preset.bounds), read_raw(extract.osm(tmp_path))
    inside = [
        osm for osm, at in zip(whole.osm, whole.plane.to_lonlat(whole.center), strict=True)
        if west <= at[0] <= east and south <= at[1] <= north and osm.startswith("node/")
    ]  # fmt: skip
    assert inside
    assert set(inside) == {osm for osm in part.osm if osm.startswith("node/")}
    for cell in city.cells:
        assert len(city.graph(cell).labels) >= 6
        lon, lat = city.plane.to_lonlat(city.cells.center(cell))
        assert west <= lon <= east
        assert south <= lat <= north


def test_viewpoints_of_an_area_lie_in_its_cells(preset, town, tmp_path):
    del preset
    extract = extract_of(f"karlsruhe={town}", tmp_path)
    city, path = extract.open(tmp_path), extract.osm(tmp_path)
    for middle, reach in ((True, 10.0), (False, 25.0 * 2**0.5)):
        asked = extracts.unseen_queries(extract, city, path, n=12, seed=0, in_the_middle=middle)
        for query in asked:
            cell = city.cells.at(query.longitude, query.latitude)
            assert cell is not None
            at = city.plane.to_plane((query.longitude, query.latitude))
            assert np.hypot(*(at - city.cells.center(cell))) <= reach + 1e-2
    bins = Bins.of(read_raw(path))
    here = bins.city.plane.to_plane([(q.longitude, q.latitude) for q in asked])
    assert (np.diff(bins.around(here, SIGHT).starts) >= 2).all()


def test_an_extract_that_does_not_cover_the_area(town, tmp_path, monkeypatch):
    extract = extract_of(f"sydney={town}", tmp_path)
    with pytest.raises(InputError, match=r"town.osm holds .* E, .* N, but the area of sydney") as e:
        extract.open(tmp_path)
    assert "take a larger extract" in str(e.value)
    west, south, east, north = AREAS["sydney"].bounds
    assert f"{west:.3f} to {east:.3f} E, {south:.3f} to {north:.3f} N" in str(e.value)
    small = Area(8.404, 49.009, 0.04, 1000)
    monkeypatch.setitem(extracts.AREAS, "karlsruhe", small)
    with pytest.raises(InputError, match=r"cells with 6 objects .* the paper has 1,000"):
        extract_of(f"karlsruhe={town}", tmp_path).open(tmp_path)
    broken = tmp_path / "broken.osm.pbf"
    broken.write_bytes(b"nothing")
    monkeypatch.undo()
    with pytest.raises(InputError, match="cannot be read as OpenStreetMap data"):
        extract_of(f"toronto={broken}", tmp_path).open(tmp_path)


@pytest.mark.parametrize(
    ("table", "options"),
    [
        ("outdoor_matchers", ["--methods", "triple bag;relational (default)", "--queries", 3]),
        ("outdoor_map_size", []),
        ("outdoor_cities", ["--queries", 2]),
        ("outdoor_candidates", ["--queries", 1, "--without", 4, "--sizes", "9,20"]),
        pytest.param("outdoor_pairs", ["--quick"], marks=pytest.mark.all),
    ],
)
@pytest.mark.parametrize("given", ["{town}", "karlsruhe={town}"])
def test_every_table_takes_an_extract(preset, town, tmp_path, measure, table, options, given):
    del preset
    chosen = "--city" if table in ("outdoor_candidates", "outdoor_pairs") else "--cities"
    city = given.format(town=town)
    done = measure(table, chosen, city, *options, "--cache", tmp_path, "--out", tmp_path / "a.json")
    assert done.exit_code == 0, done.output
    assert "| " in done.stdout
    told = json.loads((tmp_path / "a.json").read_text())
    assert told["table"] == table
    if table in ("outdoor_matchers", "outdoor_map_size", "outdoor_cities"):
        assert ("karlsruhe, 0.09 km²" if "=" in city else "town.osm") in done.stdout


def rows_of(city):
    """Objects by id, as plain values."""
    o = city.objects
    return {
        o.osm(i): (o.label(i), o.name(i), o.kind[i], [p.tolist() for p in o.parts(i)])
        for i in range(len(o))
    }


def test_copies_stand_apart_and_differ(harbour):
    city = harbour
    three = tile(city, 3, np.random.default_rng(0))
    three.objects.check()
    n = len(city.objects)
    assert len(three.objects) == 3 * n
    assert len(set(three.objects.osm_id)) >= 3 * len(set(city.objects.osm_id))
    original, first = rows_of(city), rows_of(three)
    assert all(first[osm] == row for osm, row in original.items())  # the first is as it was
    for k in (1, 2):
        copy = slice(k * n, (k + 1) * n)
        labels = [three.objects.label(i) for i in range(k * n, (k + 1) * n)]
        assert sorted(labels) == sorted(city.objects.label(i) for i in range(n))
        assert labels != [city.objects.label(i) for i in range(n)]
        shift = three.objects.center[copy] - city.objects.center
        assert np.ptp(shift, axis=0).max() < 0.01
    spans = [three.objects.center[k * n : (k + 1) * n] for k in range(3)]
    assert spans[1][:, 0].min() > spans[0][:, 0].max() + 100.0
    assert spans[2][:, 1].min() > spans[0][:, 1].max() + 100.0
    # stones' throws are kept: every copy has as many cells
    assert abs(len(three.cells) - 3 * len(city.cells)) <= 0.05 * len(three.cells)
