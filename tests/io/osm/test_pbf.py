"""Our reader of PBF beside osmium, which wrote the files; and bytes that nobody wrote."""

import struct
import zlib
from collections import Counter
from contextlib import suppress

import numpy as np
import osmium
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.io.damage import damaged, refusing

from placegraph.errors import InputError
from placegraph.io.osm import osm_kernels as kernels
from placegraph.io.osm import osm_process, pbf
from placegraph.io.osm.osm import AREA, LINE, POINT, LeftOut, is_area, read_osm
from placegraph.io.osm.pbf import NodeIndex
from placegraph.io.osm.reader import _rings

KEYS = ("building", "highway", "name", "natural")
CUT, NONE = "ways cut where members are missing", "ways without positions"
FORMATS = ("pbf", "pbf,pbf_dense_nodes=false", "pbf,pbf_compression=none", "pbf,add_metadata=false")


@pytest.fixture(autouse=True, scope="module")
def here():
    """Assembled in this process: starting another takes longer than all else."""

    def none(*_, **__):
        raise OSError

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(osm_process.subprocess, "Popen", none)
        yield


def by_osmium(path, keys=KEYS):
    """What osmium's own objects say: elements by type and id, and what was left out."""
    factory, found, counts, relations = osmium.geom.WKBFactory(), {}, Counter(), set()
    wanted = osmium.filter.KeyFilter(*keys)
    for item in osmium.FileProcessor(str(path)).with_areas(wanted).with_filter(wanted):
        tags = dict(item.tags)
        if item.is_node() and item.location.valid():
            found[0, item.id] = POINT, tags, [np.array([[item.lon, item.lat]])]
        elif item.is_node():
            counts["nodes without a position"] += 1
        elif item.is_way():
            known = [(n.lon, n.lat) for n in item.nodes if n.location.valid()]
            line = [p for i, p in enumerate(known) if i == 0 or p != known[i - 1]]
            if len(known) < len(item.nodes) or len(line) < 2:
                counts[CUT if len(known) > 1 else NONE] += 1
                line = known
            if len(line) > 1:
                area = line[0] == line[-1] and len(line) > 3 and is_area(tags)
                found[1, item.id] = AREA if area else LINE, tags, [np.array(line)]
        elif item.is_relation() and tags.get("type") == "multipolygon":
            relations.add(item.id)
        elif item.is_area() and not item.from_way():
            with suppress(RuntimeError):  # an area of nothing
                rings = _rings(bytes.fromhex(factory.create_multipolygon(item)))
                found[2, item.orig_id()] = AREA, tags, rings
    if lost := len({(2, i) for i in relations} - found.keys()):
        counts["multipolygons with missing or crossing members"] = lost
    return found, counts


def by_us(path, keys=KEYS):
    left_out = LeftOut()
    found = {
        (e.osm_type, e.osm_id): (e.kind, e.tags, e.parts) for e in read_osm(path, keys, left_out)
    }
    return found, left_out.counts


def assert_same(path, keys=KEYS):
    (ours, left), (theirs, lost) = by_us(path, keys), by_osmium(path, keys)
    assert ours.keys() == theirs.keys()
    for key, (kind, tags, parts) in ours.items():
        assert (kind, tags) == theirs[key][:2]
        for part, other in zip(parts, theirs[key][2], strict=True):
            np.testing.assert_array_equal(part, other)
    assert left == lost


@pytest.mark.parametrize(
    "city", ["monaco_2025", pytest.param("ankara_2019", marks=pytest.mark.all)]
)
def test_an_extract_is_what_osmium_reads_of_it(city, shared):
    assert_same(shared / f"data/osm/{city}.osm.pbf", ("amenity", "landuse", *KEYS))


