"""From an extract of any size to cities of tiles, in bounded memory.

One pass over the file: each object is labelled, and put to every tile that it touches with a margin.
What touches more than `MANY` tiles waits until it is known which tiles hold anything smaller; then it
is clipped to these, down the quadtree, so that a road of 600 km through empty land costs nothing there.

Objects wait on disk by tile. A file is a row of frames. Each has a head, and then, little-endian: types
and kinds (a byte each), ids (8), how many parts each object and how many points each part has (4),
longitudes and latitudes in steps of 1e-7 degrees (4 each), and the texts in UTF-8, all compressed by
zlib. The files live until their tile is built: its core, and what lies within a margin of it.
"""

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

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import write_file
from placegraph.core.geo import Box, tile_bounds, tile_key, tile_ranges
from placegraph.core.geometry import LocalPlane
from placegraph.core.mapfile import offsets_of
from placegraph.errors import InputError, MapError, PlacegraphError
from placegraph.io.osm.osm import LeftOut, read_columns
from placegraph.io.osm.urls import is_large
from placegraph.outdoor.language.vocabulary import Vocabulary
from placegraph.outdoor.map.city import City
from placegraph.outdoor.map.extract import (
    THING,
    ElementTable,
    LabelledElement,
    Progress,
    clip,
    drop_duplicates,
    drop_largest,
    keys_read,
    label_elements,
    make_empty_error,
    make_objects,
)
from placegraph_scale.folder import digest_of
from placegraph_scale.shards.words import count_words

HEAD = struct.Struct("<4sQIIII")
"""Magic, bytes that follow, crc32 of these and of the numbers behind it: objects, parts, points."""
_SIZES = struct.Struct("<III")
MAGIC = b"PGS3"
ROOM = 64 << 20
"""Bytes that wait in memory until they are written."""
MANY = 16
"""Number of tiles above which an object is stored only in tiles that hold other objects."""
BORDER = 60.0
"""An object so near to a tile's core is seen from within it [m]."""
LARGE, DONE = "large", "split.json"
SPARE = 0.01
"""Overhang [deg] up to which an object that leaves a tile stays whole: squares, parks, long buildings."""


def pack_frame(objects: ElementTable) -> bytes:
    """Return a frame of objects."""
    columns = (
        objects.osm_type, objects.kind, objects.osm_id.astype("<i8"),
        np.diff(objects.part_starts).astype("<u4"), np.diff(objects.point_starts).astype("<u4"),
    )  # fmt: skip
    data = b"".join([c.tobytes() for c in columns] + [THING.join(objects.texts).encode()])
    data = objects.steps.astype("<i4").tobytes() + zlib.compress(data, 1)  # steps hardly shrink
    sizes = len(objects), len(objects.point_starts) - 1, len(objects.steps)
    return HEAD.pack(MAGIC, len(data), _crc(data, *sizes), *sizes) + data


def _crc(data: bytes, *sizes: int) -> int:
    return zlib.crc32(data, zlib.crc32(_SIZES.pack(*sizes)))


def _unpack_frame(data: bytes, n: int, parts: int, points: int) -> ElementTable:
    steps = np.frombuffer(data, "<i4", 2 * points)
    data, at, columns = zlib.decompress(memoryview(data)[steps.nbytes :]), 0, []
    for dtype, count in zip(("u1", "u1", "<i8", "<u4", "<u4"), (n, n, n, n, parts), strict=True):
        columns.append(np.frombuffer(data, dtype, count, at))
        at += columns[-1].nbytes
    osm_type, kind, osm_id, n_parts, n_points = columns
    texts = str(data[at:], "utf-8").split(THING)
    return ElementTable(
        osm_type,
        osm_id,
        kind,
        offsets_of(n_parts),
        offsets_of(n_points),
        steps.reshape(-1, 2),
        texts,
    )


class TileFiles:
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

    def add(self, key: str, objects: ElementTable) -> None:
        """Add objects to those of a tile."""
        frame = pack_frame(objects)
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


def read_frames(path: Path, size: int) -> list[ElementTable]:
    """Read the frames of a file of so many bytes; raises `MapError` where it was damaged."""
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
                found.append(_unpack_frame(data, *sizes))
    except OSError as error:
        raise MapError(f"{mend[:-1]} ({error.strerror}).") from error
    if size:
        raise MapError(mend)
    return found


def no_room(path: Path, error: OSError) -> MapError:
    """Return the error of a build that cannot go on writing."""
    return MapError(
        f"{path} cannot be written: {error.strerror or error}. Free some space, or fix the "
        "cause; the same command then resumes."
    )


