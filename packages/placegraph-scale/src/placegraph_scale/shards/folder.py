"""The folder of a world in shards: what `world.json` says of it, and where its files lie."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from placegraph.core import files
from placegraph.core.geo import DEEPEST, bounds
from placegraph.core.mapfile import DIGEST
from placegraph.errors import InputError, MapError
from placegraph.maps import WORLD

if TYPE_CHECKING:
    from placegraph.core.geo import Box


NAME, WORDS, SHARDS = WORLD, "words.table", "shards"
FORMAT, VERSION = "placegraph world", 1
_MEND = "Write it anew with `placegraph world build`."


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
    """Of which the centre lies in the core."""
    cells: int
    viewpoints: int
    """In the core."""

    @property
    def core(self) -> Box:
        """Ground that it answers for."""
        return bounds(self.key)


@dataclass(frozen=True)
class WorldFile:
    """What `world.json` says."""

    folder: Path
    zoom: int
    overlap: float
    """How far shards reach beyond their cores [m]."""
    words: str
    """SHA-256 of `words.table`, as of a shard."""
    shards: tuple[ShardFile, ...]
    """By key."""

    @classmethod
    def read(cls, folder: str | PathLike[str]) -> Self:
        """Read it; `InputError` where it is missing, `MapError` where it is none, or of a newer version."""
        path = Path(folder) / NAME
        try:
            told = json.loads(files.regular(path).read_bytes())
        except OSError as error:
            raise InputError(
                f"{path} cannot be read: {error.strerror}. Name a folder that `placegraph world "
                "build` has finished."
            ) from error
        except (ValueError, RecursionError) as error:
            raise MapError(f"{path} is no JSON ({error}). {_MEND}") from error
        if not isinstance(told, dict) or told.get("format") != FORMAT:
            raise MapError(f"{path} does not describe a world in shards. {_MEND}")
        if told.get("version") != VERSION:
            raise MapError(
                f"{path} is of version {told.get('version')!r}, this placegraph reads {VERSION}; "
                "update placegraph, or build the world again."
            )
        try:
            return cls._of(Path(folder), told)
        except (LookupError, TypeError, ValueError, AttributeError) as error:
            raise MapError(f"{path}: {type(error).__name__}: {error}. {_MEND}") from error

    @classmethod
    def _of(cls, folder: Path, told: dict[str, Any]) -> Self:
        zoom, overlap = int(told["zoom"]), float(told["overlap_m"])
        shards = tuple(
            ShardFile(str(s["key"]), str(s["file"]), str(s["digest"]),
                      *(int(s[name]) for name in ("bytes", "objects", "cells", "viewpoints")))
            for s in told["shards"]
        )  # fmt: skip
        if not (1 <= zoom <= DEEPEST and overlap >= 0.0 and shards):
            raise ValueError(f"zoom {zoom}, overlap {overlap} m, {len(shards)} shards")
        keys = [s.key for s in shards]
        if keys != sorted(set(keys)) or any(len(key) != zoom for key in keys):
            raise ValueError("keys are not in order, or of another zoom")
        for s in shards:
            bounds(s.key)
            if s.file != f"{SHARDS}/{s.key}.city" or min(s.bytes, s.objects, s.viewpoints) < 0:
                raise ValueError(f"shard {s.key} is {s}")
        return cls(folder, zoom, overlap, str(told["words"]["digest"]), shards)

    def write(self) -> None:
        """Write it in one step; `MapError` where that fails."""
        told = {
            "format": FORMAT, "version": VERSION, "zoom": self.zoom, "overlap_m": self.overlap,
            "words": {"file": WORDS, "digest": self.words},
            "shards": [asdict(s) | {"core": list(s.core)} for s in self.shards],
        }  # fmt: skip
        text = json.dumps(told, ensure_ascii=False, indent=1)
        files.write_file(self.folder / NAME, [text.encode() + b"\n"])

    def path(self, shard: ShardFile) -> Path:
        """Where a shard's file lies."""
        return self.folder / shard.file


def digest_of(path: Path) -> str:
    """Digest that a map file ends with; `InputError` where it cannot be read."""
    try:
        with files.regular(path).open("rb") as file:
            file.seek(-DIGEST, 2)
            return file.read(DIGEST).hex()
    except OSError as error:
        raise InputError(
            f"{path} cannot be read: {error.strerror or error}. Bring it back, or build it again."
        ) from error


def same(path: Path, digest: str) -> None:
    """Raise `PlacegraphError` where a file is missing, or is not the one that the world was made of."""
    if digest_of(path) != digest:
        raise MapError(
            f"{path} is not the file that the world was finished with; bring that back, or finish "
            "the world again with `placegraph world build`."
        )
