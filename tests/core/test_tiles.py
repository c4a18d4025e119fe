"""The quadtree: keys are paths, cores cover the Earth once, margins reach what they say."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.core.geo import bounds, check_zoom, held, key_at, key_of, reached, tile_of, tiles
from placegraph.core.geometry import LocalPlane
from placegraph.errors import OptionError

places = st.tuples(st.floats(-180.0, 179.999), st.floats(-89.9, 89.9))


@given(places, st.integers(1, 16))
def test_a_place_lies_in_the_tile_of_its_key(place, zoom):
    key = key_at(*place, zoom)
    box = bounds(key)
    assert box.west - 1e-9 <= place[0] <= box.east + 1e-9
    assert box.south - 1e-9 <= place[1] <= box.north + 1e-9
    assert key_of(*tile_of(key)) == key
    assert key.startswith(key_at(*place, zoom - 1))
    assert held(np.array([place]), key).all()


@pytest.mark.parametrize("key", ["4", "01x", "0" * 17, "٣"])
def test_what_is_no_key(key):
    with pytest.raises(OptionError, match="is no tile"):
        tile_of(key)


@pytest.mark.parametrize("zoom", [0, 17, -1, 1.5, True, "3"])
def test_what_is_no_zoom(zoom):
    with pytest.raises(OptionError, match="zoom"):
        check_zoom(zoom)


def test_children_make_up_their_parent():
    parent = bounds("120")
    children = [bounds("120" + digit) for digit in "0123"]
    assert {c.west for c in children} == {parent.west, parent.center[0]}
    assert max(c.north for c in children) == parent.north
    assert children[0].south == children[2].north


def test_keys_are_those_of_web_maps():
    """As Bing's quadkeys of tile 3, 5 of level 3."""
    assert key_of(3, 5, 3) == "213"
    assert key_of(3 + 8, 5, 3) == "213"  # once around the Earth
    assert key_at(-123.1, 49.25, 3) == "021"
    assert key_at(180.0, 10.0, 3) == key_at(-180.0, 10.0, 3)
    assert tiles(np.array([(0.1, 0.1), (-0.1, -0.1)]), 1).tolist() == [[1, 0], [0, 1]]
    assert not held(np.array([(0.1, 0.1)]), "2").any()


@given(places.filter(lambda p: abs(p[1]) < 80), st.integers(8, 15), st.floats(0.0, 3000.0))
def test_a_margin_reaches_every_tile_within_it(place, zoom, margin):
    lonlat = np.array([place])
    west, north, east, south = reached(lonlat, lonlat, zoom, margin)[0]
    plane = LocalPlane(*place)
    for angle in np.linspace(0.0, 2.0 * np.pi, 9):
        there = plane.to_lonlat(margin * np.array([np.sin(angle), np.cos(angle)]))
        column, row, _ = tile_of(key_at(*there, zoom))
        assert north <= row <= south
        assert any(west <= column + turn <= east for turn in (-(1 << zoom), 0, 1 << zoom))
