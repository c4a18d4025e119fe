import asyncio
import concurrent.futures
import json
import os
import signal
import time

import pytest
from starlette.requests import Request
from starlette.responses import PlainTextResponse
from starlette.testclient import TestClient
from starlette.websockets import WebSocketDisconnect, WebSocketState

from placegraph_serve.limits import Guard, Keys, Metrics
from placegraph_serve.options import ServeOptions
from placegraph_serve.routes import live
from placegraph_serve.workers import answer
from serve_world import SENTENCE, ready, serving

SAID = {"text": SENTENCE}


def processes(client):
    (worker,) = client.app.state.server.sentences._workers
    return worker.process


def replaced(client):
    return client.app.state.server.sentences.replaced


@pytest.fixture(scope="module")
def bounded(town):
    with serving(town, processes=("sentences", "steps"), queue=1, sentence_seconds=4.0) as client:
        yield client


@pytest.fixture
def stopped(bounded):
    """The same, while its process is stopped."""
    ready(lambda: bounded.get("/healthz"))
    os.kill(processes(bounded).pid, signal.SIGSTOP)
    return bounded


def test_a_dead_process_is_told_and_replaced(stopped):
    process, before = processes(stopped), replaced(stopped)
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        asked = pool.submit(stopped.post, "/v1/locate", json=SAID)
        while not stopped.app.state.server.sentences.running:
            time.sleep(0.01)
        os.kill(process.pid, signal.SIGBUS)  # as where a map was cut short
        os.kill(process.pid, signal.SIGCONT)
        told = asked.result()
    assert (told.status_code, told.json()["code"]) == (500, "worker_died")
    assert "try again" in told.json()["detail"]
    assert replaced(stopped) == before + 1
    ready(lambda: stopped.get("/healthz"))
    assert stopped.post("/v1/locate", json=SAID).status_code == 200


def test_a_process_that_dies_is_replaced_at_once_and_the_others_answer(town):
    """Two processes: one is killed while requests wait, then one while it is idle."""
    with serving(town, processes=("sentences",), sentence_workers=2) as client:
        queue = client.app.state.server.sentences

        def wait(event):
            while not event():
                time.sleep(0.01)

        def both_idle():
            return len(queue._workers) == 2 and all(w.state == "idle" for w in queue._workers)

        wait(both_idle)
        with concurrent.futures.ThreadPoolExecutor(12) as pool:
            asked = [pool.submit(client.post, "/v1/locate", json=SAID) for _ in range(12)]
            wait(lambda: queue.running)
            os.kill(
                next(w for w in queue._workers if w.state == "busy").process.pid, signal.SIGKILL
            )
            codes = [answer.result().status_code for answer in asked]
        assert codes.count(200) >= 11
        wait(both_idle)
        assert queue.replaced == 1
        os.kill(next(iter(queue._workers)).process.pid, signal.SIGKILL)
        wait(lambda: queue.replaced == 2)
        assert [client.post("/v1/locate", json=SAID).status_code for _ in range(4)] == [200] * 4
        wait(both_idle)


def test_what_takes_too_long_ends_and_who_waits_is_sent_away(stopped):
    with concurrent.futures.ThreadPoolExecutor(3) as pool:
        asked = [pool.submit(stopped.post, "/v1/locate", json=SAID) for _ in range(3)]
        told = [a.result() for a in asked]
    codes = sorted(t.status_code for t in told)
    assert codes[-1] == 504
    assert 503 in codes
    for busy in (t for t in told if t.status_code == 503):
        assert (busy.json()["code"], int(busy.headers["retry-after"]) > 0) == ("busy", True)
    (late,) = (t for t in told if t.status_code == 504)
    assert late.json()["code"] == "too_long"
    ready(lambda: stopped.get("/healthz"))
    assert stopped.post("/v1/locate", json=SAID).status_code == 200


def test_a_session_whose_process_died_is_over(bounded):
    client = bounded
    lane = client.app.state.server.steps
    at = f"/v1/sessions/{client.post('/v1/sessions', json={}).json()['session']}"
    (worker,) = lane._workers
    os.kill(worker.process.pid, signal.SIGKILL)
    codes = [client.post(at, json=SAID).json()["code"] for _ in range(2)]
    assert codes[0] in {"worker_died", "session_over"}  # the same, or the one that replaced it
    assert codes[1] == "session_unknown"
    assert len(client.app.state.server.sessions) == 0
    ready(lambda: client.get("/healthz"))


def test_an_answer_that_is_no_json_is_a_problem(monkeypatch):
    monkeypatch.setattr("placegraph_serve.locate.locate", lambda *_: {"text": "\ud800"})
    body, trouble = answer(None, "locate", {})
    assert (body, trouble["code"]) == (None, "failed")


def test_all_bodies_together_are_bounded():
    async def app(scope, receive, send):
        await receive()
        await PlainTextResponse("read")(scope, receive, send)

    guard = Guard(app, ServeOptions(held_bytes=50), Keys(()), Metrics())
    client = TestClient(guard, base_url="http://127.0.0.1")
    full = client.post("/v1/locate", json=SAID)
    assert (full.status_code, full.json()["code"]) == (503, "busy")
    for _ in range(2):  # what was answered is held no more
        assert client.post("/v1/locate", json={"text": "A bakery is near."}).text == "read"


class SlowQueue:
    """Queue whose one worker is free once `free` is set."""

    def __init__(self):
        self.free, self.asked = asyncio.Event(), []

    async def ask(self, _verb, request):
        await self.free.wait()
        self.asked.append(request())
        await asyncio.sleep(0.01)
        return b"{}", None


def test_a_request_whose_client_left_is_not_asked(client):
    async def leave():
        queue = SlowQueue()

        async def receive():
            return {"type": "http.disconnect"}

        request = Request({"type": "http"}, receive)
        told = await client.app.state.server.ask(queue, "locate", SAID, request)
        queue.free.set()
        await asyncio.sleep(0.05)
        return told.status_code, queue.asked

    with concurrent.futures.ThreadPoolExecutor(
        1
    ) as pool:  # a browser's loop may run in this thread
        assert pool.submit(asyncio.run, leave()).result() == (499, [])


class TypedSocket:
    client_state = WebSocketState.CONNECTED

    def __init__(self):
        self.typed, self.sent = asyncio.Queue(), asyncio.Queue()

    async def accept(self):
        pass

    async def receive_text(self):
        if (text := await self.typed.get()) is None:
            raise WebSocketDisconnect
        return text

    async def send_text(self, text):
        await self.sent.put(json.loads(text))


def test_of_keys_typed_while_others_are_answered_the_newest_is_asked():
    async def type_keys():
        queue, socket = SlowQueue(), TypedSocket()
        answering = asyncio.create_task(live(socket, queue))
        for end in range(1, 10):
            socket.typed.put_nowait(json.dumps({"id": end, "text": SENTENCE[:end]}))
            await asyncio.sleep(0)
        await asyncio.sleep(0.01)
        queue.free.set()
        first = await socket.sent.get()
        socket.typed.put_nowait(json.dumps({"id": 10, "text": SENTENCE[:10]}))
        second = await socket.sent.get()
        socket.typed.put_nowait(None)
        await answering
        return first["id"], second["id"], [len(asked["text"]) for asked in queue.asked]

    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        assert pool.submit(asyncio.run, type_keys()).result() == (9, 10, [9, 10])
