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


def test_a_german_text_is_answered_in_german_and_nothing_is_missing(browser, url):
    with opened(browser, url + "#q=Ich bin in der Küche.") as page:
        page.wait_for_selector(".status.AMBIGUOUS")
        options = page.locator(".options button")
        assert options.all_inner_texts() == ["ja", "nein", "weiß nicht"]
        first = page.locator(".mode .named").first.inner_text()
        options.nth(1).click()
        page.wait_for_selector(".chip")
        page.wait_for_function(
            "name => document.querySelector('.mode .named').innerText !== name", arg=first
        )
        assert "Wahrscheinlichkeit" in page.inner_text(".reason")
        shares = " ".join(page.locator(".share b, .rest").all_inner_texts())
        assert sum(map(int, re.findall(r"(\d+) %", shares))) == pytest.approx(100, abs=3)


def test_rivals_in_two_towns_stand_in_their_own(browser, url):
    with opened(browser, url + "#q=A bakery is to my west. A fountain is to my east.") as page:
        for k in (0, 1):  # the likeliest two
            page.locator(".mode").nth(k).click()
            page.wait_for_selector(f'.pin.on[data-mode="{k}"]')
            still(page)
        towns = page.locator(".mode .named").all_inner_texts()
        assert {town.split(", ")[-1] for town in towns} == {"Hafenstadt", "Hostile"}
        pins = page.locator(".pin").evaluate_all("all => all.map(p => p.dataset.mode)")
        assert 0 < len(pins) < len(towns)
    with opened(browser, url + "#q=A bakery is to my west. A fountain is to my east.") as page:
        page.wait_for_selector(".status.AMBIGUOUS")
        still(page)
        page.wait_for_selector('.pin[data-mode="0"]')  # seen, wherever its rivals are


TERMS = re.compile(
    r"\b(altbau|nat|ellipse|outside|programs|likelier|correlate|along|level)\b|\.osm|_\w|"
    r"\b(amenity|building|highway|place|railway|shop|tourism)=|\b(node|way|relation)/"
)
READ = """() => {
  for (const part of document.querySelectorAll("details")) part.open = part.innerText !== "GeoPose";
  const hints = [...document.querySelectorAll("[title],[aria-label],[placeholder]")];
  return document.body.innerText + hints.map((e) => "\\n" + e.title + "\\n" + e.ariaLabel).join("");
}"""


def test_people_read_names_and_words(browser, url, walk):
    found = []
    for link in ("#map=hafenstadt", f"#q={KITCHEN}", f"#map=hafenstadt&q={SENTENCE}",
                 "#q=I'm on Lange Straße. A bakery is north of me.", "#tab=walk&map=hafenstadt",
                 "#tab=inside&scene=altbau", "#tab=inside"):  # fmt: skip
        with opened(browser, url + link) as page:
            page.wait_for_selector(".examples button, .scenes, .log ~ *, .reason")
            if "inside" in link:
                image = walk / "rgb" / "000005.jpg"
                page.locator(".drop input[type=file]").last.set_input_files(image)
            elif "walk" in link:
                page.fill("#text", SENTENCE)
                page.click("#go")
            if "q=" in link or "tab=" in link:
                page.wait_for_selector(".status")
            still(page)
            assert TERMS.findall(page.evaluate(READ)) == []
            found += page.locator(".mode .named").all_inner_texts()[:1]
    assert found[1] == found[3] == "Fischmarkt, near Kaffeekontor, Hafenstadt"
    assert found[2] == "Lange Straße, near Bäckerei Kern, Hafenstadt"
    assert found[4].endswith("Hotel Hansa, floor 2, Hafenstadt")


BUSY = """text => {
  const field = document.getElementById("text");
  field.value = text;
  field.dispatchEvent(new Event("input"));
  return document.body.hasAttribute("data-busy");
}"""
COVERED = """() => {
  const box = (e) => e.getBoundingClientRect();
  const pins = [...document.querySelectorAll(".pin:not([hidden])")].map(box);
  const others = [...document.querySelectorAll(".legend, .door:not([hidden]), .tools button")].map(box);
  return pins.filter((p) => others.some((o) => o.width && p.left < o.right && o.left < p.right
    && p.top < o.bottom && o.top < p.bottom)).length;
}"""


