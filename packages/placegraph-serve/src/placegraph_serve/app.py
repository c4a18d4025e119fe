"""The application: routes, and what stands behind them."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException
from starlette.routing import Match

from placegraph import __version__
from placegraph.errors import PlacegraphError, RequestError
from placegraph_serve.drawing import drawing_router, page_files
from placegraph_serve.limits import Guard, Keys
from placegraph_serve.options import ServeOptions
from placegraph_serve.places import Places
from placegraph_serve.problem import problem, refused
from placegraph_serve.routes import add_routes
from placegraph_serve.server import Server, response_of


def create_app(places: Places, options: ServeOptions | None = None) -> FastAPI:
    """The server of some maps as an ASGI application; its processes start with its lifespan.

    Raises `InputError` where the file of keys cannot be read.
    """
    server = Server(places, options or ServeOptions())

    @asynccontextmanager
    async def lifespan(_app: FastAPI) -> AsyncIterator[None]:
        for lane in server.lanes:
            lane.begin()
        try:
            yield
        finally:
            for lane in server.lanes:
                await lane.end()

    app = FastAPI(
        title="placegraph", version=__version__, lifespan=lifespan, docs_url=None, redoc_url=None
    )
    app.state.server = server
    _add_errors(app)
    add_routes(app, server)
    app.add_middleware(
        Guard, options=server.options, keys=Keys.of(server.options.keys), metrics=server.metrics
    )
    app.include_router(drawing_router(places))
    for path, files in page_files().items():
        app.mount(path, files)
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
        return await ours(request, refused(error.errors()))

    async def http(request: Request, error: Exception) -> Response:
        assert isinstance(error, HTTPException)  # noqa: S101
        where, status = request.url.path[:80], error.status_code
        allowed = methods_at(request) if status in {404, 405} else []
        status = 405 if allowed else status
        said = {
            404: f"There is nothing at {where}; see /docs for what there is.",
            405: f"{request.method} is not answered at {where}; see /docs for what is.",
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
