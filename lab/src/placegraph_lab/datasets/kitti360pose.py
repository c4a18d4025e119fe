"""KITTI360Pose in a file of our own: cells with their objects, poses with what was said of them.

`convert_kitti360pose` makes it from the published pickles. No point cloud is kept: of an object its
label, colour, centre, box, and where on the ground it lies, to the metre. All positions are those of
the data's world frame, x east, y north, z up [m].
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from math import asinh, cos, radians, tan
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.core.geometry import Floats
from placegraph.core.mapfile import (
    MapFile,
    Write,
    compress_array,
    map_writer,
    pack_strings,
    read_map,
)
from placegraph.errors import InputError, MapError, OptionError
from placegraph_lab.datasets.pickles import Record, Release, finished, read_pickle

KIND = "kitti360pose"
VERSION = 1
GRAIN = 0.05  # positions of objects are stored in these steps [m], from their cell's lower corner

SPLITS = {
    "train": ("0000", "0002", "0004", "0006", "0007"),
    "validation": ("0010",),
    "test": ("0003", "0005", "0009"),
}
"""Drives of each split, as published."""

DIRECTIONS = ("north", "south", "east", "west", "on-top")
"""Where a pose is said to be, seen from an object."""


@dataclass(frozen=True, eq=False)
class Cells:
    """Columns of C cells: boxes of the world, with the objects in them."""

    ids: tuple[str, ...]  # drive and number: ``0003_00012``
    scene: NDArray[np.int64]  # (C,) row of `Kitti360Pose.scenes`
    boxes: Floats  # (C, 6) lower and upper corner [m]
    sizes: Floats  # (C,) longest edge [m]
    points: NDArray[np.int64]  # (C,) points of the cloud that the objects were made of
    point_bytes: NDArray[np.int64]  # (C,) bytes of these points and their colours
    object_starts: NDArray[np.int64]  # (C + 1,) objects of a cell

    @property
    def centers(self) -> Floats:
        """Centres (C, 2) east, north [m]."""
        return 0.5 * (self.boxes[:, 0:2] + self.boxes[:, 3:5])

    def objects(self, cell: int) -> slice:
        """Rows of the objects of a cell."""
        return slice(int(self.object_starts[cell]), int(self.object_starts[cell + 1]))


@dataclass(frozen=True, eq=False)
class Objects:
    """Columns of N objects; a thing that lies in several cells is an object in each."""

    ids: NDArray[np.int64]  # (N,) unique in the cell
    instances: NDArray[
        np.int64
    ]  # (N,) of the segmented scan; the parts of a road or a hedge share one
    labels: NDArray[np.int64]  # (N,) row of `Kitti360Pose.labels`
    colours: NDArray[np.int64]  # (N,) row of `Kitti360Pose.colours`
    rgb: NDArray[np.uint8]  # (N, 3) mean colour
    centers: Floats  # (N, 3) mean of the points [m]
    low: Floats  # (N, 3) lower corner of the points [m]
    high: Floats  # (N, 3) upper corner of the points [m]
    footprint_starts: NDArray[np.int64]  # (N + 1,)
    footprints: Floats  # (F, 2) a point in each square metre of ground that an object covers [m]

    def footprint(self, row: int) -> Floats:
        """Points (n, 2) on the ground of an object, about a metre apart [m]."""
        return self.footprints[self.footprint_starts[row] : self.footprint_starts[row + 1]]


@dataclass(frozen=True, eq=False)
class Poses:
    """Columns of P poses: places that were described, and what was said of them."""

    scene: NDArray[np.int64]  # (P,) row of `Kitti360Pose.scenes`
    positions: Floats  # (P, 3) [m]; the truth, for evaluation only
    cells: NDArray[np.int64]  # (P,) row of the best cell; the truth, for evaluation only
    hint_starts: NDArray[np.int64]  # (P + 1,) hints of a pose

    def hints(self, pose: int) -> slice:
        """Rows of the hints of a pose."""
        return slice(int(self.hint_starts[pose]), int(self.hint_starts[pose + 1]))


@dataclass(frozen=True, eq=False)
class Hints:
    """Columns of H hints, each a sentence "The pose is <direction> of a <colour> <label>"."""

    labels: NDArray[np.int64]  # (H,) row of `Kitti360Pose.labels`
    colours: NDArray[np.int64]  # (H,) row of `Kitti360Pose.colours`
    directions: NDArray[np.int64]  # (H,) row of `DIRECTIONS`
    objects: NDArray[np.int64]
    """(H,) id of the object in the best cell, -1 where it has none. No part of what was said."""
    instances: NDArray[np.int64]  # (H,) instance of the object. No part of what was said.
    offsets: Floats  # (H, 2) from the object's centre to the pose [m]. No part of what was said.
    closest: (
        Floats  # (H, 2) from the object's closest point to the pose [m]. No part of what was said.
    )


@dataclass(frozen=True, eq=False)
class Kitti360Pose:
    """The converted data: opened by `Kitti360Pose.open`, written by `convert_kitti360pose`."""

    source: str  # name of the folder it was made from
    scenes: tuple[str, ...]  # drives: ``0003``
    scene_bytes: tuple[int, ...]  # bytes of the cells' pickle of each drive
    labels: tuple[str, ...]
    colours: tuple[str, ...]
    cells: Cells
    objects: Objects
    poses: Poses
    hints: Hints
    tags: dict[str, str] = field(default_factory=dict)
    """Tags of labels, where the objects are those of OpenStreetMap; not kept in a file."""

    def split(self, name: str) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Rows of the cells and of the poses of a split, or of a single drive.

        Raises `OptionError` where there is no such split, or nothing of it in the file.
        """
        drives = SPLITS.get(name, (name,))
        scenes = [i for i, scene in enumerate(self.scenes) if scene in drives]
        cells = np.flatnonzero(np.isin(self.cells.scene, scenes))
        poses = np.flatnonzero(np.isin(self.poses.scene, scenes))
        if not len(cells) or not len(poses):
            raise OptionError(
                f"{self.source} has no cells and poses of {name!r}; it holds the drives "
                f"{', '.join(self.scenes)}. Choose one of {', '.join(SPLITS)}, or a drive."
            )
        return cells, poses

    def graph_bytes(self, cells: NDArray[np.int64]) -> int:
        """Bytes that these cells (rows) and their objects take in a file."""
        rows = np.concatenate([np.r_[self.cells.objects(int(c))] for c in cells])
        return sum(len(compress_array(a)[2]) for a in _map_columns(self, cells, rows).values())

    def save(self, write: Write) -> None:
        """Write a store through `map_writer`; raises `OptionError` if it is made from OSM."""
        if self.tags:
            raise OptionError(
                f"{self.source} is made from its extract when it is needed; save the data without it."
            )
        every = np.arange(len(self.cells.ids)), np.arange(len(self.objects.ids))
        p, h = self.poses, self.hints
        arrays = _map_columns(self, *every) | {
            "pose_scene": p.scene.astype(np.uint8),
            "pose_position": p.positions.astype("<f8"),
            "pose_cell": p.cells.astype(np.int32),
            "hint_counts": np.diff(p.hint_starts).astype(np.uint16),
            "hint_label": h.labels.astype(np.uint8),
            "hint_colour": h.colours.astype(np.uint8),
            "hint_direction": h.directions.astype(np.uint8),
            "hint_object": h.objects.astype(np.int32),
            "hint_instance": h.instances.astype("<i8"),
            "hint_offset": h.offsets.astype(np.float32),
            "hint_closest": h.closest.astype(np.float32),
            "labels": pack_strings(self.labels),
            "colours": pack_strings(self.colours),
        }
        meta = {
            "source": self.source,
            "scenes": list(self.scenes),
            "scene_bytes": list(self.scene_bytes),
            "grain": GRAIN,
        }
        write(KIND, VERSION, meta, arrays, ())

    @classmethod
    def open(cls, path: str | PathLike[str]) -> Kitti360Pose:
        """Open a converted file.

        Raises `InputError`: the file is missing, empty, or may not be read; `MapError`: it is
        foreign, damaged, newer, of another kind, or its columns contradict each other.
        """
        file = read_map(path, KIND, VERSION)
        try:
            data = _read(file)
            _check(data)
        except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
            raise MapError(
                f"{path}: its columns contradict each other ({error}). Convert the data again."
            ) from error
        return data

    def __repr__(self) -> str:
        return (
            f"Kitti360Pose({self.source!r}, {len(self.cells.ids):,} cells, "
            f"{len(self.objects.ids):,} objects, {len(self.poses.cells):,} poses)"
        )


