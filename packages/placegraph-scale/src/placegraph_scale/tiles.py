"""From an extract of any size to cities of tiles, in bounded memory."""

from __future__ import annotations

import json
import os
import struct
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import write_file
from placegraph.core.geo import bounds, key_of, reached
from placegraph.core.geometry import LocalPlane
from placegraph.core.mapfile import DIGEST, starts
from placegraph.errors import InputError, MapError
from placegraph.io.osm.osm import LeftOut, read_columns
from placegraph.io.osm.urls import is_large
from placegraph.outdoor.language.vocabulary import Vocabulary
from placegraph.outdoor.map.city import City
from placegraph.outdoor.map.extract import (
    THING,
    Thing,
    Things,
    clip,
    keys_read,
    labelled,
    nothing_in,
    objects_of,
    once,
    without_largest,
)
from placegraph_scale.shards.words import counted, keep

if TYPE_CHECKING:
    from placegraph.core.geo import Box
    from placegraph.outdoor.map.extract import Progress

HEAD = struct.Struct("<4sQIIII")
"""Magic, bytes that follow, crc32 of these and of the numbers behind it: things, parts, points."""
_SIZES = struct.Struct("<III")
MAGIC = b"PGS2"
ROOM = 64 << 20
"""Bytes that wait in memory until they are written."""


def packed(things: Things) -> bytes:
    """A frame of things."""
    columns = (
        things.osm_type, things.kind, things.osm_id.astype("<i8"),
        np.diff(things.part_starts).astype("<u4"), np.diff(things.point_starts).astype("<u4"),
        things.steps.astype("<i4"),
    )  # fmt: skip
    data = b"".join([c.tobytes() for c in columns] + [THING.join(things.texts).encode()])
    data = zlib.compress(data, 1)
    sizes = len(things), len(things.point_starts) - 1, len(things.steps)
    return HEAD.pack(MAGIC, len(data), _crc(data, *sizes), *sizes) + data


def _crc(data: bytes, *sizes: int) -> int:
    return zlib.crc32(data, zlib.crc32(_SIZES.pack(*sizes)))


def _unpacked(data: bytes, n: int, parts: int, points: int) -> Things:
    data, at, columns = zlib.decompress(data), 0, []
    for dtype, count in (
        ("u1", n),
        ("u1", n),
        ("<i8", n),
        ("<u4", n),
        ("<u4", parts),
        ("<i4", 2 * points),
    ):
        columns.append(np.frombuffer(data, dtype, count, at))
        at += columns[-1].nbytes
    osm_type, kind, osm_id, n_parts, n_points, steps = columns
    texts = str(data[at:], "utf-8").split(THING)
    return Things(
        osm_type, osm_id, kind, starts(n_parts), starts(n_points), steps.reshape(-1, 2), texts
    )


class Spills:
    """Files of a folder, ``KEY.things``, to which frames are added in any order.

    `sizes` are those of a folder that was begun before: what its files hold beyond, or besides, was
    not finished, and is taken away. Raises `MapError` where the disk is full.
    """

    def __init__(self, folder: Path, sizes: Mapping[str, int] | None = None) -> None:
        self.folder = folder
        self.sizes = dict(sizes or {})
        """Bytes of each file so far, by key."""
        for path in folder.glob("*.things"):
            if path.stem in self.sizes:
                os.truncate(path, self.sizes[path.stem])
            else:
                path.unlink()
        self._waiting: dict[str, list[bytes]] = {}
        self._bytes = 0

    @property
    def full(self) -> bool:
        """Whether it is time to `flush`."""
        return self._bytes > ROOM // 2

    def add(self, key: str, things: Things) -> None:
        """Put things to a tile's."""
        frame = packed(things)
        self._waiting.setdefault(key, []).append(frame)
        self._bytes += len(frame)
        if self._bytes > ROOM:
            self.flush()

    def flush(self) -> None:
        """Write what waits in memory."""
        for key, frames in self._waiting.items():
            path = self.folder / f"{key}.things"
            try:
                with path.open("ab") as file:
                    file.writelines(frames)
            except OSError as error:
                raise no_room(path, error) from error
            self.sizes[key] = self.sizes.get(key, 0) + sum(map(len, frames))
        self._waiting, self._bytes = {}, 0


