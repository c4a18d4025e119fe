"""Pages that open without a network, and in which names are only names."""

import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from io import BytesIO
from itertools import combinations

import numpy as np
import pytest
from PIL import Image, ImageColor
from tests.browser import opened, still
from tests.view.test_scene_plan import BOXES, near, scene_of

from placegraph.core.estimate import Status
from placegraph.core.geo import Anchor
from placegraph.errors import OptionError
from placegraph.outdoor.city import build_city
from placegraph.view import write_page
from placegraph.view.city.page import (
    SCRIPTS,
    TITLE,
    CityTiles,
    _choose_tiles,
    _clip,
    _json,
    read_part,
)
from placegraph.view.draw.style import PALETTE, escape_text, style_sheet
from placegraph.view.scene.page import FINE, MAX_PIXELS, describe_plan, draw_png, open_plan
from placegraph.view.scene.room_plan import ROOM_PAINTS


class Reader(HTMLParser):
    """Elements with attributes, and their text."""

    def __init__(self):
        super().__init__(convert_charrefs=True)
        self.elements, self.text, self.tag = [], {}, ""

    def handle_starttag(self, tag, attrs):
        self.tag = tag
        self.elements.append((tag, dict(attrs)))

    def handle_data(self, data):
        self.text[self.tag] = self.text.get(self.tag, "") + data


def read(path):
    page = path.read_text("utf-8")
    reader = Reader()
    reader.feed(page)
    reader.close()
    return page, reader


@pytest.fixture
def page(city, estimate, tmp_path):
    path = write_page(city, estimate, tmp_path / "here.html", question="Is there a <fountain>?")
    return read(path)


def test_modes_are_drawn_finely_before_the_page_is_full(city, estimate):
    tiles = CityTiles(city)
    tiles.__dict__["top"] = 3
    levels = [level for (level, _, _), _ in _choose_tiles(tiles, city, estimate)]
    assert levels.index(0) < levels.index(2)


def test_a_page_asks_for_nothing(page):
    text, reader = page
    links = re.findall(r"https?://[^/`\"]+", text)
    assert set(links) <= {"https://www.openstreetmap.org"}  # to follow, never to load
    for tag, attributes in reader.elements:
        assert not attributes.keys() & {"src", "data", "action", "srcset", "poster"}
        assert tag not in {"link", "iframe", "object", "embed", "base", "form", "img"}
    [policy] = [a["content"] for _, a in reader.elements if a.get("http-equiv")]
    assert policy.startswith("default-src 'none'")


def test_names_and_texts_are_only_text(page, estimate):
    text, reader = page
    assert [tag for tag, _ in reader.elements].count("script") == 2
    assert "<script>alert" not in text
    assert "<img" not in text
    assert "<fountain>" not in text
    assert not any(name.startswith("on") for _, given in reader.elements for name in given)
    [data] = re.findall(
        r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL
    )
    data = json.loads(data)
    assert data["answer"]["question"]["text"] == "Is there a <fountain>?"
    assert len(data["answer"]["estimate"]["modes"]) == len(estimate.modes)
    names = [name for tile in data["tiles"].values() for name in tile["names"]]
    assert '<script>alert("K")</script>' in names


def test_scripts_are_whole_and_share_no_name():
    names, declared = [], r"^(?:export )?(?:class|const|function\*?|let) (\w+)"
    for i, name in enumerate(SCRIPTS):
        script = read_part(f"{name}.js")
        names += re.findall(declared, script, re.MULTILINE)
        assert set(re.findall(r'from "\./(\w+)\.js"', script)) <= set(SCRIPTS[:i])
    assert len(names) == len(set(names))


def test_the_same_estimate_gives_the_same_bytes(city, sure, tmp_path):
    one = write_page(city, sure, tmp_path / "one.html").read_bytes()
    assert one == write_page(city, sure, str(tmp_path / "two.html")).read_bytes()


def test_titles_are_escaped_and_end_with_a_word(city, sure, tmp_path):
    _, reader = read(write_page(city, sure, tmp_path / "x.html", title="</title><script>{{css}}"))
    assert reader.text["title"].strip() == "</title><script>{{css}}"
    long = "A bakery is north of me. " * 9
    assert _clip(long) == "A bakery is north of me. A bakery is north of me. A bakery is north …"
    assert len(_clip("x" * 200)) <= TITLE + 3


@pytest.mark.parametrize("name", ["</script>", "<!--", "a&b", "\u2028", '"\\'])
def test_json_survives_a_script_element(name):
    text = _json({"name": name})
    assert not set("<>&\u2028") & set(text)
    assert json.loads(text) == {"name": name}


def test_cleaned_text_cannot_leave_its_place():
    assert escape_text("<b>\u202e&\x00\"'") == "&lt;b&gt; &amp; &quot;&#x27;"


def test_the_style_sheet_knows_every_color_twice_and_for_dark_by_choice():
    css = style_sheet()
    for name, (light, dark) in PALETTE.items():
        assert css.count(f"--{name}:{light};") >= 1
        assert css.count(f"--{name}:{dark};") >= 2
    used = re.findall(r"var\(--([\w-]+)\)", read_part("style.css"))
    assert set(used) <= PALETTE.keys()


def test_a_real_city_stays_small(shared, estimate_of, tmp_path):
    source = shared / "data" / "osm" / "toronto_downtown_2020.osm.bz2"
    city = build_city(source, tmp_path / "toronto.city")
    path = write_page(city, estimate_of(Status.LOST), tmp_path / "toronto.html")
    assert 100_000 < path.stat().st_size < 3_000_000


