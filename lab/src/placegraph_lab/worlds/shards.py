"""Worlds in shards to measure on: a city cut into them, with the same viewpoints, and copies of these."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from placegraph.core.geo import are_in_tile, parse_tile_key, tile_bounds, tile_key, tiles_at
from placegraph.core.geometry import LocalPlane
from placegraph.outdoor.city import CityMap
from placegraph.outdoor.map.index import REACH, STRIDE
from placegraph.outdoor.map.objects import POINT, CityObjects
from placegraph_scale.shards import WorldFile, finish
from placegraph_scale.shards.words import WordCounts

SIDE = 8  # viewpoints are kept in squares of so many
DISTINCT = 19  # so many copies of a world have labels that are shuffled anew


def write_shards(city: CityMap, folder: Path, zoom: int, overlap: float = 150.0) -> WorldFile:
    """Cut a city into the shards of a world, and finish it."""
    (folder / "shards").mkdir(parents=True, exist_ok=True)
    for key, shard in split_city(city, zoom, overlap):
        shard.save(folder / "shards" / f"{key}.city")
    return finish(folder, zoom, overlap)


def split_city(city: CityMap, zoom: int, overlap: float) -> Iterator[tuple[str, CityMap]]:
    """Shards of a city by their keys, each with what reaches within `overlap` [m] of its core.

    Viewpoints of a city stand on a grid that begins at its south-western corner. A hut beyond the
    overlap makes every shard's grid a part of the city's, so that both have the same viewpoints.
    """
    objects = city.objects
    ends = objects.point_starts[objects.part_starts[:-1]]
    low, high = (
        cut.reduceat(objects.points, ends).astype(float) for cut in (np.minimum, np.maximum)
    )
    places = city.plane.to_lonlat(city.views.positions.astype(np.float64))
    for tile in np.unique(tiles_at(places, zoom), axis=0):
        column, row = tile.tolist()
        key = tile_key(column, row, zoom)
        core = tile_bounds(key)
        corners = city.plane.to_plane([[core.west, core.south], [core.east, core.north]])
        box = np.add(corners, [[-overlap], [overlap]])
        rows = np.flatnonzero((high >= box[0]).all(axis=1) & (low <= box[1]).all(axis=1))
        part = part_of(objects, rows, hut(objects, low[rows], box[0]))
        centers = city.plane.to_lonlat(city.cells.centers(np.arange(len(city.cells))))
        cells = replace(city.cells, points=city.cells.points[are_in_tile(centers, key)])
        yield key, CityMap(city.plane, part, cells, f"{city.source} {key}", {})


def hut(
    objects: CityObjects, low: NDArray[np.float64], corner: NDArray[np.float64]
) -> NDArray[np.float64]:
    """A place (2,) [m] south-west of all, a whole number of squares from where the city's grid begins."""
    first = objects.points.min(axis=0).astype(np.float64)
    beyond = np.minimum(low.min(axis=0, initial=np.inf), corner - 4.0 * REACH)
    steps = np.floor((beyond - first) / (STRIDE * SIDE))
    return np.asarray(first + steps * STRIDE * SIDE)


def part_of(
    objects: CityObjects, rows: NDArray[np.int64], extra: NDArray[np.float64]
) -> CityObjects:
    """Some of the objects, and a point of the first label at `extra` (2,) [m]."""
    labels, label_starts, label_values = _strings(
        objects.labels, objects.label_starts, objects.label_values, rows
    )
    names, name_starts, name_values = _strings(
        objects.names, objects.name_starts, objects.name_values, rows
    )
    parts, part_starts = _take_rows(objects.part_starts, rows)
    points, point_starts = _take_rows(objects.point_starts, parts)
    at = extra.astype(np.float32)[None]
    return replace(
        objects,
        osm_type=np.append(objects.osm_type[rows], np.uint8(0)),
        osm_id=np.append(objects.osm_id[rows], np.int64(0)),
        kind=np.append(objects.kind[rows], np.uint8(POINT)),
        label_starts=np.append(label_starts, label_starts[-1] + 1).astype(np.int32),
        label_values=np.append(label_values, 0).astype(np.int32),
        name_starts=np.append(name_starts, name_starts[-1]).astype(np.int32),
        name_values=name_values.astype(np.int32),
        part_starts=np.append(part_starts, part_starts[-1] + 1).astype(np.int32),
        point_starts=np.append(point_starts, point_starts[-1] + 1).astype(np.int32),
        points=np.concatenate([objects.points[points], at]),
        center=np.concatenate([objects.center[rows], at]),
        labels=labels,
        names=names,
    )


def _strings(
    table: tuple[str, ...],
    starts: NDArray[np.int32],
    values: NDArray[np.int32],
    rows: NDArray[np.int64],
) -> tuple[tuple[str, ...], NDArray[np.int64], NDArray[np.int64]]:
    """Strings of some rows: those that occur, and which of them each row has."""
    entries, kept = _take_rows(starts, rows)
    used, where = np.unique(values[entries], return_inverse=True)
    return tuple(table[i] for i in used.tolist()), kept, where.ravel()


