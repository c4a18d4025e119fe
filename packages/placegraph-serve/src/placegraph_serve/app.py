"""The application, its socket, and a good end."""

from __future__ import annotations

import errno
import logging
import signal
import socket
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from functools import partial
from importlib import import_module

from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException
from starlette.middleware.gzip import GZipMiddleware
from starlette.routing import Match

from placegraph import __version__
from placegraph.errors import MissingExtraError, OptionError, PlacegraphError, RequestError
from placegraph_serve.answers import describe_api
from placegraph_serve.drawing import drawing_router, page_files
from placegraph_serve.limits import Guard, Keys
from placegraph_serve.options import ServeOptions
from placegraph_serve.places import Places
from placegraph_serve.problem import make_request_error, problem
from placegraph_serve.routes import add_routes
from placegraph_serve.server import Server, response_of


def create_app(places: Places, options: ServeOptions | None = None) -> FastAPI:
    """The server of some maps as an ASGI application; its processes start with its lifespan.

    Raises `InputError` where the file of keys cannot be read.
    """
    server = Server(places, options or ServeOptions())

    @asynccontextmanager
    async def lifespan(_app: FastAPI) -> AsyncIterator[None]:
        for queue in server.queues:
            queue.start()
        try:
            yield
        finally:
            for queue in server.queues:
                await queue.end()

    app = FastAPI(
        title="placegraph", version=__version__, lifespan=lifespan, docs_url=None, redoc_url=None
    )
    app.state.server = server
    _add_errors(app)
    add_routes(app, server)
    app.add_middleware(GZipMiddleware, minimum_size=1000, compresslevel=5)
    app.add_middleware(
        Guard, options=server.options, keys=Keys.of(server.options.keys), metrics=server.metrics
    )
    app.routes.extend(drawing_router(places).routes)  # an included router hides their methods
    for path, files in page_files().items():
        app.mount(path, files)
    app.openapi = partial(describe_api, app)  # type: ignore[method-assign]  # FastAPI's way
    return app


def methods_at(request: Request) -> list[str]:
    """Methods that some route answers at the path of a request with another; the page is at all paths."""
    known = [r for r in request.app.routes if r.matches(request.scope)[0] is Match.PARTIAL]
    return sorted({method for route in known for method in route.methods})


def _add_errors(app: FastAPI) -> None:
    async def ours(_request: Request, error: Exception) -> Response:
        return response_of(None, problem(error))

    async def invalid(request: Request, error: Exception) -> Response:
        assert isinstance(error, RequestValidationError)  # noqa: S101
        return await ours(request, make_request_error(error.errors()))

    async def http(request: Request, error: Exception) -> Response:
        assert isinstance(error, HTTPException)  # noqa: S101
        where, status = request.url.path[:80], error.status_code
        allowed = methods_at(request) if status in {404, 405} else []
        allowed = ["GET", "HEAD"] if status == 405 and not allowed else allowed  # files of the page
        status = 405 if allowed else status
        said = {
            404: f"There is no route {where}; see /docs for all routes.",
            405: f"{request.method} is not allowed at {where}; see /docs for the allowed methods.",
        }.get(status, f"{error.detail}; see /docs for what is expected.")
        code = {404: "not_found", 405: "method"}.get(status, "request")
        answer = await ours(request, RequestError(said, status=status, code=code))
        if allowed:
            answer.headers["Allow"] = ", ".join(allowed)
        return answer

    app.add_exception_handler(PlacegraphError, ours)
    app.add_exception_handler(RequestValidationError, invalid)
    app.add_exception_handler(HTTPException, http)
    app.add_exception_handler(Exception, ours)


GRACE = 30
"""Time that running answers have to end after SIGTERM [s]."""


def serve(
    places: Places, options: ServeOptions, host: str, port: int, ready: Callable[[str], None]
) -> None:
    """Serve until SIGTERM or Ctrl-C; `ready` is called with the URL once the socket is open.

    Raises `MissingExtraError`: the extra `serve` is not installed; `OptionError`: the address is
    taken, or is none of this machine.
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
    from placegraph_serve.limits import HeadTimeoutProtocol
    from placegraph_serve.workers import QUERIES

    app = create_app(places, options)
    listening = listen(host, port)
    logging.getLogger("uvicorn.error").setLevel(logging.WARNING)
    if options.log_queries:
        logging.basicConfig(format="%(asctime)s %(message)s")
        QUERIES.setLevel(logging.INFO)
    config = uvicorn.Config(
        app,
        http=partial(HeadTimeoutProtocol, seconds=options.head_seconds),  # type: ignore[arg-type]  # makes one
        ws="websockets-sansio", log_config=None, access_log=False,
        timeout_graceful_shutdown=GRACE, server_header=False, ws_max_size=options.image_bytes,
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
                f"--port {port}: another program uses {host}:{port}; choose another port."
            ) from error
        raise OptionError(
            f"--host {host}, --port {port}: the server cannot listen there ({error.strerror}); "
            "choose others."
        ) from error
    except OverflowError as error:
        raise OptionError(f"--port {port}: choose a number from 0 to 65535.") from error
    return listening
