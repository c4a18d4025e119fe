"""The application: routes, and what stands behind them."""

from __future__ import annotations

from contextlib import asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fastapi import FastAPI, Request, Response, WebSocket
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from fastapi.staticfiles import StaticFiles
from starlette.exceptions import HTTPException

from placegraph import __version__, kept
from placegraph.errors import PlacegraphError, RequestError
from placegraph.serve.lanes import Lane
from placegraph.serve.limits import Guard, Keys
from placegraph.serve.live import live
from placegraph.serve.options import ServeOptions
from placegraph.serve.problem import MEDIA_TYPE, problem
from placegraph.serve.schema import Locate
from placegraph.serve.worker import Setting

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from placegraph.serve.places import Places

PAGE = Path(__file__).parent / "page"


class Server:
    """What the routes share: maps, limits, lanes."""

    def __init__(self, places: Places, options: ServeOptions) -> None:
        self.places, self.options = places, options
        setting = Setting(places.paths, options, kept.FOLDERS.chosen)
        self.sentences = Lane(
            "sentences", options.sentence_workers, options.sentence_seconds, setting
        )

    @property
    def lanes(self) -> tuple[Lane, ...]:
        """All lanes."""
        return (self.sentences,)

    async def ask(self, lane: Lane, verb: str, asked: Any) -> Response:  # noqa: ANN401
        """Answer of a lane as a response."""
        body, trouble = await lane.ask(verb, asked)
        if trouble is not None:
            return problem_response(trouble)
        return Response(body, media_type="application/json")


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

    app = FastAPI(title="placegraph", version=__version__, lifespan=lifespan)
    app.state.server = server
    _add_errors(app)
    _add_routes(app, server)
    app.add_middleware(Guard, options=server.options, keys=Keys.of(server.options.keys))
    app.mount("/", StaticFiles(directory=PAGE, html=True), name="page")
    return app


def problem_response(told: dict[str, Any]) -> Response:
    """A problem as a response."""
    headers = {"Retry-After": str(told["retry_after"])} if "retry_after" in told else {}
    return JSONResponse(told, told["status"], headers, media_type=MEDIA_TYPE)


def _add_routes(app: FastAPI, server: Server) -> None:
    @app.get("/healthz")
    async def healthz() -> Response:
        """Whether sentences are answered yet."""
        ready = all(lane.ready for lane in server.lanes)
        return JSONResponse({"status": "ok" if ready else "starting"}, 200 if ready else 503)

    @app.get("/v1/maps")
    def maps() -> dict[str, Any]:
        """All maps."""
        return {"maps": server.places.listed()}

    @app.post("/v1/locate")
    async def locate(asked: Locate) -> Response:
        """Where a sentence was said: estimate, next question, GeoJSON."""
        return await server.ask(server.sentences, "locate", asked.model_dump())

    @app.websocket("/v1/live")
    async def while_typing(socket: WebSocket) -> None:
        await live(socket, server.sentences)


def _add_errors(app: FastAPI) -> None:
    async def ours(_request: Request, error: Exception) -> Response:
        return problem_response(problem(error))

    async def invalid(request: Request, error: Exception) -> Response:
        assert isinstance(error, RequestValidationError)  # noqa: S101
        return await ours(request, refused(error.errors()))

    async def http(request: Request, error: Exception) -> Response:
        assert isinstance(error, HTTPException)  # noqa: S101
        where = request.url.path[:80]
        said = {
            404: f"There is nothing at {where}; see /docs for what there is.",
            405: f"{request.method} is not answered at {where}; see /docs for what is.",
        }.get(error.status_code, f"{error.detail}; see /docs for what is expected.")
        code = {404: "not_found", 405: "method"}.get(error.status_code, "request")
        return await ours(request, RequestError(said, status=error.status_code, code=code))

    app.add_exception_handler(PlacegraphError, ours)
    app.add_exception_handler(RequestValidationError, invalid)
    app.add_exception_handler(HTTPException, http)
    app.add_exception_handler(Exception, ours)


def refused(errors: Any) -> RequestError:  # noqa: ANN401  # pydantic's
    """What pydantic found wrong with a body, first things first."""
    first = errors[0]
    where = ".".join(str(part) for part in first["loc"] if part != "body") or "body"
    return RequestError(
        f"{where[:80]}: {first['msg']}; see /docs for the fields.", status=422, code="fields"
    )
