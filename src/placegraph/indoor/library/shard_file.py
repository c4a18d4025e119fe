"""A shard of a library on disk: columns that are mapped when they are asked for, not read.

A shard is a folder of plain NumPy files and `shard.json`, which names every column with its type and
shape. It appears whole or not at all.
"""

from __future__ import annotations

import json
import shutil
from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph.columns import DTYPES
from placegraph.errors import InputError, MapError

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    Arrays = Mapping[str, NDArray[Any]]

VERSION = 1
HEAD = "shard.json"
USUAL, BESIDE = "usual", "beside"
"""Folders beside the shards: what is usual, and the homes that no library has."""


def write_shard(folder: Path, meta: Mapping[str, Any], arrays: Arrays) -> None:
    """Write a shard in one step; raises `MapError` where it cannot be written."""
    made = folder.with_name(f".{folder.name}.tmp")
    try:
        shutil.rmtree(made, ignore_errors=True)  # left by a crash
        made.mkdir(parents=True)
        for name, array in arrays.items():
            np.save(made / f"{name}.npy", np.ascontiguousarray(array), allow_pickle=False)
        columns = {name: [array.dtype.str, list(array.shape)] for name, array in arrays.items()}
        head = {"kind": "library shard", "version": VERSION, "meta": meta, "columns": columns}
        (made / HEAD).write_text(json.dumps(head, ensure_ascii=False), "utf-8")
        if folder.exists():
            shutil.rmtree(folder)
        made.replace(folder)
    except OSError as error:
        raise MapError(
            f"{folder} cannot be written ({error.strerror}); choose another place."
        ) from error


def unfinished(folder: Path) -> None:
    """Let a folder be no library until its shards are written; `MapError` where it cannot be."""
    try:
        (folder / USUAL / HEAD).unlink(missing_ok=True)
    except OSError as error:
        raise MapError(
            f"{folder} cannot be written ({error.strerror}); choose another place."
        ) from error


def map_shard(folder: Path) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Metadata and mapped columns of a shard.

    Types and shapes are checked, contents are not read: what has been tampered with may crash.

    Raises
    ------
    InputError
        It is not there.
    MapError
        It is none, of a newer version, or a column is missing or another than it was.

    """
    if not (folder / HEAD).is_file():
        raise InputError(f"{folder} is no shard of a library: it has no {HEAD}; make it again.")
    try:
        head = json.loads((folder / HEAD).read_text("utf-8"))
        version, meta, columns = int(head["version"]), dict(head["meta"]), dict(head["columns"])
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise MapError(f"{folder / HEAD} is damaged ({error}); make the shards again.") from error
    if version > VERSION:
        raise MapError(
            f"{folder} is of version {version}, this placegraph reads up to {VERSION}; update it."
        )
    return meta, {name: _mapped(folder / f"{name}.npy", told) for name, told in columns.items()}


def _mapped(path: Path, told: Any) -> NDArray[Any]:  # noqa: ANN401
    """One column, copied where it is written to, so that compiled code takes it as any array."""
    try:
        array = np.asarray(np.load(path, mmap_mode="c", allow_pickle=False))
    except (OSError, ValueError, EOFError) as error:
        raise MapError(f"{path} is missing or damaged ({error}); make the shards again.") from error
    if [array.dtype.str, list(array.shape)] != told or array.dtype.str not in DTYPES:
        raise MapError(
            f"{path} is {array.dtype.str} {array.shape}, and was {told} when it was written; make the "
            "shards again."
        )
    return array


def packed(strings: list[str] | tuple[str, ...]) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """Strings as bytes, and where each begins and the last ends."""
    parts = [s.encode() for s in strings]
    starts = np.concatenate([[0], np.cumsum([len(p) for p in parts])]).astype(np.int64)
    return np.frombuffer(b"".join(parts) or b"\0", np.uint8), starts


def unpacked(blob: NDArray[np.uint8], starts: NDArray[np.int64], row: int) -> str:
    """One of the strings."""
    return bytes(blob[starts[row] : starts[row + 1]]).decode("utf-8", "replace")
