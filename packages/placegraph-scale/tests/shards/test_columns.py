import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from placegraph.core.mapfile import offsets_of, write_map
from placegraph.errors import InputError, MapError
from placegraph_scale.shards.columns import (
    OFFSETS,
    PAGE,
    PAGE_CHECKSUMS,
    PagedTexts,
    add_page_checksums,
    open_pages,
)

TYPES = {"numbers": "<u8", "short": "<i4", "text": "|u1", "text_starts": OFFSETS}
NAMES = tuple(f"name {i}" for i in range(9_000))
NUMBERS = np.sort(np.random.default_rng(0).integers(0, 1 << 60, 20_000)).astype(np.uint64)


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("pages") / "a.table"
    text = np.frombuffer("".join(NAMES).encode(), np.uint8)
    starts = offsets_of([len(name) for name in NAMES]).astype(np.uint32)
    paged = {"numbers": NUMBERS, "short": np.arange(5, dtype=np.int32)}
    paged |= {"text": text, "text_starts": starts}
    arrays = add_page_checksums({"other": np.ones(3), **paged}, paged)
    write_map(path, "words", 3, {}, arrays, mapped=(*paged, PAGE_CHECKSUMS))
    return path


def read(path, version=3):
    return open_pages(path, "words", version, TYPES, "Mend it.")


def test_what_is_sliced_is_what_was_written(file):
    made, columns = read(file)
    assert made.array("other", "<f8").tolist() == [1.0, 1.0, 1.0]
    assert np.array_equal(columns["numbers"][700:1900], NUMBERS[700:1900])
    assert columns["short"][1:9].tolist() == [1, 2, 3, 4]
    texts = PagedTexts(columns["text_starts"], columns["text"])
    assert (len(texts), texts[8_999], texts[17:19]) == (9_000, NAMES[8_999], list(NAMES[17:19]))
    assert list(texts) == list(NAMES)


def test_no_more_is_checked_than_is_read(file):
    _, columns = read(file)
    columns["numbers"][600:601]
    assert sum(columns["numbers"].is_checked) == 1


@settings(max_examples=20)
@given(st.one_of(st.integers(0, 1 << 60), st.sampled_from(NUMBERS.tolist())))
def test_a_value_is_found_where_it_belongs(file, value):
    assert read(file)[1]["numbers"].find(value) == np.searchsorted(NUMBERS, np.uint64(value))


def test_a_damaged_page_is_named_when_it_is_read_and_not_before(file, tmp_path):
    path, blob = tmp_path / "b.table", bytearray(file.read_bytes())
    at = blob.index(NUMBERS[5 * PAGE // 8 + 7].tobytes())
    blob[at] ^= 1
    path.write_bytes(blob)
    _, columns = read(path)
    assert np.array_equal(columns["numbers"][:500], NUMBERS[:500])
    with pytest.raises(MapError, match=r"b\.table.*'numbers'"):
        columns["numbers"][2_000:4_000]


def test_files_of_another_kind_or_version_and_none_are_refused(file, tmp_path):
    with pytest.raises(MapError, match=r"version 3.*Mend it"):
        read(file, version=2)
    with pytest.raises(InputError, match="does not exist"):
        read(tmp_path / "none")
    write_map(tmp_path / "c.table", "words", 3, {}, {PAGE_CHECKSUMS: np.zeros(1, np.uint32)})
    with pytest.raises(MapError, match="'numbers' is missing"):
        read(tmp_path / "c.table")
    columns = {"numbers": NUMBERS[:0], "short": NUMBERS[:0].astype(np.int32)}
    columns |= {"text": np.zeros(0, np.uint8), "text_starts": np.zeros(1, np.uint32)}
    write_map(
        tmp_path / "c.table", "words", 3, {}, columns | {PAGE_CHECKSUMS: np.zeros(7, np.uint32)}
    )
    with pytest.raises(MapError, match="7 checksums of 1 pages"):
        read(tmp_path / "c.table")


def test_texts_that_point_nowhere_or_are_none_are_told(tmp_path):
    for starts, text in (([0, 9], b"abc"), ([2, 1], b"abc"), ([0, 2], b"\xff\xfe")):
        paged = {
            "numbers": NUMBERS[:1], "short": np.zeros(1, np.int32),
            "text": np.frombuffer(text, np.uint8), "text_starts": np.array(starts, np.uint64),
        }  # fmt: skip
        write_map(tmp_path / "d.table", "words", 3, {}, add_page_checksums(paged, paged))
        _, columns = read(tmp_path / "d.table")
        with pytest.raises(MapError, match=r"d\.table"):
            PagedTexts(columns["text_starts"], columns["text"])[0]
