"""Painted pictures: right colours at the right places."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import ImageColor

from placegraph.view.draw.canvas import Area, Disc, Dot, Frame, Glow, Line, Stroke, Text
from placegraph.view.draw.painter import heat, paint_picture
from placegraph.view.draw.style import PALETTE

FRAME = Frame((0.0, 0.0), 2.0, 200, 120)


def color(name, *, dark=False):
    return ImageColor.getrgb(PALETTE[name][dark])


def at(image, east, north):
    x, y = FRAME.to_px(np.array([east, north]))
    return image.getpixel((int(x), int(y)))


def box(size):
    return np.array([(-size, -size), (size, -size), (size, size), (-size, size), (-size, -size)])


@pytest.mark.parametrize("dark", [False, True])
def test_an_area_with_a_hole(dark):
    image = paint_picture([Area([box(25.0), box(10.0)], "park")], FRAME, dark=dark)
    assert image.size == (200, 120)
    assert at(image, 0.0, 0.0) == color("land", dark=dark)
    assert at(image, 18.0, 0.0) == color("park", dark=dark)
    assert at(image, 40.0, 0.0) == color("land", dark=dark)


def test_layers_do_not_follow_the_order_of_the_list():
    road = Line([np.array([(-40.0, 0.0), (40.0, 0.0)])], "street")
    image = paint_picture([road, Area([box(25.0)], "park")], FRAME)
    assert at(image, 0.0, 0.0) == color("road")


def test_crossing_roads_have_an_open_junction():
    one = Line([np.array([(-40.0, 0.0), (40.0, 0.0)])], "street")
    other = Line([np.array([(0.0, -40.0), (0.0, 40.0)])], "service")
    image = paint_picture([one, other], FRAME)
    assert {at(image, 0.0, y) for y in np.arange(-4.0, 4.1, 0.5)} == {color("road")}


def test_points_of_every_form_are_painted():
    for paint in ("food", "transit", "health", "tree"):
        image = paint_picture([Dot(np.zeros(2), paint)], FRAME)
        assert at(image, 0.0, 0.0) != color("land")


def test_marks_are_painted():
    marks = [
        Stroke(box(20.0), "for", 3.0, fill=0.5),
        Disc(np.array([40.0, 0.0]), 8.0, "mode", text="1"),
        Text(np.array([0.0, 0.0]), "NAME", 24.0, "against"),
        Text(np.array([-40.0, 0.0]), "TURNED", 24.0, "against", angle=1.2),
    ]
    image = paint_picture(marks, FRAME)
    assert at(image, 20.0, 5.0) == color("for")
    colors = {c for _, c in image.getcolors(100_000)}
    assert {color("mode"), color("against"), color("on-mode")} <= colors


def test_heat_grows_with_density():
    opacity = np.asarray(heat(np.linspace(0.0, 1.0, 50)[None]))[0, :, 3].astype(int)
    assert opacity[0] == 0
    assert (np.diff(opacity) >= 0).all()
    assert opacity[-1] > 120
    glow = Glow(np.ones((4, 4)), (-10.0, -10.0, 10.0, 10.0))
    image = paint_picture([glow], FRAME)
    assert at(image, 0.0, 0.0) != color("land") == at(image, 30.0, 0.0)


def test_the_same_items_give_the_same_picture():
    items = [Area([box(25.0)], "park"), Text(np.zeros(2), "Park", 12.0, "ink")]
    assert paint_picture(items, FRAME).tobytes() == paint_picture(items, FRAME).tobytes()


@given(st.floats(-1e4, 1e4), st.floats(-1e4, 1e4), st.integers(50, 900), st.integers(50, 900))
def test_a_frame_shows_its_bounds(west, south, width, height):
    frame = Frame.around((west, south, west + 120.0, south + 80.0), width, height)
    w, s, e, n = frame.bounds
    assert w <= west + 1e-6
    assert s <= south + 1e-6
    assert e >= west + 120.0 - 1e-6
    assert n >= south + 80.0 - 1e-6
    corner = frame.to_px(np.array([w, n]))
    assert np.allclose(corner, 0.0, atol=1e-6)


def test_of_a_dashed_line_beyond_the_picture_only_what_is_seen_is_cut():
    line = Stroke(np.array([(-1e12, 0.0), (1e12, 0.0)]), "for", 3.0, (5.0, 4.0))
    image = paint_picture([line], FRAME)
    row = [at(image, x, 0.0) == color("for") for x in np.linspace(-49.0, 49.0, 200)]
    assert 0.4 < np.mean(row) < 0.7
