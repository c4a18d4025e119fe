"""From the published pickles of KITTI360Pose to a file of our own."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.core.mapfile import writing
from placegraph.errors import InputError
from placegraph_lab.datasets.kitti360pose import (
    DIRECTIONS,
    Cells,
    Hints,
    Kitti360Pose,
    Objects,
    Poses,
)
from placegraph_lab.datasets.pickle_names import Record, Release
from placegraph_lab.datasets.pickles import finished, read_pickle

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
PADDING = "pad"
"""Label of what only fills up a cell; it is left out."""
SQUARE = 1.0
"""A footprint has a point in each square of this edge [m]."""
FARTHEST = 1e5
"""No point of a cell is farther from its corner [m]."""

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
    unmatched: int
    """Hints about things that the best cell does not hold."""
    padding: int
    """Objects left out, for they only fill up a cell."""
    points: int
    source_bytes: int
    """Of the cells' pickles."""
    bytes: int
    """Of the file written."""


def convert_kitti360pose(
    folder: str | PathLike[str],
    out: str | PathLike[str],
    *,
    progress: Callable[[str, int], None] | None = None,
) -> Conversion:
    """Read the pickles of a published folder and write all of it to one file, atomically.

    Parameters
    ----------
    folder
        Such as ``k360_30-10_scG_pd10_pc4_spY_all``, with ``cells/<scene>.pkl`` and
        ``poses/<scene>.pkl``. Its pickles are read by a machine that can make plain data only.
    out
        File to write; `Kitti360Pose.open` opens it.
    progress
        Is told the scene at hand and how many of its cells are done.

    Raises
    ------
    InputError
        A file is missing, damaged or no such pickle; or a field is missing or not what it should
        be: the message names file, row and field.
    MapLockedError
        Somebody else is writing the same file.
    MapError
        The file cannot be written.

    """
    scenes = _scenes(Path(folder))
    told = progress or (lambda _scene, _n: None)
    with writing(out) as write:
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
