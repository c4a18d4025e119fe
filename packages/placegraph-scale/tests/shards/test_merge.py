"""Words of a world put in order on disk: the same bytes however few are held in memory."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from placegraph.errors import MapError
from placegraph_scale.shards import words as merge
from placegraph_scale.shards import words as table
from placegraph_scale.shards.words import ColumnFiles, TextSorter, WordCounts, WordTable, sort_rows

NAMES = ("Rex", "The Rex Theatre", "Rex Theatre", "rex theatre", "Museum", "Museum of Salt", "12 Rex",
         "12 West Street", "Straße", "\U0001f600", "\uffff", "The Salt")  # fmt: skip
LABELS = ("amenity=bank", "amenity=bench", "shop=salt")


@st.composite
def shards(draw):
    """What is counted of some shards; some words occur in none of their cores."""
    found = []
    for _ in range(draw(st.integers(1, 5))):
        labels, names = (
            tuple(sorted(draw(st.sets(st.sampled_from(words))))) for words in (LABELS, NAMES)
        )
        n = len(labels) + len(names)
        objects = np.array(draw(st.lists(st.integers(0, 3), min_size=n, max_size=n)), np.int32)
        mass = objects.astype(np.float32) * 0.5
        found.append(
            WordCounts(labels, names, objects, mass, mass / 3, mass / 9, 1.0, 2.0, 3.0, 4, 5, 6)
        )
    return found


@settings(max_examples=12, deadline=None)
@given(shards())
def test_a_table_is_the_same_however_little_memory_there_is(tmp_path_factory, found):
    folder = tmp_path_factory.mktemp("table")
    for at_once in (2, 1 << 20):
        table.write_table(folder / f"{at_once}", iter(found), folder / "scratch", at_once)
    assert (folder / "2").read_bytes() == (folder / f"{1 << 20}").read_bytes()
    assert sorted(p.name for p in folder.iterdir() if not p.name.startswith(".")) == [
        "1048576",
        "2",
    ]
    made = WordTable.open(folder / "2")
    assert made.labels == tuple(sorted({label for c in found for label in c.labels}))
    assert made.names.names[:] == sorted({name for c in found for name in c.names})
    words = [*made.labels, *made.names.names[:]]
    for row, word in enumerate(words):
        said = [(*c.labels, *c.names) for c in found]
        held = {
            i: int(found[i].objects[texts.index(word)])
            for i, texts in enumerate(said) if word in texts
        }  # fmt: skip
        entries = made.entries(row)
        expected = {i: n for i, n in held.items() if n}
        assert dict(zip(entries.shards.tolist(), entries.objects.tolist(), strict=True)) == expected
        np.testing.assert_array_equal(entries.mass, entries.objects * np.float32(0.5))


def test_texts_wait_on_disk(tmp_path):
    texts = TextSorter(tmp_path / "texts", at_once=3)
    for n, word in enumerate(["the", "rex", "and", "the", "rex", "and", "a", "fox\nand"]):
        texts.add(word, [n, -n])
    assert len(list((tmp_path / "texts").iterdir())) == 2
    assert list(texts.merge()) == [
        ("a", [6, -6]), ("and", [2, -2, 5, -5]), ("fox\nand", [7, -7]),
        ("rex", [1, -1, 4, -4]), ("the", [0, 0, 3, -3]),
    ]  # fmt: skip


@given(st.lists(st.integers(0, 2**63 - 1) | st.integers(0, 3), max_size=30), st.integers(1, 9))
def test_rows_in_the_order_of_their_keys(keys, at_once):
    keys = np.array(keys, np.uint64)
    rows = np.concatenate([np.zeros(0, np.int64), *sort_rows(keys, at_once)])
    np.testing.assert_array_equal(rows, np.argsort(keys, kind="stable"))


def test_starts_grow_step_by_step(tmp_path, monkeypatch):
    monkeypatch.setattr(merge, "SOME", 2)
    made, sizes = ColumnFiles(tmp_path / "columns"), np.array([3, 0, 4, 1, 1])
    np.testing.assert_array_equal(made.starts("starts", sizes), [0, 3, 3, 7, 8, 9])
    np.testing.assert_array_equal(made.take("few", sizes, np.array([4, 2, 0])), [1, 4, 3])
    assert len(made.open("none", "<u4")) == 0


def test_a_scratch_folder_that_cannot_be_made_is_told(tmp_path):
    (tmp_path / "scratch").write_text("in the way")
    with pytest.raises(MapError, match=r"scratch cannot be written"):
        table.write_table(tmp_path / "words.table", iter(()), tmp_path / "scratch")
