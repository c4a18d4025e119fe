"""The server, asked in this process: what its workers would hide behind a status is raised here."""

from __future__ import annotations

import json
import shutil
import socket
import threading
from functools import cached_property, partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from numpy.random import Generator

from placegraph.errors import PlacegraphError, RequestError
from placegraph_lab.campaign.uses import Bench
from placegraph_serve.app import create_app
from placegraph_serve.limits import HeadTimeoutProtocol
from placegraph_serve.options import ServeOptions
from placegraph_serve.places import Dispatcher, Places
from placegraph_serve.problem import problem
from placegraph_serve.workers import VERBS, Answer, dumped

if TYPE_CHECKING:
    from starlette.testclient import TestClient


HONEST = {501, 502, 503}  # statuses from 500 on that say what is wrong


class Here:
    """A lane that answers in this process."""

    ready, name = True, "here"
    waiting = running = answered = replaced = 0

    def __init__(self, desk: Dispatcher) -> None:
        self.desk = desk

    def begin(self) -> None:
        """There is no process to be started."""

    async def end(self) -> None:
        """There is no process to be ended."""

    async def ask(self, verb: str, asked: Any) -> Answer:  # noqa: ANN401  # of the verb
        """Answer, or a problem of ours; another error is raised."""
        module, function = VERBS[verb].split(":")
        try:
            made = getattr(import_module(f"placegraph_serve.{module}"), function)(self.desk, asked)
        except PlacegraphError as error:
            return None, problem(error)
        return (made if isinstance(made, bytes) else dumped(made | {"seconds": 0.0})), None


class Served:
    """Clients of a server of a town and a room."""

    def __init__(self, bench: Bench) -> None:
        folder = bench.folder / "served"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        bench.kleinstadt.save(folder / "town.city")
        bench.room.save(folder / "room.scene")
        places, options = Places([folder]), ServeOptions()
        self.app = create_app(places, options)
        lane: Any = Here(Dispatcher(Places([folder]), options))
        server = self.app.state.server
        server.sentences = server.captures = server.steps = lane
        server.sessions._lane = lane  # noqa: SLF001  # the routes hold the sessions
        self.sessions: dict[str, str] = {}

    @cached_property
    def client(self) -> TestClient:
        """Asks without a network."""
        from starlette.testclient import TestClient

        client = TestClient(self.app, base_url="http://127.0.0.1")
        client.__enter__()
        return client

    @cached_property
    def port(self) -> int:
        """Of the same on the network of this machine."""
        import uvicorn

        http: Any = partial(HeadTimeoutProtocol, seconds=20.0)
        config = uvicorn.Config(
            self.app, http=http, port=0, log_level="critical", ws="websockets-sansio"
        )
        server = uvicorn.Server(config)
        threading.Thread(target=server.run, daemon=True).start()
        while not server.started:
            threading.Event().wait(0.01)
        return int(server.servers[0].sockets[0].getsockname()[1])

    def session(self, name: str) -> str:
        """Path of a session in a map, begun where there is none any more."""
        camera = {"fx": 35, "width": 48, "height": 36}
        known = self.sessions.get(name, "/v1/sessions/none")
        if self.client.post(known, json={"distance": 0.0}).status_code == 404:
            body = {"map": name} | ({"camera": camera} if name == "room" else {})
            told = self.client.post("/v1/sessions", json=body).json()
            self.sessions[name] = f"/v1/sessions/{told['session']}"
        return self.sessions[name]


def request(bench: Bench, folder: Path, rng: Generator) -> None:
    """Send one of the folder's requests; `RequestError` where it is refused."""
    served = _served(bench)
    files = sorted(folder.glob("*.request"))
    text = files[rng.integers(len(files))].read_bytes()
    try:
        told = json.loads(text)
        method, path, body = str(told["method"]), str(told["path"]), told["body"]
        accept = str(told["accept"]).encode("latin-1")
    except (ValueError, LookupError, TypeError, RecursionError):  # it is a body now
        _judged(served.client.post("/v1/locate", content=text))
        return
    if method == "SOCKET":
        _socket(served, body, rng)
    elif method == "FORM":
        sent = {"request": json.dumps(body)}
        images = [("images", ("a.png", (folder / "image.png").read_bytes()))]
        _judged(served.client.post("/v1/localize", files=images, data=sent))
    elif method == "STEP":
        where = served.session("room" if path == "room" else "town")
        _judged(served.client.post(where, content=json.dumps(body)))
    else:
        head = {b"accept": accept, b"content-type": b"application/json"}
        content = b"" if body is None else json.dumps(body).encode()
        url = f"http://127.0.0.1/{quote(path.encode('utf-8', 'replace').lstrip(b'/'), '/?&=%+,')}"
        kind = method if method.isalpha() and method.isascii() else "POST"
        _judged(served.client.request(kind, url, content=content, headers=head))


def _socket(served: Served, body: Any, rng: Generator) -> None:  # noqa: ANN401  # any JSON
    from starlette.websockets import WebSocketDisconnect

    path = "/v1/live" if rng.integers(2) else served.session("town")
    try:
        with served.client.websocket_connect(path) as there:
            there.send_text(json.dumps(body))
            told = json.loads(there.receive_text())
    except WebSocketDisconnect as error:
        raise RequestError(f"closed: {error.code}") from error
    _told(told.get("problem") or (told if "status" in told and "detail" in told else None))


def _judged(answer: Any) -> None:  # noqa: ANN401  # of httpx
    if answer.status_code >= 400:
        said = answer.json() if "json" in answer.headers.get("content-type", "") else {}
        _told({"status": answer.status_code, "detail": answer.text} | said)


def _told(trouble: dict[str, Any] | None) -> None:
    if trouble is None:
        return
    if trouble["status"] >= 500 and trouble["status"] not in HONEST:
        raise AssertionError(f"status {trouble['status']}: {trouble['detail']}")
    raise RequestError(str(trouble["detail"]), status=trouble["status"])


def message(bench: Bench, folder: Path, rng: Generator) -> None:
    """Send bytes to the port; the server says something honest, or hangs up, and goes on."""
    served = _served(bench)
    files = sorted(folder.glob("*.http"))
    data = files[rng.integers(len(files))].read_bytes()
    with socket.create_connection(("127.0.0.1", served.port), timeout=200.0) as there:
        try:
            there.sendall(data)
            there.shutdown(socket.SHUT_WR)
            said = there.recv(1 << 16)
        except (BrokenPipeError, ConnectionResetError):
            said = b""
    status = said[9:12].decode("latin-1") if said.startswith(b"HTTP/1.1 ") else ""
    if status.isdigit() and int(status) >= 400:
        _told({"status": int(status), "detail": said[:60].decode("latin-1")})
    if not status:
        raise RequestError("hung up")


def _served(bench: Bench) -> Served:
    if not hasattr(bench, "served"):
        bench.served = Served(bench)  # type: ignore[attr-defined]
    served: Served = bench.served  # type: ignore[attr-defined]
    return served
