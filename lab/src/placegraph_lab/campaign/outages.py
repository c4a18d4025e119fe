"""A server whose workers are killed under load, or which is killed itself."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from http.client import HTTPConnection, HTTPException
from pathlib import Path
from typing import Any

from numpy.random import Generator

from placegraph_lab.campaign.row import Effort, Row

HONEST = {
    "worker_died",
    "busy",
    "too_long",
}  # codes of problems that a client may see while workers die
ASKING = 120.0  # A request that is not answered after so long hangs [s]
READY = 900.0
"""It is given up after so long: beside other work its processes take minutes to import what they need [s]."""


@dataclass
class Server:
    """`placegraph serve` in processes of its own."""

    process: subprocess.Popen[str]
    host: str
    port: int

    @classmethod
    def start(cls, maps: Path, room: Path) -> Server:
        """Wait until it is ready; `RuntimeError` where it is not."""
        words = [sys.executable, "-m", "placegraph", "serve", str(maps), "--port", "0"]
        process = subprocess.Popen(  # noqa: S603
            words, stdout=subprocess.PIPE, text=True, env=os.environ | {"TMPDIR": str(room)}
        )
        assert process.stdout is not None  # noqa: S101
        found = re.search(r"http://([^\s:]+):(\d+)", process.stdout.readline())
        if found is None:
            process.kill()
            raise RuntimeError("the server did not start")
        made = cls(process, found[1], int(found[2]))
        end = time.monotonic() + READY
        while made.ask("GET", "/healthz")[0] != 200:
            if time.monotonic() > end:
                made.end()
                raise RuntimeError("the server was not ready")
            time.sleep(0.1)
        return made

    def ask(self, method: str, path: str, body: bytes = b"") -> tuple[int, Any]:
        """Status and JSON; 0 where nobody answers, -1 where the answer does not come."""
        connection = HTTPConnection(self.host, self.port, timeout=ASKING)
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
        """Its processes, but itself and Python's own helpers."""
        return [p for p in _children(self.process.pid) if b"spawn_main" in _line(p)]

    def end(self) -> None:
        """Stop it, whatever it does."""
        self.process.kill()
        self.process.wait()


@dataclass
class Load:
    """Clients that ask without a pause."""

    server: Server
    counts: Counter[str] = field(default_factory=Counter)
    over: threading.Event = field(default_factory=threading.Event)
    gone: threading.Event = field(default_factory=threading.Event)
    """That the server was killed: no answer is the right one."""

    def ask(self, say: Callable[[str], None]) -> None:
        """Ask for sentences until it is over."""
        body = json.dumps({"text": "A bakery is north of me.", "map": "town"}).encode()
        while not self.over.is_set():
            status, told = self.server.ask("POST", "/v1/locate", body)
            if self.gone.is_set():
                return
            code = told.get("code", "") if isinstance(told, dict) else ""
            if status == 200:
                outcome = "accepted"
            elif status in (500, 503, 504) and code in HONEST:
                outcome = "typed"
            else:
                outcome = "hang" if status < 0 else "untyped"
                say(f"under load: {status} {str(told)[:200]}")
            self.counts[outcome] += 1

    @contextmanager
    def on(self, clients: int, say: Callable[[str], None]) -> Iterator[None]:
        """Ask with so many clients meanwhile."""
        threads = [threading.Thread(target=self.ask, args=(say,)) for _ in range(clients)]
        for thread in threads:
            thread.start()
        try:
            yield
        finally:
            self.over.set()
            for thread in threads:
                thread.join()


def kills_under_load(inputs: Path, effort: Effort, rng: Generator, seconds: float) -> Iterator[Row]:
    """Kill workers, then the server itself, while clients ask."""
    import shutil

    maps, room = effort.folder / "maps", effort.folder / "serving"
    for folder in (maps, room):
        folder.mkdir()
    for name in ("town.city", "flat.scene"):
        shutil.copy(inputs / name, maps)
    server = Server.start(maps, room)
    start, load, killed = time.perf_counter(), Load(server), 0
    with load.on(2, effort.say):
        while not killed or time.perf_counter() - start < seconds / 2:
            time.sleep(3.0 * rng.random())
            if there := server.workers():
                with suppress(ProcessLookupError):
                    os.kill(there[int(rng.integers(len(there)))], signal.SIGKILL)
                killed += 1
    taken, what = time.perf_counter() - start, "a server's workers killed under load"
    said = f"{killed} killed while so many requests were answered"
    yield Row.counted("faults", what, load.counts, effort.seed, taken, said)
    start, counts = time.perf_counter(), Counter[str]()
    while True:
        counts[_killed(server, effort, rng)] += 1
        if time.perf_counter() - start > seconds / 2:
            break
        server = Server.start(maps, room)
    taken = time.perf_counter() - start
    yield Row.counted("faults", "a server killed under load", counts, effort.seed, taken)


def _killed(server: Server, effort: Effort, rng: Generator) -> str:
    """Kill a server while it answers: its workers end by themselves."""
    load = Load(server)
    workers = server.workers()
    with load.on(2, effort.say):
        time.sleep(2.0 * rng.random())
        load.gone.set()
        server.end()
    end = time.monotonic() + ASKING
    while any(_line(worker) for worker in workers):
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


def _line(number: int) -> bytes:
    """Command line of a process; nothing of one that has ended."""
    try:
        return Path(f"/proc/{number}/cmdline").read_bytes()
    except OSError:
        return b""
