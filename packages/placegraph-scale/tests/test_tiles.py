import os
import re
import subprocess
import sys

import numpy as np
import osmium
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.core.geo import key_at, tile_bounds
from placegraph.errors import InputError, MapError
from placegraph.io.osm import urls
from placegraph.outdoor.city import CityMap
from placegraph.outdoor.map import extract
from placegraph.outdoor.map.extract import (
    ElementTable,
    LabelledElement,
    drop_duplicates,
    join_words,
    split_words,
)
from placegraph_scale import tiles as module
from placegraph_scale.tiles import (
    LARGE,
    Split,
    TileFiles,
    TileJob,
    build_tile,
    read_frames,
    split,
    spread_large,
)

ZOOM, MARGIN = 15, 100.0  # tiles of 780 m at 50 degrees
BENCH, TREE = {"amenity": "bench"}, {"natural": "tree"}


def split_up(path, folder, zoom=ZOOM):
    folder.mkdir(exist_ok=True)
    return split(path, folder, zoom, MARGIN)


def held(folder, sizes, key):
    tables = read_frames(folder / f"{key}.things", sizes[key])
    return {i for things in tables for i in things.osm_id.tolist()}


def city_of(folder, found, key, tmp_path):
    (tmp_path / "large").mkdir(exist_ok=True)
    large = spread_large(folder, tmp_path / "large", found.sizes, found.populated, MARGIN)
    files = [(str(folder / f"{key}.things"), found.sizes[key])]
    files += [(str(tmp_path / "large" / f"{key}.things"), large[key])] if key in large else []
    out = tmp_path / f"{key}.city"
    done = build_tile(TileJob(key, tuple(files), str(out), MARGIN, (50.0, 50.0, 50.0), "w"))
    assert done.stands(out)
    return CityMap.open(out)


def test_things_near_a_border_are_in_both_tiles(write_world, tmp_path):
    east = tile_bounds(key_at(10.0, 50.0, ZOOM)).east
    steps = (-500.0, -80.0, 80.0, 500.0)
    at = (east - 10.0) * 71_700
    path = write_world([(at + step, 0.0, BENCH) for step in steps])
    found = split_up(path, tmp_path / "things")
    west, other = key_at(10.0, 50.0, ZOOM), key_at(east + 1e-6, 50.0, ZOOM)
    assert held(tmp_path / "things", found.sizes, west) == {1, 2, 3}
    assert held(tmp_path / "things", found.sizes, other) == {2, 3, 4}
    assert found.populated == sorted([west, other])
    assert Split.load(tmp_path / "things") == found
    assert split_up(path, tmp_path / "things") == found


