"""Targets of fuzzing: formats, server requests, sentences and command lines, and how each is used."""

from __future__ import annotations

import base64
import io
import json
import re
import shutil
import socket
import threading
from collections.abc import Callable
from contextlib import chdir, suppress
from dataclasses import dataclass
from functools import cached_property, partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from numpy.random import Generator
from PIL import Image

from placegraph.errors import PlacegraphError, RequestError
from placegraph_lab.campaign import uses
from placegraph_lab.campaign.mutate import WORDS, flip_bytes, mutate_path, mutate_world
from placegraph_lab.campaign.seeds import POSE, SeedWorld, load_layouts, save_image
from placegraph_lab.campaign.uses import INSIDE, OUTSIDE, Bench, happens
from placegraph_serve.app import create_app
from placegraph_serve.limits import HeadTimeoutProtocol
from placegraph_serve.options import ServeOptions
from placegraph_serve.places import Dispatcher, Places
from placegraph_serve.problem import problem
from placegraph_serve.workers import VERBS, Answer, to_json

if TYPE_CHECKING:
    from starlette.testclient import TestClient

ALLOWED = {501, 502, 503}  # statuses from 500 on that name the problem


class InProcessQueue:
    """A worker queue that answers in this process."""

    ready, name = True, "here"
    waiting = running = answered = replaced = 0

    def __init__(self, dispatcher: Dispatcher) -> None:
        self.dispatcher = dispatcher

    def start(self) -> None:
        """Do nothing: there is no process."""

    async def end(self) -> None:
        """Do nothing: there is no process."""

    async def ask(self, verb: str, request: Any) -> Answer:  # noqa: ANN401  # of the verb
        """Return the answer, or the problem of a `PlacegraphError`; other errors are raised."""
        module, function = VERBS[verb].split(":")
        try:
            answer = getattr(import_module(f"placegraph_serve.{module}"), function)(
                self.dispatcher, request
            )
        except PlacegraphError as error:
            return None, problem(error)
        return (answer if isinstance(answer, bytes) else to_json(answer | {"seconds": 0.0})), None


class ServerUnderTest:
    """A server of a town and a room, with clients in this process and on the network."""

    def __init__(self, bench: Bench) -> None:
        folder = bench.folder / "served"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        bench.kleinstadt.save(folder / "town.city")
        bench.room.save(folder / "room.scene")
        places, options = Places([folder]), ServeOptions()
        self.app = create_app(places, options)
        queue: Any = InProcessQueue(Dispatcher(Places([folder]), options))
        server = self.app.state.server
        server.sentences = server.captures = server.steps = queue
        server.sessions._queue = queue  # noqa: SLF001  # the routes hold the sessions
        self.sessions: dict[str, str] = {}

    @cached_property
    def client(self) -> TestClient:
        """A client without a network."""
        from starlette.testclient import TestClient

        client = TestClient(self.app, base_url="http://127.0.0.1")
        client.__enter__()
        return client

    @cached_property
    def port(self) -> int:
        """The port on which the same server listens."""
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
        """Return the path of a session in a map; begin one where there is none."""
        camera = {"fx": 35, "width": 48, "height": 36}
        known = self.sessions.get(name, "/v1/sessions/none")
        if self.client.post(known, json={"distance": 0.0}).status_code == 404:
            body = {"map": name} | ({"camera": camera} if name == "room" else {})
            reply = self.client.post("/v1/sessions", json=body).json()
            self.sessions[name] = f"/v1/sessions/{reply['session']}"
        return self.sessions[name]


def send_request(bench: Bench, folder: Path, rng: Generator) -> None:
    """Send one of the folder's requests; `RequestError` where it is refused."""
    served = _server(bench)
    files = sorted(folder.glob("*.request"))
    text = files[rng.integers(len(files))].read_bytes()
    try:
        asked = json.loads(text)
        method, path, body = str(asked["method"]), str(asked["path"]), asked["body"]
        accept = str(asked["accept"]).encode("latin-1")
    except (ValueError, LookupError, TypeError, RecursionError):  # it is a body now
        _check_answer(served.client.post("/v1/locate", content=text))
        return
    if method == "SOCKET":
        _ask_socket(served, body, rng)
    elif method == "FORM":
        sent = {"request": json.dumps(body)}
        images = [("images", ("a.png", (folder / "image.png").read_bytes()))]
        _check_answer(served.client.post("/v1/localize", files=images, data=sent))
    elif method == "STEP":
        where = served.session("room" if path == "room" else "town")
        _check_answer(served.client.post(where, content=json.dumps(body)))
    else:
        head = {b"accept": accept, b"content-type": b"application/json"}
        content = b"" if body is None else json.dumps(body).encode()
        url = f"http://127.0.0.1/{quote(path.encode('utf-8', 'replace').lstrip(b'/'), '/?&=%+,')}"
        kind = method if method.isalpha() and method.isascii() else "POST"
        _check_answer(served.client.request(kind, url, content=content, headers=head))


