"""What images of a map show of its objects: the views that an object is known by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera, quaternion_from_rotation
from placegraph.indoor.map.scene import Scene
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame

if TYPE_CHECKING:
    from placegraph_learn.scenegraphloc.features import ImageFeatures

MOST = 10
"""Views of an object that are kept: those that show most of it."""
LEVELS = 3
"""Crops of each view; each grows the box by a fifth of its sides beyond the one before."""
GROWTH = 0.2
LONGEST = 960
"""Rays are cast for images at most so wide and high [px]; 3RScan's are as wide."""
LEAST = 0.2
"""A patch shows what covers more than this share of it."""


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """Views of N objects; every object has at least one.

    One that was never seen has a single one, of a feature of zeros.
    """

    owner: NDArray[np.int64]
    """(V,) row of the object, ascending."""
    features: NDArray[np.float32]
    """(V, f) mean over the crops, not unit vectors."""
    map_from_camera: NDArray[np.float64]
    """(V, 4, 4); the identity of what was never seen."""

    def of(self, rows: NDArray[np.integer]) -> Views:
        """Views of some objects, which become 0, 1, ... in their order."""
        chosen = [np.flatnonzero(self.owner == row) for row in rows.tolist()]
        at = np.concatenate(chosen)
        owner = np.repeat(np.arange(len(rows)), [len(c) for c in chosen])
        return Views(owner, self.features[at], self.map_from_camera[at])

    def poses(self, scene_from_map: NDArray[np.float64]) -> NDArray[np.float32]:
        """Quaternion x, y, z, w and position [m] (V, 7) of scene_from_camera.

        A quaternion's largest component is positive, as SciPy has it; what was never seen has
        0, 0, 0, 1, 0, 0, 0.
        """
        seen = np.any(self.features != 0.0, axis=1, keepdims=True)
        poses = np.where(seen[:, :, None], scene_from_map @ self.map_from_camera, np.eye(4))
        quaternions = quaternion_from_rotation(poses[:, :3, :3])
        largest = np.abs(quaternions).argmax(axis=1)[:, None]
        quaternions *= np.sign(np.take_along_axis(quaternions, largest, axis=1))
        return np.concatenate([quaternions, poses[:, :3, 3]], axis=1).astype(np.float32)


class _Sight(NamedTuple):
    """An object in one image, which is turned upright."""

    pixels: int
    frame: int
    box: tuple[int, int, int, int]
    """Left, top, right, bottom [px]; right and bottom lie outside."""


def quarter_turns(frame: Frame, rotate: bool | None) -> int:
    """Quarter turns clockwise that a frame's image is given before it is looked at.

    `rotate`: True turns every image once, as 3RScan's are; None turns each so that it stands
    upright by its gravity: phones are held in many ways.
    """
    if rotate is not None:
        return int(rotate)
    x, y = frame.gravity[:2].tolist()
    if abs(x) > abs(y):
        return 1 if x > 0 else 3
    return 0 if y >= 0 else 2


def seen_objects(scene: Scene, frame: Frame, *, longest: int = LONGEST) -> NDArray[np.int32]:
    """Rows (h, w) of the objects that a frame's pixels see, -1 none, from its pose in the map.

    As large as the image, or as small as makes its longer side `longest`.
    """
    camera = frame.camera
    shrink = longest / max(camera.width, camera.height)
    if shrink < 1.0:
        width, height = (max(1, round(side * shrink)) for side in (camera.width, camera.height))
        camera = camera.resized(width, height)
    pose = frame.odometry
    hits = scene.caster.cast(pose[:3, 3], _rays(camera) @ pose[:3, :3].T)
    objects = np.append(scene.mesh.object_of, np.int32(-1))[hits.triangle]
    return objects.reshape(camera.height, camera.width)


@lru_cache(maxsize=4)
def _rays(camera: Camera) -> NDArray[np.float64]:
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    return camera.directions(np.stack([u, v], axis=-1)).reshape(-1, 3)


def shown(objects: NDArray[np.int32], grid: tuple[int, int]) -> NDArray[np.int32]:
    """Object (rows, columns) that most pixels (h, w) of each patch see, -1 none.

    None too where the most frequent, which may itself be none, covers at most `LEAST` of it.
    """
    from placegraph.indoor.encode.grid import cells

    count = int(objects.max(initial=-1)) + 2
    number = grid[0] * grid[1]
    flat = cells(objects.shape, grid) * count + objects + 1
    votes = np.bincount(flat.ravel(), minlength=number * count).reshape(number, count)
    best = votes.argmax(axis=1)
    told = votes[np.arange(number), best] > LEAST * votes.sum(axis=1)
    return np.where(told, best - 1, -1).astype(np.int32).reshape(grid)


