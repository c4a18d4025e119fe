"""An extract of any size, split into tiles in little memory.

One pass over the file: each thing is labelled, and put to every tile that it touches with a margin.
What touches more than `MANY` tiles waits until it is known which tiles hold anything smaller; then it
is clipped to these, down the quadtree, so that a road of 600 km through empty land costs nothing there.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import closing
from dataclasses import asdict, dataclass
from itertools import pairwise
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import write_file
from placegraph.core.geo import bounds, key_of, reached
from placegraph.core.mapfile import starts
from placegraph.errors import InputError
from placegraph.io.osm.osm import LeftOut, read_columns
from placegraph.io.osm.urls import is_url, size_of
from placegraph.outdoor.language.vocabulary import Vocabulary
from placegraph.outdoor.map.extract import Thing, Things, clip, keys_read, labelled, nothing_in
from placegraph_scale.build.spill import Spills, no_room, things_of

if TYPE_CHECKING:
    from placegraph.outdoor.map.extract import Progress


MANY = 16
"""What touches more tiles than this is put to them only where they hold something else."""
BORDER = 60.0
"""A thing so near to a tile's core is seen from within it [m]."""
SMALL = 64 << 20
"""Bytes of an extract that one map is made of, in memory: some 9 million nodes, 16 bytes each."""
LARGE, DONE = "large", "split.json"


@dataclass(frozen=True)
class Split:
    """What became of an extract, or of its first objects."""

    of: list[int]
    """Size and time of the extract, by which a change is seen."""
    sizes: dict[str, int]
    """Bytes of the things of each tile, by key, and of those that touch many, as `LARGE`."""
    populated: list[str]
    """Keys of the tiles that hold something of their own."""
    things: int
    left_out: dict[str, int]
    read: int
    """Blocks of the extract so far."""
    whole: bool = False

    def save(self, folder: Path) -> None:
        """Write it beside the tiles: what they hold beyond it does not count."""
        try:
            write_file(folder / DONE, [json.dumps(asdict(self), sort_keys=True).encode()])
        except OSError as error:
            raise no_room(folder / DONE, error) from error

    @classmethod
    def read_in(cls, folder: Path) -> Split | None:
        """Of a folder; None where nothing was put there, or where less is there than was."""
        try:
            found = cls(**json.loads((folder / DONE).read_bytes()))
            sizes = [(folder / f"{key}.things").stat().st_size for key in found.sizes]
        except (OSError, ValueError, TypeError):
            return None
        kept = all(map(int.__ge__, sizes, found.sizes.values()))
        return found if kept else None


def is_large(extract: str | PathLike[str]) -> bool:
    """Whether a map of all of an extract, or of one at a URL, would take more memory than there may be."""
    if is_url(extract):
        return (size_of(str(extract)) or 0) > SMALL
    path = Path(extract)
    return path.is_file() and path.stat().st_size > SMALL


def split(
    path: Path,
    folder: Path,
    zoom: int,
    margin: float,
    vocabulary: Vocabulary | None = None,
    progress: Progress | None = None,
) -> Split:
    """Put the things of an extract into a file a tile, in `folder`.

    Memory does not grow with the extract, but for the ways that its relations are made of; nodes of a
    large one lie on disk, 12 bytes each. Killed and called again, it passes over what it had read.

    Parameters
    ----------
    path
        Extract, see `read_columns`.
    folder
        Is filled with ``KEY.things`` (`spill`).
    zoom, margin
        Which tiles, and how far around them things are taken [m].
    vocabulary
        Which tags are worth naming; the shipped one where not given.
    progress
        Is told how far it is.

    Raises
    ------
    InputError
        The extract cannot be read, changed meanwhile, or holds nothing worth naming.
    MapError
        The folder cannot be written, as on a full disk.

    """
    vocabulary, state = vocabulary or Vocabulary.default(), _state(path)
    begun = Split.read_in(folder)
    if begun is None or begun.of != state:
        begun = Split(state, {}, [], 0, {}, 0)
    if begun.whole:
        return begun
    left_out = LeftOut(Counter(begun.left_out), begun.read)
    index = folder / "nodes.index" if is_large(path) else None
    spills, populated, count = Spills(folder, begun.sizes), set(begun.populated), begun.things

    def so_far(*, whole: bool = False) -> Split:
        spills.flush()
        counts = dict(sorted(left_out.counts.items()))
        found = Split(state, spills.sizes, sorted(populated), count, counts, left_out.read, whole)
        found.save(folder)
        return found

    tables = labelled(
        read_columns(path, keys_read(vocabulary), left_out, index),
        vocabulary,
        progress or (lambda _step, _n: None),
    )
    with closing(tables):
        for things in tables:
            count += len(things)
            _spread(things, spills, populated, left_out.counts, (zoom, margin))
            if spills.full:
                so_far()
    if _state(path) != state:
        (folder / DONE).unlink(missing_ok=True)
        raise InputError(f"{path} changed while it was read; build again when it is whole.")
    if not count:
        raise nothing_in(path, left_out)
    return so_far(whole=True)


