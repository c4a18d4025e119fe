"""A server in processes of its own, and wrk that asks it."""

from __future__ import annotations

import asyncio
import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any
from urllib.error import URLError
from urllib.request import urlopen

from placegraph.errors import OptionError

SCRIPT = Path(__file__).with_name("requests.lua")
TICK = 1.0 / os.sysconf("SC_CLK_TCK")
PAGE = os.sysconf("SC_PAGE_SIZE")
STARTING = 300.0
"""A server that is not ready after so long is given up [s]."""


@dataclass(frozen=True)
class Request:
    """What is asked."""

    method: str
    path: str
    body: bytes = b""
    kind: str = "application/json"

    @classmethod
    def of(cls, path: str, **told: Any) -> Request:  # noqa: ANN401  # any JSON
        """POST of JSON."""
        return cls("POST", path, json.dumps(told).encode())

    @property
    def bytes(self) -> bytes:
        """As the script reads it."""
        return f"{self.method} {self.path} {self.kind} {len(self.body)}\n".encode() + self.body


@dataclass(frozen=True)
class Served:
    """A server that runs."""

    process: subprocess.Popen[str]
    url: str

    @cached_property
    def processes(self) -> list[int]:
        """Itself and its workers, as they are at first; of one that died nothing is known."""
        every = (int(path.name) for path in Path("/proc").iterdir() if path.name.isdigit())
        own = self.process.pid
        return [own, *(process for process in every if _stat(process)[1] == str(own))]

    def cpu(self) -> float:
        """Time of all cores that its processes have taken [s]."""
        stats = [_stat(p) for p in self.processes]
        return sum(int(x) for stat in stats for x in stat[11:13]) * TICK

    def memory(self) -> float:
        """What its processes hold [MB], resident; shared pages count in each."""
        return sum(int(_stat(p)[21]) for p in self.processes) * PAGE * 1e-6

    def asked(
        self, requests: Iterable[Request], file: Path, *, at_once: int, seconds: int
    ) -> dict[str, Any]:
        """What wrk saw of requests in turn, so many at once, and the CPU that each took.

        Raises `OptionError` where wrk is not installed.
        """
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
    """Fields of a process after its name, from its state on; zeros where it is gone."""
    try:
        text = Path(f"/proc/{process}/stat").read_text()
    except OSError:
        return ["0"] * 50
    return text.rpartition(")")[2].split()


@contextmanager
def served(folder: Path) -> Iterator[Served]:
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
        yield Served(process, found[0])
    finally:
        process.terminate()
        process.wait()


def _is_ready(url: str) -> bool:
    try:
        with urlopen(url, timeout=5) as answer:  # noqa: S310  # our own server
            return bool(answer.status == 200)
    except (URLError, OSError):
        return False


async def idle(server: Served, count: int, request: dict[str, Any]) -> dict[str, Any]:
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
