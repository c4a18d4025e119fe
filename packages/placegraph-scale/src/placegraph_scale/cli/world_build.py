"""`placegraph world build`: extracts of any size become a folder of shards."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click

from placegraph.cli.command import Argument, Option
from placegraph.cli.common import AsJson, Quiet, echo_json, progress_of

if TYPE_CHECKING:
    from placegraph_scale.build.build import BuildOptions


def build(
    files: Annotated[
        list[str],
        Argument(
            help="OpenStreetMap extracts, as of `city build`, or URLs of such; they may overlap."
        ),
    ],
    out: Annotated[
        str, Option("--out", "-o", help="Folder to write, such as europe/, or URL (s3://...).")
    ],
    zoom: Annotated[
        int, Option(help="Level of the quadtree: tiles of 10 km at the equator by 12.")
    ] = 12,
    overlap: Annotated[float, Option(help="How far shards reach beyond their tiles [m].")] = 500.0,
    cell_size: Annotated[float, Option(help="Edge of a cell [m].")] = 50.0,
    stride: Annotated[
        float | None, Option(help="Distance of cell centres [m]; the cell size if not given.")
    ] = None,
    edge_distance: Annotated[
        float | None,
        Option(help="Objects nearer than this are joined [m]; the cell size if not given."),
    ] = None,
    vocabulary: Annotated[Path | None, Option(help="Folder with edited vocabulary tables.")] = None,
    workers: Annotated[
        int | None, Option(help="Processes; one a processor if not given.", least=1)
    ] = None,
    scheduler: Annotated[
        str | None,
        Option(help="Dask scheduler (tcp://host:port) whose workers see the same folders."),
    ] = None,
    work: Annotated[
        Path | None, Option(help="Folder to build in what is then brought to a URL.")
    ] = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Build a folder of shards from OpenStreetMap extracts of any size.

    Interrupted or killed, the same command goes on where it stopped.

    Example: placegraph world build germany.osm.pbf -o germany/
    """
    from placegraph_scale.build.build import BuildOptions

    options = BuildOptions(
        zoom=zoom, overlap=overlap, cell_size=cell_size, stride=stride,
        edge_distance=edge_distance, vocabulary=vocabulary, workers=workers, scheduler=scheduler,
        work=work,
    )  # fmt: skip
    made_of(files, out, options, as_json=as_json, quiet=quiet)


def made_of(
    files: Sequence[str], out: str, options: BuildOptions, *, as_json: bool, quiet: bool
) -> None:
    """Build a world, and say what it holds."""
    from time import perf_counter

    from placegraph_scale.build.build import build_world

    start = perf_counter()
    with progress_of(hidden=quiet or as_json) as tell:
        made = build_world(files, out, options, tell)
    told = {
        "shards": len(made.shards),
        "objects": sum(shard.objects for shard in made.shards),
        "cells": sum(shard.cells for shard in made.shards),
        "bytes": sum(shard.bytes for shard in made.shards),
        "seconds": round(perf_counter() - start, 3),
    }
    if as_json:
        echo_json(told)
    elif not quiet:
        click.echo(
            f"{out}: {told['objects']:,} objects in {told['shards']:,} shards, "
            f"{told['bytes'] / 1e6:,.1f} MB, built in {told['seconds']:.1f} s."
        )
