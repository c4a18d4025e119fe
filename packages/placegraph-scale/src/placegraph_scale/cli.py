"""Commands `placegraph world build` and `placegraph library shard`."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from placegraph.cli.command import Argument, Fields, Option
from placegraph.cli.common import AsJson, Quiet, echo_json, progress_of
from placegraph.cli.library import ItsEncoders, open_library
from placegraph.cli.scene_options import NoProgress, WeightsFile
from placegraph.core.files import resolve_path
from placegraph.errors import MapError
from placegraph_scale.options import BuildOptions

if TYPE_CHECKING:
    from placegraph.indoor.library import SceneLibrary
    from placegraph_scale.library.write import NamedEntry


def build(
    files: Annotated[
        list[str],
        Argument(
            help="OpenStreetMap extracts or their URLs, as for `city build`; they may overlap."
        ),
    ],
    out: Annotated[
        str, Option("--out", "-o", help="Folder to write, such as europe/, or URL (s3://...).")
    ],
    options: Annotated[dict[str, Any], Fields(BuildOptions)],
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Build a folder of shards from OpenStreetMap extracts of any size.

    Run the same command again to resume an interrupted build.

    Example: placegraph world build germany.osm.pbf -o germany/
    """
    run_build(files, out, BuildOptions(**options), as_json=as_json, quiet=quiet)


def run_build(
    files: Sequence[str], out: str, options: BuildOptions, *, as_json: bool, quiet: bool
) -> None:
    """Build a world, and print what it holds."""
    from time import perf_counter

    from placegraph_scale.build import build_world

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


def shard(
    libraries: Annotated[
        list[Path], Argument(help="Libraries (.library), or folders of scene maps.")
    ],
    out: Annotated[Path, Option("--out", "-o", help="Folder to write, such as homes.shards.")],
    size: Annotated[int, Option(help="Number of scenes per shard.", least=1)] = 10_000,
    encoder: ItsEncoders = None,
    weights: WeightsFile = None,
    as_json: AsJson = False,
    quiet: NoProgress = False,
) -> None:
    """Convert libraries to shards: memory-mapped files, for tens of thousands of scenes.

    The folder stores the relative path of each map. `library search` and `library localize` accept the
    folder like a library.

    Example: placegraph library shard north.library south.library -o homes.shards
    """
    from placegraph_scale.library.write import write_shards

    with progress_of(hidden=quiet or as_json) as tell:
        first = open_library(libraries[0], encoder, weights, tell)
        every = _named_entries(
            libraries, first, out, lambda path: open_library(path, encoder, weights, tell)
        )
        made = write_shards(out, every, first.encoders, size)
    told = {"scenes": len(made), "shards": len(made.shards)}
    told["bytes"] = sum(f.stat().st_size for f in out.rglob("*") if f.is_file())
    if as_json:
        echo_json(told)
    elif not quiet:
        click.echo(
            f"{out}: {len(made):,} scenes in {len(made.shards)} shards, {told['bytes'] / 1e6:,.1f} MB."
        )


def _named_entries(
    paths: list[Path], first: SceneLibrary, out: Path, open_: Callable[[Path], SceneLibrary]
) -> Iterator[NamedEntry]:
    """Yield scenes of all libraries, one open at a time; names tell of which, if there are several."""
    from placegraph_scale.library.write import NamedEntry

    for i, path in enumerate(paths):
        library = open_(path) if i else first
        if [e.key for e in library.encoders] != [e.key for e in first.encoders]:
            raise MapError(
                f"{path} and {paths[0]} were made by different encoders; use the same "
                "encoders for both."
            )
        for name in library:
            entry = library.entry(name)
            at = entry.path and resolve_path(entry.path)
            place = os.path.relpath(at, resolve_path(out)) if at else ""
            yield NamedEntry(name if len(paths) == 1 else f"{path.stem}: {name}", entry, place)
