"""`placegraph serve`: maps answer over HTTP."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import click

from placegraph.cli.command import Argument, Option


def serve(
    places: Annotated[
        list[Path],
        Argument(help="Maps, libraries, or folders of them (a world).", metavar="PLACES..."),
    ],
    host: Annotated[
        str, Option(help="Address to listen at; 0.0.0.0 for all networks.")
    ] = "127.0.0.1",
    port: Annotated[int, Option(help="Port; 0 takes any that is free.")] = 8000,
    open_: Annotated[bool, Option("--open", help="Open the page in the browser.")] = False,
    keys: Annotated[
        Path | None, Option(help="File of API keys, one a line; everybody may ask if not given.")
    ] = None,
    name: Annotated[
        list[str] | None,
        Option(help="Host name that it is asked by, beside addresses and localhost; repeatable."),
    ] = None,
    log_queries: Annotated[
        bool, Option("--log-queries", help="Log what is asked; nothing is kept of it otherwise.")
    ] = False,
    scheduler: Annotated[
        str | None,
        Option(help="Dask scheduler whose workers search worlds in shards, as tcp://host:8786."),
    ] = None,
) -> None:
    """Serve maps: a page at /, sentences, images and GeoPose for other programs (/docs).

    Example: placegraph serve demo-out/world --open
    """
    from placegraph_serve.app import serve as run
    from placegraph_serve.options import ServeOptions
    from placegraph_serve.places import Places

    options = ServeOptions(
        keys=keys, names=tuple(name or ()), log_queries=log_queries, scheduler=scheduler
    )
    found = Places(places, scheduler)

    def ready(url: str) -> None:
        names = ", ".join(entry.name for entry in found.entries()[:8])
        click.echo(f"Serving {names} at {url} (Ctrl-C ends it; {url}/docs says what can be asked).")
        if open_:
            click.launch(url)

    run(found, options, host, port, ready)