def _map_columns(
    data: Kitti360Pose, cells: NDArray[np.int64], objects: NDArray[np.int64]
) -> dict[str, NDArray[Any]]:
    """What the map is made of, for these rows."""
    c, o = data.cells, data.objects
    counts = np.diff(c.object_starts)[cells]
    corner = np.repeat(c.boxes[cells, :3], counts, axis=0)
    squares = np.diff(o.footprint_starts)[objects]
    ground = np.concatenate(
        [
            np.zeros((0, 2)),
            *(o.footprint(int(i)) - k[:2] for i, k in zip(objects, corner, strict=True)),
        ]
    )

    def steps(values: Floats) -> NDArray[np.int32]:
        return np.round(values / GRAIN).astype(np.int32)

    return {
        "cell_ids": pack_strings([c.ids[i] for i in cells]),
        "cell_scene": c.scene[cells].astype(np.uint8),
        "cell_box": c.boxes[cells].astype("<f8"),
        "cell_size": c.sizes[cells].astype("<f8"),
        "cell_points": c.points[cells].astype("<i8"),
        "cell_point_bytes": c.point_bytes[cells].astype("<i8"),
        "object_counts": counts.astype(np.uint32),
        "object_id": o.ids[objects].astype(np.int32),
        "object_instance": o.instances[objects].astype("<i8"),
        "object_label": o.labels[objects].astype(np.uint8),
        "object_colour": o.colours[objects].astype(np.uint8),
        "object_rgb": o.rgb[objects],
        "object_center": steps(o.centers[objects] - corner),
        "object_low": steps(o.low[objects] - corner),
        "object_extent": steps(o.high[objects] - o.low[objects]),
        "footprint_counts": squares.astype(np.uint32),
        "footprint": steps(ground),
    }


