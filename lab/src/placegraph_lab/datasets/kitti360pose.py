"""KITTI360Pose as a map file: cells with their objects, poses with their descriptions.

`convert_kitti360pose` makes it from the published pickles. Point clouds are reduced to label, colour,
centre, box and footprint (a point per square metre) of each object. Positions are in the data's world
frame, x east, y north, z up [m].
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
from placegraph_lab.datasets.pickles import Record, Release, read_pickle, unwrap_array

KIND = "kitti360pose"
VERSION = 1
GRAIN = 0.05  # positions of objects are stored in these steps [m], from their cell's lower corner

SPLITS = {
    "train": ("0000", "0002", "0004", "0006", "0007"),
    "validation": ("0010",),
    "test": ("0003", "0005", "0009"),
}
"""Drives of each split, as published."""

DIRECTIONS = ("north", "south", "east", "west", "on-top")  # Directions of a pose from an object


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
        """Centres (C, 2), east and north [m]."""
        return 0.5 * (self.boxes[:, 0:2] + self.boxes[:, 3:5])

    def objects(self, cell: int) -> slice:
        """Return the rows of the objects of a cell."""
        return slice(int(self.object_starts[cell]), int(self.object_starts[cell + 1]))


@dataclass(frozen=True, eq=False)
class Objects:
    """Columns of N objects; one that lies in several cells is an object in each."""

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
        """Return the footprint (n, 2) of an object, points about a metre apart [m]."""
        return self.footprints[self.footprint_starts[row] : self.footprint_starts[row + 1]]


@dataclass(frozen=True, eq=False)
class Poses:
    """Columns of P poses: described places and their hints."""

    scene: NDArray[np.int64]  # (P,) row of `Kitti360Pose.scenes`
    positions: Floats  # (P, 3) [m]; the truth, for evaluation only
    cells: NDArray[np.int64]  # (P,) row of the best cell; the truth, for evaluation only
    hint_starts: NDArray[np.int64]  # (P + 1,) hints of a pose

    def hints(self, pose: int) -> slice:
        """Return the rows of the hints of a pose."""
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
        """Return the rows of the cells and of the poses of a split or a drive.

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
        """Return the bytes that these cells (rows) and their objects take in a file."""
        rows = np.concatenate([np.r_[self.cells.objects(int(c))] for c in cells])
        return sum(len(compress_array(a)[2]) for a in _map_columns(self, cells, rows).values())

    def save(self, write: Write) -> None:
        """Write through `mapfile.map_writer`; raises `OptionError` where the data are made of OSM."""
        if self.tags:
            raise OptionError(f"{self.source} is made of OpenStreetMap; save the original data.")
        every = np.arange(len(self.cells.ids)), np.arange(len(self.objects.ids))
        arrays = _map_columns(self, *every) | {
            stored: getattr(getattr(self, table), field).astype(dtype)
            for table, field, stored, dtype in _QUERY_COLUMNS
        }
        arrays |= {
            "hint_counts": np.diff(self.poses.hint_starts).astype(np.uint16),
            "labels": pack_strings(self.labels), "colours": pack_strings(self.colours),
        }  # fmt: skip
        meta = {
            "source": self.source, "scenes": list(self.scenes),
            "scene_bytes": list(self.scene_bytes), "grain": GRAIN,
        }  # fmt: skip
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