@dataclass(frozen=True)
class Split:
    """State of the split of an extract, or of its first objects."""

    of: list[int]
    """Size and time of the extract, by which a change is seen."""
    sizes: dict[str, int]
    """Bytes of the objects of each tile, by key, and of those that touch many, as `LARGE`."""
    populated: list[str]
    """Keys of the tiles that hold something of their own."""
    objects: int
    left_out: dict[str, int]
    read: int
    """Blocks of the extract so far."""
    complete: bool = False

    def save(self, folder: Path) -> None:
        """Write it beside the tiles: what they hold beyond it does not count."""
        try:
            write_file(folder / DONE, [json.dumps(asdict(self), sort_keys=True).encode()])
        except OSError as error:
            raise no_room(folder / DONE, error) from error

    @classmethod
    def load(cls, folder: Path) -> Split | None:
        """Read the state of a folder; None where there is none, or where files are shorter."""
        try:
            found = cls(**json.loads((folder / DONE).read_bytes()))
            sizes = [(folder / f"{key}.things").stat().st_size for key in found.sizes]
        except (OSError, ValueError, TypeError):
            return None
        return found if all(map(int.__ge__, sizes, found.sizes.values())) else None


def split(
    path: Path,
    folder: Path,
    zoom: int,
    margin: float,
    vocabulary: Vocabulary | None = None,
    progress: Progress | None = None,
) -> Split:
    """Put the objects of an extract into a file a tile, in `folder`.

    Memory does not grow with the extract, but for the ways that its relations are made of; nodes of a
    large one lie on disk, 12 bytes each. Killed and called again, it passes over what it had read.

    Raises `InputError`: the extract cannot be read, changed meanwhile, or holds nothing worth
    naming; `MapError`: the folder cannot be written, as on a full disk.

    `path`: extract, see `read_columns`.
    `folder`: is filled with ``KEY.things``.
    `zoom`, `margin`: which tiles, and how far around them objects are taken [m].
    `vocabulary`: which tags are worth naming; the shipped one where not given.
    `progress`: is told how far it is.
    """
    vocabulary, state = vocabulary or Vocabulary.default(), _state(path)
    begun = Split.load(folder)
    if begun is None or begun.of != state:
        begun = Split(state, {}, [], 0, {}, 0)
    if begun.complete:
        return begun
    left_out = LeftOut(Counter(begun.left_out), begun.read)
    index = folder / "nodes.index" if is_large(path) else None
    files, populated, count = TileFiles(folder, begun.sizes), set(begun.populated), begun.objects

    def save(*, complete: bool = False) -> Split:
        files.flush()
        counts = dict(sorted(left_out.counts.items()))
        found = Split(state, files.sizes, sorted(populated), count, counts, left_out.read, complete)
        found.save(folder)
        return found

    tables = label_elements(
        read_columns(path, keys_read(vocabulary), left_out, index),
        vocabulary,
        progress or (lambda _step, _n: None),
    )
    with closing(tables):
        for objects in tables:
            count += len(objects)
            _spread(objects, files, populated, left_out.counts, (zoom, margin))
            if files.full:
                save()
    if _state(path) != state:
        (folder / DONE).unlink(missing_ok=True)
        raise InputError(f"{path} changed while it was read; build again when it is complete.")
    if not count:
        raise make_empty_error(path, left_out)
    return save(complete=True)


def _state(path: Path) -> list[int]:
    try:
        found = path.stat()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error
    return [found.st_size, found.st_mtime_ns]


def _spread(
    objects: ElementTable, files: TileFiles, populated: set[str], left_out: Counter[str],
    grid: tuple[int, float],
) -> None:  # fmt: skip
    """Put objects to all tiles of a grid (zoom, margin [m]) that they touch, and note whose they are."""
    zoom, margin = grid
    low, high = objects.ends()
    if (around := high[:, 0] - low[:, 0] > 180.0).any():
        left_out["objects across the date line"] += int(around.sum())
    wide = tile_ranges(low, high, zoom, margin)
    many = (wide[:, 2] - wide[:, 0] + 1) * (wide[:, 3] - wide[:, 1] + 1) > MANY
    if (large := np.flatnonzero(many & ~around)).size:
        files.add(LARGE, objects.take(large))
    small = np.flatnonzero(~many & ~around)
    tiles, _ = _touched_tiles(tile_ranges(low[small], high[small], zoom, BORDER), zoom)
    populated |= {tile_key(t >> zoom, t % (1 << zoom), zoom) for t in np.unique(tiles).tolist()}
    tiles, rows = _touched_tiles(wide[small], zoom)
    order = np.argsort(tiles, kind="stable")
    tiles, rows = tiles[order], small[rows[order]]
    ends = np.append(np.flatnonzero(np.diff(tiles, prepend=-1)), len(tiles)).tolist()
    for first, last in pairwise(ends):
        tile = int(tiles[first])
        key = tile_key(tile >> zoom, tile % (1 << zoom), zoom)
        files.add(key, objects.take(rows[first:last]))


