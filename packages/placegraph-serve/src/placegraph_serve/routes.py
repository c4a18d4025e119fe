"""The routes, one function each, and what clients upload to them."""

from __future__ import annotations

import asyncio
import json
import shutil
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from html import escape
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import orjson
from fastapi import FastAPI, Query, Request, Response, WebSocket
from fastapi.responses import HTMLResponse, JSONResponse, PlainTextResponse
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import FormData, UploadFile
from starlette.routing import WebSocketRoute
from starlette.websockets import WebSocketState

from placegraph.errors import InputError, PlacegraphError, RequestError
from placegraph_serve.answers import describe_api
from placegraph_serve.geopose import version_of
from placegraph_serve.limits import MEDIA_TYPE_METRICS, check_depth
from placegraph_serve.options import ServeOptions
from placegraph_serve.problem import problem
from placegraph_serve.requests import BeginSession, Live, Localize, Locate, Reverse, Search, Step
from placegraph_serve.server import Server, receive_texts, response_of
from placegraph_serve.workers import WorkerQueue, to_json

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
                        "request": {"$ref": "#/components/schemas/Localize"},
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
            f"application/vnd.oscp+json; version={v}": {
                "schema": {
                    "type": "object",
                    "required": ["sensorReadings"],
                    "properties": {"sensorReadings": {"type": kind, "description": "Readings."}},
                }
            }
            for v, kind in (("1.0", "array"), ("2.0", "object"))
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
        ready = all(queue.ready for queue in server.queues)
        return JSONResponse({"status": "ok" if ready else "starting"}, 200 if ready else 503)

    @app.get("/docs", include_in_schema=False)
    async def docs() -> Response:
        return listing(app)

    @app.get("/metrics")
    async def counts() -> Response:
        """Counts for Prometheus."""
        return PlainTextResponse(server.metrics.text(), media_type=MEDIA_TYPE_METRICS)

    @app.get("/v1/maps")
    def maps() -> dict[str, Any]:
        """All maps."""
        return {"maps": server.places.describe_maps()}

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
    async def locate(body: Locate, request: Request) -> Response:
        """Locate a sentence: estimate, next question, GeoJSON."""
        return await server.ask(server.sentences, "locate", body.model_dump(), request)

    @app.get("/api")
    @app.get("/api/", include_in_schema=False)
    async def search(query: Annotated[Search, Query()], request: Request) -> Response:
        """Names, kinds of things, or a sentence, as a search box asks; answered as Photon does."""
        return await server.ask(server.sentences, "search", query.model_dump(), request)

    @app.get("/reverse")
    @app.get("/reverse/", include_in_schema=False)
    async def reverse(query: Annotated[Reverse, Query()], request: Request) -> Response:
        """What lies nearest to a point, answered as Photon does."""
        return await server.ask(server.sentences, "reverse", query.model_dump(), request)

    @app.post("/v1/localize", openapi_extra=_FORM)
    async def localize(request: Request) -> Response:
        """Localize images, or a capture as a ZIP."""
        async with save_upload(request, server.options) as body:
            return await server.ask(server.captures, "localize", body, request)

    @app.post("/geopose", openapi_extra=_OSCP)
    async def geopose(request: Request) -> Response:
        """The Open AR Cloud's GeoPose protocol, versions 1 and 2."""
        version = version_of(request.headers.get("accept", ""))
        body = {"body": await request.body(), "version": version}
        answer = await server.ask(server.captures, "geopose", body, request)
        if answer.status_code == 200 and version is not None:
            answer.headers["content-type"] = f"application/vnd.oscp+json; version={version}.0"
        return answer

    @app.websocket("/v1/live")
    async def while_typing(socket: WebSocket) -> None:
        """The posterior while one types: messages as bodies of /v1/locate, each with an `id`.

        With `changes` an answer has `changes` in place of `result`: a JSON merge patch of the answer before.
        """
        await live(socket, server.sentences)


