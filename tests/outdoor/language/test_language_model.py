from __future__ import annotations

import json
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from math import pi
from types import SimpleNamespace

import pytest

from placegraph.errors import DescriptionError, OptionError, ServiceError
from placegraph.outdoor.language import LanguageModelDescriber
from placegraph.outdoor.language.description import Relation
from placegraph.outdoor.language.language_model import Answer
from placegraph.outdoor.language.vocabulary import Vocabulary

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


@pytest.fixture(scope="module")
def service():
    """A service on this machine: its address, what it was asked, and what it answers with."""
    now = SimpleNamespace(asked=[], body=b"", status=200, delay=0.0)

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self):
            length = int(self.headers["Content-Length"])
            now.asked.append((self.path, dict(self.headers), json.loads(self.rfile.read(length))))
            time.sleep(now.delay)
            try:
                self.send_response(now.status)
                self.send_header("Content-Length", str(len(now.body)))
                self.end_headers()
                self.wfile.write(now.body)
            except OSError:
                pass  # the client gave up

        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True)
    thread.start()
    now.address = f"http://127.0.0.1:{server.server_address[1]}/v1"
    yield now
    server.shutdown()
    thread.join()
    server.server_close()


def ask(service, body, *, status=200, delay=0.0, timeout=5.0):
    service.asked.clear()
    service.body, service.status, service.delay = body, status, delay
    describer = LanguageModelDescriber(service.address, "small", api_key="key", timeout=timeout)
    return describer.describe(TEXT)


def test_a_recorded_answer_becomes_a_query_graph(service):
    description = ask(service, reply(json.dumps(ANSWER)))
    bakery, avenue, benches, trees = description.mentions[2:]
    assert (bakery.words, bakery.definite) == ("a bakery", False)
    assert bakery.senses[0].label == "shop=bakery"
    assert avenue.name == "Penn Avenue"
    assert benches.count == 2
    same, along, north, no, far = description.statements
    assert (same.relation, same.source, same.target) == (Relation.SAME, 0, bakery.id)
    assert (along.relation, along.source, along.target) == (Relation.ALONG, bakery.id, avenue.id)
    assert along.certainty == 0.9
    assert (north.bearing, north.text) == (0.0, "Two benches are north of me")
    assert no.negated
    assert no.source == trees.id
    assert far.far
    assert far.bearing == pytest.approx(pi / 4)
    assert description.ignored[0].text == "It is nice."

    path, headers, request = service.asked[0]
    assert path == "/v1/chat/completions"
    assert headers["Authorization"] == "Bearer key"
    assert request["model"] == "small"
    assert request["messages"][-1] == {"role": "user", "content": TEXT}
    assert '"direction"' in request["messages"][0]["content"]


NONSENSE = [
    (["statements", 0, "relation"], "above", r"statements\[0\].relation"),
    (["statements", 0, "target"], 9, r"statements\[0\].target"),
    (["statements", 0, "target"], -1, r"statements\[0\].target"),
    (["statements", 0, "target"], True, r"statements\[0\].target"),
    (["statements", 0, "source"], "god", r"statements\[0\].source"),
    (["statements", 1, "source"], 1, r"statements\[1\].target"),
    (["statements", 1, "certainty"], 2, r"statements\[1\].certainty"),
    (["statements", 1, "distance_m"], -3, r"statements\[1\].distance_m"),
    (["statements", 1, "bearing_deg"], 3, r"statements\[1\].bearing_deg"),
    (["statements", 2, "bearing_deg"], None, r"statements\[2\].bearing_deg"),
    (["statements", 2, "bearing_deg"], float("nan"), r"statements\[2\].bearing_deg"),
    (["statements", 2, "bearing_deg"], 10**400, r"statements\[2\].bearing_deg"),
    (["statements", 1, "relation"], "between", r"statements\[1\].target2"),
    (["statements", 0, "mood"], "good", r"statements\[0\].mood"),
    (["things", 0, "words"], None, r"things\[0\].words"),
    (["things", 0], "a bakery", r"things\[0\]"),
    (["things"], [{"words": "x"}] * 500, "things has 500 items"),
]


def test_nonsense_is_refused_by_its_field(service):
    for path, value, field in NONSENSE:
        answer = json.loads(json.dumps(ANSWER))
        part = answer
        for key in path[:-1]:
            part = part[key]
        part[path[-1]] = value
        with pytest.raises(ServiceError, match=field):
            Answer(answer, "here").describe(TEXT, Vocabulary.default())
    for answer in ([], None):
        with pytest.raises(ServiceError, match="not of type object"):
            Answer(answer, "here")
    with pytest.raises(ServiceError, match=r"answer\.ignored is missing"):
        ask(service, reply('{"things": [], "statements": []}'))


def test_no_json_is_refused(service):
    bodies = (b"", b"<html>", b"{}", b'{"choices": []}', b"[1]", b"\xff\xfe")
    for body in (*bodies, reply("Sure!"), reply(None)):
        with pytest.raises(ServiceError, match="is not JSON"):
            ask(service, body)


def test_a_service_that_fails_is_given_up(service):
    for status in (401, 404, 500, 503):
        with pytest.raises(ServiceError, match=f"{status}.*api_key"):
            ask(service, b"no", status=status)
    with pytest.raises(ServiceError, match="timeout="):
        ask(service, reply("{}"), delay=0.3, timeout=0.1)
    with pytest.raises(ServiceError, match="longer than"):
        ask(service, b" " * 1_100_000)
    with pytest.raises(ServiceError, match="check that it is running"):
        LanguageModelDescriber("http://127.0.0.1:9/v1", "small", timeout=2.0).describe(TEXT)


def test_bad_texts_and_options_are_refused_before_anything_is_sent(service):
    service.asked.clear()
    with pytest.raises(DescriptionError):
        LanguageModelDescriber(service.address, "small").describe(" ")
    assert service.asked == []
    with pytest.raises(OptionError, match="http"):
        LanguageModelDescriber("file:///etc/passwd", "small")
    with pytest.raises(OptionError, match="timeout"):
        LanguageModelDescriber("http://127.0.0.1/v1", "small", timeout=0)