def _touched_tiles(
    ends: NDArray[np.int64], zoom: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return tiles, ``column * 2^zoom + row``, within `tile_ranges` (N, 4), and the row of each."""
    wide, high = (ends[:, 2:] - ends[:, :2] + 1).T
    owner = np.repeat(np.arange(len(ends)), wide * high)
    nth = np.arange(len(owner)) - np.repeat(offsets_of(wide * high)[:-1], wide * high)
    column = (ends[owner, 0] + nth // high[owner]) % (1 << zoom)
    return (column << zoom) + ends[owner, 1] + nth % high[owner], owner


def spread_large(
    folder: Path, out: Path, sizes: dict[str, int], populated: Iterable[str], margin: float
) -> dict[str, int]:
    """Put what touches many tiles to those that hold something else; return bytes of each tile's file.

    `folder` is what `split` filled, `sizes` its sizes; `out` is an empty folder.
    """
    files = TileFiles(out)
    if LARGE in sizes:
        holding = {key[:depth] for key in populated for depth in range(len(key) + 1)}
        zoom = max(map(len, holding))
        for objects in read_frames(folder / f"{LARGE}.things", sizes[LARGE]):
            for row in range(len(objects)):
                for key, piece in _descend("", objects.element(row), holding, zoom, margin):
                    files.add(key, ElementTable.of([piece]))
        files.flush()
    return files.sizes


def _descend(
    key: str, piece: LabelledElement, holding: set[str], zoom: int, margin: float
) -> Iterator[tuple[str, LabelledElement]]:
    """Yield the tiles of a subtree that hold something, and what of an object lies in each."""
    if key:
        parts = clip(piece.kind, piece.parts, tile_bounds(key).expand(margin))
        if not parts:
            return
        piece = piece._replace(parts=parts)
    if len(key) == zoom:
        yield key, piece
        return
    for child in (key + digit for digit in "0123"):
        if child in holding:
            yield from _descend(child, piece, holding, zoom, margin)


@dataclass(frozen=True)
class TileJob:
    """A tile to be built; it can be sent to other processes, and done again."""

    key: str
    objects: tuple[tuple[str, int], ...]
    """Files of objects, and their sizes [bytes]."""
    out: str
    """City to write."""
    margin: float
    """Distance around the tile within which objects are included [m]."""
    sizes: tuple[float, float, float]
    """Cells, their distance, and how far edges reach [m]."""
    source: str
    """Source that the city names."""
    counts: str = ""
    """File for the words that were counted in it; none where it is empty."""

    @property
    def is_ready(self) -> bool:
        """Whether the objects of the tile are stored and still present."""
        try:
            return all(Path(path).stat().st_size >= size for path, size in self.objects)
        except OSError:
            return False


@dataclass(frozen=True)
class TileDone:
    """A tile that was built."""

    key: str
    digest: str
    """SHA-256 that the map file ends with; empty where there is nothing, and no file."""
    bytes: int = 0
    objects: int = 0
    cells: int = 0

    def stands(self, path: Path) -> bool:
        """Return whether the file is there that was written then."""
        if not self.digest:
            return True
        try:
            return path.stat().st_size == self.bytes and digest_of(path) == self.digest
        except (OSError, PlacegraphError):
            return False


def build_tile(job: TileJob) -> TileDone:
    """Build the city of a tile, in one step, whoever built it before.

    Raises `MapError` where objects are damaged, or the city cannot be written.
    """
    tables = [table for path, size in job.objects for table in read_frames(Path(path), size)]
    core = tile_bounds(job.key)
    plane = LocalPlane(*(round(x, 4) for x in core.center))
    left_out, objects = LeftOut(), None
    if tables:
        objects = _cut(drop_duplicates(ElementTable.concatenate(tables)), core.expand(job.margin))
        del tables
    if objects:
        objects = drop_largest(objects, left_out, plane)
    out = Path(job.out)
    if not objects:
        return TileDone(job.key, "")
    cell_size, stride, edge_distance = job.sizes
    city = City.create(
        plane, make_objects(objects, plane), cell_size=cell_size, stride=stride,
        edge_distance=edge_distance, source=job.source, left_out=dict(left_out.counts),
    )  # fmt: skip
    words = count_words(city, job.key)
    city.save(out)
    made = TileDone(job.key, digest_of(out), out.stat().st_size, len(city.objects), len(city.cells))
    if job.counts:
        words.save(Path(job.counts), made.digest)
    return made


def _cut(objects: ElementTable, box: Box) -> ElementTable | None:
    """Cut objects to a box [deg], which may reach across the date line; return None where none is left."""
    low, high = objects.ends()
    turn = 360.0 * np.round((low[:, 0] - box.center[0]) / 360.0)
    low[:, 0] -= turn
    high[:, 0] -= turn
    west, south, east, north = box
    there = (low <= (east, north)).all(axis=1) & (high >= (west, south)).all(axis=1)
    inside = (low >= (west - SPARE, south - SPARE)) & (high <= (east + SPARE, north + SPARE))
    found = [objects.take(np.flatnonzero(there & inside.all(axis=1)))]
    cut = []
    for row in np.flatnonzero(there & ~inside.all(axis=1)).tolist():
        piece = objects.element(row)
        parts = [part - (turn[row], 0.0) for part in piece.parts]
        if parts := clip(piece.kind, parts, box):
            cut.append(piece._replace(parts=parts))
    if cut:
        found.append(ElementTable.of(cut))
    made = ElementTable.concatenate([table for table in found if len(table)] or found)
    return made if len(made) else None
