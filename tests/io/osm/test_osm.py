"""Reader of OpenStreetMap files: the same elements from every ending, or one typed error."""

import bz2
import gzip
import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import osmium
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.io.damage import damaged

from placegraph.errors import InputError
from placegraph.io.osm import osm_process
from placegraph.io.osm.osm import (
    AREA,
    LINE,
    NODE,
    POINT,
    RELATION,
    WAY,
    LeftOut,
    OsmElement,
    is_area,
    read_osm,
)

KEYS = ("amenity", "building", "highway", "landuse", "leisure", "name", "natural", "shop")
ENDINGS = (".osm", ".osm.gz", ".osm.bz2", ".osm.pbf")

WORLD = """<osm version="0.6">
<node id="1" version="1" lat="50.0" lon="10.0"/>
<node id="2" version="1" lat="50.0" lon="10.001"/>
<node id="3" version="1" lat="50.001" lon="10.001"/>
<node id="4" version="1" lat="50.001" lon="10.0"/>
<node id="5" version="1" lat="50.0004" lon="10.0004"/>
<node id="6" version="1" lat="50.0004" lon="10.0006"/>
<node id="7" version="1" lat="50.0006" lon="10.0006"/>
<node id="8" version="1" lat="50.0006" lon="10.0004"/>
<node id="9" version="1" lat="50.0005" lon="10.0005">
  <tag k="amenity" v="bench"/><tag k="name" v="Bänkle &amp; Söhne"/></node>
<node id="10" version="1" lat="50.002" lon="10.002"><tag k="source" v="survey"/></node>
<way id="11" version="1"><nd ref="1"/><nd ref="2"/><nd ref="3"/>
  <tag k="highway" v="residential"/></way>
<way id="12" version="1"><nd ref="1"/><nd ref="2"/><nd ref="3"/><nd ref="4"/><nd ref="1"/></way>
<way id="13" version="1"><nd ref="5"/><nd ref="6"/><nd ref="7"/><nd ref="8"/><nd ref="5"/></way>
<way id="14" version="1"><nd ref="1"/><nd ref="2"/><nd ref="3"/><nd ref="1"/>
  <tag k="building" v="yes"/></way>
<way id="15" version="1"><nd ref="2"/><nd ref="3"/><nd ref="4"/><nd ref="2"/>
  <tag k="highway" v="residential"/></way>
<relation id="16" version="1"><member type="way" ref="12" role="outer"/>
  <member type="way" ref="13" role="inner"/>
  <tag k="type" v="multipolygon"/><tag k="natural" v="water"/></relation>
</osm>"""


def write(path, text=WORLD):
    """Write OpenStreetMap XML in the format that the ending of `path` asks for."""
    plain = path.with_name(path.name.split(".", maxsplit=1)[0] + ".source.osm")
    plain.write_text(text, encoding="utf-8")
    with osmium.SimpleWriter(str(path), overwrite=True) as writer:
        for thing in osmium.FileProcessor(str(plain)):
            writer.add(thing)
    return path


def raw(path, text):
    """Write text as it is, wrapped into <osm>."""
    path.write_text(f'<osm version="0.6">{text}</osm>', encoding="utf-8")
    return path


def node(i, lon, lat, tags=""):
    return f'<node id="{i}" version="1" lon="{lon}" lat="{lat}">{tags}</node>'


def way(i, refs, tags=""):
    members = "".join(f'<nd ref="{ref}"/>' for ref in refs)
    return f'<way id="{i}" version="1">{members}{tags}</way>'


def relation(i, members, tags=""):
    listed = "".join(f'<member type="way" ref="{ref}" role="{role}"/>' for ref, role in members)
    tag = '<tag k="type" v="multipolygon"/>'
    return f'<relation id="{i}" version="1">{listed}{tag}{tags}</relation>'


def tag(key, value):
    return f'<tag k="{key}" v="{value}"/>'


SQUARE = ((0, 0), (0.1, 0), (0.1, 0.1), (0, 0.1))


