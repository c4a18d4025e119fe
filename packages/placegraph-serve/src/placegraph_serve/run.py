"""`placegraph serve`: the socket, uvicorn, and a good end."""

from __future__ import annotations

import errno
import logging
import signal
import socket
from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING

from placegraph.errors import MissingExtraError, OptionError
from placegraph_serve.options import ServeOptions

if TYPE_CHECKING:
    from placegraph_serve.places import Places

GRACE = 30
"""Time that running answers have to end after SIGTERM [s]."""


def serve(
    places: Places, options: ServeOptions, host: str, port: int, ready: Callable[[str], None]
) -> None:
    """Serve until SIGTERM or Ctrl-C; `ready` is called with the URL once the socket is open.

    Raises
    ------
    MissingExtraError
        The extra `serve` is not installed.
    OptionError
        The address is taken, or is none of this machine.

    """
    try:
        import uvicorn

        for name in ("python_multipart", "websockets"):
            import_module(name)
        from placegraph_serve.app import create_app
    except ImportError as error:
        raise MissingExtraError(
            f"{error.name} is not installed; install the extra: pip install 'placegraph[serve]'."
        ) from error
    from placegraph_serve.lanes import QUERIES
    from placegraph_serve.protocol import Patient

    app = create_app(places, options)
    listening = listen(host, port)
    logging.getLogger("uvicorn.error").setLevel(logging.WARNING)
    if options.log_queries:
        logging.basicConfig(format="%(asctime)s %(message)s")
        QUERIES.setLevel(logging.INFO)
    config = uvicorn.Config(
        app,
        http=partial(Patient, seconds=options.head_seconds),  # type: ignore[arg-type]  # makes one
        ws="websockets-sansio", log_config=None, access_log=False,
        timeout_graceful_shutdown=GRACE, server_header=False, ws_max_size=options.image_bytes,
        ws_per_message_deflate=False,
    )  # fmt: skip
    before = signal.signal(signal.SIGTERM, lambda *_: None)  # uvicorn raises it again at its end
    shown = f"[{host}]" if ":" in host else host
    ready(f"http://{shown}:{listening.getsockname()[1]}")
    try:
        uvicorn.Server(config).run(sockets=[listening])
    finally:
        signal.signal(signal.SIGTERM, before)


def listen(host: str, port: int) -> socket.socket:
    """Open a socket; `OptionError` where the address is taken or unknown."""
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listening = socket.create_server(address[:2], family=family, backlog=2048)
        # asyncio sets it for sockets of its own alone; else each answer waits 40 ms for the client
        listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise OptionError(
                f"--port {port}: another program listens at {host}:{port}; choose another port."
            ) from error
        raise OptionError(
            f"--host {host}, --port {port}: cannot listen there ({error.strerror}); choose others."
        ) from error
    except OverflowError as error:
        raise OptionError(f"--port {port}: choose a number from 0 to 65535.") from error
    return listening