def _read(file: MapFile) -> Kitti360Pose:
    meta = file.meta
    grain = float(meta["grain"])

    def whole(name: str, dtype: str) -> NDArray[np.int64]:
        return file.array(name, dtype).astype(np.int64)

    def metres(name: str) -> Floats:
        return file.array(name, "<i4", 2) * grain

    boxes = file.array("cell_box", "<f8", 2)
    object_starts = _starts(whole("object_counts", "<u4"))
    corner = np.repeat(boxes[:, :3], np.diff(object_starts), axis=0)
    footprint_starts = _starts(whole("footprint_counts", "<u4"))
    low = metres("object_low") + corner
    ground = np.repeat(corner[:, :2], np.diff(footprint_starts), axis=0)
    return Kitti360Pose(
        source=str(meta["source"]),
        scenes=tuple(str(s) for s in meta["scenes"]),
        scene_bytes=tuple(int(n) for n in meta["scene_bytes"]),
        labels=file.strings("labels"),
        colours=file.strings("colours"),
        cells=Cells(
            file.strings("cell_ids"),
            whole("cell_scene", "|u1"),
            boxes,
            file.array("cell_size", "<f8"),
            whole("cell_points", "<i8"),
            whole("cell_point_bytes", "<i8"),
            object_starts,
        ),
        objects=Objects(
            whole("object_id", "<i4"),
            whole("object_instance", "<i8"),
            whole("object_label", "|u1"),
            whole("object_colour", "|u1"),
            file.array("object_rgb", "|u1", 2),
            metres("object_center") + corner,
            low,
            low + metres("object_extent"),
            footprint_starts,
            metres("footprint") + ground,
        ),
        poses=Poses(
            whole("pose_scene", "|u1"),
            file.array("pose_position", "<f8", 2),
            whole("pose_cell", "<i4"),
            _starts(whole("hint_counts", "<u2")),
        ),
        hints=Hints(
            whole("hint_label", "|u1"),
            whole("hint_colour", "|u1"),
            whole("hint_direction", "|u1"),
            whole("hint_object", "<i4"),
            whole("hint_instance", "<i8"),
            file.array("hint_offset", "<f4", 2).astype(np.float64),
            file.array("hint_closest", "<f4", 2).astype(np.float64),
        ),
    )


