"""The page at /docs: what can be asked, as OpenAPI has it, without a script or another host."""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING, Any

from fastapi.responses import HTMLResponse
from starlette.routing import WebSocketRoute

if TYPE_CHECKING:
    from fastapi import FastAPI

_HEAD = """<!doctype html><html lang="en"><meta charset="utf-8">
<meta name="viewport" content="width=device-width"><title>placegraph: what can be asked</title>
<style>:root{color-scheme:light dark}body{font:16px/1.5 system-ui,sans-serif;max-width:60rem;
margin:2rem auto;padding:0 1rem}table{border-collapse:collapse}td,th{text-align:left;vertical-align:top;
padding:.2rem 1rem .2rem 0;border-bottom:1px solid #8884}code{font-size:.9em}</style>
<h1>What can be asked</h1><p>The same for programs: <a href="openapi.json">openapi.json</a>. Errors are
<code>application/problem+json</code> (RFC 9457) with <code>detail</code>, <code>mend</code> and
<code>code</code>. Where the server has keys, send <code>Authorization: Bearer KEY</code>.</p>
"""
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; style-src 'unsafe-inline'; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'",
}


def listing(app: FastAPI) -> HTMLResponse:
    """The page, of the routes that the application has."""
    told = app.openapi()
    schemas = told.get("components", {}).get("schemas", {})
    parts = [_HEAD]
    for path, methods in told["paths"].items():
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
        form = schema.get("properties", {}).get("request", {}).get("properties")
        out += [_table("its field request, JSON", form)] if form else []
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
