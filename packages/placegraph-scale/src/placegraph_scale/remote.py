"""Worlds in shards that lie elsewhere: at any URL that fsspec knows (``s3://``, ``gs://``, ``memory://``).

A shard is read where it lies, which only a disk of this machine allows. So a world is built here and
brought there, or fetched from there and opened here; what is the same at both ends stays as it is.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from placegraph.core import files
from placegraph.errors import InputError, MapError, OptionError, PlacegraphError
from placegraph.io.osm.osm import one_line
from placegraph.io.osm.urls import is_missing, is_url, system_of
from placegraph_scale.shards.folder import NAME, SHARDS, WORDS, WorldFile, digest_of

if TYPE_CHECKING:
    Progress = Callable[[str, int, int | None], None]


def bring(world: WorldFile, url: str, progress: Progress | None = None) -> WorldFile:
    """Bring a world to a URL, and return it; its `world.json` comes last, so that what is there is whole.

    Raises
    ------
    MapError
        Something cannot be written there.
    MissingExtraError, OptionError
        fsspec is not installed; or knows no such URL.

    """
    system, root = system_of(url)
    try:
        known = {s["file"]: s for s in json.loads(system.cat_file(f"{root}/{NAME}"))["shards"]}
    except (OSError, ValueError, LookupError, TypeError):
        known = {}
    try:
        system.makedirs(f"{root}/{SHARDS}", exist_ok=True)
        if system.exists(f"{root}/{NAME}"):
            system.rm_file(f"{root}/{NAME}")
        for n, shard in enumerate(world.shards):
            if known.get(shard.file, {}).get("digest") != shard.digest:
                system.put_file(str(world.path(shard)), f"{root}/{shard.file}")
            if progress is not None:
                progress("bringing shards", n + 1, len(world.shards))
        for gone in known.keys() - {shard.file for shard in world.shards}:
            system.rm_file(f"{root}/{gone}")
        for name in (WORDS, NAME):
            system.put_file(str(world.folder / name), f"{root}/{name}")
    except Exception as error:  # each file system has its own
        raise MapError(
            f"{url} cannot be written: {one_line(error)}. The same command goes on."
        ) from error
    return world


def fetch(url: str, folder: str | PathLike[str], progress: Progress | None = None) -> Path:
    """Fetch a world from a URL into a folder of this machine, and return that.

    Raises
    ------
    InputError
        There is no world, or a file of it is missing.
    MapError
        Something cannot be read there or written here, or `world.json` is none.
    MissingExtraError, OptionError
        fsspec is not installed; or knows no such URL.

    """
    system, root = system_of(url)
    folder = Path(folder)
    try:
        told = system.cat_file(f"{root}/{NAME}")
        (folder / SHARDS).mkdir(parents=True, exist_ok=True)
        files.write_file(folder / NAME, [told])
        world = WorldFile.read(folder)
        for n, shard in enumerate(world.shards):
            _fetched(system, f"{root}/{shard.file}", world.path(shard), shard.digest)
            if progress is not None:
                progress("fetching shards", n + 1, len(world.shards))
        _fetched(system, f"{root}/{WORDS}", folder / WORDS, world.words)
    except PlacegraphError:
        raise
    except Exception as error:  # each file system has its own
        if is_missing(error):
            raise InputError(
                f"{url}: {getattr(error, 'filename', None) or error} is not there; name the folder of a "
                "world in shards, build it, or bring it again."
            ) from error
        raise MapError(
            f"{url} cannot be fetched to {folder}: {one_line(error)}. The same command goes on."
        ) from error
    return folder


def at_hand(places: Sequence[str | PathLike[str]], keep: str | PathLike[str] | None) -> list[Path]:
    """Places on this machine; `fetch` brings the world that lies at a URL to the folder `keep`."""
    urls = [str(place) for place in places if is_url(place)]
    if keep is not None and not urls:
        raise OptionError("keep: it is of a world at a URL, and none is given; leave it out.")
    if keep is None and urls:
        raise OptionError(f"{urls[0]} is a URL: name a folder for what is fetched (keep).")
    if len(urls) > 1:
        raise OptionError(
            f"{' and '.join(urls)} are URLs, and one folder keeps one world: fetch the others by "
            "`placegraph_scale.remote.fetch`, and name their folders."
        )
    return [fetch(str(p), keep) if keep is not None and is_url(p) else Path(p) for p in places]


def _fetched(system: Any, there: str, here: Path, digest: str) -> None:  # noqa: ANN401  # fsspec has no types
    try:
        same = digest_of(here) == digest
    except PlacegraphError:
        same = False
    if not same:
        system.get_file(there, str(here))
