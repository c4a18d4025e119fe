"""`placegraph library shard`: many libraries as one that is mapped, not read."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click

from placegraph.cli.command import Argument, Option
from placegraph.cli.common import AsJson, echo_json, progress_of
from placegraph.cli.library import ItsEncoders, opened
from placegraph.cli.scene_options import NoProgress, WeightsFile
from placegraph.core.files import real_path
from placegraph.errors import MapError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from placegraph.indoor.library import SceneLibrary
    from placegraph_scale.library.shard_write import Listed


def shard(
    libraries: Annotated[
        list[Path], Argument(help="Libraries (.library), or folders of scene maps.")
    ],
    out: Annotated[Path, Option("--out", "-o", help="Folder to write, such as homes.shards.")],
    size: Annotated[int, Option(help="Scenes of a shard.", least=1)] = 10_000,
    encoder: ItsEncoders = None,
    weights: WeightsFile = None,
    as_json: AsJson = False,
    quiet: NoProgress = False,
) -> None:
    """Put the scenes of libraries into shards, which a search maps instead of reading them.

    For tens of thousands of scenes. Maps stay where they are, known by their place relative to the
    folder. `library search` and `library localize` take the folder as they take a library.

    Example: placegraph library shard north.library south.library -o homes.shards
    """
    from placegraph_scale.library.shard_write import write_shards

    with progress_of(hidden=quiet or as_json) as tell:
        first = opened(libraries[0], encoder, weights, tell)
        every = _listed(libraries, first, out, lambda path: opened(path, encoder, weights, tell))
        made = write_shards(out, every, first.encoders, size)
    told = {"scenes": len(made), "shards": len(made.shards)}
    told["bytes"] = sum(f.stat().st_size for f in out.rglob("*") if f.is_file())
    if as_json:
        echo_json(told)
    elif not quiet:
        click.echo(
            f"{out}: {len(made):,} scenes in {len(made.shards)} shards, {told['bytes'] / 1e6:,.1f} MB."
        )


def _listed(
    paths: list[Path], first: SceneLibrary, out: Path, open_: Callable[[Path], SceneLibrary]
) -> Iterator[Listed]:
    """Scenes of all libraries, one library open at a time; names say of which, if there are several."""
    from placegraph_scale.library.shard_write import Listed

    for i, path in enumerate(paths):
        library = open_(path) if i else first
        if [e.key for e in library.encoders] != [e.key for e in first.encoders]:
            raise MapError(
                f"{path} was encoded by others than {paths[0]}; make both by the same encoders."
            )
        for name in library:
            entry = library.entry(name)
            at = entry.path and real_path(entry.path)
            place = os.path.relpath(at, real_path(out)) if at else ""
            yield Listed(name if len(paths) == 1 else f"{path.stem}: {name}", entry, place)
