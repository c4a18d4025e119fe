"""Routes, asked through the application with real processes behind them."""

import pytest

SENTENCE = "A bakery is north of me. The church is east of the bakery."


def test_maps_and_health(client):
    assert client.get("/healthz").json() == {"status": "ok"}
    (town,) = client.get("/v1/maps").json()["maps"]
    assert (town["name"], town["kind"]) == ("hafenstadt", "city")
    assert client.get("/").status_code == 200


def test_a_sentence_is_located(client, town):
    import placegraph as pg

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
    assert "send it back unchanged" in bent.json()["detail"]


@pytest.mark.parametrize(
    ("body", "status", "code", "says"),
    [
        ({"text": ""}, 422, "description", "empty"),
        ({"text": "x" * 3000}, 422, "description", "at most 2000"),
        ({"text": "A bank", "map": "paris"}, 404, "map_unknown", "known are: hafenstadt"),
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