def test_a_new_text_selects_its_best_place_and_something_moves_at_once(browser, url):
    with opened(browser, "about:blank") as page:
        page.route("**/v1/maps", lambda route: page.wait_for_timeout(300) or route.continue_())
        page.goto(f"{url}#map=hafenstadt", wait_until="commit")
        page.wait_for_selector("#tab-here", state="attached")
        page.wait_for_load_state()
        assert page.evaluate(BUSY, SENTENCE)  # before the maps are known
        page.wait_for_selector(".mode >> nth=1")
        assert page.get_attribute("body", "data-busy") is None
        page.click(".mode >> nth=1")
        page.wait_for_selector('.mode[data-mode="1"][aria-pressed=true]')
        assert page.evaluate(BUSY, SENTENCE + " A library is behind me.")
        page.wait_for_selector('.mode[data-mode="0"][aria-pressed=true]')
        page.wait_for_selector("body:not([data-busy])")
        assert not page.evaluate(BUSY, "")


def test_a_tab_that_is_clicked_early_stays(browser, url):
    with opened(browser, "about:blank") as page:
        page.route("**/drawing", lambda route: page.wait_for_timeout(500) or route.continue_())
        page.goto(f"{url}#map=hafenstadt", wait_until="commit")
        page.wait_for_selector("#city option", state="attached")
        page.click("#tab-walk")
        page.wait_for_selector("#source:not(:empty)")
        still(page)
        assert page.get_attribute("#tab-walk", "aria-selected") == "true"


def test_nothing_covers_a_pin(browser, url):
    for link in (
        f"#q={KITCHEN}",
        f"#q={SENTENCE}",
        "#q=A bakery is to my west.",
        "#q=I am at Hotel Hansa.",
    ):
        for size in ((1280, 800), (390, 800)):
            with opened(
                browser, url + link, viewport=dict(zip(("width", "height"), size, strict=True))
            ) as page:
                page.wait_for_selector(".status")
                still(page)
                assert page.evaluate(COVERED) == 0, (link, size)


def test_an_answer_that_comes_late_is_shown(browser, url):
    with opened(browser, url) as page:
        page.wait_for_selector(".examples button")
        still(page)
        page.evaluate("WebSocket.prototype.send = function () { this.close(); }")
        page.route("**/v1/locate", lambda route: page.wait_for_timeout(1200) or route.continue_())
        page.evaluate(BUSY, "A bakery is to my west. A fountain is to my east.")
        page.wait_for_selector(".pin.on")
        still(page)
        assert page.evaluate(SCALE) in {"20 m", "50 m"}


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


def test_a_way_is_looked_for_in_all_towns(browser, url):
    with opened(browser, url + "#tab=walk") as page:
        page.fill("#text", "A bakery is to my west. A fountain is to my east.")
        page.click("#go")
        page.wait_for_selector(".mode >> nth=1")
        towns = page.locator(".mode .named").all_inner_texts()
        assert {town.split(", ")[-1] for town in towns} == {"Hafenstadt", "Hostile"}
        page.fill("#text", "The museum is south of me.")
        page.keyboard.press("Enter")
        page.wait_for_selector(".log li >> nth=1")
        assert "Hostile" in page.inner_text(".modes")  # the museum is there


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
            focused = "document.activeElement.id || document.activeElement.tagName"
            seen.append(page.evaluate(focused))
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


KITCHEN = "I am in the Hotel Hansa, in the kitchen."
SCALE = "document.querySelector('.scale span').textContent"


def inside(page):
    page.wait_for_selector(".floor:not([hidden])")
    still(page)