def _ask_socket(served: ServerUnderTest, body: Any, rng: Generator) -> None:  # noqa: ANN401  # any JSON
    from starlette.websockets import WebSocketDisconnect

    path = "/v1/live" if rng.integers(2) else served.session("town")
    try:
        with served.client.websocket_connect(path) as there:
            there.send_text(json.dumps(body))
            reply = json.loads(there.receive_text())
    except WebSocketDisconnect as error:
        raise RequestError(f"closed: {error.code}") from error
    _check_problem(
        reply.get("problem") or (reply if {"status", "detail"} <= reply.keys() else None)
    )


def _check_answer(answer: Any) -> None:  # noqa: ANN401  # of httpx
    if answer.status_code >= 400:
        reply = answer.json() if "json" in answer.headers.get("content-type", "") else {}
        _check_problem({"status": answer.status_code, "detail": answer.text} | reply)


def _check_problem(report: dict[str, Any] | None) -> None:
    if report is None:
        return
    if report["status"] >= 500 and report["status"] not in ALLOWED:
        raise AssertionError(f"status {report['status']}: {report['detail']}")
    raise RequestError(str(report["detail"]), status=report["status"])


def send_message(bench: Bench, folder: Path, rng: Generator) -> None:
    """Send bytes to the port; the server answers with a proper status or hangs up, and goes on."""
    served = _server(bench)
    files = sorted(folder.glob("*.http"))
    data = files[rng.integers(len(files))].read_bytes()
    with socket.create_connection(("127.0.0.1", served.port), timeout=200.0) as there:
        try:
            there.sendall(data)
            there.shutdown(socket.SHUT_WR)
            reply = there.recv(1 << 16)
        except (BrokenPipeError, ConnectionResetError):
            reply = b""
    status = reply[9:12].decode("latin-1") if reply.startswith(b"HTTP/1.1 ") else ""
    if status.isdigit() and int(status) >= 400:
        _check_problem({"status": int(status), "detail": reply[:60].decode("latin-1")})
    if not status:
        raise RequestError("hung up")


def _server(bench: Bench) -> ServerUnderTest:
    if not hasattr(bench, "server"):
        bench.server = ServerUnderTest(bench)  # type: ignore[attr-defined]
    server: ServerUnderTest = bench.server  # type: ignore[attr-defined]
    return server


ODD = ("\u202e", "\x1b[2J", "\0", "\ud800", "½", "٣", "\U0001f468\u200d\U0001f469", "\n\n", "://",
       "ß" * 40, "9" * 5000, "not", "no", "and", "between", "(", ")", '"', "300 m", "-5 km",
       "1e400 m", "north of", "I", "𝔞")  # fmt: skip


def mutate_sentences(path: Path, rng: Generator) -> None:
    """Keep one to three sentences of a file, with words exchanged, doubled, removed or odd."""
    lines = path.read_text("utf-8").split("\n")
    chosen = [lines[i] for i in rng.integers(len(lines), size=int(rng.choice([1, 1, 2, 3])))]
    words = re.findall(r"\w+\s*|\W\s*", " ".join(chosen))
    for _ in range(int(rng.choice([1, 2, 4, 9]))):
        at, kind = int(rng.integers(len(words) + 1)), int(rng.integers(6))
        if kind == 0:
            words[at : at + 1] = []
        elif kind == 1:
            words[at:at] = words[int(rng.integers(len(words) + 1)) :][:4]
        elif kind == 2:
            other = re.findall(r"\w+\s*|\W\s*", lines[rng.integers(len(lines))])
            words[at:at] = other[: int(rng.integers(1, 6))]
        elif kind == 3:
            words[at : at + 1] = [f"{ODD[rng.integers(len(ODD))]} "]
        elif kind == 4:
            rng.shuffle(words)
        else:
            words = words * int(rng.choice([2, 30]))
    text = "".join(words)[:20_000].encode("utf-8", "surrogatepass")
    path.write_bytes(flip_bytes(text, rng) if happens(rng, 0.2) else text)


