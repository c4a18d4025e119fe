"""What stands before the routes: keys, strange hosts and origins, sizes, slow senders, deep JSON."""

from __future__ import annotations

import asyncio
import hmac
import re
from dataclasses import dataclass
from ipaddress import ip_address
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING
from urllib.parse import parse_qs, urlsplit

from placegraph.errors import InputError, RequestError
from placegraph_serve.metrics import Metrics
from placegraph_serve.options import ServeOptions
from placegraph_serve.problem import MEDIA_TYPE, problem
from placegraph_serve.worker import dumped

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send


LARGE = ("/v1/localize", "/v1/sessions/", "/geopose")
"""Paths whose bodies carry images."""
CLOSED = ("/v1/", "/api/", "/geopose/", "/metrics/")
"""Paths that need a key where there are keys; the page and the state of health do not."""
_TOKENS = re.compile(rb'"[^"\\]*+(?:\\.[^"\\]*+)*+"|\\.|[\[\]{}]', re.DOTALL)
_MOST_BRACKETS = 200_000


@dataclass(frozen=True)
class Keys:
    """API keys."""

    known: tuple[bytes, ...]
    """None: everybody may ask."""

    @classmethod
    def of(cls, path: Path | None) -> Keys:
        """Keys of a file, one a line; lines with # are notes."""
        if path is None:
            return cls(())
        try:
            lines = [line.strip() for line in path.read_text("utf-8").splitlines()]
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"{path} cannot be read ({error}); name a file of keys.") from error
        known = tuple(line.encode() for line in lines if line and not line.startswith("#"))
        if not known:
            raise InputError(f"{path} holds no key; write one a line.")
        return cls(known)

    def let_in(self, scope: Scope) -> bool:
        """Whether a request has a key, in its header or, where there is none, as `key=`."""
        if not self.known or not f"{scope['path']}/".startswith(CLOSED):
            return True
        headers = {name: value for name, value in scope["headers"] if name in _HEADERS}
        given = headers.get(b"x-api-key") or headers.get(b"authorization", b"").removeprefix(
            b"Bearer "
        )
        asked = parse_qs(scope["query_string"].decode("latin-1")).get("key", [""])[0]
        given = given or asked.encode()
        # all are compared, each in constant time
        return sum(hmac.compare_digest(given.strip(), key) for key in self.known) > 0


_HEADERS = (b"x-api-key", b"authorization")


class _Held:
    """Bytes of one body that are held in memory."""

    def __init__(self, guard: Guard) -> None:
        self._guard, self.bytes = guard, 0

    def more(self, count: int) -> None:
        """Hold some more; `RequestError` (503) where all bodies together would be too much."""
        self.bytes += count
        self._guard.held += count
        if self._guard.held > self._guard.options.held_bytes:
            raise RequestError(
                "Too much is sent at once by all who ask; ask again in a moment.",
                status=503, code="busy", retry_after=2,
            )  # fmt: skip


class Guard:
    """ASGI middleware that refuses what no route should have to look at."""

    def __init__(self, app: ASGIApp, options: ServeOptions, keys: Keys, metrics: Metrics) -> None:
        self.app, self.options, self.keys, self.metrics = app, options, keys, metrics
        self.sockets = 0
        self.held = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let a request through, or answer it with a problem."""
        if scope["type"] == "lifespan":
            return await self.app(scope, receive, send)
        start, status = perf_counter(), 0

        async def noted(message: Message) -> None:
            nonlocal status
            status = message.get("status", status)
            await send(message)

        try:
            return await self._guarded(scope, receive, noted)
        finally:
            if scope["type"] == "http":
                self.metrics.note(scope["path"], status, perf_counter() - start)

    async def _guarded(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            self._check(scope)
        except RequestError as error:
            return await refuse(scope, receive, send, error)
        if scope["type"] == "http":
            return await self._answered(scope, receive, send)
        self.sockets += 1
        try:
            return await self.app(scope, receive, send)
        finally:
            self.sockets -= 1

    async def _answered(self, scope: Scope, receive: Receive, send: Send) -> None:
        holds = _Held(self)
        try:
            try:
                receive = await self._body(scope, receive, holds)
            except RequestError as error:
                return await refuse(scope, receive, send, error)
            return await self.app(scope, receive, send)
        finally:
            self.held -= holds.bytes

    def _check(self, scope: Scope) -> None:
        if not self.keys.let_in(scope):
            raise RequestError(
                "The key is missing or unknown; send it as `Authorization: Bearer KEY`.",
                status=401, code="key",
            )  # fmt: skip
        check_host(scope, self.options.names, keyed=bool(self.keys.known))
        check_origin(scope, self.options.names)
        if scope["type"] == "websocket" and self.sockets >= self.options.sockets:
            raise RequestError(
                "Too many WebSockets are open; come again later.",
                status=503, code="busy", retry_after=10,
            )  # fmt: skip

    async def _body(self, scope: Scope, receive: Receive, holds: _Held) -> Receive:
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
            holds.more(len(message.get("body", b"")))
            if message["type"] != "http.request" or not message.get("more_body", False):
                break
        check_depth(body, self.options.depth)
        return _replayed({**message, "body": bytes(body)}, receive)


async def refuse(scope: Scope, receive: Receive, send: Send, error: RequestError) -> None:
    """Answer with a problem, in place of the application."""
    told = problem(error)
    if scope["type"] == "websocket":
        await receive()
        return await send({"type": "websocket.close", "code": 1008, "reason": told["detail"][:120]})
    headers = [(b"content-type", MEDIA_TYPE.encode()), (b"connection", b"close")]
    if error.retry_after is not None:
        headers.append((b"retry-after", str(error.retry_after).encode()))
    await send({"type": "http.response.start", "status": told["status"], "headers": headers})
    return await send({"type": "http.response.body", "body": dumped(told)})


def check_host(scope: Scope, names: tuple[str, ...], *, keyed: bool) -> None:
    """Refuse to be asked under a strange name, unless a key is asked for anyway.

    A page of a strange host may bend its own name to this machine's address (DNS rebinding), and
    would be at home here. No page can do so with an address.
    """
    host = _header(scope, b"host")
    name = _host_of(f"//{host}")
    if not keyed and host and not (_is_plain(name) or name in names):
        raise RequestError(
            f"This server is not known as {name[:80]!r}; ask by its address, or start it with --name.",
            status=421, code="host",
        )  # fmt: skip


def check_origin(scope: Scope, names: tuple[str, ...]) -> None:
    """Refuse a page of another host, which a browser would let work here, though not read answers."""
    origin, host = _header(scope, b"origin"), _header(scope, b"host")
    ours = origin.partition("://")[2] == host or _host_of(origin) in names
    if origin and not ours:
        raise RequestError(
            f"A page of {origin[:80]} may not ask here; ask from a page of this server.",
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
        f"The body has {size:,} bytes, and at most {most:,} are taken here; send less.",
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
                "The body came too slowly and was given up; send it again.",
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
