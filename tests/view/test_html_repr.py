"""Maps and estimates as cells of a notebook: a picture that needs nothing else, and words."""

import base64
import io
import re
import subprocess
import sys

import pytest
from PIL import Image

import placegraph as pg
from placegraph.core.estimate import Estimate, SceneMode, Status
from placegraph.world import open_world


def picture(html):
    data = re.search(r'src="data:image/png;base64,([^"]+)"', html)
    return Image.open(io.BytesIO(base64.b64decode(data[1])))


@pytest.fixture(scope="module")
def flat(demo_world):
    return pg.open_map(demo_world / "altbau.scene")


def test_maps(harbour, flat, demo_world):
    for shown in (harbour, flat):
        html = shown._repr_html_()
        assert picture(html).width == 640
        assert len(html) < 150_000
        assert shown.source in html
    library = pg.SceneLibrary("labels")
    library.add("home1", demo_world / "home1.scene")
    html = library._repr_html_()
    assert "home1" in html
    assert picture(html).width == 640
    assert picture(library.search("a kitchen")._repr_html_()).width == 640
    assert picture(pg.open_capture(demo_world / "walk")._repr_html_()).width == 640


def test_worlds(harbour_file, demo_world):
    world = open_world([harbour_file, demo_world / "altbau.scene"])
    assert picture(world._repr_html_()).size == (640, 440)
    for text, height in (("A bakery is north of me.", 480), ("I am in the kitchen.", None)):
        estimate = world.locate(text)
        assert height in {None, picture(estimate._repr_html_()).height}


def test_no_number_is_raw():
    mode = SceneMode("attic", 1.06381e-29, 12.5)
    shown = Estimate(Status.OK, (mode,), "")
    for text in (repr(mode), repr(shown), shown._repr_html_()):
        assert "e-29" not in text


def test_estimates(harbour, flat, demo_world):
    text = harbour.locate("A bakery is north of me.")._repr_html_()
    assert picture(text).size == (640, 480)
    assert "A bakery is north of me" in text
    posed = flat.localize(pg.open_capture(demo_world / "walk"), frames=slice(0, 3))
    assert picture(posed._repr_html_()).width == 640
    lost = harbour.locate("hm")._repr_html_()  # nothing to draw
    assert "LOST" in lost
    assert "<img" not in lost


def test_what_a_stranger_wrote_is_no_markup():
    mode = SceneMode("<script>x</script>", 1.0, 0.0)
    html = Estimate(Status.OK, (mode,), "<b>why</b>")._repr_html_()
    assert "<script" not in html
    assert "<b>why" not in html


def test_nothing_is_drawn_before_a_notebook_asks():
    code = "import placegraph as pg, sys; pg.CityMap, pg.SceneMap, pg.SceneLibrary, pg.Estimate;"
    code += "sys.exit(any(name.startswith('placegraph.view') for name in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], check=False)  # noqa: S603  # our own
    assert done.returncode == 0
