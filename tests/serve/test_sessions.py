"""Sessions of somebody who walks through a town."""

import threading
import time

import pytest
from tests.serve.conftest import serving

SAID = "A bakery is north of me. The church is east of the bakery."


@pytest.fixture
def walker(client):
    session = client.post("/v1/sessions", json={}).json()["session"]
    yield client, f"/v1/sessions/{session}"
    client.delete(f"/v1/sessions/{session}")


def test_words_and_ways(walker, town):
    import placegraph as pg

    client, at = walker
    tracker = pg.open_map(town).track()
    for step, own in (
        ({"text": SAID}, lambda: tracker.tell(SAID)),
        ({"east": 30.0, "north": 5.0}, lambda: tracker.move(30.0, 5.0)),
        ({"distance": 20.0, "bearing_deg": 180.0}, lambda: tracker.walk(20.0, 3.141592653589793)),
    ):
        told = client.post(at, json=step).json()
        known = own()
        assert told["estimate"]["status"] == known.status.name
        assert told["estimate"]["modes"][0]["longitude"] == pytest.approx(known.best.longitude)
    nothing = client.post(at, json={})
    assert nothing.status_code == 422
    assert "give text, east and north, or distance" in nothing.json()["detail"]


def test_their_number_is_bounded_and_they_end(town):
    with serving(town, sentence_workers=1, sessions=2, session_seconds=2.0) as client:
        ids = [client.post("/v1/sessions", json={}).json()["session"] for _ in range(2)]
        full = client.post("/v1/sessions", json={})
        assert (full.status_code, full.json()["code"]) == (503, "busy")
        assert int(full.headers["retry-after"]) > 0
        end = time.monotonic() + 30
        while client.post("/v1/sessions", json={}).status_code != 201:
            assert time.monotonic() < end
            threading.Event().wait(0.1)
        gone = client.post(f"/v1/sessions/{ids[0]}", json={"text": SAID})
        assert (gone.status_code, gone.json()["code"]) == (404, "session_unknown")
