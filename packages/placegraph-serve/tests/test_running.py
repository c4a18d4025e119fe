import base64
import concurrent.futures
import json
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
from pathlib import Path

import httpx
import pytest
from tests.browser import opened

from placegraph.errors import OptionError
from placegraph_serve.app import listen
from serve_world import SENTENCE, Running, ready

SAID = {"text": SENTENCE, "map": "hafenstadt"}


@pytest.fixture(scope="module")
def small(town, tmp_path_factory):
    """A server with tiny limits, keys, and a log of what is asked, under its own program."""
    folder = tmp_path_factory.mktemp("small")
    shutil.copy(town, folder)
    (folder / "keys").write_text("# ours\nsecret\nother\n")
    (folder / "serve.py").write_text(
        "import sys\n"
        "from pathlib import Path\n"
        "from placegraph_serve.options import ServeOptions\n"
        "from placegraph_serve.places import Places\n"
        "from placegraph_serve.app import serve\n"
        "if __name__ == '__main__':\n"
        "    options = ServeOptions(head_seconds=0.5, body_seconds=1.0, json_bytes=3000, depth=8,\n"
        "        sentence_workers=1, keys=Path('keys'), log_queries=True)\n"
        "    say = lambda url: print('Serving at ' + url, flush=True)\n"
        "    serve(Places(['hafenstadt.city']), options, '127.0.0.1', 0, say)\n"
    )
    server = Running(program="serve.py", cwd=folder)
    ready(lambda: httpx.post(f"{server.url}/v1/locate?key=secret", json=SAID, timeout=60))
    yield server
    code, said = server.end()
    assert code == 0
    assert "locate" in said
    assert "The church is east of the bakery" in said
    assert "secret" not in said


def spoken(server, *parts, wait=b""):
    with socket.create_connection(("127.0.0.1", server.port), timeout=30) as wire:
        for part in parts:
            wire.sendall(part)
        told = b""
        while chunk := wire.recv(65536):
            told += chunk
            if wait and wait in told:
                break
        return told


def head(length, path="/v1/locate", **more):
    lines = [f"POST {path} HTTP/1.1", "Host: localhost", "Content-Type: application/json",
             "Authorization: Bearer secret", f"Content-Length: {length}",
             *(f"{k}: {v}" for k, v in more.items())]  # fmt: skip
    return ("\r\n".join(lines) + "\r\n\r\n").encode()


def test_slow_heads_are_given_up_the_first_and_the_next(small):
    assert spoken(small, b"POST /v1/locate HTT") == b""
    told = spoken(
        small, b"GET /v1/maps HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer secret\r\n\r\nGET"
    )
    assert told.count(b"HTTP/1.1") == 1


def test_a_websocket_may_be_silent_for_longer_than_a_head(small):
    from websockets.sync.client import connect

    with connect(f"ws://127.0.0.1:{small.port}/v1/live?key=secret") as live:
        with pytest.raises(TimeoutError):
            live.recv(timeout=0.8)
        live.send(json.dumps({"id": 7} | SAID))
        assert json.loads(live.recv(timeout=30))["id"] == 7


class CountedSocket(socket.socket):
    received = 0

    def recv(self, *args):
        data = super().recv(*args)
        self.received += len(data)
        return data


def merged(before, changes):
    if not isinstance(changes, dict):
        return changes
    before = before if isinstance(before, dict) else {}
    return before | {key: merged(before.get(key), value) for key, value in changes.items()}


@pytest.mark.parametrize("scope", ["hafenstadt", None])
def test_a_sentence_typed_key_by_key_costs_below_150_kb(running, scope):
    """Bytes on the wire, of a town and of all maps; the changes add up to the answer of /v1/locate."""
    from websockets.sync.client import connect

    wire, answer, asked = CountedSocket(), {}, {"map": scope, "changes": True}
    wire.connect(("127.0.0.1", running.port))
    with connect(f"ws://127.0.0.1:{running.port}/v1/live", sock=wire) as live:
        for end in range(1, len(SENTENCE) + 1):
            live.send(json.dumps(asked | {"id": end, "text": SENTENCE[:end]}))
            told = json.loads(live.recv(timeout=60))
            assert told["id"] == end
            answer = merged(answer, told["changes"])
        assert wire.received < 150_000
        live.send(json.dumps({"text": SENTENCE, "map": scope}))
        whole = json.loads(live.recv(timeout=60))["result"]
    for told in (answer, whole):
        assert told.pop("seconds") > 0
    assert {key: value for key, value in answer.items() if value is not None} == {
        key: value for key, value in whole.items() if value is not None
    }
    posted = {"text": SENTENCE, "map": scope}
    plain = httpx.post(f"{running.url}/v1/locate", json=posted, timeout=60).json()
    assert whole["estimate"] == plain["estimate"]
    assert plain["geojson"]["features"]
    assert "geojson" not in whole


