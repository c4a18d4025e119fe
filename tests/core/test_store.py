"""Map files: what was written comes back; anything else is refused with a sentence."""

import errno
import json
import os
import struct
import subprocess
import sys
import time
import zlib
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as stnp

from placegraph import open_map
from placegraph.core import mapfile
from placegraph.core.mapfile import map_writer, read_header, read_map, write_map
from placegraph.errors import InputError, MapError, MapLockedError, OptionError

REFUSALS = (InputError, MapError)

dtypes = st.sampled_from(sorted(mapfile.DTYPES)).map(np.dtype)
arrays = dtypes.flatmap(
    lambda d: stnp.arrays(d, stnp.array_shapes(min_dims=1, max_dims=3, min_side=0, max_side=9))
)
texts = st.lists(st.text(st.characters(exclude_categories=["Cs"])), max_size=20)


def sample(rng, n=2000):
    steps = rng.integers(-300, 300, (n, 2))
    return {
        "points": np.cumsum(steps, axis=0).astype(np.int32),
        "ids": np.sort(rng.integers(0, 1 << 40, n)),
        "weights": rng.normal(size=n),
        "flags": rng.random(n) < 0.5,
        "names": mapfile.pack_strings([f"Straße {i}" for i in range(n // 4)]),
        "none": np.zeros((0, 3), np.float32),
    }


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.city"


@pytest.fixture
def written(path, rng):
    write_map(path, "city", 1, {"cells": 7}, sample(rng))
    return path


def identical(a, b):
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()


def alone(path):
    """No temporary file and no lock was left behind."""
    return list(path.parent.iterdir()) == [path]


def forged(path, *, container=1, tail=b"", **changes):
    """A map file with every checksum right, and a header of our making."""
    header = {"kind": "city", "version": 1, "meta": {}, "arrays": []} | changes
    text = json.dumps(header).encode()
    body = (
        struct.pack("<8sIII", mapfile.MAGIC, container, len(text), zlib.crc32(text)) + text + tail
    )
    path.write_bytes(body + sha256(body).digest())
    return path


def entry(tail, **changes):
    base = {"name": "a", "dtype": "<i4", "shape": [2], "codec": "raw", "filter": "none"}
    return base | {"offset": 0, "length": len(tail), "crc32": zlib.crc32(tail)} | changes


def test_a_map_comes_back_bit_by_bit(written, rng):
    found = read_map(written, "city", 1)
    assert found.meta == {"cells": 7}
    assert list(found.arrays) == list(sample(rng))
    for name, array in sample(np.random.default_rng(20261121)).items():
        assert identical(found.arrays[name], array), name
        assert not found.arrays[name].flags.writeable
    assert (found.header.kind, found.header.version) == ("city", 1)
    assert read_header(written).file_size == written.stat().st_size


@settings(max_examples=25)
@given(st.dictionaries(st.text(st.characters(exclude_categories=["Cs"])), arrays, max_size=4))
def test_any_set_of_columns_comes_back(tmp_path_factory, found):
    path = tmp_path_factory.mktemp("maps") / "x"
    write_map(path, "scene", 3, {}, found)
    back = read_map(path, "scene", 3).arrays
    assert list(back) == list(found)
    assert all(identical(back[name], array) for name, array in found.items())


@given(texts)
@example([*map(chr, range(300)), ""])
def test_strings_come_back(strings):
    assert mapfile.unpack_strings(mapfile.pack_strings(strings)) == tuple(strings)


def test_foreign_byte_order_and_gaps_in_memory_are_put_right(path):
    big = np.arange(12, dtype=">i4").reshape(3, 4)[:, ::2]
    write_map(path, "city", 1, {}, {"a": big})
    back = read_map(path, "city", 1).arrays["a"]
    assert back.dtype == np.dtype("<i4")
    assert np.array_equal(back, big)


def test_same_input_same_bytes(tmp_path, rng):
    content = sample(rng)
    for name in ("a", "b"):
        write_map(tmp_path / name, "city", 1, {"b": 1, "a": [2]}, content)
        time.sleep(0.01)
    write_map(tmp_path / "c", "city", 1, {"a": [2], "b": 1}, content)
    first, second, third = ((tmp_path / n).read_bytes() for n in "abc")
    assert first == second == third


def test_coordinates_and_sorted_ids_become_small(written):
    sizes = {b.name: b for b in read_header(written).blocks}
    assert sizes["points"].filter == "delta"
    assert sizes["points"].length < 0.4 * sizes["points"].nbytes
    assert sizes["flags"].length <= sizes["flags"].nbytes
    assert sizes["none"].length == 0


def test_columns_are_asked_for_by_type(written):
    found = read_map(written, "city", 1)
    assert found.array("points", "<i4", 2) is found.arrays["points"]
    assert found.strings("names")[3] == "Straße 3"
    for name, dtype, ndim in (("points", "<i8", 2), ("points", "<i4", 1), ("gone", "<i4", 1)):
        with pytest.raises(MapError, match=f"{name}.*[Bb]uild the map again"):
            found.array(name, dtype, ndim)
    with pytest.raises(MapError, match="ids"):
        found.strings("ids")


def test_text_that_is_no_unicode_is_refused(path):
    write_map(path, "city", 1, {}, {"names": np.array([0, 0xFF, 0xFE], np.uint8)})
    with pytest.raises(MapError, match=r"names.*UTF-8"):
        read_map(path, "city", 1).strings("names")
    with pytest.raises(OptionError, match="not Unicode text"):
        mapfile.pack_strings(["\ud800"])


@pytest.mark.parametrize(
    "array",
    [
        np.array(["text"]), np.array([object()], dtype=object), np.array([1j]), np.array(5),
        np.array(["2026-11-21"], "datetime64[D]"), np.zeros(2, [("x", "f4"), ("y", "f4")]),
    ],
    ids=lambda a: str(a.dtype),
)  # fmt: skip
def test_only_arrays_of_plain_numbers(path, array):
    with pytest.raises(OptionError, match=r"Column 'a' is .*numeric arrays"):
        write_map(path, "city", 1, {}, {"a": array})
    assert not path.exists()


@pytest.mark.parametrize("meta", [{"a": float("nan")}, {"a": {1, 2}}, {"a": b"x"}])
def test_only_plain_metadata(path, meta):
    with pytest.raises(OptionError, match="JSON with finite numbers"):
        write_map(path, "city", 1, meta, {})


@pytest.mark.parametrize("name", [".", "/dev/null", "a\0b"])
def test_targets_that_are_not_plain_files(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(MapError, match="file"):
        write_map(name, "city", 1, {}, {})


@pytest.mark.parametrize(
    ("raised", "error", "message"),
    [
        (OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)), MapError, "No space left on device"),
        (KeyboardInterrupt("pressed"), KeyboardInterrupt, "pressed"),
    ],
)
def test_a_failed_write_leaves_the_old_map_and_nothing_else(
    written, monkeypatch, raised, error, message
):
    before = written.read_bytes()

    def fail(_):
        raise raised

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(error, match=message):
        write_map(written, "city", 1, {}, {"a": np.arange(9)})
    assert written.read_bytes() == before
    assert alone(written)


def test_whoever_has_the_old_map_open_keeps_it_and_a_link_stays_one(written):
    with written.open("rb") as old:
        write_map(written, "city", 2, {}, {})
        assert b'"version":1' in old.read()
    link = written.with_name("link.city")
    link.symlink_to(written)
    write_map(link, "city", 3, {}, {})
    assert link.is_symlink()
    assert read_header(written).version == 3


def test_a_second_writer_is_refused_at_once(written):
    with map_writer(written) as write:
        with pytest.raises(MapLockedError, match="being written by another process"):
            write_map(written, "city", 1, {}, {})
        assert read_header(written).version == 1, "reading goes on"
        write("city", 2, {}, {})
    assert read_header(written).version == 2
    write_map(written, "city", 3, {}, {})
    assert alone(written)


def test_a_lock_dies_with_its_process(path):
    holder = (
        "import sys; from placegraph.core.mapfile import map_writer\n"
        f"with map_writer({str(path)!r}): print('held', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(  # noqa: S603  # our own interpreter and code
        [sys.executable, "-c", holder], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        assert process.stdout.readline() == b"held\n"
        with pytest.raises(MapLockedError):
            write_map(path, "city", 1, {}, {})
        process.kill()
        process.wait()
    lock = path.with_name(".a.city.lock")
    assert lock.exists(), "the killed writer could not tidy up"
    write_map(path, "city", 1, {}, {})
    assert alone(path)


def test_what_a_killed_writer_left_is_no_obstacle(path):
    path.with_name(".a.city.tmp").write_bytes(b"half a map")
    path.with_name(".a.city.lock").touch()
    write_map(path, "city", 1, {}, {})
    assert alone(path)


def test_missing_or_empty_files_and_things_that_are_not_files(path, tmp_path):
    for call in (open_map, read_header):
        with pytest.raises(InputError, match=r"a\.city does not exist; build it with"):
            call(path)
    path.touch()
    with pytest.raises(InputError, match="is empty; build the map again"):
        open_map(path)
    path.unlink()
    os.mkfifo(tmp_path / "pipe")
    for name in (tmp_path / "pipe", "/dev/zero"):
        with pytest.raises(InputError, match="not a regular file"):
            open_map(name)
    with pytest.raises(InputError, match="contains no scene map"):
        open_map(tmp_path)
    with pytest.raises(InputError, match="cannot be read"):
        open_map("a\0b")


def test_a_file_one_may_not_read(written, monkeypatch):
    def denied(*_):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr(os, "open", denied)  # file modes would not stop root
    with pytest.raises(InputError, match="Permission denied"):
        open_map(written)


@pytest.mark.parametrize(
    "content", [b"PK\x03\x04" * 99, b"\x80\x04\x95pickle", b"x", b"\x00" * 500, b"<osm></osm>"]
)
def test_foreign_files(path, content):
    path.write_bytes(content)
    with pytest.raises(MapError, match=r"not a placegraph map; build one from"):
        open_map(path)


def test_a_file_that_went_through_a_text_transfer(written):
    written.write_bytes(written.read_bytes().replace(b"\r\n", b"\n"))
    with pytest.raises(MapError, match="not a placegraph map"):
        open_map(written)


def test_other_kinds_and_newer_versions_are_refused_and_older_ones_read(path):
    write_map(path, "moon", 1, {}, {})
    with pytest.raises(MapError, match="is a moon map, not a city map"):
        read_map(path, "city", 1)
    with pytest.raises(MapError, match="moon map, which this version of placegraph does not"):
        open_map(path)
    write_map(path, "city", 99, {}, {})
    with pytest.raises(MapError, match=r"version 99.*reads up to 1; update placegraph"):
        read_map(path, "city", 1)
    with pytest.raises(MapError, match="version 99"):
        open_map(path)
    with pytest.raises(MapError, match=r"file layout 2.*update placegraph"):
        read_header(forged(path, container=2))
    write_map(path, "city", 1, {}, {})
    assert read_map(path, "city", 5).header.version == 1


def lies(tail):
    """Headers whose checksums are right and whose contents are not."""
    huge = 1 << 40
    bomb = zlib.compress(bytes(1 << 20), 9)
    return {
        "more data than the file has": (tail, [entry(tail, shape=[huge])]),
        "have the length given in its header": (tail, [entry(tail, shape=[3])]),
        "bytes, unlike the size in": (tail, [entry(tail, length=7)]),
        "cannot be parsed.*": (tail, [entry(tail, offset=4)]),
        "cannot be parsed.*shape": (tail, [entry(tail, shape=[-2])]),
        "cannot be parsed.*'2'": (tail, [entry(tail, shape=["2"])]),
        "cannot be parsed.*dtype": (tail, [entry(tail, dtype="|O")]),
        "cannot be parsed.*codec": (tail, [entry(tail, codec="pickle")]),
        "cannot be parsed.*filter": (tail, [entry(tail, filter="xor")]),
        "cannot be parsed.*same name": (tail * 2, [entry(tail), entry(tail, offset=len(tail))]),
        "cannot be parsed.*extra": (tail, [entry(tail, extra=1)]),
        "length given in its header": (bomb, [entry(bomb, codec="zlib")]),
        "given in its header": (tail, [entry(tail, codec="lzma")]),
        "other than true and false": (tail, [entry(tail, dtype="|b1", shape=[8])]),
        "checksum": (tail, [entry(tail, crc32=1)]),
        # a gigabyte of zeros in 1 MB: refused before it is allocated
        "more data than": (bomb, [entry(bomb, codec="zlib", dtype="|u1", shape=[1 << 34])]),
    }


TAIL = struct.pack("<ii", 2, 3)


@pytest.mark.parametrize("sentence", lies(TAIL))
def test_headers_that_lie(path, sentence):
    honest = read_map(forged(path, tail=TAIL, arrays=[entry(TAIL)]), "city", 1)
    assert honest.arrays["a"].tolist() == [2, 3]
    tail, table = lies(TAIL)[sentence]
    with pytest.raises(MapError, match=f"is damaged: .*{sentence}.*[Bb]uild the map again"):
        read_map(forged(path, tail=tail, arrays=table), "city", 1)


@pytest.mark.parametrize(
    "changes",
    [{"kind": 1}, {"version": "1"}, {"meta": []}, {"arrays": 3}, {"arrays": [3]}, {"arrays": [{}]}],
    ids=str,
)
def test_headers_of_another_shape(path, changes):
    with pytest.raises(MapError, match="is damaged: its header cannot be parsed"):
        read_header(forged(path, **changes))


@pytest.mark.parametrize("text", [b"[" * 200_000, b"{", b"[]", b"\xff", b"1" * 9999])
def test_headers_that_are_no_header(path, text):
    body = struct.pack("<8sIII", mapfile.MAGIC, 1, len(text), zlib.crc32(text)) + text
    path.write_bytes(body + sha256(body).digest())
    with pytest.raises(MapError, match="is damaged"):
        read_header(path)


def test_truncated_anywhere(written):
    whole = written.read_bytes()
    spots = {*range(200), *range(len(whole) - 50, len(whole)), *range(0, len(whole), 501)}
    for spot in sorted(spots):
        written.write_bytes(whole[:spot])
        with pytest.raises(REFUSALS):
            read_map(written, "city", 1)


def test_bytes_flipped_anywhere_or_appended(written, rng):
    whole = bytearray(written.read_bytes())
    spots = {*range(64), *rng.integers(0, len(whole), 400).tolist(), len(whole) - 1}
    for spot in sorted(spots):
        flip = int(rng.integers(1, 256))
        whole[spot] ^= flip
        written.write_bytes(whole)
        with pytest.raises(MapError):
            read_map(written, "city", 1)
        whole[spot] ^= flip
    written.write_bytes(whole)
    assert read_map(written, "city", 1).meta == {"cells": 7}
    written.write_bytes(whole + b"\0")
    with pytest.raises(MapError, match="is damaged"):
        read_map(written, "city", 1)


@given(st.binary(max_size=300))
def test_any_bytes_behind_the_magic(tmp_path_factory, junk):
    path = tmp_path_factory.mktemp("junk") / "x"
    path.write_bytes(mapfile.MAGIC + junk)
    with pytest.raises(MapError):
        read_map(path, "city", 1)


@given(
    st.sampled_from(sorted(mapfile.CODECS)),
    st.sampled_from(sorted(mapfile.FILTERS)),
    st.binary(max_size=200),
    st.sampled_from(sorted(mapfile.DTYPES)),
    st.lists(st.integers(0, 9), min_size=1, max_size=3).map(tuple),
)
def test_any_block_is_an_array_or_refused(codec, filter_, block, dtype, shape):
    try:
        array = mapfile.decompress_array(codec, filter_, memoryview(block), dtype, shape)
    except ValueError:
        return
    assert array.shape == shape
    assert array.dtype == np.dtype(dtype)


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=5,
)


@given(st.sampled_from(["kind", "version", "meta", "arrays"]), json_values)
def test_any_json_as_header(tmp_path_factory, key, value):
    path = tmp_path_factory.mktemp("json") / "x"
    try:
        read_map(forged(path, **{key: value}), "city", 1)
    except REFUSALS:
        return
    assert isinstance({"kind": "city", "version": 1, "meta": {}}.get(key, []), type(value))


@given(st.sampled_from(sorted(entry(TAIL))), json_values)
def test_any_json_in_the_table(tmp_path_factory, key, value):
    path = tmp_path_factory.mktemp("json") / "x"
    try:
        found = read_map(forged(path, tail=TAIL, arrays=[entry(TAIL, **{key: value})]), "city", 1)
    except REFUSALS:
        return
    assert found.arrays[value if key == "name" else "a"].nbytes == len(TAIL)


@pytest.fixture
def long(path, rng):
    content = sample(rng) | {
        "wide": rng.integers(0, 1 << 60, 20_000),
        "bytes": rng.integers(0, 255, 100_001).astype(np.uint8),
        "words": rng.integers(0, 1 << 30, 40_000).astype(np.uint32),
    }
    write_map(path, "city", 1, {"cells": 7}, content, ("bytes", "wide", "words", "ids"))
    return path, content


def test_mapped_columns_lie_at_the_head_and_come_back_bit_by_bit(long):
    path, content = long
    for mapped in ((), ("bytes", "wide", "words", "ids", "none", "other")):
        found = read_map(path, "city", 1, mapped).arrays
        assert set(found) == set(content)
        for name, array in content.items():
            assert identical(found[name], array), name
            assert found[name].flags.aligned
            assert not found[name].flags.writeable
    blocks = {b.name: b for b in read_header(long[0]).blocks}
    assert list(blocks)[:3] == ["wide", "words", "bytes"]
    assert all(blocks[name].codec == "raw" for name in ("wide", "words", "bytes"))
    assert blocks["ids"].codec != "raw", "short ones are squeezed"


def test_mapped_columns_hold_two_descriptors_however_many_they_are(long):
    there = Path("/proc/self/fd")
    before = len(list(there.iterdir()))
    found = read_map(long[0], "city", 1, ("bytes", "wide", "words"))
    assert len(list(there.iterdir())) == before + 2, "of the map, and of its watch"
    del found
    assert len(list(there.iterdir())) == before


def test_damage_to_a_mapped_column_is_named(long):
    path, content = long
    data = bytearray(path.read_bytes())
    at = data.index(content["words"].tobytes()[:64])
    data[at + 5000] ^= 1
    path.write_bytes(data)
    with pytest.raises(MapError, match="'words'"):
        read_map(path, "city", 1, ("bytes", "wide", "words"))


def test_a_map_that_is_replaced_stays_as_it_was_opened(long, rng):
    path, content = long
    found = read_map(path, "city", 1, ("words",))
    write_map(path, "city", 1, {}, sample(rng))
    assert identical(found.arrays["words"], content["words"])
