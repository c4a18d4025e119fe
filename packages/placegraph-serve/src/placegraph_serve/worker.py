"""A process that answers: it holds the maps open, and takes one request after the other."""

from __future__ import annotations

import logging
import os
import signal
import sys
import traceback
import warnings
from importlib import import_module
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, NamedTuple

import orjson

from placegraph.errors import PlacegraphError, RequestError
from placegraph_serve.options import ServeOptions
from placegraph_serve.places import Desk, Places
from placegraph_serve.problem import problem

if TYPE_CHECKING:
    from multiprocessing.connection import Connection


LOG = logging.getLogger("placegraph_serve")
VERBS = {
    "warm": "locate:warm",
    "look": "localize:warm",
    "plan": "localize:plan",
    "locate": "locate:locate",
    "search": "photon:search",
    "localize": "localize:localize",
    "geopose": "geopose:geopose",
    "begin": "steps:begin",
    "step": "steps:step",
    "end": "steps:end",
}
"""What can be asked, and the function of `placegraph_serve` that answers."""

Answer = tuple[bytes | None, dict[str, Any] | None]
"""A body, or else a problem."""


class Setting(NamedTuple):
    """What a process needs to begin."""

    paths: tuple[Path, ...]
    options: ServeOptions
    warm: str
    """Verb that makes a process ready."""
    compiled: Path | None
    """Folder of compiled code, where one was chosen."""


def answer(desk: Desk, verb: str, asked: Any) -> Answer:  # noqa: ANN401
    """Answer one request; whatever goes wrong becomes a problem."""
    module, function = VERBS[verb].split(":")
    start = perf_counter()
    try:
        made = getattr(import_module(f"placegraph_serve.{module}"), function)(desk, asked)
        if isinstance(made, bytes):
            return made, None
        return dumped(made | {"seconds": round(perf_counter() - start, 4)}), None
    except Exception as error:  # noqa: BLE001  # a server goes on
        if not isinstance(error, PlacegraphError | MemoryError):
            # without its message, whose words may be the asker's
            where = "".join(traceback.format_tb(error.__traceback__))
            LOG.error("a request failed: %s\n%s", type(error).__name__, where)  # noqa: TRY400
        if isinstance(error, MemoryError):
            error = RequestError(
                "This takes more memory than there is; send less.", status=413, code="memory"
            )
        return None, problem(error)


def dumped(told: object) -> bytes:
    """JSON, which has no NaN and no infinity: they become null."""
    return orjson.dumps(told, option=orjson.OPT_SERIALIZE_NUMPY | orjson.OPT_NON_STR_KEYS)


def run(connection: Connection, setting: Setting) -> None:
    """Answer until the other end is closed; a busy process is ended by its parent alone."""
    from placegraph.core import cache

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent lets running answers end
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    warnings.simplefilter("ignore")
    cache.FOLDERS.choose(setting.compiled)
    try:
        desk = Desk(Places(setting.paths, setting.options.scheduler), setting.options)
        answer(desk, setting.warm, None)
        connection.send((b"", None))
        while True:
            verb, asked = connection.recv()
            connection.send(answer(desk, verb, asked))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        pass
    except PlacegraphError as error:
        connection.send((None, problem(error)))
    sys.stdout.flush()
    os._exit(0)  # threads of libraries are not waited for
