import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.errors import OptionError
from placegraph.world.shards.quadtree import checked_zoom, core_of, held, key_of, tile_of, tiles

PLACES = st.tuples(st.floats(-180.0, 179.999999), st.floats(-90.0, 90.0))


@given(PLACES, st.integers(1, 16))
def test_every_place_lies_in_one_square(place, zoom):
    key = key_of(tiles(place, zoom), zoom)
    assert len(key) == zoom
    assert held(place, key)
    core = core_of(key)
    assert core.west - 1e-9 <= place[0] <= core.east + 1e-9
    assert core.south - 1e-9 <= place[1] <= core.north + 1e-9


@given(PLACES, st.integers(2, 16))
def test_keys_begin_with_the_key_of_what_holds_them(place, zoom):
    assert key_of(tiles(place, zoom), zoom)[:-1] == key_of(tiles(place, zoom - 1), zoom - 1)


@given(st.text("0123", min_size=1, max_size=16))
def test_a_key_is_its_tile(key):
    assert key_of(tile_of(key), len(key)) == key


def test_squares_cover_the_earth_and_the_date_line_is_an_edge():
    assert core_of("0").north == 90.0
    assert core_of("2").south == -90.0
    assert core_of("1").east == 180.0
    assert key_of(tiles((180.0, 10.0), 3), 3) == key_of(tiles((-180.0, 10.0), 3), 3)


@pytest.mark.parametrize("key", ["", "4", "01a", "0" * 17])
def test_what_is_no_key_is_refused(key):
    with pytest.raises(ValueError, match="no key"):
        tile_of(key)


@pytest.mark.parametrize("zoom", [0, 17, 1.5, True, "3"])
def test_zooms_are_checked(zoom):
    with pytest.raises(OptionError, match="zoom"):
        checked_zoom(zoom)


def test_known_tile():
    assert key_of(tiles((-123.1, 49.25), 3), 3) == "021"
    assert np.array_equal(tiles([(0.1, 0.1), (-0.1, -0.1)], 1), [(1, 0), (0, 1)])
