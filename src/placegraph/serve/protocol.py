"""HTTP as uvicorn reads it, for connections that never say what they want."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from uvicorn.protocols.http.h11_impl import H11Protocol

if TYPE_CHECKING:
    import asyncio

HEAD_SECONDS = 20.0
"""A head that takes longer to arrive is given up [s]."""


class Patient(H11Protocol):
    """Ends a connection whose first request has no whole head after a while."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin, and look again later."""
        super().connection_made(transport)
        self._transport = transport
        self._look: Any = self.loop.call_later(HEAD_SECONDS, self._end_if_silent)

    def connection_lost(self, exc: Exception | None) -> None:
        """End, and do not look again."""
        self._look.cancel()
        super().connection_lost(exc)

    def _end_if_silent(self) -> None:
        if getattr(self, "cycle", None) is None and not self._transport.is_closing():
            self._transport.close()