def object_views(
    scene: Scene,
    captures: Sequence[Capture],
    features: ImageFeatures,
    *,
    rotate: bool | None = None,
) -> Views:
    """Views of all objects of a map in captures of it, whose odometry is map_from_camera.

    Raises `InputError` where an image is broken.
    """
    frames = [frame for capture in captures for frame in capture]
    best = _best(scene, frames, rotate)
    made = _described(frames, best, features, rotate)
    owner, vectors, poses = [], [], []
    for row, sights in enumerate(best):
        for sight in sights:
            owner.append(row)
            vectors.append(made[row, sight.frame])
            poses.append(frames[sight.frame].odometry)
        if not sights:
            owner.append(row)
            vectors.append(np.zeros(features.dimension, np.float32))
            poses.append(np.eye(4))
    return Views(np.array(owner, np.int64), np.array(vectors, np.float32), np.array(poses))


def _best(scene: Scene, frames: Sequence[Frame], rotate: bool | None) -> list[list[_Sight]]:
    """The sights of each object that show most of it, the most first; of equals the earlier."""
    found: list[list[_Sight]] = [[] for _ in range(len(scene))]
    for index, frame in enumerate(frames):
        turns = quarter_turns(frame, rotate)
        objects = np.rot90(seen_objects(scene, frame), -turns)
        size = frame.camera.width, frame.camera.height
        whole = size if turns % 2 == 0 else size[::-1]
        for row, pixels, box in _boxes(objects, whole):
            found[row].append(_Sight(pixels, index, box))
    return [sorted(sights, key=lambda s: (-s.pixels, s.frame))[:MOST] for sights in found]


def _boxes(
    objects: NDArray[np.int32], size: tuple[int, int]
) -> list[tuple[int, int, tuple[int, int, int, int]]]:
    """Row, pixels and box, in an image of width and height `size`, of each object that is there."""
    rows, at = np.unique(objects, return_inverse=True)
    at = at.reshape(objects.shape)
    sx, sy = size[0] / objects.shape[1], size[1] / objects.shape[0]
    counts = np.bincount(at.ravel())
    out = []
    for k, row in enumerate(rows.tolist()):
        if row < 0:
            continue
        mask = at == k
        x, y = np.flatnonzero(mask.any(axis=0)), np.flatnonzero(mask.any(axis=1))
        left, top = int(x[0] * sx), int(y[0] * sy)
        right, bottom = int(np.ceil((x[-1] + 1) * sx)), int(np.ceil((y[-1] + 1) * sy))
        out.append((row, int(counts[k]), (left, top, min(right, size[0]), min(bottom, size[1]))))
    return out


def _described(
    frames: Sequence[Frame],
    best: Sequence[Sequence[_Sight]],
    features: ImageFeatures,
    rotate: bool | None,
) -> dict[tuple[int, int], NDArray[np.float32]]:
    """Feature of each (object, frame); every image is read once."""
    wanted: dict[int, list[tuple[int, _Sight]]] = {}
    for row, sights in enumerate(best):
        for sight in sights:
            wanted.setdefault(sight.frame, []).append((row, sight))
    made: dict[tuple[int, int], NDArray[np.float32]] = {}
    for index, sights_of in wanted.items():
        image = np.rot90(frames[index].rgb(), -quarter_turns(frames[index], rotate))
        for row, sight in sights_of:
            vectors = [features.crop(part) for part in crops(image, sight.box)]
            made[row, index] = np.stack(vectors).mean(axis=0)
    return made


def crops(image: NDArray[np.uint8], box: tuple[int, int, int, int]) -> list[NDArray[np.uint8]]:
    """The parts of an image (H, W, 3) that show what a box does, each with more around it."""
    left, top, right, bottom = box
    height, width = image.shape[:2]
    dx, dy = int(GROWTH * (right - left)), int(GROWTH * (bottom - top))
    return [
        np.ascontiguousarray(
            image[max(0, top - k * dy) : min(height, bottom + k * dy),
                  max(0, left - k * dx) : min(width, right + k * dx)]
        )
        for k in range(LEVELS)
    ]  # fmt: skip
