"""Folders of worlds in shards, here or at a URL."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from placegraph.core import files
from placegraph.core.geo import MAX_ZOOM, Box, tile_bounds
from placegraph.core.mapfile import DIGEST_SIZE
from placegraph.errors import InputError, MapError, OptionError, PlacegraphError
from placegraph.io.osm.osm import one_line
from placegraph.io.osm.urls import is_missing, is_url, open_file_system
from placegraph.maps import WORLD

if TYPE_CHECKING:
    Progress = Callable[[str, int, int | None], None]

NAME, WORDS, SHARDS = WORLD, "words.table", "shards"
FORMAT, VERSION = "placegraph world", 1
_MEND = "Build it again with `placegraph world build`."


@dataclass(frozen=True, slots=True)
class ShardFile:
    """A shard, as `world.json` lists it."""

    key: str
    """Path in the quadtree, from which its core follows."""
    file: str
    """Relative to the folder."""
    digest: str
    """SHA-256 of the file's contents, as its last 32 bytes hold it."""
    bytes: int
    objects: int
    """Number of objects with their centre in the core."""
    cells: int
    viewpoints: int
    """In the core."""

    @property
    def core(self) -> Box:
        """Ground that it answers for."""
        return tile_bounds(self.key)


@dataclass(frozen=True)
class WorldFile:
    """Content of `world.json`."""

    folder: Path
    zoom: int
    overlap: float
    """Distance by which shards extend beyond their cores [m]."""
    words: str
    """SHA-256 of `words.table`, as of a shard."""
    shards: tuple[ShardFile, ...]
    """By key."""

    @classmethod
    def read(cls, folder: str | PathLike[str]) -> Self:
        """Read it; `InputError` where it is missing, `MapError` where it is none, or of a newer version."""
        path = Path(folder) / NAME
        try:
            meta = json.loads(files.check_regular(path).read_bytes())
        except OSError as error:
            raise InputError(
                f"{path} cannot be read: {error.strerror}. Name a folder written by `placegraph "
                "world build`."
            ) from error
        except (ValueError, RecursionError) as error:
            raise MapError(f"{path} is not JSON ({error}). {_MEND}") from error
        if not isinstance(meta, dict) or meta.get("format") != FORMAT:
            raise MapError(f"{path} does not describe a world in shards. {_MEND}")
        if meta.get("version") != VERSION:
            raise MapError(
                f"{path} has version {meta.get('version')!r}, but this placegraph reads {VERSION}; "
                "update placegraph, or build the world again."
            )
        try:
            return cls._of(Path(folder), meta)
        except (LookupError, TypeError, ValueError, AttributeError) as error:
            raise MapError(f"{path}: {type(error).__name__}: {error}. {_MEND}") from error

    @classmethod
    def _of(cls, folder: Path, meta: dict[str, Any]) -> Self:
        zoom, overlap = int(meta["zoom"]), float(meta["overlap_m"])
        shards = tuple(
            ShardFile(str(s["key"]), str(s["file"]), str(s["digest"]),
                      *(int(s[name]) for name in ("bytes", "objects", "cells", "viewpoints")))
            for s in meta["shards"]
        )  # fmt: skip
        if not (1 <= zoom <= MAX_ZOOM and overlap >= 0.0 and shards):
            raise ValueError(f"zoom {zoom}, overlap {overlap} m, {len(shards)} shards")
        keys = [s.key for s in shards]
        if keys != sorted(set(keys)) or any(len(key) != zoom for key in keys):
            raise ValueError("keys are not sorted, or have another zoom")
        for s in shards:
            tile_bounds(s.key)
            if s.file != f"{SHARDS}/{s.key}.city" or min(s.bytes, s.objects, s.viewpoints) < 0:
                raise ValueError(f"shard {s.key} is {s}")
        return cls(folder, zoom, overlap, str(meta["words"]["digest"]), shards)

    def write(self) -> None:
        """Write it in one step; `MapError` where that fails."""
        meta = {
            "format": FORMAT, "version": VERSION, "zoom": self.zoom, "overlap_m": self.overlap,
            "words": {"file": WORDS, "digest": self.words},
            "shards": [asdict(s) | {"core": list(s.core)} for s in self.shards],
        }  # fmt: skip
        text = json.dumps(meta, ensure_ascii=False, indent=1)
        files.write_file(self.folder / NAME, [text.encode() + b"\n"])

    def path(self, shard: ShardFile) -> Path:
        """Return the path of a shard's file."""
        return self.folder / shard.file


