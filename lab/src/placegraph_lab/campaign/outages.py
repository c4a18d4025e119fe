"""Milvus servers that are none, or have just stopped."""

from __future__ import annotations

import socket
import threading
import time
from collections import Counter
from contextlib import suppress
from typing import TYPE_CHECKING

from placegraph.errors import PlacegraphError
from placegraph_lab.campaign.row import Row

if TYPE_CHECKING:
    from collections.abc import Iterator

    from placegraph_lab.campaign.row import Effort

ASKING = 120.0
"""What does not answer for so long hangs [s]."""


def endpoints(effort: Effort) -> Iterator[Row]:
    """What is no Milvus server, or one that has just stopped: nobody, who never answers, who hangs up."""
    try:
        import pymilvus  # noqa: F401
    except ImportError:
        effort.say("pymilvus is not installed: no server is asked")
        return
    start, counts = time.perf_counter(), Counter[str]()
    for said in (
        None,
        b"",
        b"HTTP/1.1 200 OK\r\n\r\n",
        b"\x00\x00\x00\x04\x00\x00\x00\x00\x00",
        b"gone",
    ):
        counts[_connected(said, effort)] += 1
    taken = time.perf_counter() - start
    yield Row.counted("faults", "a Milvus server that is none", counts, effort.seed, taken)


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
        start = time.perf_counter()
        try:
            open_store(f"http://127.0.0.1:{port}", name="any", timeout=2.0)
        except PlacegraphError:
            found = "typed"
        except Exception as error:  # noqa: BLE001  # it is counted
            effort.say(f"Milvus, {said!r}: {type(error).__name__}: {error}")
            found = "untyped"
        else:
            found = "untyped"
        finally:
            over.set()
            thread.join()
    return found if time.perf_counter() - start < ASKING else "hang"
