import asyncio
import math
from concurrent.futures import ThreadPoolExecutor

import pytest
from starlette.websockets import WebSocketDisconnect

import placegraph as pg
from placegraph.errors import RequestError
from placegraph_serve.options import ServeOptions
from placegraph_serve.requests import BeginSession, Step
from placegraph_serve.server import Sessions
from serve_world import SENTENCE


def test_maps_and_health(client):
    assert client.get("/healthz").json() == {"status": "ok"}
    (town,) = client.get("/v1/maps").json()["maps"]
    assert (town["name"], town["kind"]) == ("hafenstadt", "city")
    assert client.get("/").status_code == 200


def test_a_sentence_is_located(client, town):
    told = client.post("/v1/locate", json={"text": SENTENCE}).json()
    alone = pg.open_map(town).locate(SENTENCE)
    assert told["map"] == "hafenstadt"
    assert told["estimate"]["status"] == alone.status.name
    assert told["estimate"]["modes"][0]["longitude"] == pytest.approx(alone.best.longitude)
    assert told["geojson"]["type"] == "FeatureCollection"
    assert told["seconds"] > 0


def test_a_question_is_answered_by_sending_it_back(client):
    first = client.post("/v1/locate", json={"text": "I see a bench."}).json()
    question = first["question"]
    answer = {"question": question, "option": question["options"][0]}
    told = client.post("/v1/locate", json={"text": "I see a bench.", "answers": [answer]}).json()
    statements = [s["text"] for s in told["estimate"]["understood"]["statements"]]
    assert any(question["text"] in s for s in statements)
    answer["question"]["things"] = []
    bent = client.post("/v1/locate", json={"text": "I see a bench.", "answers": [answer]})
    assert bent.status_code == 422
    assert "send it back as it was asked" in bent.json()["detail"]


@pytest.mark.parametrize(
    ("body", "status", "code", "says"),
    [
        ({"text": ""}, 422, "description", "empty"),
        ({"text": "x" * 3000}, 422, "description", "at most 2000"),
        ({"text": "A bank", "map": "paris"}, 404, "map_unknown", "the maps are: hafenstadt"),
        ({"text": "A bank", "near": [1.0]}, 422, "fields", "near"),
        ({"text": "A bank", "near": [400, 91]}, 422, "option", "near"),
        ({"text": "A bank", "radius": -1}, 422, "fields", "radius"),
        ({"txt": "A bank"}, 422, "fields", "text"),
        ([], 422, "fields", "body"),
    ],
)
def test_bad_questions_have_problems(client, body, status, code, says):
    answer = client.post("/v1/locate", json=body)
    told = answer.json()
    assert answer.headers["content-type"] == "application/problem+json"
    assert (answer.status_code, told["status"], told["code"]) == (status, status, code)
    assert says in told["detail"]
    assert told["mend"]
    assert told["mend"].lower() in told["detail"].lower()


def test_methods_and_bodies_of_another_kind(client):
    wrong = client.get("/v1/locate")
    assert (wrong.status_code, wrong.headers["allow"], wrong.json()["code"]) == (
        405, "POST", "method",
    )  # fmt: skip
    assert client.get("/v1/locat").status_code == 404
    plain = client.post("/v1/locate", content='{"text": "A bank"}')
    assert plain.json()["mend"] == "Send one, as application/json."
    json = {"content-type": "application/json"}
    broken = client.post("/v1/locate", content='{"text": "A bank', headers=json)
    assert (broken.status_code, broken.json()["code"]) == (400, "json")
    assert broken.json()["detail"].startswith("body: not JSON (Unterminated string")


@pytest.mark.parametrize("method", ["PUT", "DELETE", "PATCH", "OPTIONS", "POST", "TRACE"])
def test_every_route_refuses_other_methods(client, method):
    ours = {
        "/v1/locate": "POST",
        "/v1/localize": "POST",
        "/geopose": "POST",
        "/v1/sessions": "POST",
    }
    for path in (*ours, "/", "/healthz", "/api", "/api/", "/v1/maps", "/v1/maps/x/drawing", "/docs",
                 "/v1/maps/x/drawing.png", "/v1/maps/x/drawing/0/0/0", "/parts/palette.css"):  # fmt: skip
        if ours.get(path) != method and not (method == "OPTIONS" and "api" in path):
            answer = client.request(method, path)
            assert (path, answer.status_code) == (path, 405)
            assert answer.headers["allow"]