def test_a_road_of_600_km_costs_its_part_in_populated_tiles(write_world, tmp_path):
    park = [(7e4 * x, 11e4 * y) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    nodes = [(0, 0, BENCH), (30, 0, TREE), (20_000, 5, BENCH), (-300_000, 7, {}), (300_000, 7, {})]
    path = write_world(
        [*nodes, *((x, y, {}) for x, y in park)],
        [([3, 4], {"highway": "primary", "name": "Long"}), ([5, 6, 7, 8, 5], {"leisure": "park"})],
    )
    found = split_up(path, tmp_path / "things")
    assert len(found.populated) == 2
    key = key_at(10.0, 50.0, ZOOM)
    assert held(tmp_path / "things", found.sizes, LARGE) == {1, 2}
    city = city_of(tmp_path / "things", found, key, tmp_path)
    assert sorted(city.objects.osm(i) for i in range(len(city.objects))) == [
        "node/1", "node/2", "way/1", "way/2",
    ]  # fmt: skip
    assert np.ptp(city.objects.points, axis=0).max() < 1200
    assert len(city.cells) < 800
    assert city.locate("There is a bench next to a tree. I am on Long.").best is not None


def test_a_tile_on_the_date_line_is_whole(tmp_path):
    nodes = "".join(
        f'<node id="{i}" version="1" lon="{lon}" lat="-16.8"><tag k="amenity" v="bench"/></node>'
        for i, lon in enumerate((179.9995, 179.9999, -179.9999, -179.9995), 1)
    )
    path = tmp_path / "taveuni.osm"
    path.write_text(f'<osm version="0.6">{nodes}</osm>')
    found = split_up(path, tmp_path / "things")
    assert len(found.populated) == 2
    for key in found.populated:
        city = city_of(tmp_path / "things", found, key, tmp_path)
        assert len(city.objects) == 4
        assert np.ptp(city.objects.points, axis=0).max() < 200


def test_nodes_on_disk_give_the_same(write_world, tmp_path, monkeypatch):
    nodes = [(30.0 * i, 20.0 * (i % 7), BENCH if i % 2 else TREE) for i in range(60)]
    ways = [([3 * i, 3 * i + 1, 3 * i + 2], {"highway": "path"}) for i in range(20)]
    path = write_world(nodes, ways)
    one = split_up(path, tmp_path / "one")
    monkeypatch.setattr(urls, "SMALL", 0)
    assert split_up(path, tmp_path / "two") == one
    names = sorted(p.name for p in (tmp_path / "one").iterdir())
    assert sorted(p.name for p in (tmp_path / "two").iterdir()) == names
    for name in names:
        assert (tmp_path / "two" / name).read_bytes() == (tmp_path / "one" / name).read_bytes()


def test_an_extract_that_changes_meanwhile(write_world, tmp_path, monkeypatch):
    path = write_world([(0, 0, BENCH)])
    real = module.label_elements

    def touched(*given):
        yield from real(*given)
        os.utime(path, (1, 1))

    monkeypatch.setattr(module, "label_elements", touched)
    with pytest.raises(InputError, match=r"world\.osm changed while it was read"):
        split_up(path, tmp_path / "things")
    assert Split.load(tmp_path / "things") is None


def along(n):
    nodes = [(30.0 * i, 20.0 * (i % 7), BENCH if i % 2 else TREE) for i in range(n)]
    ways = [([3 * i, 3 * i + 1, 900 + i], {"highway": "path"}) for i in range(n // 3)]
    ways += [([0, 6], {}), ([6, 7, 0], {})]
    lake = ([(n // 3, "outer"), (n // 3 + 1, "outer")], {"natural": "water"})
    return nodes, ways, [lake, ([(0, "outer")], {"natural": "water"})]


@pytest.mark.parametrize("batches", [1, 2])
def test_a_split_that_was_killed_goes_on(batches, write_world, tmp_path, monkeypatch):
    path = write_world(*along(60))
    monkeypatch.setattr(extract, "BATCH", 10)
    whole = split_up(path, tmp_path / "whole")
    assert whole.left_out == {
        "multipolygons with missing or crossing members": 1,
        "ways cut where members are missing": 20,
    }
    monkeypatch.setattr(module.TileFiles, "full", True)  # written down after every block
    real, seen = module._spread, []

    def dies(*given):
        if len(seen) == batches:
            raise KeyboardInterrupt
        seen.append(real(*given))

    monkeypatch.setattr(module, "_spread", dies)
    with pytest.raises(KeyboardInterrupt):
        split_up(path, tmp_path / "things")
    torn = next((tmp_path / "things").glob("*.things"))
    torn.write_bytes(torn.read_bytes() + b"half a frame")
    (tmp_path / "things" / "stray.things").touch()
    seen.clear()
    monkeypatch.setattr(module, "_spread", lambda *given: seen.append(real(*given)))
    assert split_up(path, tmp_path / "things") == whole
    assert len(seen) == 3 - batches
    for file in (tmp_path / "whole").glob("*.things"):
        assert (tmp_path / "things" / file.name).read_bytes() == file.read_bytes()
    assert not (tmp_path / "things" / "stray.things").exists()


def test_an_extract_that_changed_since_it_was_killed_begins_anew(write_world, tmp_path):
    path = write_world([(0, 0, BENCH)])
    split_up(path, tmp_path / "things")
    os.utime(path, (1, 1))
    again = split_up(path, tmp_path / "things")
    assert (again.objects, again.of[1]) == (1, 10**9)


@pytest.mark.parametrize(("what", "limit"), [("nodes.index", 0), ("things", 1 << 20)])
def test_a_full_disk_is_said_and_the_split_goes_on(what, limit, write_world, tmp_path):
    path = tmp_path / "world.osm.pbf"
    with osmium.SimpleWriter(str(path)) as writer:
        for thing in osmium.FileProcessor(str(write_world(*along(60)))):
            writer.add(thing)
    code = (
        "import resource, sys\n"
        "from pathlib import Path\n"
        "from placegraph.errors import MapError\n"
        "from placegraph.io.osm import urls\n"
        "from placegraph_scale import tiles as split\n"
        "urls.SMALL = int(sys.argv[3])\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (100, resource.RLIM_INFINITY))\n"
        "try: split.split(Path(sys.argv[1]), Path(sys.argv[2]), 15, 100.0)\n"
        "except MapError as error: print(error)\n"
    )
    folder = tmp_path / "things"
    folder.mkdir()
    said = subprocess.run(  # noqa: S603  # our own interpreter and code
        [sys.executable, "-c", code, path, folder, str(limit)],
        check=True, capture_output=True, text=True, env=os.environ,
    )  # fmt: skip
    for words in (what, "cannot be written", "File too large"):
        assert words in said.stdout
    assert what != "things" or "then resumes" in said.stdout
    assert split_up(path, folder).objects == 81


def test_nothing_worth_naming(write_world, tmp_path):
    with pytest.raises(
        InputError, match=r"nothing\. Choose a larger extract, or extend the vocabulary\."
    ):
        split_up(write_world([(0, 0, {"source": "survey"})]), tmp_path / "things")


words = st.lists(
    st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=9), max_size=3
)
degrees = st.tuples(st.integers(-1800000000, 1800000000), st.integers(-900000000, 900000000))
parts = st.lists(st.lists(degrees, min_size=1, max_size=4), min_size=1, max_size=3)
BENCH_TEXT = join_words(["amenity=bench"], [])


def thing(i=1, points=((100000000, 500000000),)):
    return LabelledElement(0, i, 0, BENCH_TEXT, [np.array(points) / 1e7])


def put(folder, *tables):
    spills = TileFiles(folder)
    for things in tables:
        spills.add("0", ElementTable.of(things))
    spills.flush()
    return folder / "0.things", spills.sizes["0"]


@given(st.lists(st.tuples(st.integers(-(1 << 60), 1 << 60), words, parts), min_size=1, max_size=4))
def test_things_come_back(tmp_path_factory, drawn):
    given_ = [
        LabelledElement(
            2, i, 2, join_words(("a=b", "c=d"), names), [np.array(part) / 1e7 for part in shape]
        )
        for i, names, shape in drawn
    ]
    [back] = read_frames(*put(tmp_path_factory.mktemp("spill"), given_))
    for row, (one, (_, names, _)) in enumerate(zip(given_, drawn, strict=True)):
        found = back.element(row)
        assert found[:4] == one[:4]
        labels, said = split_words(found.text)
        assert labels == ("a=b", "c=d")
        assert said == tuple(re.sub("[\x1d-\x1f]", " ", name) for name in names)
        for a, b in zip(found.parts, one.parts, strict=True):
            np.testing.assert_array_equal(a, b)


@given(at=st.integers(0, 60), cut=st.booleans())
def test_a_damaged_file_is_named(tmp_path_factory, at, cut):
    path, size = put(tmp_path_factory.mktemp("spill"), [thing()])
    data = bytearray(path.read_bytes())
    path.write_bytes(data[:at] if cut else data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :])
    with pytest.raises(MapError, match=r"0\.things is damaged"):
        read_frames(path, size)


def test_the_longest_version_counts():
    things = ElementTable.of([thing(1), thing(1, [(0, 0), (1, 1)]), thing(2)])
    kept = drop_duplicates(things)
    assert kept.osm_id.tolist() == [1, 2]
    assert len(kept.element(0).parts[0]) == 2
    assert drop_duplicates(kept) is kept
