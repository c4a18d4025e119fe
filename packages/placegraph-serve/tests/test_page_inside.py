"""The way from the city into a building, in a real browser: plans, poses, images."""

from tests.browser import opened, still

KITCHEN = "I am in the Hotel Hansa, in the kitchen."
SCALE = "document.querySelector('.scale span').textContent"


def inside(page):
    """Wait until the plan fills the map."""
    page.wait_for_selector(".floor:not([hidden])")
    still(page)


def test_a_sentence_leads_from_the_city_into_the_room_and_back(browser, url):
    with opened(browser, f"{url}#q={KITCHEN}") as page:
        page.get_by_role("button", name="yes").click()  # in Hotel Hansa
        page.wait_for_selector(".chip:has-text('Hotel Hansa')")
        assert page.inner_text(".mode .named >> nth=0") == "kitchen, Hotel Hansa, floor 2"
        still(page)
        assert page.evaluate(SCALE) == "50 m"
        page.click(".modes .mode >> nth=0")
        inside(page)
        assert page.evaluate(SCALE) in {"1 m", "2 m"}
        assert page.inner_text(".floor b") == "Hotel Hansa"
        assert (
            page.get_by_role("button", name="Floor 2", exact=True).get_attribute("aria-pressed")
            == "true"
        )
        box = page.locator(".pin.on").bounding_box()  # it stands in the kitchen
        page.mouse.move(box["x"] + 60, box["y"] + 60)
        page.wait_for_selector(".tip:has-text('kitchen')")
        page.click(".floor .out")
        page.wait_for_selector(".floor", state="hidden")
        still(page)
        page.get_by_role("button", name="Enter Hotel Hansa").click()
        inside(page)
        page.click("#tab-inside")  # images that are taken now are of this flat
        page.wait_for_selector(".scenes [aria-pressed=true]:has-text('altbau')")
        assert {a.split("/")[2] for a in page.asked} == {url.split("/")[2]}


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
        assert page.get_by_role("button", name="altbau").inner_text().endswith("floor 2")
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
