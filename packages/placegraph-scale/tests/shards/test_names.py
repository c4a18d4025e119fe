from contextlib import suppress
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from placegraph.errors import MapError
from placegraph.outdoor.language.words import tokens
from placegraph.outdoor.map.names import NameIndex
from placegraph_scale.shards import words as table
from placegraph_scale.shards.words import WordCounts, WordTable

WORDS = ("Rex", "The", "Theatre", "Station", "Stations", "4th", "West", "Street", "Lange", "Straße",
         "12", "Ulica", "Ulicy", "Museum", "of", "Salt")  # fmt: skip
SAID = st.lists(st.sampled_from(WORDS), min_size=1, max_size=4).map(" ".join)


def written(path, names):
    n = len(names)
    counted = WordCounts((), names, np.ones(n, np.int32), *np.ones((3, n), np.float32),
                      1.0, 1.0, 1.0, n, 1, 1)  # fmt: skip
    table.write_table(path, [counted], path.with_name("scratch"))
    return WordTable.open(path).names


@settings(max_examples=30, deadline=None)
@given(st.lists(SAID, min_size=1, max_size=12, unique=True).map(sorted), SAID)
def test_names_on_disk_mean_what_names_in_memory_mean(tmp_path_factory, names, phrase):
    path = tmp_path_factory.mktemp("names") / "words.table"
    here, there = NameIndex.build(SimpleNamespace(names=names)), written(path, tuple(names))
    for said in (phrase, names[0], phrase.replace("eu", "ue")):
        assert list(there.named(said).items()) == list(here.named(said).items())
        words = tokens(said)
        for k in range(len(words)):
            assert there.longest_name(words, k) == here.longest_name(words, k)


def test_a_misspelt_name_is_found_by_its_words(tmp_path):
    names = written(tmp_path / "words.table", ("Museum of Salt", "Rex", "Station Square"))
    assert names.closest_name("Museum of Slat")[0] == "museum of salt"
    assert names.closest_name("Staton Square")[0] == "station sq"
    assert names.closest_name("Church") is None


@settings(max_examples=20, deadline=None)
@given(st.data())
def test_a_damaged_table_is_named_or_says_what_it_said(tmp_path_factory, data):
    names = tuple(sorted(f"{a} {b}" for a in WORDS for b in WORDS))
    path = tmp_path_factory.mktemp("names") / "words.table"
    whole = written(path, names).named("Rex Theatre")
    blob = bytearray(path.read_bytes())
    blob[data.draw(st.integers(0, len(blob) - 1))] ^= data.draw(st.integers(1, 255))
    path.write_bytes(blob)
    with suppress(MapError):
        assert WordTable.open(path).names.named("Rex Theatre") == whole


@pytest.mark.parametrize("off", [99, 1])  # a name that is not there; a way in which none is called
def test_a_forged_posting_is_told(off, tmp_path, monkeypatch):
    def forged(*given, real=table.write_names):
        counts, columns = real(*given)
        return counts, columns | {"postings": columns["postings"] + off}

    monkeypatch.setattr(table, "write_names", forged)
    names = written(tmp_path / "words.table", ("Museum of Salt", "Rex Theatre"))
    with pytest.raises(MapError, match=r"words\.table.*'postings'"):
        names.named("Theatre")
