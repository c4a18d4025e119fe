"""The index of viewpoints as columns of a map file; most of them are read where they lie."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from numpy.typing import NDArray

from placegraph.core.mapfile import MapFile
from placegraph.outdoor.map.index import ViewIndex

WORTH = 10_000
"""Maps of fewer objects are stored without one: it is several times as large as they are, and derived
in a fifth of a second."""
_PREFIX = "view_"
_DTYPES = {
    "tiles": "<i8", "present": "<i8", "total": "|u1", "pairs": "<u2", "thing_counts": "<u4",
    "things": "<i4", "run_counts": "<u4", "run_tiles": "<u4", "run_slots": "<i8",
    "run_first": "<u4", "run_pairs": "|u1", "run_total": "|u1", "postings": "<u4", "share": "<f8",
}  # fmt: skip
MAPPED = frozenset(
    _PREFIX + name
    for name in (
        "run_slots", "run_tiles", "run_first", "postings", "things", "pairs", "total", "run_pairs",
        "run_total",
    )
)  # fmt: skip
"""Columns that are read where they lie ..."""
LARGE = 16 << 20
"""... where they have so many bytes together: what is read is held, whatever becomes of the file."""


def stored(index: ViewIndex) -> dict[str, NDArray[Any]]:
    """Columns of a map file."""
    return {_PREFIX + name: column for name, column in index.arrays().items()}


def index_in(file: MapFile, words: int) -> ViewIndex | None:
    """The index that a map file has of as many `words`; None where it has none.

    Raises `MapError` where a column is missing, and what `store.sound` turns into one where columns
    contradict each other.
    """
    if "views" not in file.meta:
        return None
    columns = {name: file.array(_PREFIX + name, dtype) for name, dtype in _DTYPES.items()}
    east, north, width = file.meta["views"]
    index = ViewIndex.of(columns, (float(east), float(north), int(width)))
    index = replace(index, watch=file.watch)
    if len(index.share) != words:
        raise ValueError("the index of viewpoints is of other words")
    return index