def corners(*offsets):
    """Nodes 1, 2, ... at these offsets [degree]."""
    return "".join(node(i, 10 + x, 50 + y) for i, (x, y) in enumerate(offsets, 1))


def read(path, keys=KEYS):
    """Elements by type and id, and what was left out."""
    left_out = LeftOut()
    found = {(e.osm_type, e.osm_id): e for e in read_osm(path, keys, left_out)}
    return found, left_out.counts


def refuse_process(*_args, **_options):
    raise PermissionError("no process")


@pytest.fixture(scope="module", params=ENDINGS)
def world(request, tmp_path_factory):
    return write(tmp_path_factory.mktemp("osm") / f"world{request.param}")


def test_every_ending_gives_the_same_elements(world):
    found, left_out = read(world)
    assert not left_out
    assert {key: e.kind for key, e in found.items()} == {
        (NODE, 9): POINT, (WAY, 11): LINE, (WAY, 14): AREA, (WAY, 15): LINE, (RELATION, 16): AREA,
    }  # fmt: skip
    assert found[NODE, 9].tags == {"amenity": "bench", "name": "Bänkle & Söhne"}
    np.testing.assert_allclose(found[NODE, 9].parts, [[[10.0005, 50.0005]]], atol=1e-9)
    np.testing.assert_allclose(
        found[WAY, 11].parts[0], [[10.0, 50.0], [10.001, 50.0], [10.001, 50.001]], atol=1e-9
    )


def test_where_no_process_can_be_had_xml_is_read_all_the_same(world, monkeypatch):
    monkeypatch.setattr("subprocess.run", refuse_process)
    monkeypatch.setattr("subprocess.Popen", refuse_process)
    assert list(read_osm(world, ["shop", "building", "highway"]))


def test_rings_are_closed_and_only_wanted_keys_are_read(world):
    found, _ = read(world)
    for key in ((WAY, 14), (WAY, 15)):
        [ring] = found[key].parts
        assert ring.shape == (4, 2)
        np.testing.assert_array_equal(ring[0], ring[-1])
    outer, inner = sorted(found[RELATION, 16].parts, key=lambda ring: ring[:, 0].min())
    assert outer.shape == inner.shape == (5, 2)
    for ring in (outer, inner):
        np.testing.assert_array_equal(ring[0], ring[-1])
    np.testing.assert_allclose(np.ptp(outer, axis=0), 1e-3, atol=1e-9)
    np.testing.assert_allclose(np.ptp(inner, axis=0), 2e-4, atol=1e-9)
    assert found[RELATION, 16].tags["natural"] == "water"
    found, _ = read(world, ["highway"])
    assert set(found) == {(WAY, 11), (WAY, 15)}
    assert read(world, ["nothing"]) == ({}, Counter())


def test_two_outer_rings_and_one_of_two_ways(tmp_path):
    triangle = ((0, 0), (0.1, 0), (0.1, 0.1))
    nodes = corners(*triangle, *((x + 1, y) for x, y in triangle))
    ways = way(1, [1, 2, 3, 1]) + way(2, [4, 5, 6, 4])
    woods = relation(1, [(1, "outer"), (2, "outer")], tag("natural", "wood"))
    parts = way(1, [1, 2, 3]) + way(2, [3, 4, 1])
    for text, lengths in ((nodes + ways, [4, 4]), (corners(*SQUARE) + parts, [5])):
        found, left_out = read(raw(tmp_path / "woods.osm", text + woods))
        assert not left_out
        assert [len(ring) for ring in found[RELATION, 1].parts] == lengths


@pytest.mark.parametrize(
    ("tags", "expected"),
    [
        ({"building": "yes"}, True), ({"amenity": "parking"}, True),
        ({"highway": "residential"}, False), ({"highway": "pedestrian", "area": "yes"}, True),
        ({"landuse": "grass", "area": "no"}, False), ({"highway": "platform"}, True),
        ({"railway": "station"}, True), ({"barrier": "fence"}, False),
        ({"barrier": "fence", "landuse": "garden"}, True), ({"leisure": "track"}, True),
        ({"leisure": "track", "highway": "path"}, False), ({"waterway": "riverbank"}, True),
        ({}, True),
    ],
)  # fmt: skip
def test_is_area(tags, expected):
    assert is_area(tags) is expected


