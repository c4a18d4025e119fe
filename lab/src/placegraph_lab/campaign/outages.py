"""A server whose workers are killed under load, or which is killed itself."""

from __future__ import annotations

import json
import logging
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field, replace
from http.client import HTTPConnection, HTTPException
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator

from placegraph.errors import PlacegraphError
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


SENTENCE = "A bakery is north of me. A church is south of me."


def services(inputs: Path, effort: Effort, seconds: float) -> Iterator[Row]:
    """Rows of every service that is installed here, half of the time each."""
    for what, packages, work in (
        ("a Milvus server that is none", ("pymilvus",), connections),
        ("a Milvus server stopped and started", ("pymilvus", "milvus"), milvus),
        ("a Dask scheduler stopped and started", ("distributed",), scheduler),
    ):
        if lacking := [name for name in packages if find_spec(name) is None]:
            effort.say(f"{what}: {', '.join(lacking)} is not installed")
            continue
        start = time.perf_counter()
        counts = work(inputs, effort, seconds / 2)
        yield Row.counted("faults", what, counts, effort.seed, time.perf_counter() - start)


def milvus(inputs: Path, effort: Effort, seconds: float) -> Counter[str]:  # noqa: ARG001  # of its own
    """What becomes of searches while a server goes, and comes again with what it held."""
    from milvus import MilvusServer
    from placegraph.vectors import Origin, Vectors, load_store, open_store

    rng, counts = np.random.default_rng(effort.seed), Counter[str]()
    vectors = rng.standard_normal((200, 16)).astype(np.float32)
    server = MilvusServer()
    server.set_base_dir(str(effort.folder / "milvus"))
    server.start()
    try:
        at = f"http://127.0.0.1:{server.listen_port}"
        load_store(
            at, Vectors.of(np.arange(200), vectors), name="any", origin=Origin(), timeout=60.0
        ).close()
        start = time.perf_counter()
        while not counts or time.perf_counter() - start < seconds:
            store = open_store(f"http://127.0.0.1:{server.listen_port}", name="any", timeout=60.0)
            with closing(store):
                ask = lambda store=store: store.search(vectors[:3], 1).ids[:, 0].tolist()  # noqa: E731
                counts[judged(ask, [0, 1, 2], effort)] += 1
                server.stop()
                counts[judged(ask, None, effort)] += 1
            server.start()
    finally:
        server.stop()
    return counts


def scheduler(inputs: Path, effort: Effort, seconds: float) -> Counter[str]:
    """What becomes of sentences while all workers are killed, and the scheduler goes and comes again."""
    from distributed import LocalCluster

    from placegraph.world.world import open_world
    from placegraph_scale.build import BuildOptions, build_world

    def started(port: int) -> LocalCluster:
        return LocalCluster(
            n_workers=1, threads_per_worker=1, dashboard_address=":0", scheduler_port=port,
            silence_logs=logging.CRITICAL,
        )  # fmt: skip

    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    folder, counts = effort.folder / "shards", Counter[str]()
    build_world([inputs / "hafenstadt.osm"], folder, BuildOptions(zoom=15, overlap=50.0, workers=1))
    wanted = open_world(folder).locate(SENTENCE).to_dict()
    cluster = started(0)
    try:
        world: Any = open_world(folder, scheduler=cluster.scheduler_address)
        port = int(cluster.scheduler_address.rpartition(":")[2])
        ask = lambda: world.locate(SENTENCE).to_dict()  # noqa: E731
        start = time.perf_counter()
        while not counts or time.perf_counter() - start < seconds:
            counts[judged(ask, wanted, effort)] += 1
            for worker in world.planets[folder.name].pool.client.run(os.getpid).values():
                os.kill(worker, signal.SIGKILL)
            counts[judged(ask, wanted, effort)] += 1
            cluster.close()
            counts[judged(ask, None, effort)] += 1
            cluster = started(port)
        counts[judged(ask, wanted, effort)] += 1
        world.close()
    finally:
        cluster.close()
    return counts


def judged(ask: Callable[[], object], wanted: object, effort: Effort) -> str:
    """Outcome of a question: this answer is right, or, where it is None, a typed error."""
    start = time.perf_counter()
    try:
        found = ask()
    except PlacegraphError as error:
        outcome, said = "untyped" if wanted is not None else "typed", str(error)
    except Exception as error:  # noqa: BLE001  # it is counted
        outcome, said = "untyped", f"{type(error).__name__}: {error}"
    else:
        outcome, said = "accepted" if found == wanted else "untyped", "another answer"
    if outcome == "untyped":
        effort.say(f"a service: {said[:300]}")
    return outcome if time.perf_counter() - start < ASKING else "hang"