def describe(bench: Bench, path: Path, rng: Generator) -> None:
    """Parse a text as an outdoor or indoor description, or locate it."""
    from placegraph.indoor.language import rank_scenes
    from placegraph.outdoor.language import describe as read

    text = path.read_bytes().decode("utf-8", "surrogateescape" if happens(rng, 0.1) else "replace")
    text = text if happens(rng, 0.01) else text[:400]
    kind = int(rng.integers(6))
    if kind < 3:
        repr(read(text, heading=0.5 if kind else None))
    elif kind == 3:
        rank_scenes(text, [bench.room, bench.room])
    elif kind == 4:
        bench.kleinstadt.locate(text, top=2).to_dict()
    else:
        bench.kleinstadt.track().tell(text)


def write_requests(folder: Path, world: SeedWorld) -> None:
    """Write a file for each request: method, path and body, with images in base64."""
    folder.mkdir()
    pixels = world.frames[0].rgb()
    out = io.BytesIO()
    Image.fromarray(pixels).save(out, "PNG")
    image = base64.b64encode(out.getvalue()).decode()
    fix = {"latitude": 53.0, "longitude": 8.0, "accuracy": 5.0}
    camera = {"sensorId": "0", "timestamp": 1608995990413, "imageBytes": image, "imageFormat": "PNG",
              "size": [48, 36], "params": {"model": "PINHOLE", "modelParams": [35, 35, 24, 18]}}  # fmt: skip
    sensed = {"cameraReadings": [camera],
              "geolocationReadings": [fix | {"sensorId": "1", "timestamp": 1}],
              "accelerometerReadings": [{"x": 0, "y": 9.8, "z": 0, "sensorId": "2"}]}  # fmt: skip
    asked = {
        "locate": ("POST", "/v1/locate", {"text": OUTSIDE[0], "near": [8.0, 53.0], "radius": 200.0, "top": 3,
                                          "heading_deg": 90, "map": "town", "answers": []}),
        "search": ("GET", "/api?q=Hotel%20Hansa&lat=53.0&lon=8.0&limit=5", None),
        "geopose": ("POST", "/geopose", {"id": "a", "timestamp": 1608995990413, "type": "geopose",
                    "sensors": [{"id": "0", "type": "camera"}], "sensorReadings": sensed,
                    "priorPoses": []}),
        "begin": ("POST", "/v1/sessions", {"map": "town", "near": [8.0, 53.0], "radius": 100.0}),
        "camera": ("POST", "/v1/sessions", {"map": "room", "camera": {"fx": 35, "width": 48, "height": 36},
                   "description": INSIDE[0]}),
        "step": ("STEP", "town", {"text": OUTSIDE[0], "east": 3.0, "north": 1.0, "sigma": 2.0}),
        "frame": ("STEP", "room", {"image": image, "gravity": [0, 1, 0],
                  "odometry": POSE.tolist(), "stamp": 1.0}),
        "live": ("SOCKET", "/v1/live", {"id": 3, "text": OUTSIDE[1], "top": 2}),
        "localize": ("FORM", "/v1/localize", {"map": "room", "gravity": [[0, 1, 0]], "depth_scale": 1000.0,
                     "intrinsics": {"fx": 35.0, "cx": 24.0, "cy": 18.0, "width": 48, "height": 36},
                     "prior": {"x": 2.5, "y": 0.2, "spread": 0.5}, "description": INSIDE[1],
                     "near": [8.0, 53.0], "pictures": []}),
        "plan": ("GET", "/v1/maps/room/plan.png", None),
        "maps": ("GET", "/v1/maps", None),
    }  # fmt: skip
    for name, (method, path, body) in asked.items():
        content = {"method": method, "path": path, "body": body, "accept": "*/*"}
        (folder / f"{name}.request").write_text(json.dumps(content), "utf-8")
    save_image(folder / "image.png", pixels)


def mutate_one(folder: Path, rng: Generator) -> None:
    """Mutate one of the requests or messages, at times its image, and remove the others."""
    image = folder / "image.png"
    asked = sorted(p for p in folder.iterdir() if p != image)
    chosen = asked[rng.integers(len(asked))]
    for path in asked:
        if path != chosen:
            path.unlink()
    mutate_path(image if image.exists() and happens(rng, 0.15) else chosen, rng)