def things_of(path: Path, size: int) -> list[Things]:
    """Frames of a file of so many bytes; raises `MapError` where it was damaged."""
    mend = f"{path} is damaged; remove the folder {path.parent.parent} and build again."
    found = []
    try:
        with path.open("rb") as file:
            while head := file.read(HEAD.size):
                if len(head) < HEAD.size:
                    raise MapError(mend)
                magic, length, crc, *sizes = HEAD.unpack(head)
                size -= HEAD.size + length
                if magic != MAGIC or size < 0:
                    raise MapError(mend)
                data = file.read(length)
                if _crc(data, *sizes) != crc:
                    raise MapError(mend)
                found.append(_unpacked(data, *sizes))
    except OSError as error:
        raise MapError(f"{mend[:-1]} ({error.strerror}).") from error
    if size:
        raise MapError(mend)
    return found


def no_room(path: Path, error: OSError) -> MapError:
    """What is raised where a build cannot go on writing."""
    return MapError(
        f"{path} cannot be written: {error.strerror or error}. Make room, or mend what is in the "
        "way; the same command then goes on where it stopped."
    )


MANY = 16
"""What touches more tiles than this is put to them only where they hold something else."""
BORDER = 60.0
"""A thing so near to a tile's core is seen from within it [m]."""
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


SPARE = 0.01
"""What sticks out of a tile by less than this stays whole [deg]: squares, parks, long buildings."""


@dataclass(frozen=True)
class TileJob:
    """What is to be made of a tile; it can be sent to other processes, and done again."""

    key: str
    things: tuple[tuple[str, int], ...]
    """Files of things, and their sizes [bytes]."""
    out: str
    """City to write."""
    margin: float
    """How far around the tile things are taken [m]."""
    sizes: tuple[float, float, float]
    """Cells, their distance, and how far edges reach [m]."""
    source: str
    """What the city says it was made from."""
    counts: str = ""
    """File for the words that were counted in it; none where it is empty."""

    @property
    def lies_there(self) -> bool:
        """Whether its things were put aside, and are there still."""
        try:
            return all(Path(path).stat().st_size >= size for path, size in self.things)
        except OSError:
            return False


@dataclass(frozen=True)
class TileDone:
    """What became of a tile."""

    key: str
    digest: str
    """SHA-256 that the map file ends with; empty where there is nothing, and no file."""
    bytes: int = 0
    objects: int = 0
    cells: int = 0

    def stands(self, path: Path) -> bool:
        """Whether the file is there that was written then."""
        if not self.digest:
            return True
        try:
            return path.stat().st_size == self.bytes and _digest(path) == self.digest
        except OSError:
            return False


def build_tile(job: TileJob) -> TileDone:
    """Build the city of a tile, in one step, whoever built it before.

    Raises `MapError` where things are damaged, or the city cannot be written.
    """
    tables = [table for path, size in job.things for table in things_of(Path(path), size)]
    core = bounds(job.key)
    plane = LocalPlane(*(round(x, 4) for x in core.center))
    left_out, things = LeftOut(), None
    if tables:
        things = _within(once(Things.joined(tables)), core.widened(job.margin))
        del tables
    if things:
        things = without_largest(things, left_out, plane)
    out = Path(job.out)
    if not things:
        return TileDone(job.key, "")
    cell_size, stride, edge_distance = job.sizes
    city = City.create(
        plane, objects_of(things, plane), cell_size=cell_size, stride=stride,
        edge_distance=edge_distance, source=job.source, left_out=dict(left_out.counts),
    )  # fmt: skip
    words = counted(city, job.key)
    city.save(out, quick=True)
    made = TileDone(job.key, _digest(out), out.stat().st_size, len(city.objects), len(city.cells))
    if job.counts:
        keep(words, Path(job.counts), made.digest)
    return made


def _within(things: Things, box: Box) -> Things | None:
    """What of things lies in a box [deg], which may reach across the date line; None for nothing."""
    low, high = things.ends()
    turn = 360.0 * np.round((low[:, 0] - box.center[0]) / 360.0)
    low[:, 0] -= turn
    high[:, 0] -= turn
    west, south, east, north = box
    there = (low <= (east, north)).all(axis=1) & (high >= (west, south)).all(axis=1)
    whole = (low >= (west - SPARE, south - SPARE)) & (high <= (east + SPARE, north + SPARE))
    found = [things.take(np.flatnonzero(there & whole.all(axis=1)))]
    cut = []
    for row in np.flatnonzero(there & ~whole.all(axis=1)).tolist():
        thing = things.thing(row)
        parts = [part - (turn[row], 0.0) for part in thing.parts]
        if parts := clip(thing.kind, parts, box):
            cut.append(thing._replace(parts=parts))
    if cut:
        found.append(Things.of(cut))
    made = Things.joined([table for table in found if len(table)] or found)
    return made if len(made) else None


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        file.seek(-DIGEST, 2)
        return file.read(DIGEST).hex()
