"""`placegraph city embed` and `placegraph city stores`: vectors of a map's cells."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import click

from placegraph.cli.city.options import MapFile
from placegraph.cli.command import Argument, Option
from placegraph.cli.common import AsJson, Quiet, progress_of
from placegraph.errors import OptionError


def embed(
    map_file: MapFile,
    out: Annotated[
        Path | None, Option("--out", "-o", help="File to write, such as monaco.vectors.")
    ] = None,
    store: Annotated[
        str | None,
        Option(help="Milvus server to load instead: http://[user:password@]host:port."),
    ] = None,
    name: Annotated[
        str | None, Option(help="Name of the store on the server; the map's if not given.")
    ] = None,
    bits: Annotated[int, Option(help="Bits of a number in a file: 8, 16 or 32.")] = 16,
    resume: Annotated[
        bool, Option("--resume", help="Go on with a load into a server that broke off.")
    ] = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Embed a map's cells, into a file or a Milvus server.

    For `placegraph city locate --store`; a server needs the extra `milvus`.

    Example: placegraph city embed monaco.city -o monaco.vectors
    """
    from time import perf_counter

    from placegraph.outdoor.city import CityMap
    from placegraph_scale.milvus.server import check_uri, shown

    if (out is None) == (store is None):
        raise OptionError("Say where to: a file with --out, or a server with --store.")
    if resume and out is not None:
        raise OptionError("--resume is for --store; a file is written in one go.")
    if store is not None:
        check_uri(store)
    city = CityMap.open(map_file)
    start = perf_counter()
    with progress_of(hidden=quiet or as_json) as tell:
        tell("embedding")
        made = city.encoded.keep(
            store or out or "", name=name or map_file.stem, bits=bits, resume=resume,
            progress=lambda step, done, total: tell(f"{step} {done:,} of {total:,} cells"),
        )  # fmt: skip
    seconds = perf_counter() - start
    with made:
        told = {
            "store": shown(store) if store else str(out),
            "cells": len(made),
            "dimension": made.dimension,
            "version": made.origin.version,
            "bytes": out.stat().st_size if out else None,
            "seconds": round(seconds, 3),
        }
    if as_json:
        click.echo(json.dumps(told))
    elif not quiet:
        size = f", {told['bytes']:,} bytes" if out else ""
        click.echo(
            f"{told['store']}: {told['cells']:,} cells, {told['dimension']} numbers each, version "
            f"{told['version']}{size}, in {seconds:.1f} s."
        )


def stores(
    uri: Annotated[str, Argument(help="Milvus server: http://[user:password@]host:port.")],
    drop: Annotated[
        str | None, Option(help="Remove this collection, whole or half loaded.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """List the stores on a Milvus server, or drop one.

    Needs the extra `milvus`.

    Example: placegraph city stores http://localhost:19530
    """
    from placegraph.vectors import drop_store, list_stores

    if drop is not None:
        dropped = drop_store(uri, drop)
        click.echo(json.dumps(asdict(dropped)) if as_json else f"{dropped.collection} is dropped.")
        return
    found = list_stores(uri)
    if as_json:
        click.echo(json.dumps([asdict(info) for info in found]))
        return
    for info in found:
        state = "" if info.complete else "  (half loaded: embed with --resume, or --drop it)"
        click.echo(f"{info.collection}  {info.rows:,} cells of {info.name}{state}")
    if not found:
        click.echo("No stores of placegraph's.")