def write_messages(folder: Path, _world: SeedWorld) -> None:
    """Write raw HTTP requests."""
    folder.mkdir()
    body = json.dumps({"text": OUTSIDE[0], "map": "town"}).encode()
    head = b"Host: 127.0.0.1\r\nContent-Type: application/json\r\n"
    form = b'--xx\r\nContent-Disposition: form-data; name="images"; filename="a.png"\r\n\r\nabc\r\n--xx--\r\n'
    kinds = {
        "post": b"POST /v1/locate HTTP/1.1\r\n" + head + b"Content-Length: %d\r\n\r\n" % len(body) + body,
        "chunks": b"POST /v1/locate HTTP/1.1\r\n" + head + b"Transfer-Encoding: chunked\r\n\r\n"
                  + b"%x\r\n" % len(body) + body + b"\r\n0\r\n\r\n",
        "get": b"GET /api?q=bench HTTP/1.1\r\nHost: 127.0.0.1\r\nAccept: */*\r\n\r\n",
        "form": b"POST /v1/localize HTTP/1.1\r\nHost: 127.0.0.1\r\n"
                b"Content-Type: multipart/form-data; boundary=xx\r\n"
                b"Content-Length: %d\r\n\r\n" % len(form) + form,
        "socket": b"GET /v1/live HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
                  b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
                  b'\x81\x8a\0\0\0\0{"text":1}',
        "geopose": b"POST /geopose HTTP/1.1\r\nHost: 127.0.0.1\r\n"
                   b"Accept: application/vnd.oscp+json; version=2.0\r\n"
                   b'Content-Length: 22\r\n\r\n{"sensorReadings": []}',
    }  # fmt: skip
    for name, data in kinds.items():
        (folder / f"{name}.http").write_bytes(data)


COMMANDS = (
    "city build town.osm -o out.city --cell-size 50 --stride 25", "city info town.city --json",
    "city locate town.city TEXT --top 3 --near 8.0,53.0 --radius 100 --json",
    "city locate town.city TEXT --matcher transformer --candidates-by all --candidates 5",
    "city locate town.city TEXT --png out.png --heading-deg 90 --language de", "city check town.city",
    "city locate town.city TEXT --html out.html --preset paper", "city track town.city --json",
    "city embed town.city -o out.vectors --bits 8", "scene info room.scene --png out.png",
    "scene build room.glb -o out.scene --floor 0 --up z --scale 1 --detail small", "scene check room.scene",
    "scene anchor room.scene -o out.scene --pose 8.0,53.0,6.4,17 --accuracy 1,3 --level 2",
    "scene anchor room.scene -o out.scene --pair 0,0=8,53 --pair 5,0=8.0001,53 --pair 0,4=8,53.0001",
    "scene localize room.scene walk --frames 0:2 --no-refine --near 2,1 --radius 1 --height 1.5 --json",
    "scene render room.scene --out out --pose 2.5,0.2,1.5,90 --size 48,36", "scene export room.scene out.glb",
    "scene diff room.scene room.scene -o out.json", "library build room.scene -o out.library",
    "library search rooms.library TEXT --most 3 --json", "library info rooms.library", "bag info walk",
    "locate . TEXT --near 8.0,53.0 --radius 200 --json", "scene export room.scene out.osm --overwrite",
    "scene encode room.scene -o out.scene --encoder labels:x=1", "--version", "scene --help",
)  # fmt: skip


def write_commands(folder: Path, world: SeedWorld) -> None:
    """Write maps of all kinds, and a file with command lines."""
    folder.mkdir()
    world.city(folder)
    world.room.save(folder / "room.scene")
    world.room.export(folder / "room.glb")
    from placegraph.indoor.library import make_library

    library = make_library({}, encoders="labels")
    library.add("room", folder / "room.scene")
    library.save(folder / "rooms.library")
    (folder / "words").write_text("\n".join(COMMANDS), "utf-8")