def _add_sessions(app: FastAPI, server: Server) -> None:
    sessions = server.sessions

    @app.post("/v1/sessions", status_code=201)
    async def begin_session(body: BeginSession, request: Request) -> Response:
        """Begin to follow somebody who walks and speaks, or a camera."""
        client = request.client.host if request.client else ""
        reply, trouble = await sessions.open(body, client)
        return JSONResponse(reply, 201) if trouble is None else response_of(None, trouble)

    @app.post("/v1/sessions/{session}")
    async def step(session: str, body: Step) -> Response:
        """One step: what was said or walked, or a frame."""
        return response_of(*await sessions.step(session, body))

    @app.delete("/v1/sessions/{session}", status_code=204)
    async def end(session: str) -> None:
        """End a session."""
        await sessions.end(session)

    @app.websocket("/v1/sessions/{session}")
    async def follow(socket: WebSocket, session: str) -> None:
        """The steps of a session: messages as bodies of POST, answered one after the other."""
        await sessions.follow(socket, session)


_HEAD = (
    '<!doctype html><html lang="en"><meta charset="utf-8">\n<meta name="viewport" '
    'content="width=device-width"><title>placegraph: routes</title>\n'
    "<style>:root{color-scheme:light dark}body{font:16px/1.5 "
    "system-ui,sans-serif;max-width:60rem;\nmargin:2rem auto;padding:0 "
    "1rem}table{border-collapse:collapse}td,th{text-align:left;vertical-align:top;\n"
    "padding:.2rem 1rem .2rem 0;border-bottom:1px solid #8884}code{font-size:.9em}</style>\n"
    '<h1>Routes</h1><p>Machine-readable: <a href="openapi.json">openapi.json</a>. Errors are\n'
    "<code>application/problem+json</code> (RFC 9457) with <code>detail</code>, "
    "<code>mend</code> and\n<code>code</code>. Where the server has keys, send "
    "<code>Authorization: Bearer KEY</code>.</p>\n"
)
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; style-src 'unsafe-inline'; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'",
}


def listing(app: FastAPI) -> HTMLResponse:
    """The page, of the routes that the application has."""
    reply = describe_api(app)
    schemas = reply.get("components", {}).get("schemas", {})
    parts = [_HEAD]
    for path, methods in reply["paths"].items():
        for method, what in methods.items():
            parts += [f"<h2><code>{method.upper()} {escape(path)}</code></h2>"]
            parts += [f"<p>{escape(what.get('description') or what.get('summary', ''))}</p>"]
            parts += _fields(what, schemas)
    for route in app.routes:
        if isinstance(route, WebSocketRoute):
            said = (route.endpoint.__doc__ or "").strip()
            parts += [f"<h2><code>WS {escape(route.path)}</code></h2><p>{escape(said)}</p>"]
    return HTMLResponse("".join(parts), headers=_HEADERS)


def _fields(what: dict[str, Any], schemas: dict[str, Any]) -> list[str]:
    """Tables of the parameters, and of the body by its type."""
    rows = {
        p["name"]: p["schema"] | {"description": p.get("description", "")}
        for p in what.get("parameters", [])
    }
    out = [_table(f"in the {what['parameters'][0]['in']}", rows)] if rows else []
    for kind, content in what.get("requestBody", {}).get("content", {}).items():
        schema = _resolved(content["schema"], schemas)
        out.append(_table(f"body, {kind}", schema.get("properties", {})))
        form = _resolved(schema.get("properties", {}).get("request", {}), schemas).get("properties")
        out += [_table("its field `request`, as JSON", form)] if form else []
    return out


def _table(title: str, fields: dict[str, Any]) -> str:
    rows = "".join(
        f"<tr><td><code>{escape(name)}</code></td><td>{escape(_kind(schema))}</td>"
        f"<td>{escape(schema.get('description', ''))}</td></tr>"
        for name, schema in fields.items()
    )
    return f"<table><tr><th>{escape(title)}</th><th>type</th><th></th></tr>{rows}</table>"


def _kind(schema: dict[str, Any]) -> str:
    some = schema.get("anyOf") or [schema]
    kinds = (s.get("type") or s.get("$ref", "").rpartition("/")[2] for s in some)
    return " or ".join(kind for kind in kinds if kind != "null")


def _resolved(schema: dict[str, Any], schemas: dict[str, Any]) -> dict[str, Any]:
    name = schema.get("$ref", "").rpartition("/")[2]
    found: dict[str, Any] = schemas.get(name, schema)
    return found


LONGEST = 1 << 16
"""Characters of a message."""


