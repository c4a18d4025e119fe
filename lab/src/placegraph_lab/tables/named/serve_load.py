"""A server in processes of its own, and wrk that asks it."""

from __future__ import annotations

import asyncio
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any
from urllib.error import URLError
from urllib.request import urlopen

from placegraph.demo.town import FLAT, unpack
from placegraph.errors import OptionError
from placegraph.indoor.build import build_scene
from placegraph.io.capture.capture import open_capture
from placegraph_lab.tables.outdoor.extracts import EXTRACTS, open_city
from placegraph_lab.tables.outdoor.queries import make_queries
from placegraph_lab.tables.runner import Quick, Run, Seed, markdown, number, table

SCRIPT = Path(__file__).parents[1] / "data/requests.lua"
TICK = 1.0 / os.sysconf("SC_CLK_TCK")
PAGE = os.sysconf("SC_PAGE_SIZE")
STARTING = 300.0  # A server that is not ready after so long is given up [s]


@dataclass(frozen=True)
class Request:
    """HTTP request."""

    method: str
    path: str
    body: bytes = b""
    kind: str = "application/json"

    @classmethod
    def of(cls, path: str, **told: Any) -> Request:
        return cls("POST", path, json.dumps(told).encode())

    @property
    def bytes(self) -> bytes:
        return f"{self.method} {self.path} {self.kind} {len(self.body)}\n".encode() + self.body


@dataclass(frozen=True)
class RunningServer:
    """A server that runs."""

    process: subprocess.Popen[str]
    url: str

    @cached_property
    def processes(self) -> list[int]:
        """Itself, its children and theirs, as they are at first; of one that died nothing is known."""
        every = [int(path.name) for path in Path("/proc").iterdir() if path.name.isdigit()]
        found = [self.process.pid]
        for parent in found:
            found += [process for process in every if _stat(process)[1] == str(parent)]
        return found

    def cpu(self) -> float:
        """Time of all cores that its processes have taken [s]."""
        stats = [_stat(p) for p in self.processes]
        return sum(int(x) for stat in stats for x in stat[11:13]) * TICK

    def memory(self) -> float:
        """Return the resident memory of its processes [MB]; shared pages count in each."""
        return sum(int(_stat(p)[21]) for p in self.processes) * PAGE * 1e-6

    def send(
        self, requests: Iterable[Request], file: Path, *, at_once: int, seconds: int
    ) -> dict[str, Any]:
        """Send requests in turn by wrk, so many at once; its figures, and the CPU time of each."""
        if shutil.which("wrk") is None:
            raise OptionError("wrk is not installed; install it (apt-get install wrk).")
        file.write_bytes(b"".join(r.bytes for r in requests))
        before = self.cpu()
        words = ["wrk", "-t1", f"-c{at_once}", f"-d{seconds}s", "--timeout", "60s", "-s", SCRIPT,
                 self.url, "--", file]  # fmt: skip
        out = subprocess.run(list(map(str, words)), capture_output=True, text=True, check=True)  # noqa: S603
        told: dict[str, Any] = json.loads(out.stdout.splitlines()[-1])
        told["cpu_ms"] = 1e3 * (self.cpu() - before) / max(told["requests"], 1)
        return told | {"at_once": at_once, "per_second": told["requests"] / told["seconds"]}


def _stat(process: int) -> list[str]:
    try:
        text = Path(f"/proc/{process}/stat").read_text()
    except OSError:
        return ["0"] * 50
    return text.rpartition(")")[2].split()


@contextmanager
def run_server(folder: Path) -> Iterator[RunningServer]:
    """`placegraph serve` of a folder, ready; raises `OptionError` where its CPU cannot be read."""
    if not Path("/proc/self/stat").exists():
        raise OptionError("The CPU of processes is read from /proc; measure on Linux.")
    words = [sys.executable, "-m", "placegraph", "serve", str(folder), "--port", "0"]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)  # noqa: S603
    try:
        assert process.stdout is not None  # noqa: S101
        found = re.search(r"http://[^\s;]+", process.stdout.readline())
        if found is None:
            raise OptionError(f"The server of {folder} did not start; see what it said.")
        end = time.monotonic() + STARTING
        while not _is_ready(f"{found[0]}/healthz"):
            if time.monotonic() > end:
                raise OptionError(f"The server of {folder} was not ready in {STARTING:g} s.")
            time.sleep(0.1)
        yield RunningServer(process, found[0])
    finally:
        process.terminate()
        process.wait()


def _is_ready(url: str) -> bool:
    try:
        with urlopen(url, timeout=5) as answer:  # noqa: S310  # our own server
            return bool(answer.status == 200)
    except (URLError, OSError):
        return False


async def idle(server: RunningServer, count: int, request: dict[str, Any]) -> dict[str, Any]:
    """Open WebSockets that say nothing, and ask by the last; what they hold in memory."""
    from websockets.asyncio.client import connect

    before, sockets = server.memory(), []
    at = server.url.replace("http", "ws") + "/v1/live"
    try:
        for _ in range(count):  # one after the other, and all are closed whatever happens
            sockets.append(await connect(at, ping_interval=None))  # noqa: PERF401
        start = time.perf_counter()
        await sockets[-1].send(json.dumps(request))
        answer = json.loads(await sockets[-1].recv())
        seconds = time.perf_counter() - start
        held = server.memory() - before
        return {"sockets": count, "mb": held, "answered": "result" in answer, "s": seconds}
    finally:
        await asyncio.gather(*(socket.close() for socket in sockets))


