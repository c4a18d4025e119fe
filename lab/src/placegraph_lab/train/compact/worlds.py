"""Pictures to learn from: homes, and maps, lit at random and seen from anywhere a person may stand.

A scene's pictures are light, not colours: exposure, white balance and all that a camera does are
drawn anew each time a picture is shown. Scenes lie in a folder, one file each, made once.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, NamedTuple, cast
from zipfile import BadZipFile

import numpy as np

from placegraph.errors import InputError
from placegraph.geometry import Camera, level_from_camera, pose_matrix
from placegraph.indoor.encode.compact import picture
from placegraph.indoor.encode.compact.things import Things, describe
from placegraph.indoor.encode.grid import majority
from placegraph_lab.worlds.flat.interior import Lamp
from placegraph_lab.worlds.flat.render import Stage

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from placegraph.indoor.map.mesh import Mesh
    from placegraph.indoor.scene_map import SceneMap
    from placegraph_lab.worlds.flat.interior import Interior

    Floats = NDArray[np.float32]

SHARPER = 2
"""Rays along a side of a pixel."""
CLEAR = 0.3
"""Nothing is nearer to the camera than this, on its level [m]."""
ROUND = 16
"""Directions in which that is looked for."""
VISIBLE = 0.5
"""Share of the pixels of a patch that its object must have."""
FEW = 6
"""Fewer objects than this make a picture the rarer, the fewer they are."""
SHAPES = ((9, 16), (10, 15))
"""Grids of pictures: of 16:9 and of 3:2."""


class Thing(NamedTuple):
    """What the light of a map's object depends on; as `worlds.flat.interior.Thing`."""

    id: int
    glow: float = 0.0
    is_window: bool = False


class LitMap(NamedTuple):
    """A map with lamps put into it: all of an `Interior` that `Stage` asks for."""

    surface: Mesh
    things: tuple[Thing, ...]
    lamps: tuple[Lamp, ...]

    def mesh(self) -> Mesh:
        """Its mesh; objects are rows."""
        return self.surface


