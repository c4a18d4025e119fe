"""`WS /v1/live`: the posterior while one types; the newest text cancels the ones before."""

from __future__ import annotations

import asyncio
import json
from typing import TYPE_CHECKING

from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from placegraph.errors import PlacegraphError, RequestError
from placegraph.serve.problem import problem
from placegraph.serve.schema import Live
from placegraph.serve.worker import dumped

if TYPE_CHECKING:
    from placegraph.serve.lanes import Lane

LONGEST = 1 << 16
"""Characters of a message."""


async def live(socket: WebSocket, lane: Lane) -> None:
    """Answer what is typed until the socket is closed."""
    await socket.accept()
    running: asyncio.Task[None] | None = None
    try:
        while True:
            text = await socket.receive_text()
            if running is not None:
                running.cancel()
            running = asyncio.create_task(_answer(socket, lane, text))
    except (WebSocketDisconnect, KeyError):  # gone, or bytes, which nothing here sends
        pass
    finally:
        if running is not None:
            running.cancel()


async def _answer(socket: WebSocket, lane: Lane, text: str) -> None:
    number: int | str | None = None
    try:
        asked = _asked(text)
        number = asked.id
        body, trouble = await lane.ask("locate", asked.model_dump(exclude={"id"}))
    except PlacegraphError as error:
        body, trouble = None, problem(error)
    head = json.dumps(number)
    told = f'"result":{body.decode()}' if body else f'"problem":{dumped(trouble).decode()}'
    if socket.client_state is WebSocketState.CONNECTED:
        await socket.send_text(f'{{"id":{head},{told}}}')


def _asked(text: str) -> Live:
    if len(text) > LONGEST:
        raise RequestError(f"message: {len(text)} characters; send at most {LONGEST}.", status=413)
    return Live.read(text, "message")