def test_a_sentence_leads_from_the_city_into_the_room_and_back(browser, url):
    with opened(browser, f"{url}#q={KITCHEN}") as page:
        page.wait_for_selector(".modes .mode")
        assert page.locator(".ask").count() == 0  # whether one is where one said that one is
        named = page.inner_text(".mode .named >> nth=0")
        assert named == "kitchen, Hotel Hansa, floor 2, Hafenstadt"
        still(page)
        assert page.evaluate(SCALE) == "50 m"
        page.click(".modes .mode >> nth=0")
        inside(page)
        assert page.evaluate(SCALE) in {"1 m", "2 m"}
        assert page.inner_text(".floor b") == "Hotel Hansa"
        floor = page.get_by_role("button", name="Floor 2", exact=True)
        assert floor.get_attribute("aria-pressed") == "true"
        box = page.locator(".pin.on").bounding_box()  # it stands in the kitchen
        page.mouse.move(box["x"] + 40, box["y"] + 50)
        page.wait_for_selector(".tip:has-text('kitchen')")
        page.click(".floor .out")
        page.wait_for_selector(".floor", state="hidden")
        still(page)
        page.click(".pin.on")  # no door stands beside it
        inside(page)
        page.click("#tab-inside")  # images that are taken now are of this flat
        page.wait_for_selector(".scenes [aria-pressed=true]:has-text('Hotel Hansa')")
        assert {a.split("/")[2] for a in page.asked} == {url.split("/")[2]}


OTHER = "text => document.querySelector('.ask p')?.innerText !== text"


def test_a_room_that_is_found_opens(browser, url):
    with opened(browser, f"{url}#q=I am in the kitchen.") as page:
        page.get_by_role("button", name="no", exact=True).click()  # in home1
        page.wait_for_selector(".ask p:has-text('onerror')")
        page.get_by_role("button", name="yes", exact=True).click()
        page.wait_for_selector(".status.OK")
        inside(page)
        assert "onerror" in page.inner_text(".floor b")


def test_a_question_in_german_is_answered_in_german(browser, url):
    with opened(browser, f"{url}#q=Ich bin in der Küche.") as page:
        assert page.inner_text(".ask p") == "Sind Sie hier: home1?"
        page.get_by_role("button", name="nein", exact=True).click()
        page.wait_for_function(OTHER, arg="Sind Sie hier: home1?")
        assert "Home1" not in page.inner_text(".mode .named >> nth=0")


def test_places_of_other_towns_and_of_none_are_shown_where_they_are(browser, url):
    with opened(browser, f"{url}#q={KITCHEN}") as page:
        page.click(".modes .mode >> nth=1")  # a home that stands nowhere
        page.wait_for_selector('.map[data-stage="scene"]')
        page.wait_for_selector(".pin.on:has-text('2')")
        page.click(".modes .mode >> nth=2")  # in the other town
        inside(page)
        assert "onerror" in page.inner_text(".floor b")
        page.click(".modes .mode >> nth=0")
        page.wait_for_selector(".floor b:has-text('Hotel Hansa')")
        page.wait_for_selector(".pin.on:has-text('1')")


def test_images_show_where_they_were_taken(browser, url, walk):
    with opened(browser, f"{url}#tab=inside&scene=altbau") as page:
        inside(page)
        chooser = page.locator(".drop input[type=file]")
        assert chooser.first.get_attribute("capture") == "environment"
        chooser.last.set_input_files(walk / "rgb" / "000005.jpg")
        page.wait_for_selector(".status")
        assert page.get_by_role("button", name="Hotel Hansa floor 2").count() == 1
        assert page.locator(".pin").count() >= 1
        assert "Hotel Hansa, floor 2" in page.inner_text(".mode .named >> nth=0")
        page.wait_for_selector('.pictures img[src^="data:image/png"]')
        page.wait_for_selector('.pictures img[src^="data:image/gif"]')  # particles, moving
        page.locator("summary", has_text="GeoPose").click()
        assert '"quaternion"' in page.inner_text("details pre")
        page.click(".pictures button >> nth=0")
        page.wait_for_selector("dialog[open] img")
        page.keyboard.press("Escape")
        page.wait_for_selector("dialog", state="detached")
        page.click(".floor .out")
        page.wait_for_selector(".floor", state="hidden")
        page.wait_for_selector(".pin.on")  # the pose is on the city's map, too
        page.wait_for_url("**scene=altbau**")