def _take_rows(
    starts: NDArray[np.int32], rows: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Entries of some rows of a CSR, and their own starts."""
    sizes = np.diff(starts)[rows].astype(np.int64)
    kept = np.concatenate(([0], np.cumsum(sizes)))
    return np.arange(kept[-1]) + np.repeat(starts[rows] - kept[:-1], sizes), kept


def write_copies(source: Path, folder: Path, copies: int, seed: int = 0) -> None:
    """The shards of a larger world: copies of one side by side, to the east, their labels shuffled.

    The first keeps its labels. In every other one labels and names are exchanged among the things of
    a kind of geometry in a shard, and names get a word of their own before them. From `DISTINCT` on
    only that word is new: a copy is one of those before, at another place. What is there already
    is taken as it is, so that one goes on where one was stopped; `copies_of` links the first of them.
    """
    old = WorldFile.read(source)
    (folder / "shards").mkdir(parents=True, exist_ok=True)
    for i, shard in enumerate(old.shards):
        city = CityMap.open(old.path(shard))
        keys = keys_of_copies(old, i, copies)
        for k, key in enumerate(keys):
            path = folder / "shards" / f"{key}.city"
            if path.exists():
                continue
            turn = 360.0 * (parse_tile_key(key)[0] - parse_tile_key(shard.key)[0]) / (1 << old.zoom)
            east = (city.plane.longitude + turn + 180.0) % 360.0 - 180.0
            plane = LocalPlane(east, city.plane.latitude)
            cells = replace(city.cells, plane=plane)
            first = first_of(k)
            if k > first:
                like = CityMap.open(folder / "shards" / f"{keys[first]}.city")
                named = replace(like.objects, names=rename_copy(like.objects.names, k))
                made = CityMap(plane, named, cells, city.source, {})
                made.__dict__["_views"] = like.views
                made.save(path, quick=True)
                continue
            rng = np.random.default_rng([seed, i, k])
            objects = city.objects if k == 0 else shuffle_objects(city.objects, _word(k), rng)
            CityMap(plane, objects, cells, city.source, {}).save(path)


def first_of(copy: int) -> int:
    """The copy whose labels one has."""
    return copy if copy < DISTINCT else 1 + (copy - 1) % (DISTINCT - 1)


def rename_copy(names: tuple[str, ...], copy: int) -> tuple[str, ...]:
    """Names of a copy, with the word of another one before them."""
    return tuple(f"{_word(copy)} {name.partition(' ')[2]}" for name in names)


def finish_copies(source: Path, world: Path, copies: int) -> WorldFile:
    """Finish a world of copies: what is the same in several is counted once."""
    old = WorldFile.read(source)
    keys = [keys_of_copies(old, i, copies) for i in range(len(old.shards))]
    of = {key: (i, k) for i, mine in enumerate(keys) for k, key in enumerate(mine)}

    def each(count: Callable[[Path], WordCounts], paths: list[Path]) -> Iterator[WordCounts]:
        known: dict[tuple[int, int], WordCounts] = {}
        for path in paths:
            i, k = of[path.stem]
            first = first_of(k)
            if (i, first) not in known:
                known[i, first] = count(path.with_stem(keys[i][first]))
            found = known[i, first]
            yield found if k == first else found._replace(names=rename_copy(found.names, k))

    return finish(world, old.zoom, old.overlap, each)


def keys_of_copies(world: WorldFile, shard: int, copies: int) -> list[str]:
    """Keys of the copies of a shard: as many columns apart as the world is wide."""
    columns = [parse_tile_key(s.key)[0] for s in world.shards]
    wide = max(columns) - min(columns) + 1
    column, row, zoom = parse_tile_key(world.shards[shard].key)
    return [tile_key((column + k * wide) % (1 << zoom), row, zoom) for k in range(copies)]


def copies_of(source: Path, large: Path, folder: Path, copies: int) -> None:
    """Shards of the first `copies` of what `write_copies` wrote into `large`, as links to its files."""
    old = WorldFile.read(source)
    (folder / "shards").mkdir(parents=True, exist_ok=True)
    for i in range(len(old.shards)):
        for key in keys_of_copies(old, i, copies):
            name = Path("shards") / f"{key}.city"
            (folder / name).unlink(missing_ok=True)
            (folder / name).hardlink_to(large / name)


def shuffle_objects(objects: CityObjects, word: str, rng: Generator) -> CityObjects:
    """Objects with labels and names exchanged among those of a kind."""
    rows = np.arange(len(objects))
    for kind in range(3):
        mine = np.flatnonzero(objects.kind == kind)
        rows[mine] = rng.permutation(mine)
    labels, label_starts = _take_rows(objects.label_starts, rows)
    names, name_starts = _take_rows(objects.name_starts, rows)
    return replace(
        objects,
        label_starts=label_starts.astype(np.int32),
        label_values=objects.label_values[labels],
        name_starts=name_starts.astype(np.int32),
        name_values=objects.name_values[names],
        names=tuple(f"{word} {name}" for name in objects.names),
    )


def _word(k: int) -> str:
    """A word for each number."""
    syllables = [c + v for c in "bdfgklmnprstvz" for v in "aeiou"]
    return (syllables[k % 70] + syllables[k // 70 % 70] + "mo").capitalize()
