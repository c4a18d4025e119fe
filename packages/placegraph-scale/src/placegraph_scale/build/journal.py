"""What a build has finished: a line a tile, on disk before the next one counts."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from placegraph.errors import MapError
from placegraph_scale.build.spill import no_room
from placegraph_scale.build.tile import TileDone

if TYPE_CHECKING:
    from placegraph_scale.build.build import BuildOptions


def told(path: Path) -> dict[str, Any]:
    """What a file of a build says; `MapError` where it is damaged."""
    try:
        found = json.loads(path.read_bytes())
    except ValueError:
        found = None
    if not isinstance(found, dict):
        raise MapError(f"{path} is damaged; remove {path.parent}, and run the same command again.")
    return found


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    with path.open("rb") as file:
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_SEQUENTIAL)
        return hashlib.file_digest(file, "sha256").hexdigest()


def plan_of(extracts: Iterable[Path], options: BuildOptions) -> dict[str, Any]:
    """What a build depends on; if any of it changes, it is another build."""
    known = asdict(options)
    for name in ("workers", "scheduler", "vocabulary", "work"):
        del known[name]
    words = hashlib.sha256()
    if options.vocabulary is not None:
        for path in sorted(options.vocabulary.iterdir()):
            words.update(path.name.encode() + path.read_bytes())
    return {
        "extracts": [[path.name, path.stat().st_size, sha256_of(path)] for path in extracts],
        "options": known,
        "vocabulary": words.hexdigest(),
    }


class Journal:
    """Tiles that are finished, and the file that says so."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.done: dict[str, TileDone] = {}
        """By key."""

    def read(self) -> None:
        """Read what is there; a last line that was cut off is taken away."""
        if not self.path.exists():
            return
        whole = 0
        with self.path.open("rb+") as file:
            for line in file:
                try:
                    made = TileDone(**json.loads(line))
                except (ValueError, TypeError):
                    break
                self.done[made.key] = made
                whole += len(line)
            file.truncate(whole)

    def add(self, made: TileDone) -> None:
        """Write down that a tile is finished; raises `MapError` where the disk is full."""
        line = json.dumps(asdict(made)).encode() + b"\n"
        try:
            with self.path.open("ab") as file:
                file.write(line)
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise no_room(self.path, error) from error
        self.done[made.key] = made