def test_a_home_of_no_town_has_a_plan_of_its_own(browser, url):
    with opened(browser, f"{url}#tab=inside&scene=home1", refused=True) as page:
        page.wait_for_selector('.map[data-stage="scene"]')
        still(page)
        assert page.locator(".credit").is_hidden()
        page.locator(".drop input[type=file]").last.set_input_files(
            {"name": "broken.jpg", "mimeType": "image/jpeg", "buffer": b"no image"}
        )
        page.wait_for_selector(".problem[role=alert]")
        assert "images[0]" in page.inner_text(".problem")
        assert page.inner_text(".problem").count("opy it again") == 1  # the mend
        page.click("#tab-here")
        page.fill("#text", KITCHEN)
        page.wait_for_selector('.map[data-stage="city"]')
        page.wait_for_selector(".pin.on")


@pytest.mark.parametrize("tab", ["constructor", "__proto__", "toString", "%00", "<b>"])
def test_a_tab_that_is_none_is_the_first(browser, url, tab):
    with opened(
        browser, f"{url}#tab={tab}&map={tab}&scene={tab}&answers=7&near=x&heading=x"
    ) as page:
        page.wait_for_selector(".examples button")
        assert page.get_attribute("#tab-here", "aria-selected") == "true"
        page.click("#tab-inside")
        page.wait_for_selector(".scenes")


def test_hostile_buildings_are_only_names(browser, url):
    with opened(browser, f"{url}#map=hostile") as page:
        still(page)
        page.locator(".door").click()
        inside(page)
        assert "onerror" in page.inner_text(".floor b")
        assert page.get_by_role("button", name="Floor <i>0").is_visible()
        page.click("#tab-inside")
        assert "onerror" in page.inner_text(".scenes")
        assert page.evaluate("window.hacked === undefined")
        assert page.locator(".map img, .scenes img").count() == 0


def test_plans_are_drawn_of_what_is_there(web):
    told = web.get("/v1/maps/altbau/drawing").json()
    assert {t["name"] for t in told["things"] if t["room"]} >= {"kitchen", "hall"}
    west, south, east, north = told["bounds"]
    for x, y, *_ in (thing["box"] for thing in told["things"]):
        assert west <= x <= east
        assert south <= y <= north
    pictures = [web.get(f"/v1/maps/altbau/drawing.png{dark}") for dark in ("", "?dark=1")]
    assert all(p.content.startswith(b"\x89PNG") for p in pictures)
    assert pictures[0].content != pictures[1].content
    wrong = web.get("/v1/maps/altbau/drawing.png", params={"scene": "attic"})
    assert (wrong.status_code, wrong.json()["detail"]) == (
        422, "scene: the map has no 'attic'; it has altbau.",
    )  # fmt: skip
    assert web.get("/v1/maps/hafenstadt/drawing.png").json()["code"] == "map_kind"
    [anchor] = {m["name"]: m for m in web.get("/v1/maps").json()["maps"]}["altbau"]["anchors"]
    assert (anchor["building"], anchor["level"]) == ("Hotel Hansa", "2")


SQUARE = "There is a fountain on the square."
EAR = """
window.SpeechRecognition = class {
  start() { window.ear = this; }
  stop() { this.onend(); }
  hear(text, isFinal) {
    const result = Object.assign([{ transcript: text }], { isFinal });
    this.onresult({ results: [result] });
  }
};
"""
DEAF = """
delete window.SpeechRecognition;
delete window.webkitSpeechRecognition;
delete Navigator.prototype.geolocation;
"""
LOST = "navigator.geolocation.watchPosition = (ok, no) => { no({ code: 2 }); return 1; };"
TURN = """a => dispatchEvent(new DeviceOrientationEvent(
    "deviceorientationabsolute", { alpha: a, beta: 0, gamma: 0, absolute: true }))"""