_MAP_COLUMNS = (
    ("cells", "scene", "cell_scene", "|u1"), ("cells", "boxes", "cell_box", "<f8"),
    ("cells", "sizes", "cell_size", "<f8"), ("cells", "points", "cell_points", "<i8"),
    ("cells", "point_bytes", "cell_point_bytes", "<i8"), ("objects", "ids", "object_id", "<i4"),
    ("objects", "instances", "object_instance", "<i8"), ("objects", "labels", "object_label", "|u1"),
    ("objects", "colours", "object_colour", "|u1"), ("objects", "rgb", "object_rgb", "|u1"),
)  # fmt: skip
_QUERY_COLUMNS = (
    ("poses", "scene", "pose_scene", "|u1"), ("poses", "positions", "pose_position", "<f8"),
    ("poses", "cells", "pose_cell", "<i4"), ("hints", "labels", "hint_label", "|u1"),
    ("hints", "colours", "hint_colour", "|u1"), ("hints", "directions", "hint_direction", "|u1"),
    ("hints", "objects", "hint_object", "<i4"), ("hints", "instances", "hint_instance", "<i8"),
    ("hints", "offsets", "hint_offset", "<f4"), ("hints", "closest", "hint_closest", "<f4"),
)  # fmt: skip
"""Table, field, name and type in the file of the columns that are stored as they are."""
_WIDE = {"boxes": 6, "rgb": 3, "positions": 3, "offsets": 2, "closest": 2}  # columns of matrices


def _map_columns(
    data: Kitti360Pose, cells: NDArray[np.int64], objects: NDArray[np.int64]
) -> dict[str, NDArray[Any]]:
    """Return the columns of the map for these rows of cells and objects."""
    c, o = data.cells, data.objects
    counts = np.diff(c.object_starts)[cells]
    corner = np.repeat(c.boxes[cells, :3], counts, axis=0)
    footprints = (o.footprint(int(i)) - k[:2] for i, k in zip(objects, corner, strict=True))

    def quantize(values: Floats) -> NDArray[np.int32]:
        return np.round(values / GRAIN).astype(np.int32)

    rows = {"cells": cells, "objects": objects}
    return {
        stored: getattr(getattr(data, table), field)[rows[table]].astype(dtype)
        for table, field, stored, dtype in _MAP_COLUMNS
    } | {
        "cell_ids": pack_strings([c.ids[i] for i in cells]),
        "object_counts": counts.astype(np.uint32),
        "object_center": quantize(o.centers[objects] - corner),
        "object_low": quantize(o.low[objects] - corner),
        "object_extent": quantize(o.high[objects] - o.low[objects]),
        "footprint_counts": np.diff(o.footprint_starts)[objects].astype(np.uint32),
        "footprint": quantize(np.concatenate([np.zeros((0, 2)), *footprints])),
    }


def _read(file: MapFile) -> Kitti360Pose:
    meta = file.meta
    grain = float(meta["grain"])
    tables: dict[str, dict[str, Any]] = defaultdict(dict)
    for table, field_, stored, dtype in _MAP_COLUMNS + _QUERY_COLUMNS:
        column = file.array(stored, dtype, 2 if field_ in _WIDE else 1)
        kind = column.dtype if field_ == "rgb" else "f8" if dtype[1] == "f" else "i8"
        tables[table][field_] = column.astype(kind)

    def starts(name: str, dtype: str) -> NDArray[np.int64]:
        return np.concatenate(([0], np.cumsum(file.array(name, dtype).astype(np.int64))))

    def metres(name: str) -> Floats:
        return file.array(name, "<i4", 2) * grain

    object_starts = starts("object_counts", "<u4")
    corner = np.repeat(tables["cells"]["boxes"][:, :3], np.diff(object_starts), axis=0)
    footprint_starts = starts("footprint_counts", "<u4")
    low = metres("object_low") + corner
    ground = np.repeat(corner[:, :2], np.diff(footprint_starts), axis=0)
    return Kitti360Pose(
        source=str(meta["source"]),
        scenes=tuple(str(s) for s in meta["scenes"]),
        scene_bytes=tuple(int(n) for n in meta["scene_bytes"]),
        labels=file.strings("labels"),
        colours=file.strings("colours"),
        cells=Cells(ids=file.strings("cell_ids"), object_starts=object_starts, **tables["cells"]),
        objects=Objects(
            centers=metres("object_center") + corner, low=low,
            high=low + metres("object_extent"), footprint_starts=footprint_starts,
            footprints=metres("footprint") + ground, **tables["objects"],
        ),
        poses=Poses(hint_starts=starts("hint_counts", "<u2"), **tables["poses"]),
        hints=Hints(**tables["hints"]),
    )  # fmt: skip