def connections(inputs: Path, effort: Effort, seconds: float) -> Counter[str]:  # noqa: ARG001
    """What becomes of those who connect to what hangs up, says nothing, babbles, or is gone."""
    said = (None, b"", b"HTTP/1.1 200 OK\r\n\r\n", b"\0\0\0\4\0\0\0\0\0", b"gone")
    return Counter(_connected(each, effort) for each in said)


def _connected(said: bytes | None, effort: Effort) -> str:
    """Connect to a socket that says something: None hangs up, empty says nothing, `gone` is closed."""
    from placegraph.vectors import open_store

    with socket.create_server(("127.0.0.1", 0)) as listening:
        port = listening.getsockname()[1]
        over = threading.Event()

        def answer() -> None:
            held = []
            listening.settimeout(0.1)
            while not over.is_set():
                with suppress(OSError):
                    connection, _ = listening.accept()
                    if said is None:
                        connection.close()
                        continue
                    connection.sendall(said)
                    held.append(connection)
            for connection in held:
                connection.close()

        thread = threading.Thread(target=answer)
        thread.start()
        if said == b"gone":
            over.set()
            thread.join()
            listening.close()
        try:
            return judged(
                lambda: open_store(f"http://127.0.0.1:{port}", name="any", timeout=2.0),
                None,
                effort,
            )
        finally:
            over.set()
            thread.join()


TYPED, UNTYPED = 20, 21  # exit codes of a trial
CHANGES = ("cut short", "deleted", "replaced", "overwritten", "older")


def change(path: Path, how: str, rng: Generator) -> None:
    """Do it to a file; `older` is another file, last changed long before: a clock was set back."""
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
    """A city's map, and a sentence in it; one with an index is mapped, as a large one is."""
    from placegraph.outdoor.city import CityMap

    found = CityMap.open(path, shard=True)
    return lambda: found.locate(SENTENCE)


def scene(path: Path) -> Callable[[], Any]:
    """A scene's map, and a window of frames in it."""
    from placegraph.io.capture.capture import open_capture
    from placegraph.maps import open_scene

    found, frames = open_scene(path), open_capture(path.parent / "window")
    return lambda: found.localize(frames, seed=0)


def library(path: Path) -> Callable[[], Any]:
    """A library, one of whose maps is looked into."""
    from placegraph.indoor.library import SceneLibrary

    found = SceneLibrary.open(path.with_name("homes.library"))
    return lambda: len(found.scene("home1"))


def vectors(path: Path) -> Callable[[], Any]:
    """Vectors of a city, and those nearest to one of them."""
    from placegraph.vectors import EmbeddedStore

    found = EmbeddedStore.open(path)
    return lambda: found.search(np.ones((1, found.dimension), np.float32), 3)


def capture(path: Path) -> Callable[[], Any]:
    """A folder of frames, one of whose images is asked for."""
    from placegraph.io.capture.capture import open_capture

    found = open_capture(path.parent.parent)
    return lambda: [frame.rgb() for frame in found]


def bag(path: Path) -> Callable[[], Any]:
    """A bag whose images are asked for."""
    from placegraph.io.capture.capture import open_capture

    found = open_capture(path)
    return lambda: [frame.rgb() for frame in found]


def weights(path: Path) -> Callable[[], Any]:
    """Weights of PyTorch, which are computed with."""
    import torch

    from placegraph.core.networks import read_state

    found = read_state(torch, path, "test")
    return lambda: float(sum(tensor.sum() for tensor in found.values()))


USES: dict[str, tuple[str, Callable[[Path], Callable[[], Any]]]] = {
    "a city's map": ("town.city", city),
    "a city's map that is mapped": ("indexed.city", city),
    "a scene's map": ("flat.scene", scene),
    "a map of a library": ("home1.scene", library),
    "vectors": ("town.vectors", vectors),
    "an image of a capture": ("window/rgb/*", capture),
    "a bag": ("walk.mcap", bag),
    "weights": ("any.pt", weights),
}
"""What is opened: its file among the inputs, and how it is used."""


def used(what: str, how: str, folder: Path, seed: int) -> None:
    """Open, let something happen to the file, and use what was opened; ends the process."""
    pattern, use = USES[what]
    path = max(folder.glob(pattern))
    code = 0
    try:
        ask = use(path)
        change(path, how, np.random.default_rng(seed))
        ask()
    except PlacegraphError:
        code = TYPED
    except BaseException as error:  # noqa: BLE001  # it is counted
        (folder / "said.txt").write_text(f"{type(error).__name__}: {error}")
        code = UNTYPED
    os._exit(code)


def served_anew(folder: Path) -> bool:
    """Whether a server's maps are opened anew where another takes a map's place, of any time."""
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
