"""Sessions of somebody who walks through a town."""

import asyncio
from concurrent.futures import ThreadPoolExecutor

import pytest

from placegraph.errors import RequestError
from placegraph_serve.options import ServeOptions
from placegraph_serve.requests import Begin, Step
from placegraph_serve.server import Sessions

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
    assert "give text, answers, east and north, or distance" in nothing.json()["detail"]


def test_questions_on_the_way_are_answered(walker):
    client, at = walker
    question = client.post(at, json={"text": "I see a bench."}).json()["question"]
    before = client.post(at, json={"distance": 0.0}).json()["estimate"]["modes"]
    answer = {"question": question, "option": question["options"][0]}
    told = client.post(at, json={"answers": [answer]}).json()
    assert told["estimate"]["modes"][0]["probability"] > before[0]["probability"]
    assert told["question"]["text"] != question["text"]
    assert client.post(at, json={"answers": [answer | {"option": "?"}]}).status_code == 422


def test_a_process_that_dies_holds_no_session():
    class WorkerQueue:
        died = b"", None

        async def ask(self, *_):
            return self.died

    async def visits():
        lane = WorkerQueue()
        sessions = Sessions(lane, ServeOptions())
        session = (await sessions.begin(Begin()))[0]["session"]
        lane.died = None, {"code": "worker_died"}
        assert (await sessions.begin(Begin()))[1]["code"] == "worker_died"
        assert len(sessions) == 1
        assert (await sessions.step(session, Step(text=SAID)))[1]["code"] == "worker_died"
        assert len(sessions) == 0

    with ThreadPoolExecutor(1) as pool:  # a browser's loop may run in this thread
        pool.submit(asyncio.run, visits()).result()


def test_their_number_is_bounded_and_they_end():
    class WorkerQueue:
        over = asyncio.Queue()

        async def ask(self, verb, asked):
            if verb == "end":
                self.over.put_nowait(asked["session"])
            return b"{}", None

    async def visits():
        sessions = Sessions(WorkerQueue(), ServeOptions(sessions=2, session_seconds=0.05))
        begun = [(await sessions.begin(Begin()))[0]["session"] for _ in range(2)]
        with pytest.raises(RequestError, match="end one, or come again") as full:
            await sessions.begin(Begin())
        assert (full.value.status, full.value.code) == (503, "busy")
        assert full.value.retry_after > 0
        assert [await WorkerQueue.over.get() for _ in range(2)] == begun
        with pytest.raises(RequestError) as gone:
            await sessions.step(begun[0], Step(text=SAID))
        assert (gone.value.status, gone.value.code) == (404, "session_unknown")
        assert (await sessions.begin(Begin()))[0]["expires_s"] == 0.05

    with ThreadPoolExecutor(1) as pool:  # a browser's loop may run in this thread
        pool.submit(asyncio.run, visits()).result()