def _check(data: Kitti360Pose) -> None:
    """Raise `ValueError` where columns differ in length or point outside a table."""
    c, o, p, h = data.cells, data.objects, data.poses, data.hints
    n_scenes, n_cells = len(data.scenes), len(c.ids)
    for table, length in ((c, n_cells), (o, len(o.ids)), (p, len(p.cells)), (h, len(h.labels))):
        for column in fields(table):
            rows = len(getattr(table, column.name)) - column.name.endswith("_starts")
            if rows != length and column.name != "footprints":
                raise ValueError(f"{column.name} does not have {length} rows")
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
    matrices = [
        (getattr(getattr(data, table), name), _WIDE[name])
        for table, name, *_ in _MAP_COLUMNS + _QUERY_COLUMNS
        if name in _WIDE
    ]
    if any(a.shape[1] != w for a, w in (*matrices, (o.centers, 3), (o.footprints, 2))):
        raise ValueError("a column is too wide or too narrow")
    if not all(np.isfinite(a).all() for a in (c.boxes, c.sizes, p.positions, o.centers)):
        raise ValueError("a number is not finite")


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
PADDING = "pad"  # label of points that fill up a cell; left out
SQUARE = 1.0  # A footprint has a point in each square of this edge [m]
FARTHEST = 1e5  # no point of a cell is farther from its corner [m]

_DRIVE = re.compile(r"(?:.*drive_)?(\d{4})(?:_.*)?")
_CENTRES = np.array([rgb for rgbs in COLOURS.values() for rgb in rgbs], np.float64)
_NAMED = [name for name, rgbs in COLOURS.items() for _ in rgbs]


@dataclass(frozen=True)
class Conversion:
    """Counts of a conversion."""

    scenes: tuple[str, ...]
    cells: int
    objects: int
    poses: int
    hints: int
    unmatched: int  # hints about objects that the best cell does not hold
    padding: int  # objects of padding, left out
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
    ``poses/<scene>.pkl``, read without running code; `out`: file to write, which `Kitti360Pose.open`
    opens; `progress`: called with scene and number of cells done.

    Raises `InputError` where a file is missing or damaged, or a field invalid (the message names file,
    row and field); `MapLockedError`: another process writes the file; `MapError`: it cannot be written.
    """
    scenes = _scenes(Path(folder))
    report = progress or (lambda _scene, _n: None)
    with map_writer(out) as write:
        gather = _Gather()
        for drive, cells, poses in scenes:
            gather.scene(drive, cells, poses, report)
        data = gather.data(Path(folder).resolve().name)
        report("writing", len(data.cells.ids))
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
    """Return the texts' name of a colour (3,), 0 to 255."""
    return _NAMED[int(np.argmin(((_CENTRES - rgb) ** 2).sum(axis=1)))]


def footprint(points: Floats) -> Floats:
    """Return one of the points (n, 2) in each square metre of ground [m]."""
    _, first = np.unique(np.floor(points / SQUARE).astype(np.int64), axis=0, return_index=True)
    return points[first]


def _scenes(folder: Path) -> list[tuple[str, Path, Path]]:
    """Return drive, cells and poses of each scene."""
    files: dict[str, dict[str, Path]] = defaultdict(dict)
    for kind in ("cells", "poses"):
        for path in sorted((folder / kind).glob("*.pkl")):
            found = _DRIVE.fullmatch(path.stem)
            if found is None:
                raise InputError(
                    f"{path}: its name has no drive; name it like 2013_05_28_drive_0003_sync.pkl."
                )
            other = files[found[1]].setdefault(kind, path)
            if other != path:
                raise InputError(f"{path} and {other} are of the same drive; remove one.")
    if not files:
        raise InputError(
            f"{folder} contains no cells/*.pkl and poses/*.pkl; give the folder of KITTI360Pose "
            "that does, such as k360_30-10_scG_pd10_pc4_spY_all."
        )
    for drive, pair in files.items():
        for kind in ("cells", "poses"):
            if kind not in pair:
                raise InputError(
                    f"{folder}: {kind}/ has no file of drive {drive}; copy it there, or remove "
                    "the drive's other file."
                )
    return [(drive, pair["cells"], pair["poses"]) for drive, pair in sorted(files.items())]