def spread_large(
    folder: Path, out: Path, sizes: dict[str, int], populated: Iterable[str], margin: float
) -> dict[str, int]:
    """Put what touches many tiles to those that hold something else; bytes of each tile's file.

    `folder` is what `split` filled, `sizes` its sizes; `out` is an empty folder.
    """
    spills = Spills(out)
    if LARGE in sizes:
        holding = {key[:depth] for key in populated for depth in range(len(key) + 1)}
        zoom = max(map(len, holding))
        for things in things_of(folder / f"{LARGE}.things", sizes[LARGE]):
            for row in range(len(things)):
                for key, thing in _down("", things.thing(row), holding, zoom, margin):
                    spills.add(key, Things.of([thing]))
        spills.flush()
    return spills.sizes


def _down(
    key: str, thing: Thing, holding: set[str], zoom: int, margin: float
) -> Iterator[tuple[str, Thing]]:
    """Tiles of a subtree that hold something, and what of a thing lies in each."""
    if key:
        parts = clip(thing.kind, thing.parts, bounds(key).widened(margin))
        if not parts:
            return
        thing = thing._replace(parts=parts)
    if len(key) == zoom:
        yield key, thing
        return
    for child in (key + digit for digit in "0123"):
        if child in holding:
            yield from _down(child, thing, holding, zoom, margin)


def _spread(
    things: Things,
    spills: Spills,
    populated: set[str],
    left_out: Counter[str],
    grid: tuple[int, float],
) -> None:
    """Put things to all tiles of a grid (zoom, margin [m]) that they touch, and note whose they are."""
    zoom, margin = grid
    low, high = things.ends()
    if (around := high[:, 0] - low[:, 0] > 180.0).any():
        left_out["things across the date line"] += int(around.sum())
    wide = reached(low, high, zoom, margin)
    many = (wide[:, 2] - wide[:, 0] + 1) * (wide[:, 3] - wide[:, 1] + 1) > MANY
    if (large := np.flatnonzero(many & ~around)).size:
        spills.add(LARGE, things.take(large))
    small = np.flatnonzero(~many & ~around)
    tiles, _ = _touched(reached(low[small], high[small], zoom, BORDER), zoom)
    populated |= {key_of(t >> zoom, t % (1 << zoom), zoom) for t in np.unique(tiles).tolist()}
    tiles, rows = _touched(wide[small], zoom)
    order = np.argsort(tiles, kind="stable")
    tiles, rows = tiles[order], small[rows[order]]
    bounds_ = np.append(np.flatnonzero(np.diff(tiles, prepend=-1)), len(tiles)).tolist()
    for first, last in pairwise(bounds_):
        tile = int(tiles[first])
        key = key_of(tile >> zoom, tile % (1 << zoom), zoom)
        spills.add(key, things.take(rows[first:last]))


def _touched(ends: NDArray[np.int64], zoom: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Tiles, ``column * 2^zoom + row``, within ends (N, 4) as of `reached`, and the row of each in `ends`."""
    wide, high = (ends[:, 2:] - ends[:, :2] + 1).T
    owner = np.repeat(np.arange(len(ends)), wide * high)
    nth = np.arange(len(owner)) - np.repeat(starts(wide * high)[:-1], wide * high)
    column = (ends[owner, 0] + nth // high[owner]) % (1 << zoom)
    return (column << zoom) + ends[owner, 1] + nth % high[owner], owner


def _state(path: Path) -> list[int]:
    try:
        found = path.stat()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error
    return [found.st_size, found.st_mtime_ns]