ALLOWED = ["geolocation", "accelerometer", "gyroscope", "magnetometer"]
PHONE = {"has_touch": True, "is_mobile": True, "viewport": {"width": 360, "height": 640}}


def test_what_is_spoken_is_asked_however_early(browser, url):
    with opened(browser, f"{url}#map=hafenstadt", first=EAR) as page:
        page.click("#voice")
        assert page.get_attribute("#voice", "aria-pressed") == "true"
        assert "its vendor's service" in page.inner_text("#note")
        page.evaluate("ear.hear('There is a', false)")
        assert page.input_value("#text") == "There is a"
        page.evaluate(f"ear.hear({SQUARE!r}, true)")
        page.wait_for_selector(".evidence .object")
        assert page.input_value("#text") == SQUARE
        page.evaluate("ear.onend()")
        assert page.get_attribute("#voice", "aria-pressed") == "false"


def test_a_deaf_ear_is_told_in_words(browser, url):
    told = {
        "not-allowed": "is not allowed to use the microphone", "network": "type instead",
        "no-speech": "Nothing was heard", "bad-grammar": "could not listen (bad-grammar)",
    }  # fmt: skip
    with opened(browser, f"{url}#map=hafenstadt", first=EAR) as page:
        for error, words in told.items():
            page.click("#voice")
            page.evaluate(f"ear.onerror({{ error: '{error}' }}); ear.onend()")
            assert words in page.inner_text("#note")
            assert page.get_attribute("#voice", "aria-pressed") == "false"


def test_satellites_and_compass_go_along_only_when_asked(browser, url):
    here = {"latitude": 53.5509, "longitude": 9.9935, "accuracy": 20}
    link = f"{url}#map=hafenstadt&q={SQUARE}"
    asked = []
    with opened(browser, link, permissions=ALLOWED, geolocation=here, **PHONE) as page:
        page.on(
            "websocket", lambda socket: socket.on("framesent", lambda sent: asked.extend([sent]))
        )
        page.reload()
        page.wait_for_selector(".status")
        assert asked
        assert not any("near" in sent or "heading" in sent for sent in asked)
        page.tap("#gps")
        page.wait_for_selector(".chip:has-text('of this device')")
        page.wait_for_url("**near=9.99350%2C53.55090&radius=150**")
        assert '"near":[9.9935,53.5509]' in asked[-1]
        page.tap("#compass")
        page.wait_for_selector("#compass[aria-pressed=true]")
        page.evaluate(TURN, 270)
        page.wait_for_selector(".chip:has-text('looking east (90°)')")
        page.wait_for_url("**heading=90**")
        assert '"heading_deg":90' in asked[-1]
        page.evaluate(TURN, 267)  # a hand that trembles
        assert page.is_visible(".chip:has-text('(90°)')")
        page.tap(".chip:has-text('looking')")
        page.tap(".chip:has-text('of this device')")
        page.wait_for_selector(".chip", state="detached")
        assert page.locator("[aria-pressed=true]:is(#gps, #compass)").count() == 0
        page.wait_for_function("!location.hash.includes('near')")


def test_what_is_denied_or_unknown_is_told_in_words(browser, url):
    with opened(browser, url) as page:
        page.click("#gps")
        page.wait_for_selector("#note:has-text('allow it for this page')")
        assert page.get_attribute("#gps", "aria-pressed") == "false"
    with opened(browser, url, first=LOST) as page:
        page.click("#gps")
        page.wait_for_selector("#note:has-text('The device has no position')")


def test_buttons_of_absent_senses_are_not_shown(browser, url):
    with opened(browser, url, first=DEAF) as page:
        still(page)
        assert page.locator("#voice:visible, #gps:visible, #compass:visible").count() == 0
        assert page.is_visible("#middle")