def test_bytes_close_a_socket_with_a_code(client):
    with client.websocket_connect("/v1/live") as socket:
        socket.send_bytes(b"A bank")
        with pytest.raises(WebSocketDisconnect) as closed:
            socket.receive_json()
        assert closed.value.code == 1003


def test_answers_are_compressed(client):
    packed = client.post("/v1/locate", json={"text": SENTENCE})
    assert packed.headers["content-encoding"] == "gzip"
    assert int(packed.headers["content-length"]) < len(packed.content) / 2


def test_the_newest_of_what_is_typed_is_answered(client):
    with client.websocket_connect("/v1/live") as socket:
        for number, text in enumerate(["A", "A bak", SENTENCE]):
            socket.send_json({"id": number, "text": text})
        while (told := socket.receive_json())["id"] != 2:
            assert told["id"] in {0, 1}
        assert told["result"]["estimate"]["modes"]
        socket.send_text("{")
        assert socket.receive_json()["problem"]["mend"] == "Send an object."
        socket.send_json({"id": "q", "text": "A bank", "map": "paris"})
        told = socket.receive_json()
        assert (told["id"], told["problem"]["code"]) == ("q", "map_unknown")


def found(client, q, **more):
    return client.get("/api", params={"q": q} | more).json()["features"]


def test_names_have_photons_properties(client, town):
    city = pg.open_map(town)
    row = next(i for i in range(len(city.objects)) if "=" in city.objects.label(i)
               and city.objects.name(i).count(" ") == 1)  # fmt: skip
    name = city.objects.name(row)
    best = found(client, name)[0]
    assert best["properties"]["name"] == name
    assert set(best["properties"]) >= {"osm_type", "osm_id", "osm_key", "osm_value", "type"}
    assert best["properties"]["osm_type"] in "NWR"
    assert found(client, name[:-2].lower())[0]["properties"]["name"].startswith(name[:3])
    wrong = name[0] + name[2:]
    assert name in [f["properties"]["name"] for f in found(client, wrong)]


def test_what_is_near_comes_first(client):
    def distance(feature):
        lon, lat = feature["geometry"]["coordinates"]
        return ((lon - at[0]) * math.cos(math.radians(lat))) ** 2 + (lat - at[1]) ** 2

    everything = found(client, "bench", limit=50)
    at = everything[-1]["geometry"]["coordinates"]
    near = found(client, "bench", lon=at[0], lat=at[1], limit=50)
    distances = [distance(f) for f in near]
    assert distances == sorted(distances)
    assert len(near) == len(everything)
    assert len(found(client, "bench", limit=1)) == 1


def test_extents_run_from_the_north_west(client):
    extents = [f["properties"]["extent"] for f in found(client, "church") if
               "extent" in f["properties"]]  # fmt: skip
    assert extents
    for west, north, east, south in extents:
        assert west < east
        assert south < north


def test_a_sentence_is_found(client):
    best = found(client, SENTENCE)[0]
    asked = client.post("/v1/locate", json={"text": SENTENCE}).json()["estimate"]["modes"][0]
    assert best["geometry"]["coordinates"] == pytest.approx([asked["longitude"], asked["latitude"]])
    assert best["properties"]["osm_key"] == "placegraph"


def test_places_are_filtered_and_preferred(client):
    everything = found(client, "bench", limit=50)
    lon, lat = everything[0]["geometry"]["coordinates"]
    box = f"{lon - 1e-5},{lat - 1e-5},{lon + 1e-5},{lat + 1e-5}"
    assert len(found(client, "bench", bbox=box)) < len(everything)
    assert found(client, "bench", layer=["street", "city"]) == []
    assert len(found(client, "bench", layer="house", limit=50)) == len(everything)
    assert found(client, "bench", osm_tag="shop") == []
    assert len(found(client, "bench", osm_tag=["amenity:bench", "!shop"], limit=50)) == len(
        everything
    )
    assert found(client, "bench", osm_tag="!amenity:bench") == []
    assert found(client, "bench", lang="de", zoom=16, location_bias_scale=0.1, lon=lon, lat=lat)


