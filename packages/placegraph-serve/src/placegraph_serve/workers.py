"""Worker processes that hold the maps open, and the queues in front of them."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import sys
import traceback
import warnings
from contextlib import suppress
from importlib import import_module
from multiprocessing import get_context
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import orjson

from placegraph.errors import PlacegraphError, RequestError
from placegraph_serve.options import ServeOptions
from placegraph_serve.places import Dispatcher, Places
from placegraph_serve.problem import problem

if TYPE_CHECKING:
    from multiprocessing.connection import Connection
    from multiprocessing.context import ForkServerProcess

LOG = logging.getLogger("placegraph_serve")
VERBS = {
    "warm": "locate:warm",
    "look": "localize:warm",
    "plan": "localize:plan",
    "locate": "locate:locate",
    "live": "locate:live",
    "search": "photon:search",
    "reverse": "photon:reverse",
    "localize": "localize:localize",
    "geopose": "geopose:geopose",
    "begin": "localize:begin_session",
    "step": "localize:step",
    "end": "localize:end",
}
"""Requests to a worker, and the function of `placegraph_serve` that answers each."""

Answer = tuple[bytes | None, dict[str, Any] | None]
"""A body, or else a problem."""


class Setting(NamedTuple):
    """Settings of a worker process."""

    paths: tuple[Path, ...]
    options: ServeOptions
    warm: str
    """Verb that makes a process ready."""
    compiled: Path | None
    """Folder of compiled code, where one was chosen."""


def answer(dispatcher: Dispatcher, verb: str, request: Any) -> Answer:  # noqa: ANN401
    """Answer one request; whatever goes wrong becomes a problem."""
    module, function = VERBS[verb].split(":")
    start = perf_counter()
    try:
        made = getattr(import_module(f"placegraph_serve.{module}"), function)(dispatcher, request)
        if isinstance(made, bytes):
            return made, None
        return to_json(made | {"seconds": round(perf_counter() - start, 4)}), None
    except Exception as error:  # noqa: BLE001  # a server goes on
        if not isinstance(error, PlacegraphError | MemoryError):
            # without its message, whose words may be the asker's
            where = "".join(traceback.format_tb(error.__traceback__))
            LOG.error("a request failed: %s\n%s", type(error).__name__, where)  # noqa: TRY400
        if isinstance(error, MemoryError):
            error = RequestError(
                "The request needs more memory than is available; send less.",
                status=413,
                code="memory",
            )
        return None, problem(error)


def to_json(value: object) -> bytes:
    """JSON, which has no NaN and no infinity: they become null."""
    return orjson.dumps(value, option=orjson.OPT_SERIALIZE_NUMPY | orjson.OPT_NON_STR_KEYS)


def run(connection: Connection, setting: Setting) -> None:
    """Answer until the other end is closed; a busy process is ended by its parent alone."""
    from placegraph.core import cache

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent lets running answers end
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    warnings.simplefilter("ignore")
    cache.FOLDERS.choose(setting.compiled)
    try:
        options = setting.options
        dispatcher = Dispatcher(Places(setting.paths, options.scheduler, options.memory), options)
        answer(dispatcher, setting.warm, None)
        connection.send((b"", None))
        while True:
            verb, request = connection.recv()
            connection.send(answer(dispatcher, verb, request))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        pass
    except PlacegraphError as error:
        connection.send((None, problem(error)))
    sys.stdout.flush()
    os._exit(0)  # threads of libraries are not waited for


QUERIES = logging.getLogger("placegraph.queries")
STARTING = 600.0
"""A process that is not ready after so long is given up [s]."""
PRELOADED = [
    "placegraph.view.city.page", "placegraph.outdoor.city", "placegraph_serve.locate",
    "placegraph_serve.localize",
]  # fmt: skip
"""Modules that one process imports, from which all workers are forked before they open maps."""
_PAUSE = 1.0
"""Before a process that did not start is tried again [s]."""


class Worker:
    """A process and the pipe to it."""

    def __init__(self, name: str, setting: Setting) -> None:
        context = get_context("forkserver")
        context.set_forkserver_preload(PRELOADED)
        self.connection: Connection
        self.connection, other_end = context.Pipe()
        self.process: ForkServerProcess = context.Process(
            target=run, args=(other_end, setting), name=f"placegraph {name}", daemon=True
        )
        self.process.start()
        self.state: Literal["starting", "idle", "busy"] = "starting"
        other_end.close()

    async def ask(self, request: tuple[str, Any], seconds: float) -> Answer:
        """Send a request, and wait for its answer; raises EOFError, OSError or TimeoutError."""
        self.connection.send(request)
        return await self.receive(seconds)

    async def receive(self, seconds: float) -> Answer:
        """Wait for what the process says next."""
        loop = asyncio.get_running_loop()
        arrived = loop.create_future()
        number = self.connection.fileno()

        def notify() -> None:
            if not arrived.done():
                arrived.set_result(None)

        loop.add_reader(number, notify)
        try:
            async with asyncio.timeout(seconds):
                await arrived
        finally:
            loop.remove_reader(number)
        reply: Answer = self.connection.recv()
        return reply

    def end(self) -> None:
        """End it, whatever it does."""
        self.process.kill()
        self.process.join()
        self.connection.close()


class WorkerQueue:
    """Processes of one kind.

    Made within a running loop's server, begun by `start`; `ask` may be called by many at once.
    """

    def __init__(self, name: str, count: int, seconds: float, setting: Setting) -> None:
        self.name, self.count, self.seconds, self.setting = name, count, seconds, setting
        self.waiting = 0
        self.running = 0
        self.answered = 0
        """Requests that were answered since the start, over WebSockets as well."""
        self.replaced = 0
        """Processes that died or were ended since the start."""
        self._idle: asyncio.Queue[Worker] = asyncio.Queue()
        self._workers: set[Worker] = set()
        self._tasks: set[asyncio.Task[Any]] = set()
        self._problem: dict[str, Any] | None = None
        self._ended = False

    @property
    def ready(self) -> bool:
        """Whether a process has opened its maps."""
        return any(worker.state != "starting" for worker in self._workers)

    def start(self) -> None:
        """Start all processes; they become ready one by one."""
        for _ in range(self.count):
            self._keep(self._start())

    async def ask(self, verb: str, request: Any) -> Answer:  # noqa: ANN401  # of the verb
        """Answer of a process; a problem where it died or took too long, or too many wait already.

        `request` may be a function that is called once a process is free. Who is cancelled while
        waiting costs nothing; a request that runs is let run, for nobody.
        """
        if self.waiting >= self.setting.options.queue:
            return None, self._busy()
        self.waiting += 1
        try:
            async with asyncio.timeout(self.seconds):
                worker = await self._idle.get()
                while worker not in self._workers:  # it died while it was idle
                    worker = await self._idle.get()
        except TimeoutError:
            return None, self._problem or self._busy()
        finally:
            self.waiting -= 1
        request = request() if callable(request) else request
        if self.setting.options.log_queries and isinstance(request, dict):
            fields = request.get("request") or request
            said = {
                k: fields[k] for k in ("text", "q", "description", "near", "map") if fields.get(k)
            }
            QUERIES.info("%s %s", verb, said)
        return await asyncio.shield(self._keep(self._run(worker, verb, request)))

    async def end(self) -> None:
        """End all processes."""
        self._ended = True
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        for worker in list(self._workers):
            self._drop(worker)

    def _busy(self) -> dict[str, Any]:
        return problem(RequestError(
            f"Too many {self.name} are waiting; try again in a moment.",
            status=503, code="busy", retry_after=1 + int(self.seconds / 10),
        ))  # fmt: skip

    def _keep(self, work: Any) -> asyncio.Task[Any]:  # noqa: ANN401  # a coroutine
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)  # the loop holds tasks weakly
        task.add_done_callback(self._tasks.discard)
        return task

    async def _run(self, worker: Worker, verb: str, request: Any) -> Answer:  # noqa: ANN401
        self.running += 1
        worker.state = "busy"
        try:
            reply = await worker.ask((verb, request), self.seconds)
        except TimeoutError:
            return self._replace(
                worker,
                f"The request exceeded the time limit of {self.seconds:g} s; send less at a time.",
                504, "too_long",
            )  # fmt: skip
        except (EOFError, OSError):
            return self._replace(
                worker,
                "The process that handled this request died and was replaced; try again.",
                500, "worker_died",
            )  # fmt: skip
        finally:
            self.running -= 1
        self._offer(worker)
        self.answered += 1
        return reply

    def _offer(self, worker: Worker) -> None:
        worker.state = "idle"
        self._idle.put_nowait(worker)

    def _notice_death(self, worker: Worker) -> None:
        """Replace a process that died while nobody waited for it; else `_run` does."""
        asyncio.get_running_loop().remove_reader(worker.process.sentinel)
        if worker.state == "idle":
            self._replace(worker, "The process died.", 500, "worker_died")

    def _replace(self, worker: Worker, why: str, status: int, code: str) -> Answer:
        self._drop(worker)
        self.replaced += 1
        if not self._ended:
            self._keep(self._start())
        return None, problem(RequestError(why, status=status, code=code))

    def _drop(self, worker: Worker) -> None:
        self._workers.discard(worker)
        asyncio.get_running_loop().remove_reader(worker.process.sentinel)
        worker.end()

    async def _start(self) -> None:
        """Start a process, again and again until one is ready."""
        while not self._ended:
            worker = Worker(self.name, self.setting)
            self._workers.add(worker)
            with suppress(EOFError, OSError, TimeoutError):
                _, self._problem = await worker.receive(STARTING)
                if self._problem is None:
                    death = worker.process.sentinel
                    asyncio.get_running_loop().add_reader(death, self._notice_death, worker)
                    self._offer(worker)
                    return
            self._drop(worker)
            await asyncio.sleep(_PAUSE)
