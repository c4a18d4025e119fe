"""Pictures of estimates and cities."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, ImageColor

from placegraph.core.estimate import CityEstimate, Evidence, ObjectRef, Place, Status
from placegraph.errors import OptionError
from placegraph.outdoor.city import build_city
from placegraph.view import draw_city, write_picture
from placegraph.view.city.picture import length_words, round_length
from placegraph.view.draw.style import PALETTE
from placegraph_lab.worlds.town.town import Town


def colors(image):
    return {color for _, color in image.convert("RGB").getcolors(1 << 24)}


@pytest.mark.parametrize("size", [(640, 480), (400, 700)])
def test_a_picture_of_every_status(city, estimate, size, tmp_path):
    path = write_picture(city, estimate, tmp_path / "here.png", size=size)
    with Image.open(path) as image:
        assert image.format == "PNG"
        assert image.size == size
        seen = colors(image)
    assert len(seen) > 200
    assert ImageColor.getrgb(PALETTE["mode"][0]) in seen
    assert path.stat().st_size < 1_000_000


def test_evidence_is_drawn_in_its_colours(city, sure, tmp_path):
    with Image.open(write_picture(city, sure, tmp_path / "here.png")) as image:
        pixels = np.asarray(image.convert("RGB"))[70:850]
    for verdict in ("for", "against"):
        color = ImageColor.getrgb(PALETTE[verdict][0])
        assert (pixels == color).all(axis=2).sum() > 60


def test_the_same_estimate_gives_the_same_bytes(city, sure, tmp_path):
    one = write_picture(city, sure, tmp_path / "one.png", size=(400, 400)).read_bytes()
    assert one == write_picture(city, sure, tmp_path / "two.png", size=(400, 400)).read_bytes()


def test_names_that_no_face_draws_do_no_harm(tmp_path):
    town = Town.parse("[drawing]\nB\n[legend]\nB: shop=bakery name=\U00012000\U00012001\n")
    city = build_city(town.write_osm(tmp_path / "one.osm"), tmp_path / "one.city")
    longitude, latitude = town.position("B")
    ref = ObjectRef("node/1", "shop=bakery", "\U00012000\U00012001", longitude, latitude)
    evidence = (Evidence("a bakery", "for", 1.0, (ref,)),)
    mode = Place(longitude, latitude - 3e-4, 0.9, "", np.eye(2), explain=lambda: evidence)
    estimate = CityEstimate(Status.OK, (mode,), "Here.")
    with Image.open(write_picture(city, estimate, tmp_path / "one.png")) as image:
        assert ImageColor.getrgb(PALETTE["for"][0]) in colors(image)


def test_a_city(city, tmp_path):
    with Image.open(draw_city(city, str(tmp_path / "city.png"), size=(500, 400))) as image:
        assert image.size == (500, 400)
        assert ImageColor.getrgb(PALETTE["water"][0]) in colors(image)
        assert ImageColor.getrgb(PALETTE["park"][0]) in colors(image)


@pytest.mark.parametrize("size", [(10, 10), (400, 10_000), (400.0, 400), (400,)])
def test_sizes_out_of_range_are_refused(city, sure, size, tmp_path):
    with pytest.raises(OptionError, match="width and height from 320 to 6000"):
        write_picture(city, sure, tmp_path / "x.png", size=size)
    with pytest.raises(OptionError):
        draw_city(city, tmp_path / "x.png", size=size)
    assert not (tmp_path / "x.png").exists()


@given(st.floats(0.01, 1e5))
def test_scale_bars_are_round(most):
    length = round_length(most)
    assert most / 2.5001 <= length <= most * (1 + 1e-9)
    assert f"{length:.0e}"[0] in "125"


def test_lengths_in_words():
    assert [length_words(m) for m in (0.5, 20.0, 500.0, 2000.0)] == [
        "0.5 m",
        "20 m",
        "500 m",
        "2 km",
    ]