@pytest.mark.parametrize(
    ("length", "body", "status", "code"),
    [
        (500, b'{"text": "a"}', b"408", b"slow"),  # less than announced
        (10**15, b"{", b"413", b"body_size"),
        (5, b'{"text": "a"}', b"400", b"json"),  # more than announced: cut, and the rest no HTTP
    ],
)
def test_lengths_that_lie(small, length, body, status, code):
    told = spoken(small, head(length), body)
    assert told.startswith(b"HTTP/1.1 " + status)
    assert b'"code":"' + code in told
    assert b'"estimate"' not in told


def test_what_is_no_http(small):
    told = spoken(small, b"\x16\x03\x01 let me in\r\n\r\n")
    assert told.startswith(b"HTTP/1.1 400")
    assert b"content-type: application/problem+json" in told.lower()
    assert json.loads(told.partition(b"\r\n\r\n")[2])["code"] == "http"


def test_a_websocket_s_key_that_is_no_ascii(small):
    lines = ["GET /v1/live?key=secret HTTP/1.1", "Host: x", "Upgrade: websocket", "Connection: Upgrade",
             "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ=\xe9", "Sec-WebSocket-Version: 13"]  # fmt: skip
    told = spoken(small, ("\r\n".join(lines) + "\r\n\r\n").encode("latin-1"))
    assert told.startswith(b"HTTP/1.1 400")


def test_chunks_without_end_are_counted(small):
    chunks = [b"%x\r\n%s\r\n" % (1000, b" " * 1000)] * 5
    start = head(0).replace(b"Content-Length: 0", b"Transfer-Encoding: chunked")
    assert b'"code":"body_size"' in spoken(small, start, *chunks, wait=b"body_size")


@pytest.mark.parametrize("bomb", [b"[" * 2900, b'{"text":' * 300, b"[" * 9 + b"]" * 9])
def test_nested_json(small, bomb):
    assert b'"code":"nested"' in spoken(small, head(len(bomb)), bomb, wait=b"nested")


@pytest.mark.parametrize(
    ("headers", "path", "status"),
    [
        ({}, "/v1/maps", 401),
        ({"Authorization": "Bearer secre"}, "/v1/maps", 401),
        ({"Authorization": "Bearer # ours"}, "/v1/maps", 401),
        ({"Authorization": "Bearer other"}, "/v1/maps", 200),
        ({"X-API-Key": "secret"}, "/v1/maps", 200),
        ({}, "/v1/maps?key=secret", 200),
        ({}, "/metrics", 401),
        ({}, "/api?q=bakery", 401),
        ({}, "/api.js", 200),
        ({}, "//v1/maps", 404),
        ({}, "/healthz", 200),
        ({}, "/", 200),
    ],
)
def test_keys(small, headers, path, status):
    answer = httpx.get(small.url + path, headers=headers)
    assert answer.status_code == status
    assert ("access-control-allow-origin" in answer.headers) == path.startswith("/api?")


def test_the_page_asks_for_the_key(browser, small):
    with opened(browser, f"{small.url}/", refused=True) as page:
        page.fill("[type=password]", "wrong")
        page.keyboard.press("Enter")
        page.wait_for_selector(".problem:has-text('The key is not valid')")
        page.fill("[type=password]", "secret")
        page.keyboard.press("Enter")
        page.wait_for_selector(".examples button")
        page.fill("#text", SAID["text"])
        page.wait_for_selector(".status")
        assert "secret" not in page.url


def test_websockets_need_keys_and_a_page_of_this_host(small):
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    at = f"ws://127.0.0.1:{small.port}/v1/live"
    for url, origin in ((at, None), (f"{at}?key=secret", "https://evil.example")):
        with pytest.raises(InvalidStatus):
            connect(url, origin=origin)


def test_docs_load_nothing_from_elsewhere(running):
    page = httpx.get(f"{running.url}/docs")
    assert "default-src 'none'" in page.headers["content-security-policy"]
    assert "<script" not in page.text
    assert not [part for part in page.text.split('"') if part.startswith(("http", "//"))]
    for word in ("POST /v1/locate", "WS /v1/live", "heading_deg", "intrinsics", "POST /geopose"):
        assert word in page.text


def test_the_first_line_names_all_maps(maps, tmp_path, run, monkeypatch):
    monkeypatch.setattr("placegraph_serve.app.serve", lambda *given: given[-1]("http://there"))
    names = [f"home{i}" for i in range(1, 11)]
    for name in names:
        shutil.copy(maps / "home1.scene", tmp_path / f"{name}.scene")
    assert f"Serving {', '.join(sorted(names))} at http://there " in run("serve", tmp_path).out


def test_two_servers_on_one_port(running, town, run):
    again = run("serve", town, "--port", running.port)
    assert again.code == OptionError.exit_code
    assert "another program uses" in again.err


