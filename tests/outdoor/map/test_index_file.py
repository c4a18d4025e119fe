"""An index that is read where it lies, while its file is changed, replaced or removed."""

import os
import pickle
from mmap import mmap

import numpy as np
import pytest

from placegraph.errors import MapError
from placegraph.outdoor.map.city import City


@pytest.fixture
def stored(harbour, tmp_path, monkeypatch):
    monkeypatch.setattr("placegraph.core.mapfile.ALIGNMENT", 1)
    path = tmp_path / "harbour.city"
    harbour.save(path, index=True)
    return path


@pytest.mark.parametrize("how", ["cut short", "written to"])
def test_a_file_that_is_changed_while_its_index_is_used_is_refused(how, harbour, stored):
    path = stored
    city = City.open(path, shard=True)
    assert isinstance(city.views.columns.postings.base.base, mmap)
    sent = pickle.loads(pickle.dumps(city))  # noqa: S301  # our own
    if how == "cut short":
        os.truncate(path, 100)
    else:
        with path.open("r+b") as file:
            file.write(b"x")
        os.utime(path, (0, 0))
    with pytest.raises(MapError, match="changed while it was open"):
        city.views  # noqa: B018
    np.testing.assert_array_equal(sent.views.columns.postings, harbour.views.columns.postings)


def test_a_file_may_be_replaced_or_removed_while_its_index_is_used(harbour, stored):
    path = stored
    city = City.open(path, shard=True)
    harbour.save(path, index=False)
    np.testing.assert_array_equal(city.views.columns.postings, harbour.views.columns.postings)
    path.unlink()
    np.testing.assert_array_equal(city.views.columns.postings, harbour.views.columns.postings)


def test_an_index_that_is_not_large_is_read_and_its_file_may_be_cut_short(
    harbour, stored, monkeypatch
):
    city = City.open(stored)
    os.truncate(stored, 100)
    np.testing.assert_array_equal(city.views.columns.postings, harbour.views.columns.postings)
    harbour.save(stored, index=True)
    monkeypatch.setattr("placegraph.outdoor.map.city.LARGE", 1000)
    assert isinstance(City.open(stored).views.columns.postings.base.base, mmap)
