"""Pages that open without a network, and in which names are only names."""

import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import pytest

from placegraph.estimate import Status
from placegraph.outdoor.city import build_city
from placegraph.view import write_page
from placegraph.view.city.page import _json
from placegraph.view.city.page_panel import factor

VOID = {"meta", "rect", "path", "use", "circle", "image", "br"}


class Reader(HTMLParser):
    """Elements with attributes and text; complains about tags that do not match."""

    def __init__(self):
        super().__init__(convert_charrefs=True)
        self.open, self.elements, self.text = [], [], {}

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data):
        tag = self.open[-1] if self.open else ""
        self.text[tag] = self.text.get(tag, "") + data


def read(path):
    page = path.read_text("utf-8")
    reader = Reader()
    reader.feed(page)
    reader.close()
    assert reader.open == []
    return page, reader


@pytest.fixture
def page(city, estimate, tmp_path):
    path = write_page(city, estimate, tmp_path / "here.html", question="Is there a <fountain>?")
    return read(path)


def test_a_page_needs_no_network(page):
    text, reader = page
    assert not re.search(r"(https?:)?//[a-z]", re.sub(r"data:image/png;base64,[\w+/=]*", "", text))
    ids = {attributes["id"] for _, attributes in reader.elements if "id" in attributes}
    for tag, attributes in reader.elements:
        for name in ("src", "href", "data", "action", "srcset", "poster"):
            value = attributes.get(name)
            if value is not None:
                assert value.startswith("data:image/png") or value[0] == "#"
                assert value[0] != "#" or value[1:] in ids, "use must refer to what is there"
        assert tag not in {"link", "iframe", "object", "embed", "base", "form", "img"}
    [policy] = [a["content"] for _, a in reader.elements if a.get("http-equiv")]
    assert policy.startswith("default-src 'none'")


def test_what_is_only_ranked_shows_no_percentage(city, estimate, tmp_path):
    for ranked in (False, True):
        path = write_page(city, replace(estimate, ranked=ranked), tmp_path / "here.html")
        page, reader = read(path)
        labels = [a["aria-label"] for _, a in reader.elements if a.get("role") == "button"]
        shown = bool(estimate.modes) and not ranked
        assert any("%" in label for label in labels) is shown
        assert ('class="share"' in page) is shown


def test_names_and_texts_are_only_text(page):
    text, reader = page
    assert [tag for tag, _ in reader.elements].count("script") == 2
    assert "<script>alert" not in text
    assert "<img" not in text
    assert "<fountain>" not in text
    assert "Is there a <fountain>?" in reader.text["p"]
    assert not any(
        name.startswith("on") for _, attributes in reader.elements for name in attributes
    )
    assert [tag for tag, _ in reader.elements if tag in ("b", "i")].count("b") <= 3


def test_the_data_is_json(page, estimate):
    text, _ = page
    [data] = re.findall(
        r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL
    )
    data = json.loads(data)
    assert len(data["modes"]) == len(estimate.modes)
    assert any(tip.startswith('<script>alert("K")</script>\nshop=bakery') for tip in data["tips"])


def test_status_modes_and_evidence_are_told(page, estimate, city):
    text, reader = page
    assert f'class="status {estimate.status.name}"' in text
    assert "One & only <reason>." in reader.text["p"]
    buttons = [a for tag, a in reader.elements if tag == "button" and "data-mode" in a]
    assert len(buttons) == len(estimate.modes)
    pins = [a for tag, a in reader.elements if tag == "g" and "data-mode" in a]
    assert [pin["role"] for pin in pins] == ["button"] * len(estimate.modes)
    for mode in estimate.modes:
        for evidence in mode.evidence:
            for ref in evidence.objects:
                assert ref.id in reader.text["small"]
    drawn = {a["data-o"] for _, a in reader.elements if "data-o" in a}
    assert drawn <= {city.objects.osm(i) for i in range(len(city.objects))}
    assert len(drawn) >= 15
    assert "OpenStreetMap contributors" in reader.text["p"]
    assert "It rains </script>" in reader.text["q"]
    assert "A bakery: west of me" in text.replace("&lt;b&gt;", "").replace("&lt;/b&gt;", "")


def test_heat_is_an_image_where_there_is_a_posterior(page, estimate):
    _, reader = page
    images = [a for tag, a in reader.elements if tag == "image"]
    assert bool(images) == bool(len(estimate.support))


def test_the_page_can_be_used_without_sight_or_mouse(page):
    _, reader = page
    [canvas] = [a for tag, a in reader.elements if tag == "svg" and a.get("id") == "map"]
    assert canvas["tabindex"] == "0"
    assert canvas["aria-label"]
    for tag, attributes in reader.elements:
        if tag == "button":
            assert attributes["type"] == "button"
        if attributes.get("role") in ("img", "group", "application"):
            assert attributes["aria-label"]


def test_the_same_estimate_gives_the_same_bytes(city, sure, tmp_path):
    one = write_page(city, sure, tmp_path / "one.html").read_bytes()
    assert one == write_page(city, sure, str(tmp_path / "two.html")).read_bytes()


def test_titles_are_escaped(city, sure, tmp_path):
    _, reader = read(write_page(city, sure, tmp_path / "x.html", title="</title><script>{{css}}"))
    assert reader.text["title"] == "</title><script>{{css}}"


@pytest.mark.parametrize("name", ["</script>", "<!--", "a&b", "\u2028", '"\\'])
def test_json_survives_a_script_element(name):
    text = _json({"name": name})
    assert not set("<>&\u2028") & set(text)
    assert json.loads(text) == {"name": name}


def test_weights_in_words():
    assert factor(0.0) == "as likely"
    assert factor(3.47) == "32 times likelier"
    assert factor(-0.7) == "2.0 times less likely"
    assert factor(99.0) == "over 1000 times likelier"


def test_a_real_city_stays_small(shared, estimate_of, tmp_path):
    source = shared / "data" / "osm" / "toronto_downtown_2020.osm.bz2"
    city = build_city(source, tmp_path / "toronto.city")
    nothing = estimate_of(Status.LOST)
    path = write_page(city, nothing, tmp_path / "toronto.html")
    assert 100_000 < path.stat().st_size < 3_000_000
    read(path)
