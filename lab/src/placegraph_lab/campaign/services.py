"""Services that others run: Milvus and a Dask scheduler are stopped and started, or are none at all."""

from __future__ import annotations

import logging
import os
import signal
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph.errors import PlacegraphError
from placegraph_lab.campaign.outages import ASKING
from placegraph_lab.campaign.row import Row

if TYPE_CHECKING:
    from placegraph_lab.campaign.row import Effort


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
            for worker in world.planets[folder.name].crew.client.run(os.getpid).values():
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