@dataclass
class _Fields:
    """A record, and its place in the file for messages."""

    record: Record
    where: str

    @classmethod
    def of(cls, value: object, kinds: tuple[str, ...], where: str) -> _Fields:
        if not isinstance(value, Record) or value.kind not in kinds:
            raise InputError(
                f"{where} is not of type {' or '.join(kinds)}; download the file again."
            )
        return cls(value, where)

    def get(self, name: str) -> Any:  # noqa: ANN401
        if name not in self.record.fields:
            raise InputError(f"{self.where} has no {name}; is this another release of the data?")
        return unwrap_array(self.record.fields[name])

    def text(self, name: str) -> str:
        value = self.get(name)
        if type(value) is not str or not value:
            raise self.wrong(name, "not text")
        return value

    def integer(self, name: str) -> int:
        value = self.get(name)
        if type(value) is not int or not -(1 << 31) <= value < 1 << 31:
            raise self.wrong(name, "not a whole number")
        return value

    def list_of(self, name: str) -> list[Any]:
        value = self.get(name)
        if type(value) is not list:
            raise self.wrong(name, "not a list")
        return value

    def numbers(self, name: str, shape: tuple[int, ...]) -> Floats:
        """Return finite numbers; -1 in the shape stands for one or more."""
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
    """Collector of columns, row by row."""

    def __init__(self) -> None:
        self.columns: dict[str, list[Any]] = defaultdict(list)
        self.labels, self.colours = _Table("labels"), _Table("colours")
        self.scenes: list[str] = []
        self.scene_bytes: list[int] = []
        self.cell_rows: dict[str, int] = {}
        self.sizes: list[float] = []
        self.padding = 0

    def scene(
        self, drive: str, cells: Path, poses: Path, report: Callable[[str, int], None]
    ) -> None:
        """Read both files of a drive."""
        self.scenes.append(drive)
        self.scene_bytes.append(cells.stat().st_size)
        for n, value in enumerate(_read_list(cells)):
            if n % 20 == 0:
                report(drive, n)
            self.cell(_Fields.of(value, ("Cell",), f"{cells}: cell {n}"))
        for n, value in enumerate(_read_list(poses)):
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
        for k, value in enumerate(cell.list_of("objects")):
            object_ = _Fields.of(value, ("Object3d",), f"{cell.where} ({id_}): object {k}")
            if object_.text("label") == PADDING:
                self.padding += 1
                continue
            points = self.object(object_, box[:3], size)
            n_points, count = n_points + points, count + 1
            n_bytes += object_.bytes("xyz") + object_.bytes("rgb")
        self.cell_rows[id_] = len(self.cell_rows)
        self.sizes.append(size)
        self.put(cell_scene=len(self.scenes) - 1, box=box, size=size, points=n_points)
        self.put(point_bytes=n_bytes, object_count=count)

    def object(self, object_: _Fields, corner: Floats, size: float) -> int:
        xyz, rgb = object_.numbers("xyz", (-1, 3)), object_.numbers("rgb", (-1, 3))
        if len(xyz) != len(rgb):
            raise object_.wrong("rgb", f"of {len(rgb)} points, xyz of {len(xyz)}")
        if not (np.abs(size * xyz) < FARTHEST).all():
            raise object_.wrong("xyz", "far away from its cell")
        xyz = corner + size * xyz
        mean = np.clip(255.0 * rgb.mean(axis=0), 0.0, 255.0)
        ground = footprint(xyz[:, :2])
        self.put(id=object_.integer("id"), instance=object_.integer("instance_id"))
        self.put(label=self.labels.row(object_.text("label"), object_.where))
        self.put(colour=self.colours.row(nearest_colour(mean), object_.where))
        self.put(rgb=np.round(mean), center=xyz.mean(axis=0), low=xyz.min(axis=0))
        self.put(high=xyz.max(axis=0), footprint=ground, footprint_count=len(ground))
        return len(xyz)

    def pose(self, pose: _Fields) -> None:
        id_ = pose.text("cell_id")
        if id_ not in self.cell_rows:
            raise InputError(
                f"{pose.where}: there is no cell {id_!r}; use two files of one folder."
            )
        row = self.cell_rows[id_]
        hints = pose.list_of("descriptions")
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
            hint_object=hint.integer("object_id") if matched else -1,
            hint_instance=hint.integer("object_instance_id"),
            offset=size * hint.numbers("offset_center", (2,)),
            closest=size * hint.numbers("offset_closest", (2,)),
        )

    def data(self, source: str) -> Kitti360Pose:
        """Return all columns."""
        f, integers, starts = self.floats, self.integers, self.starts
        return Kitti360Pose(
            source=source,
            scenes=tuple(self.scenes),
            scene_bytes=tuple(self.scene_bytes),
            labels=tuple(self.labels.rows),
            colours=tuple(self.colours.rows),
            cells=Cells(
                tuple(self.cell_rows), integers("cell_scene"), f("box", 6), np.array(self.sizes),
                integers("points"), integers("point_bytes"), starts("object_count"),
            ),
            objects=Objects(
                integers("id"), integers("instance"), integers("label"), integers("colour"),
                f("rgb", 3).astype(np.uint8), f("center", 3), f("low", 3), f("high", 3),
                starts("footprint_count"),
                np.concatenate([np.zeros((0, 2)), *self.columns["footprint"]]),
            ),
            poses=Poses(
                integers("pose_scene"), f("position", 3), integers("pose_cell"), starts("hint_count")
            ),
            hints=Hints(
                integers("hint_label"), integers("hint_colour"), integers("direction"),
                integers("hint_object"), integers("hint_instance"), f("offset", 2), f("closest", 2),
            ),
        )  # fmt: skip

    def floats(self, name: str, width: int) -> Floats:
        return np.array(self.columns[name], np.float64).reshape(-1, width)

    def integers(self, name: str) -> NDArray[np.int64]:
        return np.array(self.columns[name], np.int64)

    def starts(self, name: str) -> NDArray[np.int64]:
        return np.concatenate(([0], np.cumsum(self.integers(name))))


def _read_list(path: Path) -> list[Any]:
    value = read_pickle(path, RELEASE)
    if type(value) is not list:
        raise InputError(f"{path} contains no list; download it again.")
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
        """Project longitude and latitude (..., 2) [deg] to east and north (..., 2) [m]."""
        lon, lat = np.moveaxis(np.asarray(lonlat, np.float64), -1, 0)
        east = np.radians(lon - self.longitude)
        north = np.arcsinh(np.tan(np.radians(lat))) - asinh(tan(radians(self.latitude)))
        return self._scale * np.stack([east, north], axis=-1)

    def to_lonlat(self, east_north: ArrayLike) -> Floats:
        """Return longitude and latitude (..., 2) [deg] of east and north (..., 2) [m]."""
        east, north = np.moveaxis(np.asarray(east_north, np.float64) / self._scale, -1, 0)
        lat = np.arctan(np.sinh(north + asinh(tan(radians(self.latitude)))))
        return np.stack([self.longitude + np.degrees(east), np.degrees(lat)], axis=-1)


WORLD = Mercator(8.4295857, 48.9843445)
"""Frame of KITTI-360's poses, point clouds and annotations, and of KITTI360Pose."""
