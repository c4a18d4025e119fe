"""The last step of a build: read all shards, and write what the world as a whole is asked by."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from placegraph.core.geo import check_zoom, tile_of
from placegraph.errors import InputError, MapError, OptionError
from placegraph_scale.shards.folder import SHARDS, WORDS, ShardFile, WorldFile, digest_of
from placegraph_scale.shards.table import counted, write

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from os import PathLike

    from placegraph_scale.shards.table import Counted

    Each = Callable[[Callable[[Path], Counted], list[Path]], Iterable[Counted]]

SCRATCH = ".finish"
"""Folder for words of shards while they are put in order."""


def finish(
    folder: str | PathLike[str], zoom: int, overlap: float, each: Each | None = None
) -> WorldFile:
    """Read all shards of a folder, and write `words.table` and `world.json`, each in one step.

    Parameters
    ----------
    folder
        Holds ``shards/KEY.city``: maps of squares of the quadtree, and of `overlap` around.
    zoom
        Level of the quadtree: the number of digits of a key.
    overlap
        How far shards reach beyond their squares [m].
    each
        Applies a function to all paths, in order; one after the other where not given. The function
        and what it returns can be sent to other processes.

    Raises
    ------
    InputError
        There is no shard.
    MapError
        A shard is damaged, is no city, or is called by no key of this zoom; a file cannot be written.
    OptionError
        `zoom` or `overlap` is out of its range.

    """
    check_zoom(zoom)
    folder = Path(folder)
    if not 0.0 <= overlap < np.inf:
        raise OptionError(f"overlap is {overlap!r}; give a number of metres from 0 on.")
    paths = sorted((folder / SHARDS).glob("*.city"))
    if not paths:
        raise InputError(
            f"{folder / SHARDS} holds no shard; build the world with `placegraph world build`."
        )
    for path in paths:
        _check_key(path, zoom)
    shards: list[ShardFile] = []

    def found() -> Iterator[Counted]:
        for p, c in zip(paths, (each or map)(count, paths), strict=True):
            held = c.total, c.cells, c.viewpoints
            shards.append(
                ShardFile(p.stem, f"{SHARDS}/{p.name}", digest_of(p), p.stat().st_size, *held)
            )
            yield c

    write(folder / WORDS, found(), folder / SCRATCH)
    made = WorldFile(folder, zoom, float(overlap), digest_of(folder / WORDS), tuple(shards))
    made.write()
    return made


def count(path: Path) -> Counted:
    """What `counted` counts of the shard in a file."""
    from placegraph.outdoor.city import CityMap

    return counted(CityMap.open(path), path.stem)


def _check_key(path: Path, zoom: int) -> None:
    try:
        tile_of(path.stem)
        good = len(path.stem) == zoom
    except ValueError:
        good = False
    if not good:
        raise MapError(
            f"{path}: {path.stem!r} is no key of zoom {zoom}; a shard is called by {zoom} digits "
            "from 0 to 3. Move it away, or build the world again."
        )
