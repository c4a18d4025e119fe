"""Whether the columns of a shard fit each other: compiled code believes them.

Checksums tell damage; these tell a file that was forged with the right ones.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from placegraph.indoor.language.index import Columns
from placegraph.indoor.library.signature import BANDS, TURNS

if TYPE_CHECKING:
    from placegraph_scale.library.shard import Shard, Usual

STRINGS = ("names", "paths", "digests", "earth", "buildings")
"""Columns of bytes, each beside one that says where those of a scene begin."""


def check_usual(usual: Usual) -> None:
    """Raise any of LookupError, TypeError, ValueError where columns do not fit each other."""
    if not usual.keys:
        raise ValueError("no encoders")
    for i in range(len(usual.keys)):
        vectors, common = usual.seen(i)
        if vectors.ndim != 2 or common.shape != (len(vectors),) or not np.isfinite(vectors).all():
            raise ValueError(f"vectors_{i}")
    _check_texts(usual.columns)


def check_scenes(shard: Shard) -> None:
    """The same of a shard."""
    a = shard.arrays
    units, objects, views = len(a["starts"]) - 1, len(a["share"]), len(a["places"])
    _ends(a["unit_starts"], units, least=1)
    _ends(a["starts"], objects, least=1)
    _ends(a["place_starts"], views)
    shapes = {"panoramas": (views, BANDS, TURNS), "places": (views, 2), "share": (objects,)}
    for i in range(len(shard.usual.keys)):
        known, d = len(a[f"scales_{i}"]), shard.usual.seen(i)[0].shape[1]
        shapes |= {f"vectors_{i}": (known, d), f"means_{i}": (units, d), f"code_{i}": (objects,)}
        _rows(f"code_{i}", a[f"code_{i}"], known)
    if "order" in a:  # scenes, not the homes beside them
        shapes |= {"order": (objects,), "stands": (len(a["stands"]), 6)}
        _check_told(shard)
    for name, shape in shapes.items():
        if a[name].shape != shape:
            raise ValueError(f"{name} is {a[name].shape}, not {shape}")
    many = np.repeat(np.diff(a["starts"]), np.diff(a["place_starts"]))
    if views and (a["panoramas"].reshape(views, -1).max(axis=1) > many).any():
        raise ValueError("panoramas point outside the objects")


def _check_told(shard: Shard) -> None:
    a, count = shard.arrays, len(shard)
    _ends(a["stand_starts"], len(a["stands"]))
    for name in STRINGS:
        starts = a[f"{name}_starts"]
        _ends(starts, int(starts[-1]))
        if int(starts[-1]) > a[name].size or len(starts) != count + 1:
            raise ValueError(name)
    if len(a["stand_starts"]) != count + 1 or not np.isfinite(a["stands"]).all():
        raise ValueError("stands")
    _check_texts(shard.columns)
    if shard.columns.scenes != count:
        raise ValueError("texts are of other scenes")


def _ends(starts: NDArray[Any], total: int, least: int = 0) -> None:
    """Raise `ValueError` where runs do not begin at 0, shrink, or end elsewhere."""
    ends = (int(starts[0]), int(starts[-1])) if starts.ndim == 1 and len(starts) > 1 else None
    if starts.dtype != np.int64 or ends != (0, total) or (np.diff(starts) < least).any():
        raise ValueError("runs do not fit what they are of")


def _rows(name: str, rows: NDArray[Any], count: int) -> None:
    """Raise `ValueError` where integers are no rows of so many."""
    if rows.size and not (rows.dtype.kind == "i" and rows.min() >= 0 and rows.max() < count):
        raise ValueError(f"{name} points outside what it is of")


def _check_texts(c: Columns) -> None:
    """Raise `ValueError` where columns of texts do not fit each other."""
    count = len(c.scene)
    for of, words in ((c.of_labels, len(c.labels)), (c.of_triples, len(c.triples))):
        _ends(of.starts, len(of.units))
        if len(of.starts) - 1 != words or len(of.counts) != len(of.units):
            raise ValueError("postings of texts")
        _rows("postings", of.units, count)
    rows = len(c.looks) - len(c.of_labels.units), len(c.room_looks) - count
    lengths = {len(c.much) - count, len(c.rooms) - count, len(c.whole) - count, *rows}
    ascending = np.array_equal(np.unique(c.scene), np.arange(c.scenes))
    if lengths != {0} or not ascending or (np.diff(c.scene) < 0).any():
        raise ValueError("columns of texts are of different lengths")
    for numbers, least in (
        (c.of_labels.counts, 0),
        (c.of_triples.counts, 0),
        (c.much, 1),
        (c.rooms, 0),
    ):
        if not ((numbers >= least) & (numbers < np.inf)).all():
            raise ValueError("numbers of texts")
    for name, rows, many in zip(
        ("subjects", "relations", "targets"), c.triples.T,
        (len(c.labels), len(c.relations), len(c.labels)), strict=True,
    ):  # fmt: skip
        _rows(name, rows, many)