texts = st.sampled_from(["yes", "Weg", "", "Bänkle", "\U0001f333", "a;b"])
tags = st.dictionaries(st.sampled_from(["building", "highway", "name", "source", "area"]), texts)
places = st.tuples(st.integers(-1800, 1801), st.integers(-900, 901)) | st.tuples(
    st.integers(0, 3), st.integers(0, 3)
)
nodes = st.dictionaries(st.integers(1, 40) | st.integers(2**40, 2**40 + 3), st.tuples(places, tags))
refs = st.lists(st.integers(-5, 20), max_size=7) | st.sampled_from(
    [[1, 2, 3, 1], [3, 4, 1], [5, 5]]
)
ways = st.dictionaries(st.integers(1, 9), st.tuples(refs, tags))
members = st.lists(
    st.tuples(st.sampled_from("nwr"), st.integers(1, 9), st.sampled_from(["outer", "inner", ""]))
)
kinds = st.sampled_from(["multipolygon", "boundary", "route"])
relations = st.dictionaries(st.integers(1, 9), st.tuples(members, tags, kinds), max_size=4)


@settings(max_examples=60)
@given(form=st.sampled_from(FORMATS), nodes=nodes, ways=ways, relations=relations)
def test_whatever_osmium_writes(form, nodes, ways, relations, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "drawn.osm.pbf"
    of = osmium.osm.mutable
    with osmium.SimpleWriter(osmium.io.File(str(path), form), overwrite=True) as writer:
        for i, ((x, y), said) in sorted(nodes.items()):
            writer.add_node(of.Node(id=i, version=1, location=(x / 10, y / 10), tags=said))
        for i, (line, said) in sorted(ways.items()):
            writer.add_way(of.Way(id=i, version=1, nodes=line, tags=said))
        for i, (who, said, kind) in sorted(relations.items()):
            writer.add_relation(
                of.Relation(
                    id=i, version=1, members=who, tags={"type": kind, "natural": "wood"} | said
                )
            )
    assert_same(path)


@given(data=st.data())
def test_flipped_bytes_that_no_checksum_guards(data, tmp_path_factory):
    folder = tmp_path_factory.getbasetemp()
    whole, path = folder / "plain.osm.pbf", folder / "flipped.osm.pbf"
    if not whole.exists():
        with osmium.SimpleWriter(osmium.io.File(str(whole), "pbf,pbf_compression=none")) as writer:
            of = osmium.osm.mutable
            for i in range(1, 9):
                at = (10 + i % 3, 50 + i // 3)
                writer.add_node(of.Node(id=i, version=1, location=at, tags={"name": f"n{i}"}))
            for i in range(1, 4):
                line = [i, i + 1, i + 3, i]
                writer.add_way(of.Way(id=i, version=1, nodes=line, tags={"building": "yes"}))
            who = [("w", 1, "outer"), ("w", 3, "")]
            said = {"type": "multipolygon", "natural": "wood"}
            writer.add_relation(of.Relation(id=1, version=1, members=who, tags=said))
    path.write_bytes(data.draw(damaged(whole.read_bytes())))
    with refusing(path):
        found, _ = by_us(path)
        for _, _, parts in found.values():
            assert all(np.isfinite(part).all() for part in parts)


@given(content=st.binary(max_size=80))
def test_bytes_that_are_no_message(content):
    data = np.frombuffer(content, np.uint8)
    n = len(data)
    fields, good = kernels.read_fields.py_func(data, 0, n)
    assert good or not len(fields)
    assert all(
        0 <= at <= n and at + size <= n for kind, size, at in fields if kind > 0 and size < n
    )
    kernels.read_dense_nodes.py_func(data, 0, n)
    for kind in (pbf.NODES, pbf.WAYS, pbf.RELATIONS):
        head, starts, entries, good = kernels.read_elements.py_func(
            data, np.array([[0, n]]), kind, 3
        )
        assert len(starts) == len(head) + 1
        assert (starts[-1] <= entries.shape[1]).all()


@given(values=st.lists(st.integers(-(2**63), 2**63 - 1)))
def test_numbers_are_written_and_read(values):
    data = np.frombuffer(kernels.encode_varints(np.array(values, np.int64)).tobytes(), np.uint8)
    at = 0
    for value in values:
        found, at = kernels.decode_varint(data, at, len(data))
        assert found == value
    assert at == len(data)


def written(path, blobs, head=b"OsmSchema-V0.6", more=b""):
    heads = pbf.encode_blob(b"OSMHeader", pbf.text(4, head) + more)
    path.write_bytes(heads + b"".join(pbf.encode_blob(b"OSMData", blob) for blob in blobs))
    return path


@pytest.mark.parametrize(
    ("blobs", "head", "why"),
    [
        ([b"\x0a\x7f"], b"OsmSchema-V0.6", "cut off"), ([], b"Telepathy", "Telepathy"),
        ([pbf.text(1, b"") + pbf.text(2, pbf.text(2, b"\x0a\x01\x02"))], b"DenseNodes", "contradict"),
        ([pbf.text(1, b"") + pbf.text(2, pbf.text(3, b"\x12\x01\x01"))], b"DenseNodes", "contradict"),
        ([], b"HistoricalInformation", "history"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said(blobs, head, why, tmp_path):
    with pytest.raises(InputError, match=rf"bad\.osm\.pbf.*{why}"):
        list(read_osm(written(tmp_path / "bad.osm.pbf", blobs, head), KEYS))


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (zlib.compress(bytes(1 << 20)), "does not match its declared contents"),
        (b"no zlib", "Error -3"),
    ],
)
def test_a_blob_that_is_damaged_or_grows_beyond_what_it_says_is_refused(data, why, tmp_path):
    blob = b"\x10\x05" + pbf.text(3, data)
    head = pbf.text(1, b"OSMHeader") + b"\x18" + pbf.number(len(blob))
    path = tmp_path / "bomb.osm.pbf"
    path.write_bytes(struct.pack(">I", len(head)) + head + blob)
    with pytest.raises(InputError, match=why):
        list(read_osm(path, KEYS))


def wood(*, ids, way_at=(1, 2, 3, 1), position=None):
    """Blocks of three nodes, a way around them, and relations that are woods with it."""
    lat, lon = position or ([0, 10, 0], [0, 0, 10])
    columns = [pbf.differences(np.array(c, np.int64)) for c in ([1, 2, 3], lat, lon)]
    dense = b"".join(pbf.text(n, c) for n, c in zip((1, 8, 9), columns, strict=True))
    strings = b"".join(pbf.text(1, s) for s in (b"", b"type", b"multipolygon", b"natural", b"wood"))
    way = b"\x08\x01" + pbf.text(8, pbf.differences(np.array(way_at)))
    tags, member = pbf.text(2, b"\1\3") + pbf.text(3, b"\2\4"), b"\x42\1\0\x4a\1\2\x52\1\1"
    woods = [pbf.text(4, b"\x08" + pbf.number(i) + tags + member) for i in ids]
    groups = (pbf.text(2, dense), pbf.text(3, way), b"".join(woods))
    return [pbf.text(1, strings) + pbf.text(2, group) for group in groups]


@pytest.mark.parametrize("number", [1, 2**62 + 5])
def test_a_relation_whose_id_osmium_cannot_have_is_left_out(number, tmp_path):
    found, left = by_us(written(tmp_path / "a.osm.pbf", wood(ids=[number])))
    kept = {(2, number)} if number == 1 else set()
    assert found.keys() == kept
    assert sum(left.values()) == 1 - len(kept)


def test_the_order_that_a_file_says_is_used_and_checked(tmp_path):
    nodes, ways, woods = wood(ids=[1])
    path, more = tmp_path / "a.osm.pbf", pbf.text(5, b"Sort.Type_then_ID")
    written(path, [nodes, ways, woods, pbf.text(1, b"")], more=more)
    assert by_us(path)[0].keys() == {(2, 1)}, "an empty block hides no relation"
    with pytest.raises(InputError, match=r"not sorted as its header says.*osmium sort"):
        by_us(written(path, [nodes, woods, ways, woods], more=more))


def test_dense_nodes_that_are_none_and_positions_beyond_all_bounds(tmp_path):
    blobs = [pbf.text(1, pbf.text(1, b"")) + pbf.text(2, pbf.text(2, b"") * 9), *wood(ids=[1])]
    assert by_us(written(tmp_path / "a.osm.pbf", blobs))[0].keys() == {(2, 1)}
    blobs = wood(ids=[1], position=([-(2**63), 10, 0], [0, 0, 10]))
    assert by_us(written(tmp_path / "a.osm.pbf", blobs))[0] == {}


def test_a_message_of_countless_fields_is_refused(monkeypatch, tmp_path):
    monkeypatch.setattr(pbf, "MAX_FIELDS", 9)
    way = pbf.text(2, pbf.text(3, b"\x08\x01"))
    with pytest.raises(InputError, match="more than 9 fields"):
        by_us(written(tmp_path / "a.osm.pbf", [pbf.text(1, pbf.text(1, b"") * 10) + way]))


def test_ways_of_a_small_file_are_shared_out_over_its_blobs(monkeypatch, tmp_path):
    monkeypatch.setattr(pbf, "NODES_A_BLOCK", 8)
    n = 12
    block = pbf.Block(np.frombuffer(pbf.text(1, b""), np.uint8))
    made = pbf.encode_pbf(
        np.arange(n), 4 * np.arange(n + 1), np.zeros((4 * n, 2), np.int32),
        np.ones(4 * n, np.bool_), block, np.zeros((0, 2), np.int64),
    )  # fmt: skip
    path = tmp_path / "a.osm.pbf"
    path.write_bytes(made)
    with path.open("rb") as file:
        _, *blobs = pbf.list_blobs(file)
        ways = [pbf.Block(pbf.inflate(file, blob)) for blob in blobs]
        counts = [len(block.ways().ids) for block in ways if pbf.WAYS in block.holds]
    assert sum(counts) == n
    assert max(counts) <= 3


ids = st.integers(-3, 30) | st.integers(2**33, 2**33 + 5)


@settings(max_examples=60)
@given(
    at_once=st.sampled_from([3, 1 << 20]), on_disk=st.booleans(), asked=st.lists(ids),
    chunks=st.lists(st.lists(ids, min_size=1), max_size=4),
)  # fmt: skip
def test_what_was_added_last_is_found(on_disk, at_once, chunks, asked, tmp_path_factory):
    index = tmp_path_factory.getbasetemp() / "nodes.index" if on_disk else None
    nodes, known, n = NodeIndex(index, at_once), {}, 0
    for chunk in chunks:
        steps = np.arange(n, n + 2 * len(chunk), dtype=np.int32).reshape(-1, 2) - 5
        n += 2 * len(chunk)
        known |= dict(zip(chunk, steps.tolist(), strict=True))
        nodes.add(np.array(chunk), steps)
        found, there = nodes.find(np.array(asked, np.int64))
        assert there.tolist() == [i in known for i in asked]
        assert found[there].tolist() == [known[i] for i in asked if i in known]
    nodes.close()
    assert index is None or not index.exists()


def test_many_in_no_order_are_merged_run_by_run(tmp_path, monkeypatch):
    monkeypatch.setattr(pbf, "SAMPLE", 4)
    rng, most = np.random.default_rng(3), []
    ids = rng.permutation(np.append(np.arange(0, 9000, 3), 2**34 + 3 * np.arange(40)))
    steps = np.stack([ids % 1000, ids % 77], 1).astype(np.int32)
    sort = pbf._is_sorted
    monkeypatch.setattr(pbf, "_is_sorted", lambda i, s: (most.append(len(i)), sort(i, s))[1])
    nodes = NodeIndex(tmp_path / "a", at_once=200)
    for at in range(0, len(ids), 50):
        nodes.add(ids[at : at + 50], steps[at : at + 50])
    found, known = nodes.find(ids)
    assert known.all()
    np.testing.assert_array_equal(found, steps)
    assert not nodes.find(ids + 1)[1].any()
    assert len(most) > 2 * len(ids) // 200 - 3
    assert max(most) < 400
    assert [path.name for path in tmp_path.iterdir()] == ["a"]
    assert (tmp_path / "a").stat().st_size == 12 * len(ids)
    nodes.close()
    assert not list(tmp_path.iterdir())