@dataclass(frozen=True, eq=False)
class World:
    """One scene and M pictures of it."""

    light: NDArray[np.float16]
    """(M, PIXELS rows, PIXELS columns, 3) linear; 1 is a well lit white wall."""
    objects: NDArray[np.int16]
    """(M, PIXELS rows, PIXELS columns) rows of objects; -1: nothing."""
    patches: NDArray[np.int16]
    """(M, rows * columns) object that most pixels of a patch show; -1: none has half of them."""
    rises: Floats
    """(M, 2 rows, 2 columns) `picture.rises`."""
    spans: Floats
    """(M,) `picture.span`."""
    labels: NDArray[np.str_]
    """(N,)"""
    form: Floats
    """Of `Things`, as the rest."""
    samples: Floats
    area: Floats

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns of patches."""
        return self.rises.shape[1] // 2, self.rises.shape[2] // 2

    @property
    def shares(self) -> Floats:
        """(N,) share of each object among all patches, none of them nil."""
        counts = np.bincount(self.patches[self.patches >= 0], minlength=len(self.area)) + 1.0
        return (counts / counts.sum()).astype(np.float32)

    @property
    def things(self) -> Things:
        """Its objects."""
        one = np.zeros(len(self.area), np.int32)
        return Things(self.form, self.samples, self.area, one, coloured=True)

    def save(self, path: Path) -> None:
        """Write it, whole or not at all."""
        part = path.with_suffix(".part")
        with part.open("wb") as file:
            np.savez(file, **{f.name: getattr(self, f.name) for f in fields(self)})
        part.replace(path)

    @classmethod
    def open(cls, path: Path) -> World:
        """Read it; `InputError` where it is none."""
        try:
            with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
                return cls(**{f.name: file[f.name] for f in fields(cls)})
        except (OSError, ValueError, KeyError, BadZipFile) as error:
            raise InputError(f"{path} holds no pictures ({error}); delete it.") from error


def of_home(
    interior: Interior, scene: SceneMap, count: int, grid: tuple[int, int], rng: np.random.Generator
) -> World:
    """Pictures of a furnished flat, whose map is `scene`; rows of things are rows of objects."""
    row_of = np.full(max(thing.id for thing in interior.things) + 1, -1)
    row_of[[thing.id for thing in interior.things]] = np.arange(len(interior.things))
    return _seen(interior, scene, row_of, count, grid, rng)


def of_map(scene: SceneMap, count: int, grid: tuple[int, int], rng: np.random.Generator) -> World:
    """Pictures of a map, in which lamps are put at random."""
    low, high = scene.bounds
    number = int(np.ceil(np.prod(high[:2] - low[:2]) / rng.uniform(15.0, 30.0)))
    places = low[:2] + rng.random((number, 2)) * (high - low)[:2]
    lamps = tuple(
        Lamp((float(x), float(y), float(high[2] - rng.uniform(0.1, 1.2))), bool(rng.random() < 0.4))
        for x, y in places
    )
    things = tuple(Thing(row) for row in range(len(scene)))
    lit = LitMap(scene.mesh, things, lamps)
    return _seen(lit, scene, np.arange(len(scene)), count, grid, rng)


def _seen(
    lit: Interior | LitMap,
    scene: SceneMap,
    row_of: NDArray[np.int64],
    count: int,
    grid: tuple[int, int],
    rng: np.random.Generator,
) -> World:
    """Pictures of a scene; `row_of` says which object each id of its mesh is."""
    size = picture.PIXELS * grid[1], picture.PIXELS * grid[0]
    row_of = np.append(row_of, -1)
    stage = None
    made: list[tuple[Any, ...]] = []
    while len(made) < count:
        if stage is None or rng.random() < 0.2:
            stage = Stage(cast("Interior", lit), rng, daylight=float(rng.uniform(0.05, 0.95)))
        camera, pose = _camera(size, rng), _pose(stage, rng)
        fine = camera.resized(SHARPER * camera.width, SHARPER * camera.height)
        rows = row_of[stage.shot(camera, pose).ids].astype(np.int32)
        which = majority(rows, grid, len(scene))
        if (which >= 0).mean() < VISIBLE or len(np.unique(which)) < rng.integers(2, FEW + 1):
            continue  # out of a window, or at a bare wall
        radiance = stage.radiance(fine, pose)
        h, w = rows.shape
        light = radiance.reshape(h, SHARPER, w, SHARPER, 3).mean(axis=(1, 3))
        facts = picture.rises(camera, -pose[2, :3], grid), np.float32(picture.span(camera, grid))
        made.append((light.astype(np.float16), rows, which, *facts))
    light, objects, patches, rises, spans = (np.array(c) for c in zip(*made, strict=True))
    things = describe(scene)
    return World(
        light=light,
        objects=objects.astype(np.int16),
        patches=patches.astype(np.int16),
        rises=rises,
        spans=spans,
        labels=np.array(scene.graph.labels),
        form=things.form,
        samples=things.light,
        area=things.area,
    )


def _camera(size: tuple[int, int], rng: np.random.Generator) -> Camera:
    """Camera of 48 to 85 degrees."""
    width, height = size
    focal = width / 2.0 / np.tan(np.radians(rng.uniform(48.0, 85.0)) / 2.0)
    return Camera(width, height, focal, focal, width / 2.0, height / 2.0)


def _pose(stage: Stage, rng: np.random.Generator) -> NDArray[np.float64]:
    """A pose (4, 4) with floor below, a roof above, and nothing in front of the nose."""
    low, high = stage.mesh.bounds()
    turn = 2.0 * np.pi * np.arange(ROUND) / ROUND
    level = np.stack([np.cos(turn), np.sin(turn), np.zeros(ROUND)], axis=1)
    around = np.concatenate([level, [[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]]).astype(np.float32)
    while True:
        at = low + rng.random(3) * (high - low)
        at[2] = low[2] + rng.uniform(0.9, 1.9)
        reach = stage.caster.cast(at.astype(np.float32), around).distance
        if reach[:-2].min() > CLEAR and reach[-2:].max() < 4.0 and reach[-2] > 0.4:
            break
    pitch, roll, yaw = rng.normal(-0.12, 0.22), rng.normal(0.0, 0.06), rng.uniform(-np.pi, np.pi)
    return pose_matrix(np.array([*at, yaw]), tilted(float(pitch), float(roll)))


def tilted(pitch: float, roll: float) -> NDArray[np.float64]:
    """level_from_camera (3, 3) of a camera that looks up by `pitch` and leans by `roll` [rad]."""
    upright = np.cos(pitch)
    return level_from_camera([np.sin(roll) * upright, np.cos(roll) * upright, -np.sin(pitch)])
