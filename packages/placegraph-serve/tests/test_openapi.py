"""The API as programs read it: references, schemas of real answers, and Schemathesis."""

import subprocess
import sys
from pathlib import Path

import httpx
import jsonschema
import pytest

from serve_world import SENTENCE, Running


@pytest.fixture(scope="module")
def document(client):
    return client.get("/openapi.json").json()


def nodes(value):
    yield value
    for inner in value.values() if isinstance(value, dict) else value:
        if isinstance(inner, dict | list):
            yield from nodes(inner)


def test_all_references_resolve(document):
    found = {node["$ref"] for node in nodes(document) if isinstance(node, dict) and "$ref" in node}
    assert {"LocateAnswer", "PriorPose", "ProblemAnswer"} <= {
        ref.rpartition("/")[2] for ref in found
    }
    for ref in found:
        at = document
        for part in ref.removeprefix("#/").split("/"):
            at = at[part]
    for path, methods in document["paths"].items():
        for method, operation in methods.items():
            assert operation["responses"]["default"], (path, method)
            for answer in operation["responses"].values():
                assert all(content["schema"] or kind in {"image/png", "text/plain"}
                           for kind, content in answer.get("content", {}).items())  # fmt: skip


def check(document, path, answer):
    operation = document["paths"][path][answer.request.method.lower()]
    response = operation["responses"].get(
        str(answer.status_code), operation["responses"]["default"]
    )
    (content,) = response["content"].values()
    assert answer.headers["content-type"].startswith(next(iter(response["content"])))
    schema = content["schema"] | {"components": document["components"]}
    jsonschema.validate(answer.json(), schema)
    return answer.json()


def test_real_answers_have_the_schema_that_is_documented(client, document):
    for path in ("/healthz", "/v1/maps"):
        check(document, path, client.get(path))
    for text in (SENTENCE, "Xyzzy.", "I am in the kitchen."):
        check(document, "/v1/locate", client.post("/v1/locate", json={"text": text}))
    check(document, "/v1/locate", client.post("/v1/locate", json={"text": SENTENCE, "map": "x"}))
    check(document, "/v1/locate", client.post("/v1/locate", json=[]))
    check(document, "/api", client.get("/api", params={"q": "church"}))
    check(document, "/reverse", client.get("/reverse", params={"lat": 53.55, "lon": 9.99}))
    check(document, "/geopose", client.post("/geopose", json={"sensorReadings": []}))
    session = check(document, "/v1/sessions", client.post("/v1/sessions", json={}))["session"]
    at = f"/v1/sessions/{session}"
    check(document, "/v1/sessions/{session}", client.post(at, json={"text": SENTENCE}))
    assert client.delete(at).status_code == 204


def test_answers_to_images_have_the_schema_that_is_documented(running, walk):
    document = httpx.get(f"{running.url}/openapi.json").json()
    picture = (walk / "rgb" / "000004.jpg").read_bytes()
    answer = httpx.post(f"{running.url}/v1/localize", files={"images": picture}, timeout=60)
    assert check(document, "/v1/localize", answer)["estimate"]["modes"]


@pytest.mark.all
def test_schemathesis_finds_nothing(town, flat):
    """But that valid bodies may name maps and languages that the server lacks."""
    program = Path(sys.executable).with_name("schemathesis")
    if not program.is_file():
        pytest.skip("schemathesis is not installed; run make venv")
    server = Running(town, flat, "--port", "0")
    words = [program, "run", f"{server.url}/openapi.json", "--max-examples", "20", "--no-color",
             "--exclude-checks", "positive_data_acceptance"]  # fmt: skip
    done = subprocess.run(words, capture_output=True, text=True, check=False)  # noqa: S603
    code, _ = server.end()
    assert (code, done.returncode) == (0, 0), done.stdout[-6000:]
