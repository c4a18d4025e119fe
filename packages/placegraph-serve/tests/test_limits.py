import httpx
import pytest
from starlette.responses import PlainTextResponse
from starlette.testclient import TestClient
from starlette.websockets import WebSocketDisconnect

from placegraph_serve.limits import Guard, Keys, Metrics
from placegraph_serve.options import ServeOptions


async def _app(scope, receive, send):
    if scope["type"] == "websocket":
        await receive()
        await send({"type": "websocket.accept"})
        await send({"type": "websocket.close"})
    else:
        await PlainTextResponse("answered")(scope, receive, send)


def asking(host, keys=(), **options):
    guard = Guard(_app, ServeOptions(**options), Keys(keys), Metrics())
    return TestClient(guard, base_url=f"http://{host}")


NAMES = ("robot.local", "maps.example.org")


@pytest.mark.parametrize(
    "host",
    [
        "127.0.0.1:8000", "127.0.0.1", "localhost:8000", "LOCALHOST", "map.localhost", "[::1]:8000",
        "192.168.1.7:8000", "[fe80::1]:8000", "robot.local:8000", "maps.example.org",
    ],
)  # fmt: skip
def test_addresses_localhost_and_names_that_were_given_are_its_own(host):
    assert asking(host, names=NAMES).get("/v1/maps").text == "answered"


@pytest.mark.parametrize(
    "host",
    [
        "evil.example", "evil.example:8000", "127.0.0.1.evil.example", "localhost.evil.example",
        "notlocalhost", "maps.local:8000", "evil.example.", "127.1", "2130706433", "[", "[::1", "a]b",
        "@", "\xff",
    ],
)  # fmt: skip
@pytest.mark.parametrize("path", ["/", "/v1/maps", "/healthz"])
def test_a_name_bent_to_this_address_is_refused(host, path):
    """DNS rebinding: a strange page whose own name was given the address of this machine."""
    headers = {"Host": host.encode("latin-1")}
    told = asking("127.0.0.1", names=NAMES).get(path, headers=headers)
    assert (told.status_code, told.json()["code"]) == (421, "host")
    assert "--name" in told.json()["mend"]


def test_with_keys_any_name_will_do():
    client = asking("maps.example.org", keys=(b"secret",))
    assert client.get("/v1/maps", headers={"X-API-Key": "secret"}).status_code == 200
    assert client.get("/v1/maps").status_code == 401


def test_a_page_of_another_host_may_not_ask():
    client = asking("127.0.0.1:8000")
    for origin in ("http://evil.example", "null", "http://127.0.0.1:9000", "https://127.0.0.1"):
        told = client.post("/v1/localize", headers={"Origin": origin})
        assert (told.status_code, told.json()["code"]) == (403, "origin"), origin
    for origin in ("http://127.0.0.1:8000", "https://127.0.0.1:8000"):
        assert client.post("/v1/localize", headers={"Origin": origin}).status_code == 200


def test_behind_a_proxy_that_says_its_own_address():
    """The page is at the proxy's name, and the proxy asks by an address."""
    client = asking("127.0.0.1:8000", names=("maps.example.org",))
    headers = {"Origin": "https://maps.example.org"}
    assert client.post("/v1/localize", headers=headers).status_code == 200


def test_websockets_are_asked_the_same():
    strange, own = asking("anywhere"), asking("anywhere", names=("testserver",))  # as it says
    with own.websocket_connect("/v1/live"):
        pass
    with pytest.raises(WebSocketDisconnect), strange.websocket_connect("/v1/live"):
        pass
    headers = {"Origin": "http://evil.example"}
    with pytest.raises(WebSocketDisconnect), own.websocket_connect("/v1/live", headers=headers):
        pass


def test_a_running_server_is_not_asked_by_a_strange_name(running):
    told = httpx.get(f"{running.url}/v1/maps", headers={"Host": "evil.example"})
    assert told.status_code == 421