def test_a_page_in_a_browser(city, sure, browser, tmp_path):
    path = write_page(city, sure, tmp_path / "here.html", question="Is there a <fountain>?")
    with opened(browser, path.as_uri()) as page:
        still(page)
        assert page.asked == [path.as_uri()]
        quote = page.inner_text("blockquote")
        assert quote.startswith("A <b>bakery</b> is west of me & a fountain")
        assert page.inner_text(".ask p") == "Is there a <fountain>?"
        assert page.locator(".ask button").count() == 0  # nobody is there to be answered
        assert page.inner_text(".evidence .verdict >> nth=0") == "✓"
        title = page.get_attribute(".evidence .weight >> nth=0", "title")
        assert title == "speaks strongly for it"
        links = page.eval_on_selector_all("a.osm", "all => all.map(a => a.href)")
        assert any("openstreetmap.org/?mlat=" in link for link in links)
        assert any(re.search(r"openstreetmap\.org/(node|way)/\d+$", link) for link in links)
        assert "A <b>bakery</b>: west of me" in page.inner_text(".understood")
        page.focus('.pin[data-mode="1"]')
        page.keyboard.press("Enter")
        assert page.get_attribute('.mode[data-mode="1"]', "aria-pressed") == "true"
        page.focus(".object >> nth=0")
        assert re.match(r"(node|way)/\d+", page.get_attribute(".map", "data-lit"))


def test_names_of_the_evidence_stand_on_no_other(browser):
    found = [
        {"at": [x, y], "words": words, "verdict": "for", "id": words}
        for x, y, words in (
            (-8, 2, "Jardins de la Petite Afrique"), (-6, 0, "Avenue des Spélugues"), (-5, 1, "Casino"),
            (0, 0, "Place du Casino"), (0.2, 0.2, "swimming pool"), (9, 0, "Rampoldi"),
        )
    ]  # fmt: skip
    parts = "\n".join(read_part(f"{name}.js") for name in ("base", "letters", "marks"))
    script = re.sub(r'^import [^;]+ from "[^"]+";\n|^export ', "", parts, flags=re.MULTILINE)
    with opened(browser, "about:blank") as page:
        placed = page.evaluate(
            f"(found) => {{ {script};"
            " return beside(found, [0, 0], 2).map((t) => [t.text, covering(t, 2)]); }",
            found,
        )
    assert len(placed) >= 4
    for (one, discs), (other, others) in combinations(placed, 2):
        gaps = [np.hypot(a - x, b - y) - r - q for a, b, r in discs for x, y, q in others]
        assert min(gaps) >= 0.0, f"{one} stands on {other}"


def test_what_is_only_ranked_shows_no_percentage(city, sure, browser, tmp_path):
    path = write_page(city, replace(sure, ranked=True), tmp_path / "here.html")
    with opened(browser, path.as_uri()) as page:
        still(page)
        assert page.locator(".pin").count() == len(sure.modes)
        assert page.locator(".share").count() == 0
        assert "%" not in page.get_attribute(".pin >> nth=0", "aria-label")


@pytest.fixture(scope="module")
def plan():
    scene = scene_of(BOXES, scene="room").anchored(Anchor(9.99, 53.55, 0.0, 0.3, building="Hall"))
    rooms = [{"room": "</script>"} if label == "floor" else {} for label in scene.graph.labels]
    return open_plan(replace(scene, attributes=tuple(rooms)))


def test_things_are_told_as_they_stand(plan):
    page = describe_plan(plan)
    things = {thing["label"]: thing for thing in page["things"]}
    assert (things["floor"]["name"], things["floor"]["room"]) == ("</script>", True)
    table = things["KitchenTable"]
    assert (table["name"], table["room"], table["box"]) == ("kitchen table", False, [5, 3, 7, 4])
    assert (things["wall"]["role"], things["wall"]["name"]) == ("structure", "")
    assert "ceiling" not in things
    assert things["lamp"]["name"] == ""  # it hangs above the table
    assert page["anchors"][0]["building"] == "Hall"


@pytest.mark.parametrize("dark", [False, True])
def test_the_picture_is_of_the_bounds_alone(plan, dark):
    west, south, east, north = describe_plan(plan)["bounds"]
    with Image.open(BytesIO(draw_png(plan, dark=dark))) as image:
        pixels = np.asarray(image)
    assert pixels.shape[1] == pytest.approx(FINE * (east - west), abs=1)
    assert pixels.shape[0] == pytest.approx(FINE * (north - south), abs=1)
    table = ROOM_PAINTS["table"].dark if dark else ROOM_PAINTS["table"].light
    x, y = FINE * (6.0 - west), FINE * (north - 3.5)
    assert near(tuple(pixels[int(y), int(x)].tolist()), ImageColor.getrgb(table))
    assert near(tuple(pixels[0, 0].tolist()), ImageColor.getrgb(PALETTE["land"][dark]))


def test_a_large_scene_has_a_picture_of_bounded_size_and_a_missing_one_is_named():
    with pytest.raises(OptionError, match="no 'attic'; it has room"):
        open_plan(scene_of(BOXES, scene="room"), "attic")
    wide = scene_of({"floor": ((0, 0, -0.1), (400, 5, 0))}, scene="hall")
    with Image.open(BytesIO(draw_png(open_plan(wide)))) as image:
        assert image.width <= MAX_PIXELS + 1
        assert image.height >= 1
