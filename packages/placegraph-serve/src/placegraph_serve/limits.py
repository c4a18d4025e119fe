"""Guards before the routes: keys, hosts and origins, sizes, slow senders, deep JSON; and request counts."""

from __future__ import annotations

import asyncio
import hmac
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from ipaddress import ip_address
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

from h11 import Data, EndOfMessage, Request, Response
from prometheus_client import Counter, Histogram, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from uvicorn.protocols.http.h11_impl import H11Protocol

from placegraph.errors import InputError, RequestError
from placegraph_serve.options import ServeOptions
from placegraph_serve.problem import MEDIA_TYPE, problem
from placegraph_serve.workers import to_json

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

MEDIA_TYPE_METRICS = "text/plain; version=0.0.4; charset=utf-8"
BOUNDS = (0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 120.0)
"""Upper bounds of the histogram of seconds."""
PATHS = ("/v1/locate", "/v1/localize", "/v1/maps", "/v1/sessions", "/geopose", "/api", "/reverse")


class Metrics:
    """Requests by path and status, their seconds, and values of the moment.

    `now` returns these by name and queue (empty: of none).
    """

    def __init__(self, now: Callable[[], Mapping[tuple[str, str], float]] = dict) -> None:
        self.now = now
        self.requests = Counter(
            "placegraph_requests", "Answers.", ("path", "status"), registry=None
        )
        self.seconds = Histogram(
            "placegraph_request_seconds", "Time to an answer [s].", ("path",),
            buckets=BOUNDS, registry=None,
        )  # fmt: skip

    def note(self, path: str, status: int, seconds: float) -> None:
        """Count an answer."""
        secrets = next((p for p in PATHS if path == p or path.startswith(f"{p}/")), "other")
        self.requests.labels(secrets, str(status)).inc()
        self.seconds.labels(secrets).observe(seconds)

    def collect(self) -> list[Metric]:
        """Return the counts, and those of the moment (`now`)."""
        families: dict[str, Any] = {}
        for (name, queue), value in self.now().items():
            kind = CounterMetricFamily if name.endswith("_total") else GaugeMetricFamily
            labels = ("lane",) if queue else ()
            family = families.setdefault(
                name, kind(f"placegraph_{name}", "Current value.", labels=labels)
            )
            family.add_metric(labels and (queue,), value)
        return [*self.requests.collect(), *self.seconds.collect(), *families.values()]

    def text(self) -> bytes:
        """Return the text of `/metrics`."""
        return generate_latest(self)  # all that it asks is to collect


LARGE = ("/v1/localize", "/v1/sessions/", "/geopose")
"""Paths whose bodies carry images."""
SEARCHES = ("/api", "/reverse")
PREFLIGHT = [(b"access-control-allow-methods", b"GET"), (b"access-control-max-age", b"86400"),
             (b"access-control-allow-headers", b"Authorization, X-API-Key")]  # fmt: skip
CLOSED = ("/v1/", "/api/", "/reverse/", "/geopose/", "/metrics/")
"""Paths that need a key where there are keys; the page and the state of health do not."""
_TOKENS = re.compile(rb'"[^"\\]*+(?:\\.[^"\\]*+)*+"|\\.|[\[\]{}]', re.DOTALL)
_MOST_BRACKETS = 200_000


@dataclass(frozen=True)
class Keys:
    """API keys."""

    secrets: tuple[bytes, ...]
    """None: everybody may ask."""

    @classmethod
    def of(cls, path: Path | None) -> Keys:
        """Keys of a file, one a line; lines with # are notes."""
        if path is None:
            return cls(())
        try:
            lines = [line.strip() for line in path.read_text("utf-8").splitlines()]
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"{path} cannot be read ({error}); give a file of keys.") from error
        secrets = tuple(line.encode() for line in lines if line and not line.startswith("#"))
        if not secrets:
            raise InputError(f"{path} contains no key; write one per line.")
        return cls(secrets)

    def let_in(self, scope: Scope) -> bool:
        """Whether a request has a key, in its header or, where there is none, as `key=`."""
        if not self.secrets or not f"{scope['path']}/".startswith(CLOSED):
            return True
        headers = {name: value for name, value in scope["headers"] if name in _HEADERS}
        given = headers.get(b"x-api-key") or headers.get(b"authorization", b"").removeprefix(
            b"Bearer "
        )
        asked = parse_qs(scope["query_string"].decode("latin-1")).get("key", [""])[0]
        given = given or asked.encode()
        # all are compared, each in constant time
        return sum(hmac.compare_digest(given.strip(), key) for key in self.secrets) > 0


_HEADERS = (b"x-api-key", b"authorization")


class HeldBytes:
    """Bytes of one body that are held in memory."""

    def __init__(self, guard: Guard) -> None:
        self._guard, self.bytes = guard, 0

    def hold(self, count: int) -> None:
        """Hold some more; `RequestError` (503) where all bodies together would be too much."""
        self.bytes += count
        self._guard.held_bytes += count
        if self._guard.held_bytes > self._guard.options.held_bytes:
            raise RequestError(
                "The server receives too much data at once; try again in a moment.",
                status=503, code="busy", retry_after=2,
            )  # fmt: skip


