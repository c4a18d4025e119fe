"""The routes, one function each; what they do stands in the modules that they ask."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

from fastapi import FastAPI, Query, Request, Response, WebSocket
from fastapi.responses import JSONResponse, PlainTextResponse

from placegraph.serve import metrics
from placegraph.serve.listing import listing
from placegraph.serve.live import live
from placegraph.serve.oscp import version_of
from placegraph.serve.schema import Begin, Localize, Locate, Step
from placegraph.serve.server import response_of
from placegraph.serve.uploads import uploaded

if TYPE_CHECKING:
    from placegraph.serve.server import Server

_FORM = {
    "requestBody": {
        "required": True,
        "content": {
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "properties": {
                        name: {"type": "array", "items": {"type": "string", "format": "binary"}}
                        for name in ("images", "depth")
                    }
                    | {
                        "capture": {"type": "string", "format": "binary"},
                        "request": Localize.model_json_schema(),
                    },
                }
            }
        },
    }
}
_OSCP = {
    "requestBody": {
        "required": True,
        "content": {
            f"application/vnd.oscp+json; version={v}": {"schema": {"type": "object"}}
            for v in ("1.0", "2.0")
        },
    }
}


def add_routes(app: FastAPI, server: Server) -> None:
    """Add all routes but the page's."""
    _add_state(app, server)
    _add_questions(app, server)
    _add_sessions(app, server)


def _add_state(app: FastAPI, server: Server) -> None:
    @app.get("/healthz")
    async def healthz() -> Response:
        """Whether all that is asked can be answered yet."""
        ready = all(lane.ready for lane in server.lanes)
        return JSONResponse({"status": "ok" if ready else "starting"}, 200 if ready else 503)

    @app.get("/docs", include_in_schema=False)
    async def docs() -> Response:
        return listing(app)

    @app.get("/metrics")
    async def counts() -> Response:
        """Counts for Prometheus."""
        text = server.metrics.text(server.now())
        return PlainTextResponse(text, media_type=metrics.MEDIA_TYPE)

    @app.get("/v1/maps")
    def maps() -> dict[str, Any]:
        """All maps."""
        return {"maps": server.places.listed()}

    @app.get("/v1/maps/{name}/plan.png")
    async def plan(name: str) -> Response:
        """Plan of a scene, with names."""
        body, trouble = await server.captures.ask("plan", {"map": name})
        return (
            Response(body, media_type="image/png")
            if trouble is None
            else response_of(None, trouble)
        )


def _add_questions(app: FastAPI, server: Server) -> None:
    @app.post("/v1/locate")
    async def locate(asked: Locate) -> Response:
        """Where a sentence was said: estimate, next question, GeoJSON."""
        return await server.ask(server.sentences, "locate", asked.model_dump())

    @app.get("/api")
    async def search(
        q: Annotated[str, Query(max_length=500)],
        lat: Annotated[float | None, Query(ge=-90, le=90)] = None,
        lon: Annotated[float | None, Query(ge=-180, le=180)] = None,
        limit: Annotated[int, Query(ge=1, le=50)] = 15,
    ) -> Response:
        """Names, kinds of things, or a sentence, as a search box asks; answered as Photon does."""
        asked = {"q": q, "lat": lat, "lon": lon, "limit": limit}
        return await server.ask(server.sentences, "search", asked)

    @app.post("/v1/localize", openapi_extra=_FORM)
    async def localize(request: Request) -> Response:
        """Where images, or a capture as a ZIP, were taken."""
        async with uploaded(request, server.options) as asked:
            return await server.ask(server.captures, "localize", asked)

    @app.post("/geopose", openapi_extra=_OSCP)
    async def geopose(request: Request) -> Response:
        """The Open AR Cloud's GeoPose protocol, versions 1 and 2."""
        version = version_of(request.headers.get("accept", ""))
        asked = {"body": await request.body(), "version": version}
        answer = await server.ask(server.captures, "geopose", asked)
        if answer.status_code == 200 and version is not None:
            answer.headers["content-type"] = f"application/vnd.oscp+json; version={version}.0"
        return answer

    @app.websocket("/v1/live")
    async def while_typing(socket: WebSocket) -> None:
        """The posterior while one types: messages as bodies of /v1/locate, each with an `id`."""
        await live(socket, server.sentences)


def _add_sessions(app: FastAPI, server: Server) -> None:
    sessions = server.sessions

    @app.post("/v1/sessions", status_code=201)
    async def begin(asked: Begin) -> Response:
        """Begin to follow somebody who walks and speaks, or a camera."""
        told, trouble = await sessions.begin(asked)
        return JSONResponse(told, 201) if trouble is None else response_of(None, trouble)

    @app.post("/v1/sessions/{session}")
    async def step(session: str, asked: Step) -> Response:
        """One step: what was said or walked, or a frame."""
        return response_of(*await sessions.step(session, asked))

    @app.delete("/v1/sessions/{session}", status_code=204)
    async def end(session: str) -> None:
        """End a session."""
        await sessions.end(session)

    @app.websocket("/v1/sessions/{session}")
    async def follow(socket: WebSocket, session: str) -> None:
        """The steps of a session: messages as bodies of POST, answered one after the other."""
        await sessions.follow(socket, session)