def _starts(counts: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.concatenate(([0], np.cumsum(counts)))


def _check(data: Kitti360Pose) -> None:
    """Raise `ValueError` where columns differ in length or point outside a table."""
    c, o, p, h = data.cells, data.objects, data.poses, data.hints
    n_scenes, n_cells = len(data.scenes), len(c.ids)
    _check_lengths((c, n_cells), (o, len(o.ids)), (p, len(p.cells)), (h, len(h.labels)))
    for values, count, what in (
        (c.scene, n_scenes, "scenes"),
        (p.scene, n_scenes, "scenes"),
        (p.cells, n_cells, "cells"),
        (np.concatenate([o.labels, h.labels]), len(data.labels), "labels"),
        (np.concatenate([o.colours, h.colours]), len(data.colours), "colours"),
        (h.directions, len(DIRECTIONS), "directions"),
    ):
        if len(values) and not 0 <= values.min() <= values.max() < count:
            raise ValueError(f"a row lies outside the table of {what}")
    ends = (c.object_starts, len(o.ids)), (p.hint_starts, len(h.labels))
    if any(starts[-1] != n for starts, n in (*ends, (o.footprint_starts, len(o.footprints)))):
        raise ValueError("counts do not add up")
    if (np.diff(o.footprint_starts) < 1).any() or len(data.scene_bytes) != n_scenes:
        raise ValueError("an object lies nowhere, or a scene has no size")
    widths = (c.boxes, 6), (o.rgb, 3), (o.centers, 3), (p.positions, 3), (h.offsets, 2)
    if any(a.shape[1] != w for a, w in (*widths, (h.closest, 2), (o.footprints, 2))):
        raise ValueError("a column is too wide or too narrow")
    if not all(np.isfinite(a).all() for a in (c.boxes, c.sizes, p.positions, o.centers)):
        raise ValueError("a number is not finite")


def _check_lengths(*tables: tuple[Cells | Objects | Poses | Hints, int]) -> None:
    for table, length in tables:
        for column in fields(table):
            rows = len(getattr(table, column.name)) - column.name.endswith("_starts")
            if rows != length and column.name != "footprints":
                raise ValueError(f"{column.name} does not have {length} rows")


RELEASE = Release(
    "KITTI360Pose",
    "datapreparation.kitti360pose.imports",
    ("Cell", "Object3d", "Pose", "DescriptionBestCell", "DescriptionPoseCell"),
)
"""The published classes."""
COLOURS = {
    "dark-green": [(47, 50, 42)],
    "gray": [(136, 137, 126), (110, 113, 104)],
    "gray-green": [(87, 92, 80)],
    "bright-gray": [(214, 216, 207)],
    "black": [(27, 28, 25)],
    "green": [(67, 70, 60)],
    "beige": [(171, 170, 155)],
}
"""The colours that the published texts speak of, sRGB 0 to 255."""
PADDING = "pad"  # label of what only fills up a cell; it is left out
SQUARE = 1.0  # A footprint has a point in each square of this edge [m]
FARTHEST = 1e5  # no point of a cell is farther from its corner [m]

_DRIVE = re.compile(r"(?:.*drive_)?(\d{4})(?:_.*)?")
_CENTRES = np.array([rgb for rgbs in COLOURS.values() for rgb in rgbs], np.float64)
_NAMED = [name for name, rgbs in COLOURS.items() for _ in rgbs]


@dataclass(frozen=True)
class Conversion:
    """What a conversion did."""

    scenes: tuple[str, ...]
    cells: int
    objects: int
    poses: int
    hints: int
    unmatched: int  # hints about things that the best cell does not hold
    padding: int  # objects left out, for they only fill up a cell
    points: int
    source_bytes: int  # of the cells' pickles
    bytes: int  # of the file written


def convert_kitti360pose(
    folder: str | PathLike[str],
    out: str | PathLike[str],
    *,
    progress: Callable[[str, int], None] | None = None,
) -> Conversion:
    """Read the pickles of a published folder and write all of it to one file, atomically.

    `folder`: such as ``k360_30-10_scG_pd10_pc4_spY_all``, with ``cells/<scene>.pkl`` and
    ``poses/<scene>.pkl``. Its pickles are read by a machine that can make plain data only; `out`:
    file to write; `Kitti360Pose.open` opens it; `progress`: is told the scene at hand and how many
    of its cells are done.

    Raises `InputError`: A file is missing, damaged or no such pickle; or a field is missing or not
    what it should be: the message names file, row and field; `MapLockedError`: somebody else is
    writing the same file; `MapError`: the file cannot be written.
    """
    scenes = _scenes(Path(folder))
    told = progress or (lambda _scene, _n: None)
    with map_writer(out) as write:
        gather = _Gather()
        for drive, cells, poses in scenes:
            gather.scene(drive, cells, poses, told)
        data = gather.data(Path(folder).resolve().name)
        told("writing", len(data.cells.ids))
        data.save(write)
    return Conversion(
        scenes=data.scenes,
        cells=len(data.cells.ids),
        objects=len(data.objects.ids),
        poses=len(data.poses.cells),
        hints=len(data.hints.labels),
        unmatched=int((data.hints.objects < 0).sum()),
        padding=gather.padding,
        points=int(data.cells.points.sum()),
        source_bytes=sum(data.scene_bytes),
        bytes=Path(out).stat().st_size,
    )


def nearest_colour(rgb: Floats) -> str:
    """Name of the colour (3,) 0 to 255 in the texts' own words."""
    return _NAMED[int(np.argmin(((_CENTRES - rgb) ** 2).sum(axis=1)))]


def footprint(points: Floats) -> Floats:
    """One of the points (n, 2) of each square metre of ground that they cover, in order [m]."""
    _, first = np.unique(np.floor(points / SQUARE).astype(np.int64), axis=0, return_index=True)
    return points[first]


def _scenes(folder: Path) -> list[tuple[str, Path, Path]]:
    """Drive, cells and poses of each scene; every one has both."""
    files: dict[str, dict[str, Path]] = defaultdict(dict)
    for kind in ("cells", "poses"):
        for path in sorted((folder / kind).glob("*.pkl")):
            found = _DRIVE.fullmatch(path.stem)
            if found is None:
                raise InputError(
                    f"{path}: its name tells no drive; name it as 2013_05_28_drive_0003_sync.pkl."
                )
            other = files[found[1]].setdefault(kind, path)
            if other != path:
                raise InputError(f"{path} and {other} are of the same drive; take one away.")
    if not files:
        raise InputError(
            f"{folder} holds no cells/*.pkl and poses/*.pkl; name the folder of KITTI360Pose that "
            "does, such as k360_30-10_scG_pd10_pc4_spY_all."
        )
    for drive, pair in files.items():
        for kind in ("cells", "poses"):
            if kind not in pair:
                raise InputError(
                    f"{folder}: {kind}/ has no file of drive {drive}; copy it there, or take the "
                    "drive's other file away."
                )
    return [(drive, pair["cells"], pair["poses"]) for drive, pair in sorted(files.items())]


@dataclass
class _Fields:
    """A record with its place in the file, for messages."""

    record: Record
    where: str

    @classmethod
    def of(cls, value: object, kinds: tuple[str, ...], where: str) -> _Fields:
        if not isinstance(value, Record) or value.kind not in kinds:
            raise InputError(f"{where} is no {' or '.join(kinds)}; download the file again.")
        return cls(value, where)

    def get(self, name: str) -> Any:  # noqa: ANN401
        if name not in self.record.fields:
            raise InputError(f"{self.where} has no {name}; is this another release of the data?")
        return finished(self.record.fields[name])

    def text(self, name: str) -> str:
        value = self.get(name)
        if type(value) is not str or not value:
            raise self.wrong(name, "no text")
        return value

    def whole(self, name: str) -> int:
        value = self.get(name)
        if type(value) is not int or not -(1 << 31) <= value < 1 << 31:
            raise self.wrong(name, "no whole number")
        return value

    def listed(self, name: str) -> list[Any]:
        value = self.get(name)
        if type(value) is not list:
            raise self.wrong(name, "no list")
        return value

    def numbers(self, name: str, shape: tuple[int, ...]) -> Floats:
        """Finite numbers; -1 in the shape stands for one or more."""
        value = self.get(name)
        array = np.asarray(value, np.float64) if _is_number(value) else value
        if isinstance(value, list | tuple) and all(map(_is_number, value)):
            array = np.array(value, np.float64)
        if not isinstance(array, np.ndarray) or array.ndim != len(shape):
            raise self.wrong(name, f"not {len(shape)}-dimensional")
        if any(n < 1 if m < 0 else n != m for n, m in zip(array.shape, shape, strict=True)):
            raise self.wrong(name, f"of shape {array.shape}")
        floats = array.astype(np.float64)
        if not (np.abs(floats) < 1e9).all():
            raise self.wrong(name, "not finite")
        return floats

    def bytes(self, name: str) -> int:
        value = self.get(name)
        return value.nbytes if isinstance(value, np.ndarray) else 8 * len(value)

    def wrong(self, name: str, how: str) -> InputError:
        return InputError(f"{self.where}: {name} is {how}; download the file again.")


def _is_number(value: object) -> bool:
    return type(value) in (int, float)


class _Table:
    """Texts in the order of their first use."""

    def __init__(self, what: str) -> None:
        self.what = what
        self.rows: dict[str, int] = {}

    def row(self, text: str, where: str) -> int:
        if len(self.rows) == 256 and text not in self.rows:
            raise InputError(f"{where}: more than 256 {self.what}; is this KITTI360Pose?")
        return self.rows.setdefault(text, len(self.rows))


class _Gather:
    """Columns, growing row by row."""

    def __init__(self) -> None:
        self.columns: dict[str, list[Any]] = defaultdict(list)
        self.labels, self.colours = _Table("labels"), _Table("colours")
        self.scenes: list[str] = []
        self.scene_bytes: list[int] = []
        self.cell_rows: dict[str, int] = {}
        self.sizes: list[float] = []
        self.padding = 0

    def scene(self, drive: str, cells: Path, poses: Path, told: Callable[[str, int], None]) -> None:
        """Read both files of a drive."""
        self.scenes.append(drive)
        self.scene_bytes.append(cells.stat().st_size)
        for n, value in enumerate(_listed(cells)):
            if n % 20 == 0:
                told(drive, n)
            self.cell(_Fields.of(value, ("Cell",), f"{cells}: cell {n}"))
        for n, value in enumerate(_listed(poses)):
            self.pose(_Fields.of(value, ("Pose",), f"{poses}: pose {n}"))

    def put(self, **row: Any) -> None:  # noqa: ANN401  # one value a column
        for name, value in row.items():
            self.columns[name].append(value)

    def cell(self, cell: _Fields) -> None:
        id_ = cell.text("id")
        if id_ in self.cell_rows:
            raise InputError(f"{cell.where}: the id {id_!r} has been used before.")
        box, size = cell.numbers("bbox_w", (6,)), float(cell.numbers("cell_size", ()))
        if not (size > 0.0 and (box[3:] > box[:3]).all()):
            raise cell.wrong("bbox_w", "empty")
        n_points = n_bytes = count = 0
        for k, value in enumerate(cell.listed("objects")):
            thing = _Fields.of(value, ("Object3d",), f"{cell.where} ({id_}): object {k}")
            if thing.text("label") == PADDING:
                self.padding += 1
                continue
            points = self.object(thing, box[:3], size)
            n_points, count = n_points + points, count + 1
            n_bytes += thing.bytes("xyz") + thing.bytes("rgb")
        self.cell_rows[id_] = len(self.cell_rows)
        self.sizes.append(size)
        self.put(cell_scene=len(self.scenes) - 1, box=box, size=size, points=n_points)
        self.put(point_bytes=n_bytes, object_count=count)

    def object(self, thing: _Fields, corner: Floats, size: float) -> int:
        xyz, rgb = thing.numbers("xyz", (-1, 3)), thing.numbers("rgb", (-1, 3))
        if len(xyz) != len(rgb):
            raise thing.wrong("rgb", f"of {len(rgb)} points, xyz of {len(xyz)}")
        if not (np.abs(size * xyz) < FARTHEST).all():
            raise thing.wrong("xyz", "far away from its cell")
        xyz = corner + size * xyz
        mean = np.clip(255.0 * rgb.mean(axis=0), 0.0, 255.0)
        ground = footprint(xyz[:, :2])
        self.put(id=thing.whole("id"), instance=thing.whole("instance_id"))
        self.put(label=self.labels.row(thing.text("label"), thing.where))
        self.put(colour=self.colours.row(nearest_colour(mean), thing.where))
        self.put(rgb=np.round(mean), center=xyz.mean(axis=0), low=xyz.min(axis=0))
        self.put(high=xyz.max(axis=0), footprint=ground, footprint_count=len(ground))
        return len(xyz)

    def pose(self, pose: _Fields) -> None:
        id_ = pose.text("cell_id")
        if id_ not in self.cell_rows:
            raise InputError(
                f"{pose.where}: there is no cell {id_!r}; are both files of one folder?"
            )
        row = self.cell_rows[id_]
        hints = pose.listed("descriptions")
        self.put(pose_scene=len(self.scenes) - 1, position=pose.numbers("pose_w", (3,)))
        self.put(pose_cell=row, hint_count=len(hints))
        for k, value in enumerate(hints):
            kinds = ("DescriptionBestCell", "DescriptionPoseCell")
            self.hint(_Fields.of(value, kinds, f"{pose.where}: description {k}"), self.sizes[row])

    def hint(self, hint: _Fields, size: float) -> None:
        direction = hint.text("direction")
        if direction not in DIRECTIONS:
            raise hint.wrong("direction", f"{direction[:20]!r}, none of {', '.join(DIRECTIONS)}")
        matched = hint.record.kind == "DescriptionBestCell" and hint.get("is_matched") is True
        self.put(hint_label=self.labels.row(hint.text("object_label"), hint.where))
        self.put(hint_colour=self.colours.row(hint.text("object_color_text"), hint.where))
        self.put(
            direction=DIRECTIONS.index(direction),
            hint_object=hint.whole("object_id") if matched else -1,
            hint_instance=hint.whole("object_instance_id"),
            offset=size * hint.numbers("offset_center", (2,)),
            closest=size * hint.numbers("offset_closest", (2,)),
        )

    def data(self, source: str) -> Kitti360Pose:
        """All columns."""
        f, whole, starts = self.floats, self.whole, self.starts
        return Kitti360Pose(
            source=source,
            scenes=tuple(self.scenes),
            scene_bytes=tuple(self.scene_bytes),
            labels=tuple(self.labels.rows),
            colours=tuple(self.colours.rows),
            cells=Cells(
                tuple(self.cell_rows), whole("cell_scene"), f("box", 6), np.array(self.sizes),
                whole("points"), whole("point_bytes"), starts("object_count"),
            ),
            objects=Objects(
                whole("id"), whole("instance"), whole("label"), whole("colour"),
                f("rgb", 3).astype(np.uint8), f("center", 3), f("low", 3), f("high", 3),
                starts("footprint_count"),
                np.concatenate([np.zeros((0, 2)), *self.columns["footprint"]]),
            ),
            poses=Poses(
                whole("pose_scene"), f("position", 3), whole("pose_cell"), starts("hint_count")
            ),
            hints=Hints(
                whole("hint_label"), whole("hint_colour"), whole("direction"),
                whole("hint_object"), whole("hint_instance"), f("offset", 2), f("closest", 2),
            ),
        )  # fmt: skip

    def floats(self, name: str, width: int) -> Floats:
        return np.array(self.columns[name], np.float64).reshape(-1, width)

    def whole(self, name: str) -> NDArray[np.int64]:
        return np.array(self.columns[name], np.int64)

    def starts(self, name: str) -> NDArray[np.int64]:
        return np.concatenate(([0], np.cumsum(self.whole(name))))


def _listed(path: Path) -> list[Any]:
    value = read_pickle(path, RELEASE)
    if type(value) is not list:
        raise InputError(f"{path} holds no list; download it again.")
    return value


RADIUS = 6_378_137.0  # of the sphere that is projected [m]


@dataclass(frozen=True, slots=True)
class Mercator:
    """Metric frame of a Mercator projection, true to scale at the latitude of its origin."""

    longitude: float  # origin [deg]
    latitude: float  # origin [deg]

    @property
    def _scale(self) -> float:
        return RADIUS * cos(radians(self.latitude))

    def to_plane(self, lonlat: ArrayLike) -> Floats:
        """Longitude and latitude (..., 2) [deg] to east and north (..., 2) [m]."""
        lon, lat = np.moveaxis(np.asarray(lonlat, np.float64), -1, 0)
        east = np.radians(lon - self.longitude)
        north = np.arcsinh(np.tan(np.radians(lat))) - asinh(tan(radians(self.latitude)))
        return self._scale * np.stack([east, north], axis=-1)

    def to_lonlat(self, east_north: ArrayLike) -> Floats:
        """East and north (..., 2) [m] to longitude and latitude (..., 2) [deg]."""
        east, north = np.moveaxis(np.asarray(east_north, np.float64) / self._scale, -1, 0)
        lat = np.arctan(np.sinh(north + asinh(tan(radians(self.latitude)))))
        return np.stack([self.longitude + np.degrees(east), np.degrees(lat)], axis=-1)


WORLD = Mercator(8.4295857, 48.9843445)
"""Frame of KITTI-360's poses, point clouds and annotations, and of KITTI360Pose."""
