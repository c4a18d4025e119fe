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
from placegraph.core.mapfile import gather_spans
from placegraph.outdoor.city import CityMap
from placegraph.outdoor.map.index import REACH, STRIDE
from placegraph.outdoor.map.objects import POINT, CityObjects
from placegraph_scale.shards import WorldFile, finish
from placegraph_scale.shards.words import WordCounts

Rows = NDArray[np.int64]
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


def part_of(objects: CityObjects, rows: Rows, extra: NDArray[np.float64]) -> CityObjects:
    """Some of the objects, and a point of the first label at `extra` (2,) [m]."""
    part, one = take_objects(objects, rows), np.int32(1)
    at = extra.astype(np.float32)[None]
    return replace(
        part,
        osm_type=np.append(part.osm_type, np.uint8(0)),
        osm_id=np.append(part.osm_id, np.int64(0)),
        kind=np.append(part.kind, np.uint8(POINT)),
        label_starts=np.append(part.label_starts, part.label_starts[-1] + one),
        label_values=np.append(part.label_values, np.int32(0)),
        name_starts=np.append(part.name_starts, part.name_starts[-1]),
        part_starts=np.append(part.part_starts, part.part_starts[-1] + one),
        point_starts=np.append(part.point_starts, part.point_starts[-1] + one),
        points=np.concatenate([part.points, at]),
    )


def take_objects(objects: CityObjects, rows: Rows) -> CityObjects:
    """Objects `rows`, with those labels and names that they bear."""
    label_starts, entries = take_rows(objects.label_starts, rows)
    labels, label_values = _used(objects.labels, objects.label_values[entries])
    name_starts, entries = take_rows(objects.name_starts, rows)
    names, name_values = _used(objects.names, objects.name_values[entries])
    part_starts, parts = take_rows(objects.part_starts, rows)
    point_starts, points = take_rows(objects.point_starts, parts)
    return CityObjects(
        objects.osm_type[rows], objects.osm_id[rows], objects.kind[rows],
        label_starts, label_values, name_starts, name_values, part_starts, point_starts,
        objects.points[points], labels, names,
    )  # fmt: skip


def exchange_in_kinds(kind: NDArray[np.uint8], rng: Generator) -> Rows:
    """Permutation (N,) of objects within their kinds."""
    order = np.arange(len(kind))
    for k in np.unique(kind):
        rows = np.flatnonzero(kind == k)
        order[rows] = rng.permutation(rows)
    return order


def take_rows(starts: NDArray[np.int32], rows: Rows) -> tuple[NDArray[np.int32], Rows]:
    """CSR of some rows: their starts, and which entries they have."""
    made, entries = gather_spans(starts.astype(np.int64), rows)
    return made.astype(np.int32), entries


def _used(
    table: tuple[str, ...], values: NDArray[np.int32]
) -> tuple[tuple[str, ...], NDArray[np.int32]]:
    used, inverse = np.unique(values, return_inverse=True)
    return tuple(table[i] for i in used), inverse.astype(np.int32)


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
                made.save(path)
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
    rows = exchange_in_kinds(objects.kind, rng)
    label_starts, labels = take_rows(objects.label_starts, rows)
    name_starts, names = take_rows(objects.name_starts, rows)
    return replace(
        objects,
        label_starts=label_starts,
        label_values=objects.label_values[labels],
        name_starts=name_starts,
        name_values=objects.name_values[names],
        names=tuple(f"{word} {name}" for name in objects.names),
    )


def _word(k: int) -> str:
    """A word for each number."""
    syllables = [c + v for c in "bdfgklmnprstvz" for v in "aeiou"]
    return (syllables[k % 70] + syllables[k // 70 % 70] + "mo").capitalize()