def mutate_command(folder: Path, rng: Generator) -> None:
    """Keep one command line, with words exchanged, and with invalid numbers and options."""
    lines = [line.split() for line in (folder / "words").read_text("utf-8").split("\n")]
    words = lines[rng.integers(len(lines))]
    for _ in range(int(rng.choice([1, 1, 2, 3]))):
        at, kind = int(rng.integers(1, len(words) + 1)), int(rng.integers(5))
        if kind < 2 and at < len(words):
            odd = WORDS[rng.integers(len(WORDS))].decode("utf-8", "surrogateescape")
            parts = re.split(r"([,:=])", words[at])
            parts[rng.integers(len(parts))] = odd.replace("\0", "")
            words[at] = "".join(parts)
        elif kind == 2:
            words[at : at + 1] = []
        elif kind == 3:
            other = lines[rng.integers(len(lines))]
            words[at:at] = other[-2:]
        else:
            words[at:at] = words[at : at + 2]
    (folder / "words").write_text("\0".join(words), "utf-8", "surrogateescape")


def run_command(_bench: Bench, folder: Path, _rng: Generator) -> None:
    """Run a command line in its folder; `SystemExit` with 0 where it succeeds."""
    import sys

    from placegraph import cli

    words = (folder / "words").read_text("utf-8", "surrogateescape").split("\0")
    sys.argv = ["placegraph", *(OUTSIDE[0] if w == "TEXT" else w for w in words)]
    before, sys.stdin = sys.stdin, io.StringIO("\n".join(OUTSIDE))
    try:
        with chdir(folder), suppress(BrokenPipeError):
            cli.main()
    finally:
        sys.stdin = before


@dataclass(frozen=True)
class Target:
    """A format, its seeds, and how its files are used."""

    name: str
    seeds: dict[str, Any]  # functions that write them, by file name
    use: Callable[[Bench, Path, Generator], object]
    mutate: Callable[[Path, Generator], None] = mutate_path
    slow: bool = False
    """Whether an input takes seconds: such targets come last and share the time that is left."""

    def write_seeds(self, folder: Path, bench: Bench) -> list[Path]:
        """Write the seeds into a folder of their own, unless they are there."""
        if not folder.exists():
            unfinished = folder.with_name(f"{folder.name}.unfinished")
            shutil.rmtree(unfinished, ignore_errors=True)
            unfinished.mkdir(parents=True)
            for name, draw in self.seeds.items():
                draw(unfinished / name, bench)
            unfinished.rename(folder)
        return [folder / name for name in self.seeds]


USES = {
    "Overpass answers": uses.overpass, "Nominatim answers": uses.nominatim, "OSM rooms": uses.rooms,
    "GLB": uses.mesh, "glTF": uses.folder_mesh, "OBJ and MTL": uses.folder_mesh, "PLY": uses.mesh,
    "Spark-DSG": uses.mesh, "ConceptGraphs": uses.mesh, "3RScan scan": uses.folder_mesh,
    "ScanNet scan": uses.folder_mesh, "SceneGraphFusion": uses.folder_mesh,
    ".library": uses.library, "worlds": uses.world, ".vectors": uses.vectors,
    ".weights": uses.weights, ".run": uses.run, ".track": uses.track, "changes": uses.changes,
    "Overture": uses.overture, "worlds in shards": uses.world, "libraries in shards": uses.shards,
}  # fmt: skip
SLOW = {"OSM .osm", "OSM .osm.pbf", "OSM .osm.gz, .osm.bz2", "OSM of Overpass", "worlds", "changes",
        "MultiScan", "COLMAP"}  # fmt: skip


def find_targets(layouts: Path | None = None) -> dict[str, Target]:
    """Return all targets by name; `layouts` is a Python file with seeds of more formats."""
    maps, captures, sentences = load_layouts(layouts)
    text = "\n".join([*OUTSIDE, *INSIDE, *sentences])
    found = [
        Target(
            name, seeds, USES.get(name, uses.osm if name.startswith("OSM") else uses.any_map),
            mutate_world if name == "worlds in shards" else mutate_path, name in SLOW,
        )
        for name, seeds in maps.items()
    ]  # fmt: skip
    found += [Target(n, seeds, uses.capture, slow=n in SLOW) for n, seeds in captures.items()]
    described = {"all.words": lambda path, _: path.write_text(text, "utf-8")}
    found += [
        Target("bags as streams", captures["bags MCAP"], uses.stream),
        Target("descriptions", described, describe, mutate_sentences),
        Target("requests", {"requests": write_requests}, send_request, mutate_one, slow=True),
        Target("HTTP messages", {"messages": write_messages}, send_message, mutate_one),
        Target("command lines", {"commands": write_commands}, run_command, mutate_command),
    ]
    return {target.name: target for target in found}
