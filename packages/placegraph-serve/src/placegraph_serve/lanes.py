"""Lanes: requests of one kind, and the processes that answer them; no lane holds another up."""

from __future__ import annotations

import asyncio
import logging
from contextlib import suppress
from multiprocessing import get_context
from typing import TYPE_CHECKING, Any

from placegraph.errors import RequestError
from placegraph_serve.problem import problem
from placegraph_serve.worker import Answer, Setting, run

if TYPE_CHECKING:
    from multiprocessing.connection import Connection
    from multiprocessing.context import SpawnProcess

QUERIES = logging.getLogger("placegraph.queries")
STARTING = 600.0
"""A process that is not ready after so long is given up [s]."""
_PAUSE = 1.0
"""Before a process that did not start is tried again [s]."""


class Worker:
    """A process and the pipe to it."""

    def __init__(self, name: str, setting: Setting) -> None:
        context = get_context("spawn")
        self.connection: Connection
        self.connection, theirs = context.Pipe()
        self.process: SpawnProcess = context.Process(
            target=run, args=(theirs, setting), name=f"placegraph {name}", daemon=True
        )
        self.process.start()
        theirs.close()

    async def ask(self, asked: tuple[str, Any], seconds: float) -> Answer:
        """Send a request, and wait for its answer; raises EOFError, OSError or TimeoutError."""
        self.connection.send(asked)
        return await self.told(seconds)

    async def told(self, seconds: float) -> Answer:
        """Wait for what the process says next."""
        loop = asyncio.get_running_loop()
        there = loop.create_future()
        number = self.connection.fileno()

        def heard() -> None:
            if not there.done():
                there.set_result(None)

        loop.add_reader(number, heard)
        try:
            async with asyncio.timeout(seconds):
                await there
        finally:
            loop.remove_reader(number)
        told: Answer = self.connection.recv()
        return told

    def end(self) -> None:
        """End it, whatever it does."""
        self.process.kill()
        self.process.join()
        self.connection.close()


class Lane:
    """Processes of one kind.

    Made within a running loop's server, begun by `begin`; `ask` may be called by many at once.
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
        return self.running > 0 or not self._idle.empty()

    def begin(self) -> None:
        """Start all processes; they become ready one by one."""
        for _ in range(self.count):
            self._keep(self._start())

    async def ask(self, verb: str, asked: Any) -> Answer:  # noqa: ANN401  # of the verb
        """Answer of a process; a problem where it died or took too long, or too many wait already.

        Who is cancelled while waiting costs nothing; a request that runs is let run, for nobody.
        """
        if self.setting.options.log_queries and isinstance(asked, dict):
            told = asked.get("request") or asked
            said = {k: told[k] for k in ("text", "q", "description", "near", "map") if told.get(k)}
            QUERIES.info("%s %s", verb, said)
        if self.waiting >= self.setting.options.queue:
            return None, self._busy()
        self.waiting += 1
        try:
            async with asyncio.timeout(self.seconds):
                worker = await self._idle.get()
        except TimeoutError:
            return None, self._problem or self._busy()
        finally:
            self.waiting -= 1
        return await asyncio.shield(self._keep(self._run(worker, verb, asked)))

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
            f"Too many {self.name} wait already; ask again in a moment.",
            status=503, code="busy", retry_after=1 + int(self.seconds / 10),
        ))  # fmt: skip

    def _keep(self, work: Any) -> asyncio.Task[Any]:  # noqa: ANN401  # a coroutine
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)  # the loop holds tasks weakly
        task.add_done_callback(self._tasks.discard)
        return task

    async def _run(self, worker: Worker, verb: str, asked: Any) -> Answer:  # noqa: ANN401
        self.running += 1
        try:
            told = await worker.ask((verb, asked), self.seconds)
        except TimeoutError:
            return self._replace(
                worker,
                f"This took longer than {self.seconds:g} s and was given up; ask for less at a time.",
                504, "too_long",
            )  # fmt: skip
        except (EOFError, OSError):
            return self._replace(
                worker,
                "The process that worked on this died, and another takes its place; ask again.",
                500, "worker_died",
            )  # fmt: skip
        finally:
            self.running -= 1
        self._idle.put_nowait(worker)
        self.answered += 1
        return told

    def _replace(self, worker: Worker, why: str, status: int, code: str) -> Answer:
        self._drop(worker)
        self.replaced += 1
        if not self._ended:
            self._keep(self._start())
        return None, problem(RequestError(why, status=status, code=code))

    def _drop(self, worker: Worker) -> None:
        self._workers.discard(worker)
        worker.end()

    async def _start(self) -> None:
        """Start a process, again and again until one is ready."""
        while not self._ended:
            worker = Worker(self.name, self.setting)
            self._workers.add(worker)
            with suppress(EOFError, OSError, TimeoutError):
                _, self._problem = await worker.told(STARTING)
                if self._problem is None:
                    self._idle.put_nowait(worker)
                    return
            self._drop(worker)
            await asyncio.sleep(_PAUSE)