def test_a_map_replaced_and_deleted_under_load(running):
    scene = running.folder / "altbau.scene"
    spare, new = scene.with_suffix(".spare"), scene.with_suffix(".new")
    shutil.copy(scene, spare)
    asked = {"text": "I am in the kitchen of Hotel Hansa"}

    def ask(_):
        return httpx.post(f"{running.url}/v1/locate", json=asked, timeout=60)

    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        answers = pool.map(ask, range(12))
        for _ in range(3):
            shutil.copy(spare, new)
            new.replace(scene)
        scene.unlink()
        try:
            gone = httpx.get(f"{running.url}/v1/maps/altbau/plan.png", timeout=60)
            codes = {answer.status_code for answer in answers}
        finally:
            spare.replace(scene)
    assert gone.status_code in {404, 503}
    assert gone.json()["mend"]
    assert codes <= {200, 404, 503, 504}  # a busy machine is late
    told = next(a for a in map(ask, range(9)) if a.status_code != 504)
    assert told.json()["estimate"]["modes"][0]["scene"] == "altbau"


def test_worlds_are_asked_with_no_map_named(running, walk):
    picture = (walk / "rgb" / "000017.jpg").read_bytes()
    told = httpx.post(f"{running.url}/v1/localize", files={"images": picture}, timeout=60).json()
    assert told["map"] == "altbau"
    assert told["geopose"]["position"]["lat"] == pytest.approx(53.55, abs=1e-3)
    reading = {
        "sensorId": "0",
        "imageBytes": base64.b64encode(picture).decode(),
        "size": [320, 180],
    }
    asked = {
        "id": "w", "timestamp": 1, "type": "geopose", "sensors": [{"id": "0", "type": "camera"}],
        "sensorReadings": {"cameraReadings": [reading]},
    }  # fmt: skip
    unsure = httpx.post(f"{running.url}/geopose", json=asked, timeout=60)  # without intrinsics
    assert (unsure.status_code, unsure.json()["code"]) == (422, "no_pose")
    fix = {"sensorId": "1", "latitude": 53.55, "longitude": 9.999, "accuracy": 15}
    asked["sensorReadings"]["geolocationReadings"] = [fix]
    told = httpx.post(f"{running.url}/geopose", json=asked, timeout=60).json()
    assert told["source"] == ("images" if told["status"] == "OK" else "geolocation")
    assert told["modes"][0]["position"]["lat"] == pytest.approx(53.55, abs=1e-3)


def test_questions_of_a_world_are_answered(running):
    def ask(**more):
        return httpx.post(
            f"{running.url}/v1/locate", json={"text": "I see a bench."} | more, timeout=60
        )

    first = ask(top=2).json()
    assert len(first["estimate"]["modes"]) <= 2
    assert ask(top=1).json()["estimate"]["modes"] == first["estimate"]["modes"][:1]
    question = first["question"]
    answers = [{"question": question, "option": question["options"][0]}]
    told = ask(answers=answers).json()
    assert told["estimate"]["modes"] != first["estimate"]["modes"]
    assert ask(language="xx").status_code == 422


PAGE = Path(__file__).parents[3] / "docs" / "howto-serve.md"
LINES = re.findall(r"^curl .*$", PAGE.read_text("utf-8"), re.MULTILINE)


@pytest.mark.parametrize("line", LINES, ids=lambda line: line[:60])
def test_curl(line, running, walk, tmp_path):
    if shutil.which("curl") is None:
        pytest.skip("curl is not installed")
    (tmp_path / "walk").symlink_to(walk)
    words = shlex.split(line.replace("http://127.0.0.1:8000", running.url))
    out = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=True)  # noqa: S603
    if "-o" in words:
        assert (tmp_path / "plan.png").read_bytes().startswith(b"\x89PNG")
    elif "/metrics" in line:
        assert "placegraph_requests_total{" in out.stdout
    else:
        told = json.loads(out.stdout)
        assert "code" not in told, told
        assert told.get("maps") or told.get("features") or told["estimate"]["modes"]


def test_answers_do_not_wait_for_the_client():
    with listen("127.0.0.1", 0) as listening, socket.create_connection(listening.getsockname()):
        taken, _ = listening.accept()
        with taken:
            assert taken.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)


def test_sigterm_lets_a_running_answer_end(small):
    """The last question to this server, whose fixture looks at how it ended."""
    body = json.dumps(SAID).encode()
    with socket.create_connection(("127.0.0.1", small.port), timeout=60) as wire:
        # the request has begun, since it was answered with 100
        wire.sendall(head(len(body), Expect="100-continue"))
        assert wire.recv(100).startswith(b"HTTP/1.1 100")
        os.kill(small.process.pid, signal.SIGTERM)
        wire.sendall(body)
        told = b""
        while chunk := wire.recv(65536):
            told += chunk
    assert told.startswith(b"HTTP/1.1 200")
    assert b'"estimate"' in told