class Guard:
    """ASGI middleware that refuses what no route should have to look at."""

    def __init__(self, app: ASGIApp, options: ServeOptions, keys: Keys, metrics: Metrics) -> None:
        self.app, self.options, self.keys, self.metrics = app, options, keys, metrics
        self.sockets = 0
        self.held_bytes = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let a request through, or answer it with a problem."""
        if scope["type"] == "lifespan":
            return await self.app(scope, receive, send)
        start, status, is_open = perf_counter(), 0, self._is_open(scope)

        async def send_counted(message: Message) -> None:
            nonlocal status
            status = message.get("status", status)
            if is_open and message["type"] == "http.response.start":
                headers = [*message["headers"], (b"access-control-allow-origin", b"*")]
                message = {**message, "headers": headers}
            await send(message)

        try:
            return await self._guarded(scope, receive, send_counted)
        finally:
            if scope["type"] == "http":
                self.metrics.note(scope["path"], status, perf_counter() - start)

    async def _guarded(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope.get("method") == "OPTIONS" and self._is_open(scope):
            await send({"type": "http.response.start", "status": 204, "headers": PREFLIGHT})
            return await send({"type": "http.response.body", "body": b""})
        try:
            self._check(scope)
        except RequestError as error:
            return await refuse(scope, receive, send, error)
        if scope["type"] == "http":
            return await self._answer(scope, receive, send)
        self.sockets += 1
        try:
            return await self.app(scope, receive, send)
        finally:
            self.sockets -= 1

    async def _answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        holds = HeldBytes(self)
        try:
            try:
                receive = await self._body(scope, receive, holds)
            except RequestError as error:
                return await refuse(scope, receive, send, error)
            return await self.app(scope, receive, send)
        finally:
            self.held_bytes -= holds.bytes

    def _is_open(self, scope: Scope) -> bool:
        """Whether pages of other hosts may read the answer: they search names (CORS)."""
        path, method = scope["path"].rstrip("/"), scope.get("method")
        return not self.options.same_origin and method in {"GET", "OPTIONS"} and path in SEARCHES

    def _check(self, scope: Scope) -> None:
        if not self.keys.let_in(scope):
            raise RequestError(
                "The key is missing or unknown; send it as `Authorization: Bearer KEY`.",
                status=401, code="key",
            )  # fmt: skip
        check_host(scope, self.options.names, has_keys=bool(self.keys.secrets))
        if not self._is_open(scope):
            check_origin(scope, self.options.names)
        if scope["type"] == "websocket" and self.sockets >= self.options.sockets:
            raise RequestError(
                "Too many WebSockets are open; try again later.",
                status=503, code="busy", retry_after=10,
            )  # fmt: skip

    async def _body(self, scope: Scope, receive: Receive, holds: HeldBytes) -> Receive:
        """Check a small body whole, and count a large one while it is read."""
        headers = dict(scope["headers"])
        large = scope["path"].startswith(LARGE)
        most = self.options.body_bytes if large else self.options.json_bytes
        if large and scope["path"] != LARGE[0]:  # one image in base64, and its depth
            most = min(most, 3 * self.options.image_bytes)
        announced = headers.get(b"content-length", b"0")
        if announced.isdigit() and int(announced) > most:
            raise _too_large(int(announced), most)
        deadline = asyncio.get_running_loop().time() + self.options.body_seconds
        counted = _counted(receive, most, deadline)
        multipart = headers.get(b"content-type", b"").startswith(b"multipart/")
        if scope["method"] in {"GET", "HEAD", "DELETE"} or multipart:
            return counted
        body = bytearray()
        while True:
            message = await counted()
            body += message.get("body", b"")
            holds.hold(len(message.get("body", b"")))
            if message["type"] != "http.request" or not message.get("more_body", False):
                break
        check_depth(body, self.options.depth)
        return _replayed({**message, "body": bytes(body)}, receive)


async def refuse(scope: Scope, receive: Receive, send: Send, error: RequestError) -> None:
    """Answer with a problem, in place of the application."""
    reply = problem(error)
    if scope["type"] == "websocket":
        await receive()
        return await send(
            {"type": "websocket.close", "code": 1008, "reason": reply["detail"][:120]}
        )
    headers = [(b"content-type", MEDIA_TYPE.encode()), (b"connection", b"close")]
    if error.retry_after is not None:
        headers.append((b"retry-after", str(error.retry_after).encode()))
    await send({"type": "http.response.start", "status": reply["status"], "headers": headers})
    return await send({"type": "http.response.body", "body": to_json(reply)})


def check_host(scope: Scope, names: tuple[str, ...], *, has_keys: bool) -> None:
    """Refuse to be asked under a strange name, unless a key is asked for anyway.

    A page of a strange host may bend its own name to this machine's address (DNS rebinding), and
    would be at home here. No page can do so with an address.
    """
    host = _header(scope, b"host")
    name = _host_of(f"//{host}")
    if not has_keys and host and not (_is_plain(name) or name in names):
        raise RequestError(
            f"The host name {name[:80]!r} is not accepted; use the server's address, or "
                "start the server with --name.",
            status=421, code="host",
        )  # fmt: skip


def check_origin(scope: Scope, names: tuple[str, ...]) -> None:
    """Refuse a page of another host, which a browser would let work here, though not read answers."""
    origin, host = _header(scope, b"origin"), _header(scope, b"host")
    ours = origin.partition("://")[2] == host or _host_of(origin) in names
    if origin and not ours:
        raise RequestError(
            f"Requests from pages of {origin[:80]} are not allowed; use a page of this server.",
            status=403, code="origin",
        )  # fmt: skip


def _header(scope: Scope, name: bytes) -> str:
    return dict(scope["headers"]).get(name, b"").decode("latin-1")


def _host_of(url: str) -> str:
    """Name or address in a URL, in small letters; empty where it is none."""
    try:
        return urlsplit(url).hostname or ""
    except ValueError:
        return ""


def _is_plain(host: str) -> bool:
    """Whether it is an address, or always this machine."""
    try:
        return bool(ip_address(host.partition("%")[0]))
    except ValueError:
        return host == "localhost" or host.endswith(".localhost")


def check_depth(body: bytes | bytearray, most: int) -> None:
    """Refuse JSON that is nested deeper than `most`, or has more brackets than any answer needs."""
    if len(body) <= most:
        return
    depth = 0
    for number, token in enumerate(_TOKENS.finditer(body)):
        first = token.group()[:1]
        depth += (first in b"[{") - (first in b"]}")
        if depth > most or number > _MOST_BRACKETS:
            raise RequestError(
                f"The body is nested deeper than {most} levels, or has too many values; send plain "
                "JSON.",
                status=413,
                code="nested",
            )


def _too_large(size: int, most: int) -> RequestError:
    return RequestError(
        f"The body has {size:,} bytes, but at most {most:,} are accepted; send less.",
        status=413,
        code="body_size",
    )


def _counted(receive: Receive, most: int, deadline: float) -> Receive:
    """Receive that refuses what is too large, and what comes too slowly."""
    seen = 0
    whole = False

    async def counted() -> Message:
        nonlocal seen, whole
        if whole:
            return await receive()
        try:
            async with asyncio.timeout_at(deadline):
                message = await receive()
        except TimeoutError:
            raise RequestError(
                "The body arrived too slowly, so the request was aborted; send it again.",
                status=408, code="slow",
            ) from None  # fmt: skip
        seen += len(message.get("body", b""))
        whole = not message.get("more_body", False)
        if seen > most:
            raise _too_large(seen, most)
        return message

    return counted


def _replayed(message: Message, receive: Receive) -> Receive:
    """Receive that hands out a whole body, and then what comes after."""
    waiting = [message]

    async def replayed() -> Message:
        return waiting.pop() if waiting else await receive()

    return replayed


class HeadTimeoutProtocol(H11Protocol):
    """Ends a connection whose request has no whole head after some seconds, be it the first or not."""

    def __init__(self, *args: Any, seconds: float, **more: Any) -> None:  # noqa: ANN401  # uvicorn's
        super().__init__(*args, **more)
        self._seconds = seconds
        self._end: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin, and wait for a head."""
        super().connection_made(transport)
        self._wait()

    def data_received(self, data: bytes) -> None:
        """Take bytes; those before a head is whole let nobody wait longer."""
        super().data_received(data)
        if self.cycle is not None and not self.cycle.response_complete:
            self._stop_waiting()
        elif self.cycle is not None and self._end is None:
            self._wait()

    def send_400_response(self, _msg: str) -> None:
        """Answer what is no HTTP with a problem, as everything else."""
        reply = problem(
            RequestError(
                "The request is not valid HTTP; send it according to RFC 9112.", code="http"
            )
        )
        headers = [("content-type", MEDIA_TYPE), ("connection", "close")]
        start = Response(status_code=reply["status"], headers=headers)
        for event in (start, Data(data=to_json(reply)), EndOfMessage()):
            self.transport.write(self.conn.send(event) or b"")
        self.transport.close()

    def handle_websocket_upgrade(self, event: Request) -> None:
        """Hand the connection on; from now on it may be silent."""
        self._stop_waiting()
        keys = [value for name, value in event.headers if name == b"sec-websocket-key"]
        if not all(map(bytes.isascii, keys)):  # websockets would fail of it, and log where
            self.send_400_response("")
            return
        super().handle_websocket_upgrade(event)

    def connection_lost(self, exc: Exception | None) -> None:
        """End, and wait no more."""
        self._stop_waiting()
        super().connection_lost(exc)

    def _wait(self) -> None:
        self._end = self.loop.call_later(self._seconds, self.transport.close)

    def _stop_waiting(self) -> None:
        if self._end is not None:
            self._end.cancel()
            self._end = None