def test_a_point_has_an_address(client):
    best = found(client, "bakery")[0]
    lon, lat = best["geometry"]["coordinates"]
    asked = {"lon": lon, "lat": lat}
    (there,) = client.get("/reverse/", params=asked).json()["features"]
    assert there["properties"]["osm_id"] == best["properties"]["osm_id"]
    (street,) = client.get("/reverse", params=asked | {"layer": "street"}).json()["features"]
    assert best["properties"]["street"] == street["properties"]["name"]
    assert client.get("/reverse", params=asked | {"lon": lon + 9}).json()["features"] == []
    far = asked | {"radius": 5000, "limit": 50, "layer": ["county"]}
    assert client.get("/reverse", params=far).json()["features"] == []
    near = client.get("/reverse", params=asked | {"radius": 5000, "limit": 3}).json()["features"]
    assert near[0]["properties"]["osm_id"] == best["properties"]["osm_id"]
    assert len(near) == 3


def test_search_boxes_of_other_pages_may_read_names_only(client):
    elsewhere = {"Origin": "https://maps.example.org"}
    answer = client.get("/api/", params={"q": "bakery"}, headers=elsewhere)
    assert (answer.status_code, answer.headers["access-control-allow-origin"]) == (200, "*")
    assert client.get("/v1/maps", headers=elsewhere).status_code == 403
    before = client.options("/api/", headers=elsewhere | {"Access-Control-Request-Method": "GET"})
    allowed = before.headers["access-control-allow-methods"]
    assert (before.status_code, allowed) == (204, "GET")
    assert client.options("/v1/maps", headers=elsewhere).status_code == 403
    refused = client.get("/api", params={"q": "a", "countrycode": "DE"}, headers=elsewhere)
    assert refused.json()["detail"].startswith("countrycode: ")
    assert "access-control-allow-origin" in refused.headers


def test_bad_searches(client):
    assert client.get("/api").json()["code"] == "fields"
    assert client.get("/api", params={"q": "a", "lat": 91}).status_code == 422
    for box in ("8,50,7,51", "7,51,8,50", "nan,50,8,51"):
        refused = client.get("/api", params={"q": "a", "bbox": box})
        assert "give minLon,minLat,maxLon,maxLat" in refused.json()["detail"]
    assert found(client, "xqzzy") == []
    assert found(client, "?") == []


@pytest.fixture
def walker(client):
    session = client.post("/v1/sessions", json={}).json()["session"]
    yield client, f"/v1/sessions/{session}"
    client.delete(f"/v1/sessions/{session}")


def test_one_client_holds_a_few_sessions(client):
    most = client.app.state.server.options.client_sessions
    begun = [client.post("/v1/sessions", json={}).json()["session"] for _ in range(most)]
    try:
        more = client.post("/v1/sessions", json={})
        assert (more.status_code, more.json()["code"]) == (429, "sessions")
        assert more.headers["retry-after"]
        client.delete(f"/v1/sessions/{begun.pop()}")
        answer = client.post("/v1/sessions", json={})
        begun.append(answer.json()["session"])
        assert answer.status_code == 201
    finally:
        for session in begun:
            assert client.delete(f"/v1/sessions/{session}").status_code == 204


def test_words_and_ways(walker, town):
    client, at = walker
    tracker = pg.open_map(town).track()
    for step, own in (
        ({"text": SENTENCE}, lambda: tracker.tell(SENTENCE)),
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
        session = (await sessions.open(BeginSession()))[0]["session"]
        lane.died = None, {"code": "worker_died"}
        assert (await sessions.open(BeginSession()))[1]["code"] == "worker_died"
        assert len(sessions) == 1
        assert (await sessions.step(session, Step(text=SENTENCE)))[1]["code"] == "worker_died"
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
        begun = [(await sessions.open(BeginSession()))[0]["session"] for _ in range(2)]
        with pytest.raises(RequestError, match="end one, or try again") as full:
            await sessions.open(BeginSession())
        assert (full.value.status, full.value.code) == (503, "busy")
        assert full.value.retry_after > 0
        assert [await WorkerQueue.over.get() for _ in range(2)] == begun
        with pytest.raises(RequestError) as gone:
            await sessions.step(begun[0], Step(text=SENTENCE))
        assert (gone.value.status, gone.value.code) == (404, "session_unknown")
        assert (await sessions.open(BeginSession()))[0]["expires_s"] == 0.05

    with ThreadPoolExecutor(1) as pool:  # a browser's loop may run in this thread
        pool.submit(asyncio.run, visits()).result()