def test_ways_are_cut_where_nodes_are_missing_and_buildings_stay_closed_if_they_are(tmp_path):
    lines = ([1, 2, 99], [98, 1, 99], [97, 98, 99], [1, 1])
    road = tag("highway", "residential")
    ways = "".join(way(i, refs, road) for i, refs in enumerate(lines, 1))
    path = raw(tmp_path / "clipped.osm", corners(*SQUARE[:2]) + ways)
    found, left_out = read(path)
    assert set(found) >= {(WAY, 1)}
    np.testing.assert_allclose(found[WAY, 1].parts[0], [[10, 50], [10.1, 50]])
    assert left_out["ways cut where members are missing"] >= 1
    assert left_out["ways without positions"] >= 2
    assert (WAY, 2) not in found
    assert (WAY, 3) not in found
    house = tag("building", "yes")
    ways = way(1, [1, 2, 99, 3, 1], house) + way(2, [99, 1, 2, 3, 99], house)
    path = raw(tmp_path / "building.osm", corners(*SQUARE) + ways)
    found, left_out = read(path)
    assert found[WAY, 1].kind == AREA
    assert found[WAY, 2].kind == LINE
    assert left_out == {"ways cut where members are missing": 2}


def test_nodes_without_a_position_and_multipolygons_without_members_are_counted(tmp_path):
    path = raw(
        tmp_path / "nowhere.osm",
        f'<node id="1" version="1">{tag("shop", "bakery")}</node>'
        + node(2, 200, 95, tag("shop", "bakery"))
        + node(3, 10, 50, tag("shop", "bakery")),
    )
    found, left_out = read(path)
    assert set(found) == {(NODE, 3)}
    assert left_out == {"nodes without a position": 2}
    nodes = corners((0, 0), (0.1, 0.1), (0.1, 0), (0, 0.1))
    path = raw(
        tmp_path / "clipped.osm",
        nodes
        + way(1, [1, 2, 3, 4, 1])  # crosses itself
        + relation(1, [(1, "outer")], tag("natural", "water"))
        + relation(2, [(77, "outer")], tag("natural", "water"))
        + relation(3, [(78, "outer")]),  # nothing worth naming: not counted
    )
    found, left_out = read(path)
    assert not found
    assert left_out == {"multipolygons with missing or crossing members": 2}
    assert "2 multipolygons" in str(LeftOut(left_out))
    assert str(LeftOut()) == "nothing"


def test_clipped_real_extract(shared):
    elements, left_out = read(shared / "data/osm/monaco_2025.osm.pbf")
    assert 5_000 < len(elements) < 50_000
    assert all(0 <= n < 100 for n in left_out.values())
    assert {e.kind for e in elements.values()} == {POINT, LINE, AREA}
    assert any(e.osm_type == RELATION and len(e.parts) > 1 for e in elements.values())


@pytest.fixture
def in_process(monkeypatch):
    """Convert in this process: to start another takes longer than all else."""
    monkeypatch.setattr("subprocess.run", refuse_process)


def refused(path):
    with pytest.raises(InputError) as caught:
        list(read_osm(path, KEYS))
    message = str(caught.value)
    assert str(path) in message
    assert "\n" not in message
    assert len(message) < 600
    return message


def read_or_refused(path):
    """Read a file that may be damaged: elements, or None where it was refused as promised."""
    try:
        return list(read_osm(path, KEYS))
    except InputError as error:
        assert str(path) in str(error)  # noqa: PT017
        return None


