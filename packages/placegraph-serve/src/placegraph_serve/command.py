"""`placegraph serve`: maps answer over HTTP."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import click

from placegraph.cli.command import Argument, Fields, Option
from placegraph_serve.options import ServeOptions


def serve(
    places: Annotated[
        list[Path],
        Argument(help="Maps, libraries, or folders of them (a world).", metavar="PLACES..."),
    ],
    options: Annotated[dict[str, Any], Fields(ServeOptions)],
    host: Annotated[
        str, Option(help="Address to listen at; 0.0.0.0 also admits other computers.")
    ] = "127.0.0.1",
    port: Annotated[int, Option(help="Port; 0 selects a free one.")] = 8000,
    open_: Annotated[bool, Option("--open", help="Open the page in the browser.")] = False,
) -> None:
    """Serve maps: a page at /, sentences, images and GeoPose for other programs (/docs).

    Example: placegraph serve demo-out/world --open
    """
    from placegraph_serve.app import serve as run
    from placegraph_serve.places import Places

    found = Places(places, options.get("scheduler"), options.get("memory"))

    def ready(url: str) -> None:
        names = ", ".join(entry.name for entry in found.entries())
        click.echo(f"Serving {names} at {url} (press Ctrl-C to stop; routes: {url}/docs).")
        if open_:
            click.launch(url)

    run(found, ServeOptions(**options), host, port, ready)
