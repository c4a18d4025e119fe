"""The OSM half of KITTI360Pose: its cells and poses, filled from an OpenStreetMap extract.

The paper crops OpenStreetMap around the longitude and latitude of KITTI360Pose's poses and makes
both sides of it, maps and texts (Sec. IV-A; the published files are called `osm_cell_graphs` and
`osm_*_text_graphs`, with the ids of KITTI360Pose's cells). Here an extract of Karlsruhe takes the
place of the point cloud: the same drives, cells and poses, other objects and hints. Whatever
measures the one measures the other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.errors import InputError, OptionError
from placegraph.outdoor.map.objects import of_name
from placegraph_lab.datasets.kitti360pose import (
    DIRECTIONS,
    WORLD,
    Cells,
    Hints,
    Kitti360Pose,
    Objects,
    Poses,
    footprint,
)
from placegraph_lab.tables.outdoor.nearby import DIRECTIONS as WINDS
from placegraph_lab.tables.outdoor.nearby import Around, Bins, relations
from placegraph_lab.tables.outdoor.places import KEYS, RawCity, read_raw

REACH = 15.0  # things this near to a cell's centre are in it [m]: half of KITTI360Pose's 30 m
SIGHT = (
    15.0  # things this near to a pose are spoken of [m]: as far as KITTI360Pose's own texts look
)
TOLD = (
    6  # things that a text speaks of, the nearest ones; where fewer are in sight, there is no text
)
ON_TOP = 0.05  # nearer to a thing than this, a pose is on top of it [m]


@dataclass(frozen=True)
class Crop:
    reach: float = REACH  # things this near to a cell's centre are in it [m]
    sight: float = SIGHT  # things this near to a pose are spoken of [m]
    names: bool = True
    """Things are called by their names where they have one, as the paper has it; else by tags."""


def on_osm(data: Kitti360Pose, path: str | PathLike[str], crop: Crop | None = None) -> Kitti360Pose:
    """The same cells and poses with the objects and hints of an OpenStreetMap extract.

    A thing stands at its centre, as in the paper; that it lies in a cell or in sight, and where a
    pose lies from it, is told by its nearest point. Poses with fewer than `TOLD` things in sight
    are left out. Labels are names or tag values; `tags` has the tag of each.

    `path`: extract that osmium reads, of Karlsruhe or more; only what lies around the cells is
    kept; `crop`: how far cells and texts reach.

    Raises `OptionError`: A distance is not above 0; `InputError`: the extract cannot be read, holds
    nothing around the cells, or no pose has enough in sight.
    """
    crop = crop or Crop()
    if not (crop.reach > 0.0 and crop.sight > 0.0):
        raise OptionError(
            f"Cells reach {crop.reach} m, texts {crop.sight} m; give distances above 0."
        )
    centers, positions = data.cells.centers, data.poses.positions[:, :2]
    city = _framed(path, np.concatenate([centers, positions]), max(crop.reach, crop.sight))
    bins, label = Bins.of(city), city.named if crop.names else city.label
    cells, objects = _objects(data, city, bins.around(centers, crop.reach), label)
    around = bins.around(positions, crop.sight)
    poses, hints = _hints(data, city, around, label, (cells, objects))
    if not len(poses.cells):
        raise InputError(
            f"{path}: no pose has {TOLD} things within {crop.sight:g} m; is the extract whole? "
            "Choose a larger sight otherwise."
        )
    named = {city.labels[i]: of_name(city.labels[i].replace("_", " ")) for i in city.named}
    values = {(KEYS[k], city.labels[i]) for k, i in zip(city.key, city.label, strict=True)}
    tags = {v: f"{key}={'yes' if v == key else v}" for key, v in sorted(values)}
    return replace(
        data,
        source=f"{data.source} on {path}",
        labels=city.labels,
        colours=("",),
        cells=cells,
        objects=objects,
        poses=poses,
        hints=hints,
        tags=(named | tags),
    )


def _framed(path: str | PathLike[str], points: Floats, reach: float) -> RawCity:
    corners = np.stack([points.min(axis=0) - reach, points.max(axis=0) + reach])
    low, high = WORLD.to_lonlat(corners)
    try:
        city = read_raw(str(path), (*low.tolist(), *high.tolist()))
    except InputError as error:
        west, south, east, north = np.round((*low, *high), 3)
        raise InputError(
            f"{error} The drives lie within {west} to {east} E, {south} to {north} N: "
            "take an extract that holds them."
        ) from error
    plane = city.plane

    def moved(at: Floats) -> Floats:
        return WORLD.to_plane(plane.to_lonlat(at))

    ends = moved(city.segments.reshape(-1, 2)).reshape(-1, 4)
    return replace(city, center=moved(city.center), segments=ends)


def _objects(
    data: Kitti360Pose, city: RawCity, around: Around, label: NDArray[np.int32]
) -> tuple[Cells, Objects]:
    rows, counts = around.objects.astype(np.int64), np.diff(around.starts)
    owner = np.repeat(np.arange(len(counts)), counts)
    centers, half = data.cells.centers, 0.5 * data.cells.sizes
    grounds = [
        _ground(city, row, point, centers[cell], half[cell])
        for row, point, cell in zip(rows, around.points, owner, strict=True)
    ]
    starts = np.concatenate(([0], np.cumsum([len(ground) for ground in grounds])))
    ground = np.concatenate([np.zeros((0, 2)), *grounds])
    zero = np.zeros((len(rows), 1))
    some = len(rows) > 0
    low = np.minimum.reduceat(ground, starts[:-1]) if some else np.zeros((0, 2))
    high = np.maximum.reduceat(ground, starts[:-1]) if some else np.zeros((0, 2))
    objects = Objects(
        ids=np.arange(len(rows)) - around.starts[owner],
        instances=rows,
        labels=label[rows].astype(np.int64),
        colours=np.zeros(len(rows), np.int64),
        rgb=np.zeros((len(rows), 3), np.uint8),
        centers=np.hstack([city.center[rows], zero]),
        low=np.hstack([low, zero]),
        high=np.hstack([high, zero]),
        footprint_starts=starts.astype(np.int64),
        footprints=ground,
    )
    return replace(data.cells, object_starts=around.starts.astype(np.int64)), objects


def _ground(city: RawCity, row: int, nearest: Floats, center: Floats, half: float) -> Floats:
    """Points (n, 2) a metre apart along an object, as far as it lies in a cell; its nearest first."""
    segments = city.segments[city.segment_starts[row] : city.segment_starts[row + 1]]
    a, b = segments[:, :2], segments[:, 2:]
    near = ((np.minimum(a, b) <= center + half) & (np.maximum(a, b) >= center - half)).all(axis=1)
    points = [nearest[None]]
    for p, q in zip(a[near], b[near], strict=True):
        steps = max(2, int(np.hypot(*(q - p))) + 1)
        points.append(p + np.linspace(0.0, 1.0, steps)[:, None] * (q - p))
    found = np.concatenate(points)
    inside = np.abs(found - center).max(axis=1) <= half
    return footprint(found[inside | (np.arange(len(found)) == 0)])


def _hints(
    data: Kitti360Pose,
    city: RawCity,
    around: Around,
    label: NDArray[np.int32],
    best: tuple[Cells, Objects],
) -> tuple[Poses, Hints]:
    cells, objects = best
    kept, rows, closest, ids = [], [], [], []
    for pose, at in enumerate(data.poses.positions[:, :2]):
        span = slice(*around.starts[pose : pose + 2])
        offsets = at - around.points[span]
        if len(offsets) < TOLD:
            continue
        nearest = np.argsort(np.hypot(*offsets.T), kind="stable")[:TOLD]
        held = objects.instances[cells.objects(int(data.poses.cells[pose]))]
        kept.append(pose)
        closest.append(offsets[nearest])
        for row in around.objects[span][nearest]:
            found = np.flatnonzero(held == row)
            rows.append(int(row))
            ids.append(int(found[0]) if len(found) else -1)
    chosen, things = np.array(kept, np.int64), np.array(rows, np.int64)
    offset = np.concatenate([np.zeros((0, 2)), *closest])
    winds = np.array([DIRECTIONS.index(wind) for wind in WINDS])[relations(offset)]
    hints = Hints(
        labels=label[things].astype(np.int64),
        colours=np.zeros(len(things), np.int64),
        directions=np.where(np.hypot(*offset.T) < ON_TOP, DIRECTIONS.index("on-top"), winds),
        objects=np.array(ids, np.int64),
        instances=things,
        offsets=np.repeat(data.poses.positions[chosen, :2], TOLD, axis=0) - city.center[things],
        closest=offset,
    )
    poses = Poses(
        data.poses.scene[chosen],
        data.poses.positions[chosen],
        data.poses.cells[chosen],
        TOLD * np.arange(len(chosen) + 1),
    )
    return poses, hints