@pytest.mark.usefixtures("in_process")
@pytest.mark.parametrize("ending", ENDINGS)
def test_truncated_anywhere(ending, tmp_path):
    whole = write(tmp_path / f"whole{ending}").read_bytes()
    path = tmp_path / f"part{ending}"
    refusals = 0
    ends = sorted({*range(1, 40), *range(40, len(whole) - 2, max(1, len(whole) // 60))})
    for end in ends:
        path.write_bytes(whole[:end])
        refusals += read_or_refused(path) is None
    assert refusals == len(ends), "nothing short of the last line may pass"


@pytest.mark.parametrize("ending", [".osm.gz", ".osm.bz2", ".osm.pbf"])
@settings(max_examples=10)
@given(data=st.data())
def test_damage_and_noise(ending, tmp_path_factory, data):
    folder = tmp_path_factory.getbasetemp() / "flipped"
    folder.mkdir(exist_ok=True)
    whole, path = folder / f"whole{ending}", folder / f"part{ending}"
    content = (whole if whole.exists() else write(whole)).read_bytes()
    path.write_bytes(data.draw(damaged(content)))
    for element in read_or_refused(path) or ():
        assert isinstance(element, OsmElement)
        assert all(np.isfinite(part).all() for part in element.parts)
    path.write_bytes(data.draw(st.binary(max_size=300)))
    assert not read_or_refused(path)


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("filler", [b"\0", b"\xff", None])
def test_much_garbage(ending, filler, tmp_path, rng):
    path = tmp_path / f"garbage{ending}"
    path.write_bytes(rng.bytes(300_000) if filler is None else filler * 300_000)
    refused(path)


@pytest.mark.parametrize(
    "text",
    [
        "hello", "<html><body>429 Too Many Requests</body></html>", "<osm></osm>",
        '<osm version="0.5"></osm>', '<osm version="0.6"><node id="x" lat="1" lon="2"/></osm>',
        '<osm version="0.6"><node id="99999999999999999999" lat="1" lon="2"/></osm>',
        '<osm version="0.6"><node id="1" lat="abc" lon="2"/></osm>',
        '<osm version="0.6"><node id="1" lat="1e3" lon="2"/></osm>',
        '<osm version="0.6"><node id="1" lat="" lon="2"/></osm>',
        '<osm version="0.6"><way id="1"><nd ref="north"/></way></osm>',
        '<osm version="0.6"><relation id="1"><member type="x" ref="1" role=""/></relation></osm>',
        '{"version": 0.6, "elements": []}',
        '<!DOCTYPE a [<!ENTITY b "c">]><osm version="0.6"><node id="1" lat="&b;" lon="2"/></osm>',
    ],
)  # fmt: skip
def test_other_texts_are_refused(text, tmp_path):
    path = tmp_path / "other.osm"
    path.write_text(text, encoding="utf-8")
    refused(path)


@pytest.mark.parametrize("ids", [(1 << 62, -(1 << 62)), (2**63 - 2, 5), (5, -(2**63 - 2))])
def test_numbers_of_nodes_that_are_none(ids, tmp_path):
    nodes = "".join(node(i, 10, 50) for i in ids)
    path = write(tmp_path / "w.osm.pbf", f'<osm version="0.6">{nodes}{way(1, ids)}</osm>')
    assert "not a node id" in refused(path)


def test_wrong_endings_folders_and_missing_or_empty_files_are_refused(tmp_path):
    pbf, xml = write(tmp_path / "a.osm.pbf"), write(tmp_path / "b.osm")
    refused(pbf.rename(tmp_path / "c.osm"))
    refused(xml.rename(tmp_path / "d.osm.pbf"))
    (tmp_path / "town.txt").write_text("town")
    assert ".osm.pbf" in refused(tmp_path / "town.txt")
    (tmp_path / "folder.osm").mkdir()
    assert "folder" in refused(tmp_path / "folder.osm")
    assert "does not exist" in refused(tmp_path / "missing.osm.pbf")
    (tmp_path / "empty.osm.pbf").touch()
    assert "empty" in refused(tmp_path / "empty.osm.pbf")
    os.mkfifo(tmp_path / "pipe.osm")  # reading it would wait
    refused(tmp_path / "pipe.osm")


def test_compressed_files_may_come_in_several_streams(tmp_path, rng):
    nodes = [node(i, 10, 50, tag("name", rng.bytes(16).hex())) for i in range(1, 2001)]
    content = f'<osm version="0.6">{"".join(nodes)}</osm>'.encode()
    middle = len(content) // 2
    for ending, pack in ((".osm.gz", gzip.compress), (".osm.bz2", bz2.compress)):
        path = tmp_path / f"streams{ending}"
        path.write_bytes(pack(content[:middle]) + pack(content[middle:]))
        assert len(read(path)[0]) == 2000


@pytest.mark.parametrize("name", ["WORLD.OSM", "World.Osm.Gz", "world.OSM.PBF", "w.pbf", "w.xml"])
def test_endings_in_any_case(name, tmp_path):
    plain = name.lower()
    source = write(tmp_path / (plain if plain.startswith("world.osm") else f"x.osm{plain[1:]}"))
    path = source.rename(tmp_path / name)
    assert len(read(path)[0]) == 5


def test_a_reader_may_be_left_early_and_takes_strings(tmp_path):
    path = write(tmp_path / "wörld with blanks.osm")
    elements = read_osm(path, KEYS)
    assert next(elements).osm_id == 9
    elements.close()
    assert len(list(read_osm(str(path), KEYS))) == 5


@pytest.mark.parametrize(
    ("name", "signal", "says"),
    [
        ("bad.osm.pbf", "SIGSEGV", "fault.*again"), ("bad.osm.pbf", "SIGABRT", "Abort.*again"),
        ("bad.osm", "SIGSEGV", "with Segmentation fault"),
    ],
)  # fmt: skip
def test_a_file_that_ends_its_reader_is_refused(tmp_path, monkeypatch, name, signal, says):
    dying = tmp_path / "dying.py"
    dying.write_text(f"import os, signal; os.kill(os.getpid(), signal.{signal})")
    path = write(tmp_path / name)
    monkeypatch.setattr(osm_process, "__file__", str(dying))
    with pytest.raises(InputError, match=rf"bad\.osm.* is damaged.*{says}"):
        list(read_osm(path, KEYS))


def test_the_file_that_ended_osmium_does_no_harm(shared):
    assert read_or_refused(shared / "repro" / "segv.osm.pbf")


def test_tags_outside_of_their_table_end_another_process():
    file = Path(__file__).with_name("data") / "tags_outside.osm.pbf"
    read = (
        "from placegraph.io.osm.osm import read_osm\n"
        "from placegraph.outdoor.language.vocabulary import Vocabulary\n"
        "from placegraph.outdoor.map.extract import keys_read\n"
        f"list(read_osm({str(file)!r}, keys_read(Vocabulary.default())))"
    )
    ended = subprocess.run([sys.executable, "-c", read], check=False, capture_output=True)  # noqa: S603
    assert ended.returncode >= 0


def test_a_file_with_history_is_refused(tmp_path):
    path = tmp_path / "history.osm.pbf"
    header = osmium.io.Header()
    header.has_multiple_object_versions = True
    with osmium.SimpleWriter(str(path), header=header) as writer:
        for version in (1, 2):
            node = osmium.osm.mutable.Node(
                id=1, version=version, location=(10.0, 50.0), tags={"amenity": "bench"}
            )
            writer.add_node(node)
    with pytest.raises(InputError, match=r"contains the history.*osmium time-filter"):
        list(read_osm(path, KEYS))


@pytest.mark.parametrize("on_disk", [False, True])
def test_nodes_in_any_order_but_before_their_ways(on_disk, tmp_path):
    index = tmp_path / "nodes.index" if on_disk else None
    nodes = [node(i, 10.0, f"50.{i}", tag("amenity", "x")) for i in (3, 1, 2)]
    path, line = tmp_path / "mixed.osm", way(1, [1, 3], tag("highway", "path"))
    raw(path, "".join(nodes) + line)
    found = [e for e in read_osm(path, KEYS, index=index) if e.osm_type == WAY]
    assert found[0].parts[0].tolist() == [[10.0, 50.1], [10.0, 50.3]]
    raw(path, "".join([nodes[1], line, *nodes]))
    with pytest.raises(InputError, match=r"lists nodes after the ways.*osmium sort"):
        list(read_osm(path, KEYS, index=index))
