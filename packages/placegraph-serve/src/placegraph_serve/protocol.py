"""HTTP as uvicorn reads it, for connections that never say what they want."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from h11 import Data, EndOfMessage, Request, Response
from uvicorn.protocols.http.h11_impl import H11Protocol

from placegraph.errors import RequestError
from placegraph_serve.problem import MEDIA_TYPE, problem
from placegraph_serve.worker import dumped

if TYPE_CHECKING:
    import asyncio


class Patient(H11Protocol):
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
            self._rest()
        elif self.cycle is not None and self._end is None:
            self._wait()

    def send_400_response(self, _msg: str) -> None:
        """Answer what is no HTTP with a problem, as everything else."""
        told = problem(
            RequestError("This is no HTTP; send a request as RFC 9112 has it.", code="http")
        )
        headers = [("content-type", MEDIA_TYPE), ("connection", "close")]
        start = Response(status_code=told["status"], headers=headers)
        for event in (start, Data(data=dumped(told)), EndOfMessage()):
            self.transport.write(self.conn.send(event) or b"")
        self.transport.close()

    def handle_websocket_upgrade(self, event: Request) -> None:
        """Hand the connection on; from now on it may be silent."""
        self._rest()
        keys = [value for name, value in event.headers if name == b"sec-websocket-key"]
        if not all(map(bytes.isascii, keys)):  # websockets would fail of it, and log where
            self.send_400_response("")
            return
        super().handle_websocket_upgrade(event)

    def connection_lost(self, exc: Exception | None) -> None:
        """End, and wait no more."""
        self._rest()
        super().connection_lost(exc)

    def _wait(self) -> None:
        self._end = self.loop.call_later(self._seconds, self.transport.close)

    def _rest(self) -> None:
        if self._end is not None:
            self._end.cancel()
            self._end = None
