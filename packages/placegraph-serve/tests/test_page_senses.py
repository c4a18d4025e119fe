"""What the device knows, in a real browser: voice, satellites and compass, granted, denied and absent."""

from tests.browser import opened, still

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
        assert "a service of its maker" in page.inner_text("#note")
        page.evaluate("ear.hear('There is a', false)")
        assert page.input_value("#text") == "There is a"
        page.evaluate(f"ear.hear({SQUARE!r}, true)")
        page.wait_for_selector(".evidence .object")
        assert page.input_value("#text") == SQUARE
        page.evaluate("ear.onend()")
        assert page.get_attribute("#voice", "aria-pressed") == "false"


def test_a_deaf_ear_is_told_in_words(browser, url):
    told = {
        "not-allowed": "may not use the microphone", "network": "type instead",
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
        page.wait_for_selector("#note:has-text('may not tell where it is; allow it')")
        assert page.get_attribute("#gps", "aria-pressed") == "false"
    with opened(browser, url, first=LOST) as page:
        page.click("#gps")
        page.wait_for_selector("#note:has-text('does not know where it is')")


def test_buttons_of_absent_senses_are_not_shown(browser, url):
    with opened(browser, url, first=DEAF) as page:
        still(page)
        assert page.locator("#voice:visible, #gps:visible, #compass:visible").count() == 0
        assert page.is_visible("#middle")
