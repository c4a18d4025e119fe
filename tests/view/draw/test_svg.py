"""SVG text: the same geometry to half a metre, and nothing unescaped."""

import re

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from placegraph.view.draw.canvas import Dot, Line, Text
from placegraph.view.draw.style import PAINTS, PALETTE
from placegraph.view.draw.svg import UNIT, Svg, clean, in_layers, style_sheet

coordinate = st.floats(-5000.0, 5000.0)
lines = st.lists(st.tuples(coordinate, coordinate), min_size=2, max_size=12).map(np.array)


def walked(data):
    """Points of path data with one ``M`` and one relative ``l``."""
    head, _, tail = data.partition("l")
    start = [int(n) for n in re.findall(r"-?\d+", head)]
    steps = np.array([int(n) for n in re.findall(r"-?\d+", tail)]).reshape(-1, 2)
    return np.concatenate([[start], start + np.cumsum(steps, axis=0)])


@given(lines)
def test_path_data_keeps_the_line(line):
    svg = Svg((1000.0, -300.0))
    data = svg.path([line])
    want = svg.units(line)
    moved = np.concatenate([[True], (np.diff(want, axis=0) != 0).any(axis=1)])
    if moved.sum() < 2:
        assert data == ""
    else:
        assert np.array_equal(walked(data), want[moved])


@given(lines)
def test_units_are_half_metres_and_y_grows_to_the_south(line):
    units = Svg((10.0, 20.0)).units(line)
    assert np.allclose(units * (UNIT, -UNIT) + (10.0, 20.0), line, atol=UNIT / 2 + 1e-6)


@given(st.text(max_size=40))
def test_cleaned_text_cannot_leave_its_place(text):
    cleaned = clean(text)
    assert not set(cleaned) & set("<>\"'\n\x00\u202e")
    assert "&" not in re.sub(r"&(amp|lt|gt|quot|#x27);", "", cleaned)


def test_lettering_is_escaped():
    assert "&lt;b&gt;" in Svg((0.0, 0.0)).text(Text(np.zeros(2), "<b>", 12.0, "ink"))


def test_casings_lie_below_all_roads():
    svg = Svg((0.0, 0.0))
    road = np.array([(0.0, 0.0), (50.0, 0.0)])
    layers = [
        ("service", [Line([road], "service")]),
        ("main-road", [Line([road], "main-road")]),
        ("food", [Dot(np.zeros(2), "food")]),
    ]
    text = in_layers(svg, layers, lambda _: "")
    order = [text.index(f'class="{c}"') for c in
             ("service-edge", "main-road-edge", "service", "main-road", "food-edge", "food")]  # fmt: skip
    assert order == sorted(order)


def test_the_style_sheet_knows_every_paint_and_color():
    css = style_sheet()
    for paint in PAINTS:
        assert f".{paint}{{" in css
    assert css.count("--land:") == 2
    assert set(re.findall(r"var\(--([\w-]+)\)", css)) <= PALETTE.keys()
