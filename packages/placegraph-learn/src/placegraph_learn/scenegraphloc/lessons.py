"""Training data of the network: rooms, pictures taken in them, and what each patch shows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.mapfile import pack_strings, read_map, write_map
from placegraph.errors import MapError, OptionError
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.capture import Capture, is_capture, open_capture
from placegraph_learn.scenegraphloc.features import ImageFeatures
from placegraph_learn.scenegraphloc.inputs import (
    PointSource,
    Room,
    object_views,
    quarter_turns,
    rooms_of,
    seen_objects,
    vote_patches,
)
from placegraph_learn.scenegraphloc.network import ATTRIBUTES

KIND, VERSION = "lesson", 1
_ARRAYS = ("points", "offsets", "edges", "relations", "attributes", "owner", "views", "poses")


@dataclass(frozen=True, eq=False)
class SurveyedScene:
    """A scene map with captures in it, whose odometry is map_from_camera."""

    scene: SceneMap
    captures: tuple[Capture, ...]


@dataclass(frozen=True, eq=False)
class World:
    """One place to learn from; opened, or drawn, when it is its turn."""

    name: str
    make: Callable[[], Material]


@dataclass(frozen=True, eq=False)
class Material:
    """Maps and captures of one place."""

    now: SurveyedScene
    """The map, and images from which its objects are known."""
    pictures: tuple[Capture, ...]
    """Other images of it, whose patches are learned."""
    earlier: SurveyedScene | None = None
    """The same place at another time; what is still there has the same ids."""


@dataclass(frozen=True, eq=False)
class Lesson:
    """One place, ready to be learned."""

    name: str
    room: Room
    earlier: Room | None
    features: tuple[NDArray[np.float32], ...]
    """(rows, columns, f) of each picture."""
    marks: tuple[NDArray[np.int64], ...]
    """(rows * columns,) of each picture: row of the object that a patch shows, plus 1; 0: none."""

    def targets(self, picture: int, *, earlier: bool = False) -> NDArray[np.int64]:
        """Return row (P,) in the room, or in what it was earlier, of what each patch shows; -1: none."""
        marks = self.marks[picture]
        if not earlier or self.earlier is None:
            return marks - 1
        place = {id_: row for row, id_ in enumerate(self.earlier.ids)}
        rows = [-1, *(place.get(id_, -1) for id_ in self.room.ids)]
        return np.array(rows, np.int64)[marks]


@dataclass(frozen=True, eq=False)
class Teacher:
    """Makes lessons, all in the same way."""

    features: ImageFeatures
    rotate: bool | None = None
    points: PointSource = "surface"
    attributes: tuple[str, ...] = ()
    """Words to count; without any their vectors are zeros."""
    seed: int = 0

    @property
    def attribute_count(self) -> int:
        """Length of the vectors of attributes: the published one where there are no words."""
        return len(self.attributes) or ATTRIBUTES

    def lesson(self, world: World) -> Lesson:
        """A place, looked at; raises `OptionError` where nothing in it can be learned."""
        material = world.make()
        scene = material.now.scene
        features, marks = [], []
        for frame in (frame for capture in material.pictures for frame in capture):
            turns = quarter_turns(frame, self.rotate)
            grid = self.features.grid(np.ascontiguousarray(np.rot90(frame.rgb(), -turns)))
            seen = np.rot90(seen_objects(scene, frame), -turns)
            features.append(grid)
            marks.append(
                vote_patches(seen, (grid.shape[0], grid.shape[1])).ravel().astype(np.int64) + 1
            )
        if not any(m.any() for m in marks):
            raise OptionError(
                f"{world.name}: no image shows an object of the map; give captures with poses in "
                "the map's frame."
            )
        earlier = None if material.earlier is None else self._room(material.earlier, world.name)
        room = self._room(material.now, world.name)
        return Lesson(world.name, room, earlier, tuple(features), tuple(marks))

    def _room(self, place: SurveyedScene, name: str) -> Room:
        views = object_views(place.scene, place.captures, self.features, rotate=self.rotate)
        rooms = rooms_of(
            place.scene, views, attributes=self.attributes, count=self.attribute_count,
            source=self.points, rng=np.random.default_rng([self.seed, *name.encode()]),
        )  # fmt: skip
        if len(rooms) != 1:
            raise OptionError(
                f"{name} is merged from {len(rooms)} scenes; give each map separately."
            )
        return rooms[0][1]


def kept_lesson(path: Path, make: Callable[[], Lesson]) -> Lesson:
    """Return the lesson of a file, or a new one that is then kept there."""
    if path.exists():
        try:
            return read_lesson(path)
        except MapError:  # of another version or damaged: it can be made again
            path.unlink()
    lesson = make()
    write_lesson(path, lesson)
    return lesson


def write_lesson(path: Path, lesson: Lesson) -> None:
    """Write a lesson in one go; raises as `placegraph.core.mapfile` does."""
    arrays: dict[str, NDArray[Any]] = {}
    for prefix, room in (("now", lesson.room), ("earlier", lesson.earlier)):
        if room is not None:
            arrays |= {f"{prefix}:{name}": getattr(room, name) for name in _ARRAYS}
            arrays[f"{prefix}:ids"] = pack_strings(room.ids)
            arrays[f"{prefix}:labels"] = pack_strings(room.labels)
    arrays["grids"] = np.array([f.shape[:2] for f in lesson.features], np.int64)
    arrays["features"] = np.concatenate([f.reshape(-1, f.shape[2]) for f in lesson.features])
    arrays["marks"] = np.concatenate(lesson.marks)
    write_map(path, KIND, VERSION, {"name": lesson.name}, arrays)


def read_lesson(path: Path) -> Lesson:
    """Read a lesson again; raises as `placegraph.core.mapfile` does."""
    file = read_map(path, KIND, VERSION)
    name = str(file.meta["name"])

    def room(prefix: str) -> Room | None:
        if f"{prefix}:ids" not in file.arrays:
            return None
        arrays: dict[str, Any] = {n: file.arrays[f"{prefix}:{n}"] for n in _ARRAYS}
        return Room(name, file.strings(f"{prefix}:ids"), file.strings(f"{prefix}:labels"), **arrays)

    now = room("now")
    if now is None:
        raise MapError(f"{path} contains no room; delete it, and start again.")
    grids = file.array("grids", "<i8", 2)
    ends = np.cumsum(grids.prod(axis=1))[:-1]
    features = np.split(file.array("features", "<f4", 2), ends)
    return Lesson(
        name=name,
        room=now,
        earlier=room("earlier"),
        features=tuple(
            f.reshape(rows, columns, -1)
            for f, (rows, columns) in zip(features, grids.tolist(), strict=True)
        ),
        marks=tuple(np.split(file.array("marks", "<i8"), ends)),
    )


def split(lessons: Sequence[Any], held_out: int) -> tuple[list[Any], list[Any]]:
    """Return those that are learned, and `held_out` others, spread evenly, that are only asked about."""
    rows = np.linspace(0, len(lessons) - 1, held_out + 2)[1:-1].round().astype(int).tolist()
    return [x for i, x in enumerate(lessons) if i not in rows], [lessons[i] for i in rows]


def place_capture(capture: Capture, map_from_camera: NDArray[np.float64]) -> Capture:
    """Return capture whose odometry (T, 4, 4) is map_from_camera: one of the map itself."""
    frames = zip(capture.frames, map_from_camera, strict=True)
    return replace(capture, frames=tuple(replace(f, odometry=pose) for f, pose in frames))


def folder(path: str | PathLike[str]) -> list[World]:
    """Return scene maps of a folder, each `NAME.scene` with its captures in the folder `NAME`.

    `NAME` is one capture or holds several, by whatever recorder; poses are those of
    `trajectory.tum` where there is one, else the recorder's own, and must be in the map. Of several
    captures the first shows what objects look like and the others are learned; of a single one,
    every other image.

    Raises `OptionError`: the folder holds no map with captures.
    """
    root = Path(path)
    found = sorted(root.glob("*.scene")) if root.is_dir() else []
    known = [file for file in found if file.with_suffix("").is_dir()]
    if not known:
        raise OptionError(
            f"{path} contains no NAME.scene with captures in a folder NAME; build maps with "
            "`placegraph scene build`."
        )
    return [World(file.stem, partial(_open_material, file)) for file in known]


def _open_material(file: Path) -> Material:
    from placegraph.indoor.scene_map import SceneMap

    at = file.with_suffix("")
    inner = [] if is_capture(at) else sorted(p for p in at.iterdir() if is_capture(p))
    captures = [_with_poses(p) for p in inner or [at]]
    if len(captures) == 1:
        captures = [captures[0][::2], captures[0][1::2]]
    if not len(captures[1]):
        raise OptionError(
            f"{at} has a single image; give at least two, because one encodes the objects."
        )
    scene = SceneMap.open(file)
    return Material(SurveyedScene(scene, (captures[0],)), tuple(captures[1:]))


def _with_poses(path: Path) -> Capture:
    truth = (path / "trajectory.tum").is_file()
    return open_capture(path, labels=None, poses="trajectory") if truth else open_capture(path)