def digest_of(path: Path) -> str:
    """Return the digest that a map file ends with; `InputError` where it cannot be read."""
    try:
        with files.check_regular(path).open("rb") as file:
            file.seek(-DIGEST_SIZE, 2)
            return file.read(DIGEST_SIZE).hex()
    except OSError as error:
        raise InputError(
            f"{path} cannot be read: {error.strerror or error}. Restore it, or build it again."
        ) from error


def check_digest(path: Path, digest: str) -> None:
    """Raise `PlacegraphError` where a file is missing, or is not the one that the world was made of."""
    if digest_of(path) != digest:
        raise MapError(
            f"{path} differs from the file that the world was built with; restore it, or "
            "run `placegraph world build` again."
        )


def bring(world: WorldFile, url: str, progress: Progress | None = None) -> WorldFile:
    """Bring a world to a URL, and return it; `world.json` comes last, so that a world there is complete.

    Raises `MapError`: something cannot be written there; `MissingExtraError` or `OptionError`:
    fsspec is not installed; or knows no such URL.
    """
    system, root = open_file_system(url)
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
            f"{url} cannot be written: {one_line(error)}. Run the same command to resume."
        ) from error
    return world


def fetch(url: str, folder: str | PathLike[str], progress: Progress | None = None) -> Path:
    """Fetch a world from a URL into a folder of this machine, and return that.

    Raises `InputError`: there is no world, or a file of it is missing; `MapError`: something cannot
    be read there or written here, or `world.json` is none; `MissingExtraError` or `OptionError`:
    fsspec is not installed; or knows no such URL.
    """
    system, root = open_file_system(url)
    folder = Path(folder)
    try:
        meta = system.cat_file(f"{root}/{NAME}")
        (folder / SHARDS).mkdir(parents=True, exist_ok=True)
        files.write_file(folder / NAME, [meta])
        world = WorldFile.read(folder)
        for n, shard in enumerate(world.shards):
            _fetch_file(system, f"{root}/{shard.file}", world.path(shard), shard.digest)
            if progress is not None:
                progress("fetching shards", n + 1, len(world.shards))
        _fetch_file(system, f"{root}/{WORDS}", folder / WORDS, world.words)
    except PlacegraphError:
        raise
    except Exception as error:  # each file system has its own
        if is_missing(error):
            raise InputError(
                f"{url}: {getattr(error, 'filename', None) or error} is missing; give the "
                "folder of a world in shards, build it, or copy it again."
            ) from error
        raise MapError(
            f"{url} cannot be downloaded to {folder}: {one_line(error)}. Run the same command to "
            "resume."
        ) from error
    return folder


def fetch_places(
    places: Sequence[str | PathLike[str]], keep: str | PathLike[str] | None
) -> list[Path]:
    """Return places on this machine; the world at a URL is fetched to the folder `keep`."""
    urls = [str(place) for place in places if is_url(place)]
    if keep is not None and not urls:
        raise OptionError("keep: it applies only to worlds at a URL; remove it.")
    if keep is None and urls:
        raise OptionError(f"{urls[0]} is a URL; name a local folder for its files (keep).")
    if len(urls) > 1:
        raise OptionError(
            f"{' and '.join(urls)} are URLs, but one folder can store only one world; fetch the "
            "others with `placegraph_scale.folder.fetch`, and name their folders."
        )
    return [fetch(str(p), keep) if keep is not None and is_url(p) else Path(p) for p in places]


def _fetch_file(system: Any, there: str, here: Path, digest: str) -> None:  # noqa: ANN401  # fsspec has no types
    try:
        same = digest_of(here) == digest
    except PlacegraphError:
        same = False
    if not same:
        system.get_file(there, str(here))
