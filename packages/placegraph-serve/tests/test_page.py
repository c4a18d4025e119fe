"""The page in a real browser, with a real server behind it."""

import re

import pytest
from tests.browser import opened, still

SENTENCE = "I am standing on a square. There is a fountain north of me and a café to my east."


def typed(page, text):
    page.wait_for_selector("#city option", state="attached")
    page.focus("#text")
    page.keyboard.type(text)
    page.wait_for_selector(".status")


def test_typing_asking_and_sharing(browser, url):
    with opened(browser, url + "#map=hafenstadt") as page:
        page.wait_for_selector(".examples button")
        typed(page, SENTENCE)
        page.wait_for_selector(".pin >> nth=1")
        assert page.inner_text(".status") == "Not sure yet"
        page.get_by_role("button", name="Fischmarkt", exact=True).first.click()
        page.wait_for_selector(".status.OK")
        assert page.locator(".chip").count() == 1
        page.wait_for_url("**answers**")
        assert {a.split("/")[2] for a in page.asked} == {url.split("/")[2]}  # no other host
        assert any(a.startswith("ws:") for a in page.asked)
        assert sum("/v1/locate" in a for a in page.asked) == 0
        link = page.url
    with opened(browser, link) as page:
        page.wait_for_selector(".status.OK")
        assert page.input_value("#text") == SENTENCE
        page.click(".chip")  # the answer is taken back
        page.wait_for_selector(".status.AMBIGUOUS")


def test_rivals_in_two_towns_stand_in_their_own(browser, url):
    with opened(browser, url + "#q=A bakery is to my west. A fountain is to my east.") as page:
        for k in (0, 1):  # the likeliest two
            page.locator(".mode").nth(k).click()
            page.wait_for_selector(f'.pin.on[data-mode="{k}"]')
            still(page)
        towns = page.locator(".mode .where").all_inner_texts()
        assert {town.split(".")[0] for town in towns} == {"43", "53"}
        pins = page.locator(".pin").evaluate_all("all => all.map(p => p.dataset.mode)")
        assert 0 < len(pins) < len(towns)
    with opened(browser, url + "#q=A bakery is to my west. A fountain is to my east.") as page:
        page.wait_for_selector(".status.AMBIGUOUS")
        still(page)
        page.wait_for_selector('.pin[data-mode="0"]')  # seen, wherever its rivals are


def test_a_way_is_told_and_asked_about(browser, url):
    with opened(browser, url + "#map=hafenstadt&tab=walk") as page:
        page.fill("#text", SENTENCE)
        page.click("#go")
        page.get_by_role("button", name="Fischmarkt", exact=True).first.click()
        page.wait_for_selector(".status.OK")
        assert page.locator(".log li").count() == 2
        assert page.input_value("#text") == ""
        page.fill("#text", "I walked 40 m east.")
        page.keyboard.press("Enter")
        page.wait_for_selector(".log li >> nth=2")


def test_evidence_lights_up_both_ways(browser, url):
    with opened(browser, url + "#map=hafenstadt&q=" + SENTENCE) as page:
        page.wait_for_selector(".evidence .object")
        still(page)
        row = page.locator(".evidence [data-ids]").nth(2)
        row.hover()
        assert page.get_attribute(".map", "data-lit") == row.get_attribute("data-ids")
        box = page.locator(".map canvas").bounding_box()
        for _ in range(3):  # a drawing that comes late moves the map once more
            row.locator(".object").click()
            still(page)
            page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
            if page.locator(".evidence li.on").count():
                break
        page.wait_for_selector(".evidence li.on")
        assert "on" in row.get_attribute("class").split()
        assert page.is_visible(".tip")


def test_hostile_names_are_only_names(browser, url):
    with opened(browser, url + "#map=hostile") as page:
        still(page)
        typed(page, "A bakery is to my west. A fountain is to my east. A café is south of me.")
        page.wait_for_selector(".evidence .object:has-text('onerror=')")
        assert "\u202e" not in page.inner_text("body")
        assert page.evaluate("window.hacked === undefined")
        assert page.locator("#answer img, #answer script, .map svg").count() == 0
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_phone(browser, url, scheme):
    phone = {"width": 360, "height": 640}
    options = {"viewport": phone, "has_touch": True, "is_mobile": True, "color_scheme": scheme}
    with opened(browser, url + "#map=hafenstadt&q=" + SENTENCE, **options) as page:
        page.wait_for_selector(".evidence .object")
        still(page)
        assert page.evaluate("document.documentElement.scrollWidth") == 360
        sizes = page.eval_on_selector_all(
            ".senses button:not([hidden]), .tools button, .options button, [role=tab]",
            "all => all.map(b => b.getBoundingClientRect()).map(r => Math.min(r.width, r.height))",
        )
        assert min(sizes) >= 32
        page.tap(".options button >> nth=0")
        page.wait_for_selector(".chip")
        paper = page.evaluate("getComputedStyle(document.body).backgroundColor")
        assert paper == {"light": "rgb(255, 255, 255)", "dark": "rgb(28, 33, 40)"}[scheme]


def test_keys_and_labels_suffice(browser, url):
    with opened(browser, url + "#map=hafenstadt&q=" + SENTENCE) as page:
        page.wait_for_selector(".pin.on")
        still(page)
        nameless = page.eval_on_selector_all(
            "button, select, textarea, a, canvas, [role=tab], [role=img]",
            """all => all.filter(e => !e.closest("[hidden]") && !(e.getAttribute("aria-label")
               || e.textContent.trim() || e.labels?.length)).map(e => e.outerHTML)""",
        )
        assert nameless == []
        page.focus("#tab-here")
        page.keyboard.press("ArrowRight")
        assert page.get_attribute("#tab-walk", "aria-selected") == "true"
        assert page.locator("[aria-selected]:not([role=tab])").count() == 0
        page.keyboard.press("ArrowLeft")
        page.wait_for_selector(".pin.on")
        seen = []
        for _ in range(40):
            page.keyboard.press("Tab")
            seen.append(
                page.evaluate("document.activeElement.id || document.activeElement.tagName")
            )
            if seen[-1] == "CANVAS":
                break
        assert seen[0] == "text"  # then what is found, and the map at last
        assert seen[-1] == "CANVAS"
        before = page.get_attribute(".pin.on", "style")
        page.keyboard.press("ArrowRight")
        page.wait_for_selector(f".pin.on:not([style='{before}'])")
        page.wait_for_selector("#live:has-text('places')", state="attached")


def test_tiles_are_checked_and_kept(web):
    index = web.get("/v1/maps/hafenstadt/drawing").json()
    assert len(index["examples"]) == 3
    path = f"/v1/maps/hafenstadt/drawing/{index['top']}/0/0"
    tile = web.get(path)
    assert tile.json()["layers"]
    assert tile.json() == web.get(path, headers={"Accept-Encoding": "identity"}).json()
    far = web.get("/v1/maps/hafenstadt/drawing/99/0/0")
    assert far.status_code == 404
    assert far.json()["code"] == "tile_unknown"
    assert web.get("/v1/maps/nowhere/drawing").status_code == 404


def test_the_page_trusts_nobody_else(web):
    for path in ("/", "/app.js", "/parts/map.js"):
        answer = web.get(path)
        assert answer.status_code == 200
        policy = answer.headers["content-security-policy"]
        assert policy.startswith("default-src 'none'; script-src 'self';")
        assert not re.search(r"https?:", policy)
    assert web.get("/parts/../app.py").status_code == 404
    assert web.get("/parts/nothing.js").status_code == 404