CITY = "vancouver"
EDGE = "----placegraph"
HEADER = ["asked", "at once", "a second", "p50 ms", "p95 ms", "CPU ms each", "failed"]


@table()
def serve_load(
    run: Run,
    seed: Seed = 0,
    *,
    quick: Quick = False,
) -> None:
    """Sentences and images a second that a server answers, idle WebSockets, and its memory."""
    requests, seconds = (1_000, 4) if quick else (100_000, 20)
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        world = unpack(folder / "raw")
        (folder / "maps").mkdir()
        open_city(CITY, run.osm, run.cache / "maps")
        shutil.copy(run.cache / "maps" / f"{CITY}.city", folder / "maps")
        build_scene(world / f"{FLAT}.glb", folder / "maps" / f"{FLAT}.scene")
        texts = sentences(run.osm / EXTRACTS[CITY], seed)
        with run_server(folder / "maps") as server:
            rows = list(loads(server, folder / "asked", texts, world / "walk", seconds))
            print(markdown(HEADER, map(line, rows)))
            sockets = asyncio.run(idle(server, 1000, {"id": 1, "text": texts[0], "map": CITY}))
            memory = watch_memory(server, folder / "asked", texts, requests, seconds)
    print(f"\n{summarize(sockets, memory)}")
    run.save({"rows": rows, "sockets": sockets, "memory": memory, "busy": os.getloadavg()})


def sentences(extract: Path, seed: int) -> list[str]:
    drawn = (
        make_queries(extract, statements=count, setting="speaker", n=300, seed=seed)
        for count in (1, 2, 3)
    )
    return [query.text for trio in zip(*drawn, strict=True) for query in trio]


def loads(
    server: RunningServer, file: Path, texts: list[str], walk: Path, seconds: int
) -> Iterator[dict[str, Any]]:
    """Sentences and pictures, few and many at once; the first seconds warm up and do not count."""
    asked = [Request.of("/v1/locate", text=text, map=CITY) for text in texts]
    server.send(asked, file, at_once=4, seconds=2)
    for at_once in (1, 4, 8):
        yield {"asked": "sentences"} | server.send(asked, file, at_once=at_once, seconds=seconds)
    files, gravity = sorted((walk / "rgb").iterdir()), open_capture(walk).gravity.tolist()
    plain = [picture(path) for path in files]
    leveled = [picture(path, [down]) for path, down in zip(files, gravity, strict=True)]
    server.send(plain, file, at_once=1, seconds=2)
    for name, images in (("pictures", plain), ("pictures and gravity", leveled)):
        yield {"asked": name} | server.send(images, file, at_once=2, seconds=seconds)


def picture(path: Path, gravity: list[list[float]] | None = None) -> Request:
    """A localization by one picture and its camera; where nobody tells gravity, tilts are tried."""
    camera = {"fx": 230.0, "width": 320, "height": 180}
    known = {"map": FLAT, "intrinsics": camera, "gravity": gravity}
    head = f'--{EDGE}\r\nContent-Disposition: form-data; name="'
    body = f'{head}request"\r\n\r\n{json.dumps(known)}\r\n{head}images"; filename="a"\r\n\r\n'
    data = body.encode() + path.read_bytes() + f"\r\n--{EDGE}--\r\n".encode()
    return Request("POST", "/v1/localize", data, f"multipart/form-data; boundary={EDGE}")


def watch_memory(
    server: RunningServer, file: Path, texts: list[str], requests: int, seconds: int
) -> list[dict[str, Any]]:
    """Memory before, and from time to time, of many requests: of 20 one is a sentence, others cheap."""
    mixed = [
        request
        for text in texts
        for request in (
            Request.of("/v1/locate", text=text, map=CITY),
            *[Request("GET", "/healthz")] * 6,
            *[Request("GET", "/v1/maps")] * 4,
            *[Request("GET", "/")] * 2,
            *[Request("GET", f"/v1/maps/{CITY}/drawing")] * 2,
            *[Request.of("/v1/locate", text="", map=CITY)] * 3,
            Request("GET", "/api?q=bakery"),
            Request("GET", "/metrics"),
        )
    ]
    rows = [{"requests": 0, "mb": server.memory()}]
    while rows[-1]["requests"] < requests:
        seen = server.send(mixed, file, at_once=4, seconds=seconds)
        total = rows[-1]["requests"] + seen["requests"]
        rows.append({"requests": total, "mb": server.memory(), "cpu_ms": seen["cpu_ms"]})
    return rows


def line(row: dict[str, Any]) -> list[str]:
    numbers = (number(row[k], 1) for k in ("per_second", "p50_ms", "p95_ms", "cpu_ms"))
    return [row["asked"], str(row["at_once"]), *numbers, str(row["failed"])]


def summarize(sockets: dict[str, Any], memory: list[dict[str, Any]]) -> str:
    some = memory[:2] + memory[2 :: max(1, len(memory) // 5)]
    grown = ", ".join(f"{row['mb']:.0f} after {row['requests']:,}" for row in some)
    return (
        f"{sockets['sockets']} idle WebSockets hold {sockets['mb']:.1f} MB, and the last is answered "
        f"in {sockets['s'] * 1e3:.0f} ms. MB of all processes: {grown} requests."
    )
