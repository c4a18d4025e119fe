"""Levels as tags list them."""

import pytest

from placegraph.io.osm.indoor_osm import level_text, levels_of


@pytest.mark.parametrize(
    ("text", "levels"),
    [
        ("0", (0,)), ("0;1", (0, 1)), ("1; 0 ;1", (0, 1)), ("0-2", (0, 1, 2)), ("-1", (-1,)),
        ("-2--1", (-2, -1)), ("-1-1", (-1, 0, 1)), ("2-0", (0, 1, 2)), ("0.5", (0.5,)),
        ("0.5-2", (0.5, 1, 2)), ("0,3", (0, 3)), ("", ()), ("ground", ()), ("x;2", (2,)),
        ("0-99999", ()), ("0-9999", ()), ("1e9", ()), ("\u0663", ()),
    ],
)  # fmt: skip
def test_levels(text, levels):
    assert levels_of(text) == levels


def test_a_level_as_text():
    assert [level_text(v) for v in (0.0, -1.0, 0.5)] == ["0", "-1", "0.5"]