async def live(socket: WebSocket, queue: WorkerQueue) -> None:
    """Answer what is typed until the socket is closed; a text replaces the one that waits for a worker."""
    typed: list[Live] = []
    chosen: list[Live] = []
    came = asyncio.Event()

    def take() -> dict[str, Any]:
        came.clear()
        chosen[:] = typed
        return chosen[0].model_dump(exclude={"id", "changes"})

    async def answer() -> None:
        before: dict[str, Any] = {}
        while await came.wait():
            chosen.clear()
            body, trouble = await queue.ask("live", take)
            if not chosen:  # too many wait
                take()
            if came.is_set() or socket.client_state is not WebSocketState.CONNECTED:
                continue  # nobody waits for it any more
            reply = (
                f'"result":{body.decode()}' if body else f'"problem":{to_json(trouble).decode()}'
            )
            if body and chosen[0].changes:
                now = orjson.loads(body)
                reply = f'"changes":{to_json(find_changes(before, now)).decode()}'
                before = now
            await socket.send_text(f'{{"id":{json.dumps(chosen[0].id)},{reply}}}')

    answering = asyncio.create_task(answer())
    try:
        async for text in receive_texts(socket):
            try:
                typed[:] = [_read_message(text)]
                came.set()
            except PlacegraphError as error:
                trouble = to_json({"id": None, "problem": problem(error)})
                await socket.send_text(trouble.decode())
    finally:
        answering.cancel()


def find_changes(before: dict[str, Any], now: dict[str, Any]) -> dict[str, Any]:
    """Return the JSON merge patch (RFC 7396) that makes one object of another."""
    changed = {
        key: find_changes(old, new)
        if isinstance(old := before.get(key), dict) and isinstance(new, dict)
        else new
        for key, new in now.items()
        if key not in before or before[key] != new
    }
    return changed | {key: None for key in before if key not in now}


def _read_message(text: str) -> Live:
    if len(text) > LONGEST:
        raise RequestError(f"message: {len(text)} characters; send at most {LONGEST}.", status=413)
    return Live.read(text, "message")


@asynccontextmanager
async def save_upload(request: Request, options: ServeOptions) -> AsyncIterator[dict[str, Any]]:
    """Save an upload in a temporary folder; yield the folder, its files by name, and the request.

    Raises `InputError`: the form holds neither images nor a capture, or a field is no JSON;
    `RequestError`: it holds too many files, or too large ones.
    """
    form = request.form(max_files=2 * options.images + 2, max_fields=20, max_part_size=1 << 20)
    async with form as fields:
        parameters = await _read_form_request(fields, options)
        files: dict[str, list[UploadFile]] = {
            name: [f for f in fields.getlist(name) if isinstance(f, UploadFile)]
            for name in ("images", "depth", "capture")
        }
        for field in ("images", "depth"):
            for i, file in enumerate(files[field]):
                if (file.size or 0) > options.image_bytes:
                    raise RequestError(
                        f"{field}[{i}] has {file.size:,} bytes; send at most "
                        f"{options.image_bytes:,}.",
                        status=413,
                        code="image_size",
                    )
        captures = files["capture"]
        if bool(files["images"]) == bool(captures) or len(captures) > 1:
            raise InputError(
                "images: send one or more as multipart form data, or else one `capture` as a ZIP."
            )
        with TemporaryDirectory(prefix="placegraph-") as folder:
            names = await run_in_threadpool(_copy_files, files, Path(folder))
            yield {
                "folder": folder,
                "images": names["images"],
                "depth": names["depth"],
                "capture": names["capture"][0] if captures else None,
                "request": parameters.model_dump(),
            }


async def _read_form_request(form: FormData, options: ServeOptions) -> Localize:
    """The form's field `request`, whether it came as text or as a file."""
    field = form.get("request") or "{}"
    text = await field.read() if isinstance(field, UploadFile) else field.encode()
    if len(text) > options.json_bytes:
        raise RequestError(
            f"request: {len(text):,} bytes; send at most {options.json_bytes:,}.",
            status=413, code="body_size",
        )  # fmt: skip
    check_depth(text, options.depth)
    return Localize.read(text, "request")


def _copy_files(files: dict[str, list[UploadFile]], folder: Path) -> dict[str, list[str]]:
    """Copy files into a folder, under names of our own."""
    names: dict[str, list[str]] = {}
    for field, sent in files.items():
        names[field] = [f"{field}-{i}" for i in range(len(sent))]
        for name, file in zip(names[field], sent, strict=True):
            with (folder / name).open("wb") as out:
                shutil.copyfileobj(file.file, out)
    return names
