"""Servers killed under load, and files that change while they are used."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from http.client import HTTPConnection, HTTPException
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator

from placegraph.errors import PlacegraphError
from placegraph_lab.campaign.row import Effort, Row

ALLOWED = {"worker_died", "busy", "too_long"}  # problems that a client may see while workers die
TIMEOUT = 120.0  # of a request [s]
START_TIMEOUT = 900.0  # [s]; imports take minutes on a busy machine


@dataclass
class Server:
    """`placegraph serve` in processes of its own."""

    process: subprocess.Popen[str]
    host: str
    port: int

    @classmethod
    def start(cls, maps: Path, room: Path) -> Server:
        """Start a server and wait until it is ready; `RuntimeError` where it is not."""
        words = [sys.executable, "-m", "placegraph", "serve", str(maps), "--port", "0"]
        process = subprocess.Popen(  # noqa: S603
            words, stdout=subprocess.PIPE, text=True, env=os.environ | {"TMPDIR": str(room)}
        )
        assert process.stdout is not None  # noqa: S101
        found = re.search(r"http://([^\s:]+):(\d+)", process.stdout.readline())
        if found is None:
            process.kill()
            raise RuntimeError("the server did not start")
        server = cls(process, found[1], int(found[2]))
        end = time.monotonic() + START_TIMEOUT
        while server.ask("GET", "/healthz")[0] != 200:
            if time.monotonic() > end:
                server.end()
                raise RuntimeError("the server was not ready")
            time.sleep(0.1)
        return server

    def ask(self, method: str, path: str, body: bytes = b"") -> tuple[int, Any]:
        """Return status and JSON; status 0: connection failed, -1: timeout."""
        connection = HTTPConnection(self.host, self.port, timeout=TIMEOUT)
        try:
            connection.request(method, path, body or None, {"Content-Type": "application/json"})
            answer = connection.getresponse()
            content = answer.read()
            return answer.status, json.loads(content) if content[:1] in b"{[" and content else None
        except TimeoutError:
            return -1, None
        except (OSError, HTTPException, ValueError):
            return 0, None
        finally:
            connection.close()

    def workers(self) -> list[int]:
        """Return the ids of its worker processes, which one of its children forks."""
        return [p for child in _children(self.process.pid) for p in _children(child)]

    def end(self) -> None:
        """Kill the server."""
        self.process.kill()
        self.process.wait()


@dataclass
class Load:
    """Clients that send requests without a pause."""

    server: Server
    counts: Counter[str] = field(default_factory=Counter)
    over: threading.Event = field(default_factory=threading.Event)
    gone: threading.Event = field(default_factory=threading.Event)
    """Set when the server was killed: no answer is correct then."""

    def ask(self, report: Callable[[str], None]) -> None:
        """Locate a sentence until `over` is set."""
        body = json.dumps({"text": "A bakery is north of me.", "map": "town"}).encode()
        while not self.over.is_set():
            status, reply = self.server.ask("POST", "/v1/locate", body)
            if self.gone.is_set():
                return
            code = reply.get("code", "") if isinstance(reply, dict) else ""
            if status == 200:
                outcome = "accepted"
            elif status in (500, 503, 504) and code in ALLOWED:
                outcome = "typed"
            else:
                outcome = "hang" if status < 0 else "untyped"
                report(f"under load: {status} {str(reply)[:200]}")
            self.counts[outcome] += 1

    @contextmanager
    def on(self, clients: int, report: Callable[[str], None]) -> Iterator[None]:
        """Send requests with `clients` threads meanwhile."""
        threads = [threading.Thread(target=self.ask, args=(report,)) for _ in range(clients)]
        for thread in threads:
            thread.start()
        try:
            yield
        finally:
            self.over.set()
            for thread in threads:
                thread.join()


def kill_server_under_load(
    inputs: Path, effort: Effort, rng: Generator, seconds: float
) -> Iterator[Row]:
    """Kill workers, then the server itself, while clients ask."""
    maps, room = effort.folder / "maps", effort.folder / "serving"
    for folder in (maps, room):
        folder.mkdir()
    for name in ("town.city", "flat.scene"):
        shutil.copy(inputs / name, maps)
    server = Server.start(maps, room)
    start, load, killed = time.perf_counter(), Load(server), 0
    with load.on(2, effort.report):
        while not killed or time.perf_counter() - start < seconds / 2:
            time.sleep(3.0 * rng.random())
            if there := server.workers():
                with suppress(ProcessLookupError):
                    os.kill(there[int(rng.integers(len(there)))], signal.SIGKILL)
                killed += 1
    taken, what = time.perf_counter() - start, "a server's workers killed under load"
    said = f"{killed} kills while these requests were answered"
    yield Row.from_counts("faults", what, load.counts, effort.seed, taken, said)
    start, counts = time.perf_counter(), Counter[str]()
    while True:
        counts[_kill_server(server, effort, rng)] += 1
        if time.perf_counter() - start > seconds / 2:
            break
        server = Server.start(maps, room)
    taken = time.perf_counter() - start
    yield Row.from_counts("faults", "a server killed under load", counts, effort.seed, taken)


def _kill_server(server: Server, effort: Effort, rng: Generator) -> str:
    """Kill a server while it answers; its workers must end by themselves."""
    load = Load(server)
    workers = server.workers()
    with load.on(2, effort.report):
        time.sleep(2.0 * rng.random())
        load.gone.set()
        server.end()
    end = time.monotonic() + TIMEOUT
    while any(_command_line(worker) for worker in workers):
        if time.monotonic() > end:
            return "hang"
        time.sleep(0.05)
    return "untyped" if load.counts["untyped"] or load.counts["hang"] else "accepted"


def _children(number: int) -> list[int]:
    found = []
    for path in Path("/proc").iterdir():
        with suppress(OSError, ValueError, IndexError):
            if int((path / "stat").read_text().rpartition(")")[2].split()[1]) == number:
                found.append(int(path.name))
    return found


def _command_line(number: int) -> bytes:
    """Return the command line of a process; empty where it has ended."""
    try:
        return Path(f"/proc/{number}/cmdline").read_bytes()
    except OSError:
        return b""


SENTENCE = "A bakery is north of me. A church is south of me."
TYPED, UNTYPED = 20, 21  # exit codes of a trial
CHANGES = ("cut short", "deleted", "replaced", "overwritten", "older")


def change_file(path: Path, how: str, rng: Generator) -> None:
    """Change a file in one of the ways of `CHANGES`; `older`: its time of change is set back."""
    content = path.read_bytes()
    if how == "cut short":
        os.truncate(path, int(rng.integers(len(content))))
    elif how == "deleted":
        path.unlink()
    elif how == "replaced":
        other = path.with_name(f"{path.name}.new")
        other.write_bytes(content[: len(content) // 2])
        other.replace(path)
    elif how == "overwritten":
        with path.open("r+b") as file:
            file.seek(int(rng.integers(len(content))))
            file.write(rng.bytes(len(content) // 2))
    else:
        os.utime(path, (0, 0))


def city(path: Path) -> Callable[[], Any]:
    """Open a city map; return a function that locates a sentence."""
    from placegraph.outdoor.city import CityMap

    found = CityMap.open(path)
    return lambda: found.locate(SENTENCE)


def scene(path: Path) -> Callable[[], Any]:
    """Open a scene map; return a function that localizes frames."""
    from placegraph.io.capture.capture import open_capture
    from placegraph.maps import open_scene

    found, frames = open_scene(path), open_capture(path.parent / "window")
    return lambda: found.localize(frames, seed=0)


def library(path: Path) -> Callable[[], Any]:
    """Open a library; return a function that opens one of its maps."""
    from placegraph.indoor.library import SceneLibrary

    found = SceneLibrary.open(path.with_name("homes.library"))
    return lambda: len(found.scene("home1"))


def vectors(path: Path) -> Callable[[], Any]:
    """Open vectors of a city; return a function that searches them."""
    from placegraph.vectors import EmbeddedStore

    found = EmbeddedStore.open(path)
    return lambda: found.search(np.ones((1, found.dimension), np.float32), 3)


def capture(path: Path) -> Callable[[], Any]:
    """Open a capture folder; return a function that reads its images."""
    from placegraph.io.capture.capture import open_capture

    found = open_capture(path if path.is_file() and path.suffix == ".mcap" else path.parent.parent)
    return lambda: [frame.rgb() for frame in found]


def weights(path: Path) -> Callable[[], Any]:
    """Open weights of PyTorch; return a function that sums them."""
    import torch

    from placegraph_learn.torch_files import read_state

    found = read_state(torch, path, "test")
    return lambda: float(sum(tensor.sum() for tensor in found.values()))


USES: dict[str, tuple[str, Callable[[Path], Callable[[], Any]]]] = {
    "a city's map": ("town.city", city),
    "a city's map that is mapped": ("indexed.city", city),
    "a scene's map": ("flat.scene", scene),
    "a map of a library": ("home1.scene", library),
    "vectors": ("town.vectors", vectors),
    "an image of a capture": ("window/rgb/*", capture),
    "a bag": ("walk.mcap", capture),
    "weights": ("any.pt", weights),
}
"""By kind the pattern of the file among the inputs, and the function that opens it."""


def use_changed_file(what: str, how: str, folder: Path, seed: int) -> None:
    """Open a file, change it, and use what was opened; ends the process."""
    pattern, use = USES[what]
    path = max(folder.glob(pattern))
    code = 0
    try:
        ask = use(path)
        change_file(path, how, np.random.default_rng(seed))
        ask()
    except PlacegraphError:
        code = TYPED
    except BaseException as error:  # noqa: BLE001  # it is counted
        (folder / "error.txt").write_text(f"{type(error).__name__}: {error}")
        code = UNTYPED
    os._exit(code)


def are_maps_reloaded(folder: Path) -> bool:
    """Return whether a server opens a map again when another file replaces it, whatever its time."""
    from placegraph_serve.places import Places

    places, path = Places([folder]), folder / "town.city"
    first: Any = places.city("town")
    other = replace(first, source="another")
    for when in (0.0, 4e9):
        other.save(path)
        os.utime(path, (when, when))
        if places.city("town").source != "another":
            return False
        first.save(path)
        if places.city("town").source != first.source:
            return False
    return True
