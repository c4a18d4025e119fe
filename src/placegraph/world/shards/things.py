"""Rare things of neighbouring shards, seen from afar: put beside the objects of a shard."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from placegraph.outdoor.map.objects import columns_of
from placegraph.tiles import bounds

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from placegraph.outdoor.map.city import City
    from placegraph.outdoor.map.objects import CityObjects
    from placegraph.world.shards.lexicon import Thing


def rows_of(things: Sequence[Thing], objects: CityObjects) -> NDArray[np.int64]:
    """Rows (K,) of things among objects, -1 where they are not."""
    rows = np.full(len(things), -1, np.int64)
    where = {(t.osm_type, t.osm_id): k for k, t in enumerate(things)}
    wanted = np.array([t.osm_id for t in things], np.int64)
    for row in np.flatnonzero(np.isin(objects.osm_id, wanted)).tolist():
        k = where.get((int(objects.osm_type[row]), int(objects.osm_id[row])))
        if k is not None and rows[k] < 0:
            rows[k] = row
    return rows


def joined(
    city: City, things: Sequence[Thing], key: str, reach: float
) -> tuple[City, NDArray[np.int64]]:
    """A city with the things that it lacks and that lie within `reach` [m] of its core.

    Returns it, and rows (K,) of all things in it: -1 of those too far off. What is added is in
    nobody's sight; one speaks of it from afar.
    """
    rows = rows_of(things, city.objects)
    near = [
        k
        for k in np.flatnonzero(rows < 0).tolist()
        if away(things[k], key) <= reach + things[k].extent
    ]
    if not near:
        return city, rows
    rows[near] = len(city.objects) + np.arange(len(near))
    return _with(city, [things[k] for k in near]), rows


def away(thing: Thing, key: str) -> float:
    """About how far a thing's centre lies from a core [m]; 0 inside."""
    return float(distance(thing.center[None], np.array([bounds(key)]))[0])


def distance(lonlat: NDArray[np.float64], cores: NDArray[np.float64]) -> NDArray[np.float64]:
    """About how far places (N, 2) [deg] lie from cores (N, 4), west to north [deg], in metres."""
    longitude, latitude = lonlat.T
    west, south, east, north = cores.T
    aside = np.maximum((west - longitude) % 360.0, 0.0)
    aside = np.minimum(aside, (longitude - east) % 360.0)
    within = (longitude - west) % 360.0 <= (east - west)
    aside = np.where(within, 0.0, aside)
    up = np.maximum(np.maximum(south - latitude, latitude - north), 0.0)
    # the nearer to the pole, the shorter a degree: never too far
    top = np.minimum(np.maximum(np.abs(latitude), np.maximum(np.abs(south), np.abs(north))), 89.9)
    found: NDArray[np.float64] = np.hypot(aside * np.cos(np.radians(top)), up) * 111_000.0
    return found


def _with(city: City, things: Sequence[Thing]) -> City:
    """City with more objects, which none of its viewpoints has in sight."""
    o = city.objects
    parts = [city.plane.to_plane(part) for thing in things for part in thing.parts]
    points = np.concatenate([o.points, *parts]).astype(np.float32)
    centers = city.plane.to_plane(np.array([thing.center for thing in things]))
    named = np.array([bool(thing.name) for thing in things])
    n = len(things)
    objects = replace(
        o,
        osm_type=np.append(o.osm_type, [t.osm_type for t in things]).astype(o.osm_type.dtype),
        osm_id=np.append(o.osm_id, [t.osm_id for t in things]),
        kind=np.append(o.kind, [t.kind for t in things]).astype(o.kind.dtype),
        label_starts=_on(o.label_starts, np.ones(n, np.int32)),
        label_values=np.append(o.label_values, len(o.labels) + np.arange(n)).astype(np.int32),
        name_starts=_on(o.name_starts, named),
        name_values=np.append(o.name_values, len(o.names) + np.arange(named.sum())).astype(np.int32),
        part_starts=_on(o.part_starts, np.array([len(thing.parts) for thing in things])),
        point_starts=_on(o.point_starts, np.array([len(part) for part in parts])),
        points=points, center=np.concatenate([o.center, centers]).astype(np.float32),
        labels=(*o.labels, *(t.label for t in things)),
        names=(*o.names, *(t.name for t in things if t.name)),
    )  # fmt: skip
    made = replace(city, objects=objects)
    made.__dict__["_views"] = city.views
    made.__dict__["columns"] = columns_of(objects, city.tokens)
    return made


def _on(starts: NDArray[np.int32], counts: NDArray[np.generic]) -> NDArray[np.int32]:
    """Starts of a CSR with more rows."""
    return np.append(starts, starts[-1] + np.cumsum(counts)).astype(starts.dtype)
