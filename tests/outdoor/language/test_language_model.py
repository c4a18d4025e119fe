"""A language model as parser: a recorded answer, and every way to fail, from a local server."""

from __future__ import annotations

import json
import threading
import time
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from math import pi

import pytest

from placegraph.errors import DescriptionError, OptionError, ServiceError
from placegraph.outdoor.language import LanguageModelDescriber
from placegraph.outdoor.language.description import Relation

TEXT = "I'm at a bakery on Penn Avenue. Two benches are north of me, no trees. It is nice."
ANSWER = {
    "things": [
        {"words": "a bakery", "noun": "bakery", "name": "", "count": None, "definite": False},
        {"words": "Penn Avenue", "noun": "avenue", "name": "Penn Avenue"},
        {"words": "Two benches", "noun": "bench", "count": 2, "definite": False},
        {"words": "trees", "noun": "tree"},
    ],
    "statements": [
        {"relation": "same", "source": "speaker", "target": 0},
        {"relation": "along", "source": 0, "target": 1, "certainty": 0.9},
        {"relation": "direction", "source": 2, "target": "speaker", "bearing_deg": 360,
         "distance_m": None, "text": "Two benches are north of me"},
        {"relation": "visible", "source": 3, "target": "speaker", "negated": True},
        {"relation": "direction", "source": "speaker", "target": "listener", "bearing_deg": 45},
    ],
    "ignored": [{"text": "It is nice.", "reason": "says nothing about the place"}],
}  # fmt: skip


def reply(content):
    """Body of a chat completion, as such services send it."""
    return json.dumps(
        {"id": "1", "choices": [{"message": {"role": "assistant", "content": content}}]}
    ).encode()


@contextmanager
def service(body, *, status=200, delay=0.0):
    """Serve one body at an address on this machine; yield the address and what was asked."""
    asked = []

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self):
            length = int(self.headers["Content-Length"])
            asked.append((self.path, dict(self.headers), json.loads(self.rfile.read(length))))
            time.sleep(delay)
            try:
                self.send_response(status)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)
            except OSError:
                pass  # the client gave up

        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}/v1", asked
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def ask(body, text=TEXT, **options):
    timeout = options.pop("timeout", 5.0)
    with service(body, **options) as (address, asked):
        describer = LanguageModelDescriber(address, "small", api_key="key", timeout=timeout)
        return describer.describe(text), asked


def test_a_recorded_answer_becomes_a_query_graph():
    description, asked = ask(reply(json.dumps(ANSWER)))
    bakery, avenue, benches, trees = description.mentions[2:]
    assert (bakery.words, bakery.definite, bakery.senses[0].label) == (
        "a bakery",
        False,
        "shop=bakery",
    )
    assert avenue.name == "Penn Avenue"
    assert benches.count == 2
    same, along, north, no, far = description.statements
    assert (same.relation, same.source, same.target) == (Relation.SAME, 0, bakery.id)
    assert (along.relation, along.source, along.target, along.certainty) == (
        Relation.ALONG, bakery.id, avenue.id, 0.9,
    )  # fmt: skip
    assert (north.bearing, north.text) == (0.0, "Two benches are north of me")
    assert no.negated
    assert no.source == trees.id
    assert far.far
    assert far.bearing == pytest.approx(pi / 4)
    assert description.ignored[0].text == "It is nice."

    path, headers, request = asked[0]
    assert path == "/v1/chat/completions"
    assert headers["Authorization"] == "Bearer key"
    assert request["model"] == "small"
    assert request["messages"][-1] == {"role": "user", "content": TEXT}
    assert '"direction"' in request["messages"][0]["content"]


def changed(path, value):
    """Return the answer with another value at a path."""
    answer = json.loads(json.dumps(ANSWER))
    *way, last = path
    part = answer
    for key in way:
        part = part[key]
    part[last] = value
    return answer


@pytest.mark.parametrize(
    ("answer", "field"),
    [
        (changed(["statements", 0, "relation"], "above"), r"statements\[0\].relation"),
        (changed(["statements", 0, "target"], 9), r"statements\[0\].target"),
        (changed(["statements", 0, "target"], -1), r"statements\[0\].target"),
        (changed(["statements", 0, "target"], True), r"statements\[0\].target"),
        (changed(["statements", 0, "source"], "god"), r"statements\[0\].source"),
        (changed(["statements", 1, "source"], 1), r"statements\[1\].target"),
        (changed(["statements", 1, "certainty"], 2), r"statements\[1\].certainty"),
        (changed(["statements", 1, "distance_m"], -3), r"statements\[1\].distance_m"),
        (changed(["statements", 1, "bearing_deg"], 3), r"statements\[1\].bearing_deg"),
        (changed(["statements", 2, "bearing_deg"], None), r"statements\[2\].bearing_deg"),
        (changed(["statements", 2, "bearing_deg"], float("nan")), r"statements\[2\].bearing_deg"),
        (changed(["statements", 2, "bearing_deg"], 10**400), r"statements\[2\].bearing_deg"),
        (changed(["statements", 1, "relation"], "between"), r"statements\[1\].target2"),
        (changed(["statements", 0, "mood"], "good"), r"statements\[0\].mood"),
        (changed(["things", 0, "words"], None), r"things\[0\].words"),
        (changed(["things", 0], "a bakery"), r"things\[0\]"),
        (changed(["things"], [{"words": "x"}] * 500), "things has 500 items"),
        ({"things": [], "statements": []}, "answer.ignored is missing"),
        ([], "not of type object"),
        (None, "not of type object"),
    ],
)
def test_nonsense_is_refused_by_its_field(answer, field):
    with pytest.raises(ServiceError, match=field):
        ask(reply(json.dumps(answer)))


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"<html>",
        b"{}",
        b'{"choices": []}',
        b"[1]",
        b"\xff\xfe",
        reply("Sure! Here it is:"),
        reply(None),
    ],
)
def test_no_json_is_refused(body):
    with pytest.raises(ServiceError, match="is no JSON"):
        ask(body)


@pytest.mark.parametrize("status", [401, 404, 500, 503])
def test_a_refusal_is_told_with_its_code(status):
    with pytest.raises(ServiceError, match=f"{status}.*api_key"):
        ask(b"no", status=status)


def test_a_slow_service_is_given_up():
    with pytest.raises(ServiceError, match="timeout="):
        ask(reply("{}"), delay=1.0, timeout=0.2)


def test_an_endless_answer_is_given_up():
    with pytest.raises(ServiceError, match="longer than"):
        ask(b" " * 1_100_000)


def test_no_service_at_all():
    with service(b"") as (address, _):
        pass
    with pytest.raises(ServiceError, match="Is it running"):
        LanguageModelDescriber(address, "small", timeout=2.0).describe(TEXT)


def test_bad_texts_and_options_are_refused_before_anything_is_sent():
    with service(b"") as (address, asked):
        with pytest.raises(DescriptionError):
            LanguageModelDescriber(address, "small").describe(" ")
        assert asked == []
    with pytest.raises(OptionError, match="http"):
        LanguageModelDescriber("file:///etc/passwd", "small")
    with pytest.raises(OptionError, match="timeout"):
        LanguageModelDescriber("http://127.0.0.1/v1", "small", timeout=0)
