"""Processes that die, take too long, or are all taken."""

import concurrent.futures
import os
import signal

import pytest
from tests.serve.conftest import ready, serving

SAID = {"text": "A bakery is north of me. The church is east of the bakery."}


def processes(client):
    (worker,) = client.app.state.server.sentences._workers
    return worker.process


def replaced(client):
    return client.app.state.server.sentences.replaced


@pytest.fixture
def stopped(town):
    """A client whose one process is stopped, with a tiny limit of seconds and a queue of one."""
    with serving(town, sentence_workers=1, queue=1, sentence_seconds=4.0) as client:
        os.kill(processes(client).pid, signal.SIGSTOP)
        yield client


def test_a_dead_process_is_told_and_replaced(stopped):
    process = processes(stopped)
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        asked = pool.submit(stopped.post, "/v1/locate", json=SAID)
        while not stopped.app.state.server.sentences.running:
            pass
        os.kill(process.pid, signal.SIGKILL)
        told = asked.result()
    assert (told.status_code, told.json()["code"]) == (500, "worker_died")
    assert "ask again" in told.json()["detail"]
    assert replaced(stopped) == 1
    ready(lambda: stopped.get("/healthz"))
    assert stopped.post("/v1/locate", json=SAID).status_code == 200


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


def test_all_bodies_together_are_bounded(town):
    with serving(town, sentence_workers=1, held_bytes=50) as client:
        full = client.post("/v1/locate", json=SAID)
        assert (full.status_code, full.json()["code"]) == (503, "busy")
        assert client.post("/v1/locate", json={"text": "A bakery is near."}).status_code == 200
        assert client.post("/v1/locate", json={"text": "A church is near."}).status_code == 200


@pytest.mark.parametrize("log", [True, False])
def test_nothing_asked_is_logged_unless_wanted(town, caplog, log):
    with caplog.at_level("DEBUG"), serving(town, sentence_workers=1, log_queries=log) as client:
        client.post("/v1/locate", json=SAID)
        client.post("/v1/locate", json={"text": "", "map": "nowhere"})
    assert ("The church is east" in caplog.text.replace("httpx", "")) == log
