"""Server state that the routes share: maps, limits, queues, sessions, counts."""

from __future__ import annotations

import asyncio
import json
import secrets
from collections.abc import AsyncIterator
from typing import Any

from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.websockets import WebSocket, WebSocketDisconnect

from placegraph.core import cache
from placegraph.errors import PlacegraphError, RequestError
from placegraph_serve.limits import Metrics, check_depth
from placegraph_serve.options import ServeOptions
from placegraph_serve.places import Places
from placegraph_serve.problem import MEDIA_TYPE, problem
from placegraph_serve.requests import BeginSession, Step
from placegraph_serve.workers import Answer, Setting, WorkerQueue, to_json


class Server:
    """Maps, limits, queues, sessions, counts."""

    def __init__(self, places: Places, options: ServeOptions) -> None:
        self.places, self.options = places, options
        self.metrics = Metrics(self.now)
        folder = cache.FOLDERS.chosen
        words = Setting(places.paths, options, "warm", folder)
        frames = Setting(places.paths, options, "look", folder)
        seconds = options.sentence_seconds, options.capture_seconds
        self.sentences = WorkerQueue("sentences", options.sentence_workers, seconds[0], words)
        self.captures = WorkerQueue("captures", options.capture_workers, seconds[1], frames)
        self.steps = WorkerQueue("steps", 1, seconds[1], frames)
        self.sessions = Sessions(self.steps, options)

    @property
    def queues(self) -> tuple[WorkerQueue, ...]:
        """All queues."""
        return self.sentences, self.captures, self.steps

    async def ask(
        self, queue: WorkerQueue, verb: str, body: dict[str, Any], client: Request
    ) -> Response:
        """Answer of a worker queue as a response; what waits for a worker ends when its client leaves."""

        async def leave() -> None:
            while (await client.receive())["type"] != "http.disconnect":
                pass

        def take() -> dict[str, Any]:
            leaving.cancel()
            return body

        asking = asyncio.ensure_future(queue.ask(verb, take))
        leaving = asyncio.ensure_future(leave())
        leaving.add_done_callback(lambda left: left.cancelled() or asking.cancel())
        try:
            return response_of(*await asking)
        except asyncio.CancelledError:
            if not leaving.done():
                raise
            return Response(status_code=499)  # for the counts: nobody reads it
        finally:
            leaving.cancel()

    def now(self) -> dict[tuple[str, str], float]:
        """Return the values of this moment, by name and queue."""
        values: dict[tuple[str, str], float] = {("sessions", ""): len(self.sessions)}
        for queue in self.queues:
            values["waiting", queue.name] = queue.waiting
            values["running", queue.name] = queue.running
            values["answered_total", queue.name] = queue.answered
            values["workers_replaced_total", queue.name] = queue.replaced
        return values


def response_of(body: bytes | None, trouble: dict[str, Any] | None) -> Response:
    """A body, or a problem, as a response."""
    if trouble is None:
        return Response(body, media_type="application/json")
    headers = {"Retry-After": str(trouble["retry_after"])} if "retry_after" in trouble else {}
    return JSONResponse(trouble, trouble["status"], headers, media_type=MEDIA_TYPE)


async def receive_texts(socket: WebSocket) -> AsyncIterator[str]:
    """Accept a WebSocket and yield its messages until it is closed; bytes close it."""
    await socket.accept()
    try:
        while True:
            yield await socket.receive_text()
    except WebSocketDisconnect:
        pass
    except KeyError:  # bytes, which have no text
        await socket.close(1003, "Send text, as JSON.")


class Sessions:
    """Sessions by id; their trackers stand in the one process of the queue."""

    def __init__(self, queue: WorkerQueue, options: ServeOptions) -> None:
        self._queue, self._options = queue, options
        self._ends: dict[str, asyncio.TimerHandle] = {}
        self._steps: dict[str, int] = {}
        self._clients: dict[str, str] = {}
        self._ending: set[asyncio.Task[Answer]] = set()

    def __len__(self) -> int:
        return len(self._ends)

    async def open(
        self, request: BeginSession, client: str = ""
    ) -> tuple[dict[str, Any] | None, dict[str, Any] | None]:
        """Begin a session of a client (its address): its id and seconds to live, or a problem."""
        most = self._options.client_sessions
        if sum(holder == client for holder in self._clients.values()) >= most:
            raise RequestError(
                f"You have {most} open sessions, and no client may have more; end one of them.",
                status=429, code="sessions", retry_after=30,
            )  # fmt: skip
        if len(self) >= self._options.sessions:
            raise RequestError(
                "Too many sessions are open; end one, or try again later.",
                status=503, code="busy", retry_after=30,
            )  # fmt: skip
        session = secrets.token_urlsafe(16)
        self._clients[session] = client
        self._alive(session)
        body, trouble = await self._queue.ask("begin", request.model_dump() | {"session": session})
        if trouble is not None:
            self._forget(session)
            return None, trouble
        self._alive(session)
        reply = {"session": session, "expires_s": self._options.session_seconds}
        return reply | json.loads(body or b"{}"), None

    async def step(self, session: str, request: Step) -> Answer:
        """One step; `RequestError` (404) where there is no such session."""
        self._check(session)
        self._alive(session)
        self._steps[session] += 1
        given = request.model_dump() | {"session": session, "number": self._steps[session]}
        reply = await self._queue.ask("step", given)
        if reply[1] is not None and reply[1]["code"] in {"session_over", "worker_died", "too_long"}:
            self._forget(session)
        return reply

    async def end(self, session: str) -> None:
        """End a session; `RequestError` (404) where there is none."""
        self._check(session)
        self._over(session)

    async def follow(self, socket: WebSocket, session: str) -> None:
        """Answer steps that come over a WebSocket, one after the other."""
        async for text in receive_texts(socket):
            try:
                check_depth(text.encode(), self._options.depth)
                body, trouble = await self.step(session, Step.read(text, "message"))
            except PlacegraphError as error:
                body, trouble = None, problem(error)
            await socket.send_text((body or to_json(trouble)).decode())

    def _check(self, session: str) -> None:
        if session not in self._ends:
            raise RequestError(
                "The session does not exist or has ended; start a new one.",
                status=404, code="session_unknown",
            )  # fmt: skip

    def _alive(self, session: str) -> None:
        """Let a session live for its time from now on."""
        if session in self._ends:
            self._ends[session].cancel()
        later = asyncio.get_running_loop().call_later
        self._ends[session] = later(self._options.session_seconds, self._over, session)
        self._steps.setdefault(session, -1)

    def _over(self, session: str) -> None:
        self._forget(session)
        ending = asyncio.ensure_future(self._queue.ask("end", {"session": session}))
        self._ending.add(ending)
        ending.add_done_callback(self._ending.discard)

    def _forget(self, session: str) -> None:
        self._steps.pop(session, None)
        self._clients.pop(session, None)
        if (timer := self._ends.pop(session, None)) is not None:
            timer.cancel()
