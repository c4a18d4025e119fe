"""Inputs of the network: views of a map's objects in images, and rooms as tensors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from placegraph.core.geometry import Camera, quaternion_from_rotation
from placegraph.errors import OptionError
from placegraph.indoor.encode.labels import assign_cells
from placegraph.indoor.map.scene import Scene
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame
from placegraph_learn.scenegraphloc.features import NONE, RELATIONS, ImageFeatures, relation_row
from placegraph_learn.scenegraphloc.network import Objects

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
        """Return views of some objects, which become 0, 1, ... in their order."""
        chosen = [np.flatnonzero(self.owner == row) for row in rows.tolist()]
        at = np.concatenate(chosen)
        owner = np.repeat(np.arange(len(rows)), [len(c) for c in chosen])
        return Views(owner, self.features[at], self.map_from_camera[at])

    def poses(self, scene_from_map: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return quaternion x, y, z, w and position [m] (V, 7) of scene_from_camera.

        A quaternion's largest component is positive, as SciPy has it; what was never seen has
        0, 0, 0, 1, 0, 0, 0.
        """
        seen = np.any(self.features != 0.0, axis=1, keepdims=True)
        poses = np.where(seen[:, :, None], scene_from_map @ self.map_from_camera, np.eye(4))
        quaternions = quaternion_from_rotation(poses[:, :3, :3])
        largest = np.abs(quaternions).argmax(axis=1)[:, None]
        quaternions *= np.sign(np.take_along_axis(quaternions, largest, axis=1))
        return np.concatenate([quaternions, poses[:, :3, 3]], axis=1).astype(np.float32)


class _ObjectView(NamedTuple):
    """An object in one image, which is turned upright."""

    pixels: int
    frame: int
    box: tuple[int, int, int, int]
    """Left, top, right, bottom [px]; right and bottom lie outside."""


def quarter_turns(frame: Frame, rotate: bool | None) -> int:
    """Return quarter turns clockwise that a frame's image is given before it is looked at.

    `rotate`: None turns each so that it stands upright by its gravity: phones are held in many ways.
    True turns every image once, False none.
    """
    if rotate is not None:
        return int(rotate)
    x, y = frame.gravity[:2].tolist()
    if abs(x) > abs(y):
        return 1 if x > 0 else 3
    return 0 if y >= 0 else 2


def seen_objects(scene: Scene, frame: Frame, *, longest: int = LONGEST) -> NDArray[np.int32]:
    """Return rows (h, w) of the objects that a frame's pixels see, -1 none, from its pose in the map.

    As large as the image, or as small as makes its longer side `longest`.
    """
    camera = frame.camera
    shrink = longest / max(camera.width, camera.height)
    if shrink < 1.0:
        width, height = (max(1, round(side * shrink)) for side in (camera.width, camera.height))
        camera = camera.resize(width, height)
    pose = frame.odometry
    hits = scene.caster.cast(pose[:3, 3], _rays(camera) @ pose[:3, :3].T)
    objects = np.append(scene.mesh.object_of, np.int32(-1))[hits.triangle]
    return objects.reshape(camera.height, camera.width)


@lru_cache(maxsize=4)
def _rays(camera: Camera) -> NDArray[np.float64]:
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    return camera.directions(np.stack([u, v], axis=-1)).reshape(-1, 3)


def vote_patches(objects: NDArray[np.int32], grid: tuple[int, int]) -> NDArray[np.int32]:
    """Return object (rows, columns) that most pixels (h, w) of each patch see, -1 none.

    None too where the most frequent, which may itself be none, covers at most `LEAST` of it.
    """
    count = int(objects.max(initial=-1)) + 2
    number = grid[0] * grid[1]
    flat = assign_cells(objects.shape, grid) * count + objects + 1
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
    """Return views of all objects of a map in captures of it, whose odometry is map_from_camera.

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


def _best(scene: Scene, frames: Sequence[Frame], rotate: bool | None) -> list[list[_ObjectView]]:
    """Return the sights of each object that show most of it, the most first; of equals the earlier."""
    found: list[list[_ObjectView]] = [[] for _ in range(len(scene))]
    for index, frame in enumerate(frames):
        turns = quarter_turns(frame, rotate)
        objects = np.rot90(seen_objects(scene, frame), -turns)
        size = frame.camera.width, frame.camera.height
        whole = size if turns % 2 == 0 else size[::-1]
        for row, pixels, box in _boxes(objects, whole):
            found[row].append(_ObjectView(pixels, index, box))
    return [sorted(sights, key=lambda s: (-s.pixels, s.frame))[:MOST] for sights in found]


def _boxes(
    objects: NDArray[np.int32], size: tuple[int, int]
) -> list[tuple[int, int, tuple[int, int, int, int]]]:
    """Return row, pixels and box, in an image of width and height `size`, of each object that is there."""
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
    best: Sequence[Sequence[_ObjectView]],
    features: ImageFeatures,
    rotate: bool | None,
) -> dict[tuple[int, int], NDArray[np.float32]]:
    """Return feature of each (object, frame); every image is read once."""
    wanted: dict[int, list[tuple[int, _ObjectView]]] = {}
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
    """Return the parts of an image (H, W, 3) that show what a box does, each with more around it."""
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


POINTS = 512  # of each object
PointSource = Literal["surface", "vertices"]
_DIRECTIONS = 1024
_PORTION = 1 << 14
_MOST = 4000
"""Objects of one room; every pair of them is an edge."""


@dataclass(frozen=True, eq=False)
class Room:
    """One scene graph as the network reads it; arrays, n objects."""

    name: str
    ids: tuple[str, ...]
    labels: tuple[str, ...]
    points: NDArray[np.float32]
    """(n, P, 3) less the room's mean [m]"""
    offsets: NDArray[np.float64]
    """(n, 3) barycentre of the root less the object's [m]"""
    edges: NDArray[np.int64]
    """(n (n - 1), 2) rows of source and target: a complete graph."""
    relations: NDArray[np.float32]
    """(n, 41) counts of the words of edges that leave the object."""
    attributes: NDArray[np.float32]
    """(n, A) counts of the object's attribute words."""
    owner: NDArray[np.int64]
    """(V,) row of the object of each view; ascending, each object has at least one."""
    views: NDArray[np.float32]
    """(V, f) image features"""
    poses: NDArray[np.float32]
    """(V, 7) quaternion x, y, z, w, and position [m], of scene_from_camera."""

    def __len__(self) -> int:
        return len(self.ids)

    def with_points(self, count: int) -> Room:
        """Return room with the first `count` points of each object."""
        return replace(self, points=self.points[:, :count])


def rooms_of(
    scene: Scene,
    views: Views,
    *,
    attributes: Sequence[str] = (),
    count: int = 0,
    source: PointSource = "surface",
    rng: np.random.Generator,
) -> list[tuple[NDArray[np.int64], Room]]:
    """Return rooms of a map, one for each scene that was merged into it, with the rows of their objects.

    Raises `OptionError`: a scene has so many objects that its complete graph is no sense, or
    `source` is neither.

    `scene`, `views`: the map, and what images show of its objects.
    `attributes`: attribute words to count; without any the vectors are zero.
    `count`: length of the vectors of attributes; that of `attributes` if larger.
    `source`: where points come from: spread over the triangles by area, as coarse maps need it, or
        the vertices, the farthest from each other, as of the dense scans of 3RScan.
    `rng`: draws the points, of each room from the same state.
    """
    if source not in {"surface", "vertices"}:
        raise OptionError(f"points is {source!r}; choose 'surface' or 'vertices'.")
    clouds = _Clouds(scene, source)
    made = []
    for part, name in enumerate(scene.scenes):
        rows = np.flatnonzero(scene.scene_of == part)
        if not rows.size:
            continue
        _check_size(rows.size, scene.source or name)
        triples = _triples(scene, rows)
        edges, words = complete_edges(len(rows), triples)
        points, mean = clouds.sample(rows, deepcopy(rng))  # merged or alone, it is the same room
        scene_from_map, seen = scene.scene_from_map[part], views.of(rows)
        turn = scene_from_map[:3, :3]
        room = Room(
            name=name,
            ids=tuple(scene.graph.ids[row] for row in rows),
            labels=tuple(scene.graph.labels[row] for row in rows),
            points=((points - mean) @ turn.T).astype(np.float32),
            offsets=_offsets(clouds.barycentres(rows), triples) @ turn.T,
            edges=edges,
            relations=_counts(edges[:, 0], words, len(rows)),
            attributes=_attributes([scene.attributes[row] for row in rows], attributes, count),
            owner=seen.owner,
            views=seen.features,
            poses=seen.poses(scene_from_map),
        )
        made.append((rows, room))
    return made


def _check_size(count: int, name: str) -> None:
    if count > _MOST:
        raise OptionError(
            f"{name}: a room has {count} objects, but the network relates all pairs and supports "
            f"at most {_MOST}; split the room."
        )


def complete_edges(
    count: int, triples: Sequence[tuple[int, int, int]]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return edges (E, 2) of the complete graph, and the word (E,) that the published data give each.

    Pairs that are annotated come first, once each, then all others. The k-th edge bears the word of
    the k-th triple (subject, row of the word, object): where a pair has two relations, all later
    words are shifted. So it was trained, and so it is here.
    """
    pairs = np.array(
        list(dict.fromkeys((s, t) for s, _, t in triples)), np.int64
    ).reshape(-1, 2)  # fmt: skip
    told = np.eye(count, dtype=np.bool_)
    told[pairs[:, 0], pairs[:, 1]] = True
    edges = np.concatenate([pairs, np.argwhere(~told)])
    words = np.full(len(triples) + len(edges) - len(pairs), RELATIONS.index(NONE), np.int64)
    words[: len(triples)] = [word for _, word, _ in triples]
    return edges, words[: len(edges)]


def barycentre(points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return mean (3,) of the corners of the convex hull of points (n, 3).

    Corners are the farthest points in 1024 directions: all of a box or a plane, and of rounder
    things enough for a mean.
    """
    found = np.unique(points, axis=0).astype(np.float64)
    # directions (3, 1024), evenly spread over the sphere (Fibonacci's lattice)
    k = np.arange(_DIRECTIONS) + 0.5
    z, turn = 1.0 - 2.0 * k / _DIRECTIONS, np.pi * (1.0 + 5.0**0.5) * k
    r = np.sqrt(1.0 - z * z)
    ways = np.stack([r * np.cos(turn), r * np.sin(turn), z])
    corners = [
        part[np.unique((part @ ways).argmax(axis=0))]
        for part in np.split(found, range(_PORTION, len(found), _PORTION))
    ]
    near = np.concatenate(corners)
    return np.asarray(near[np.unique((near @ ways).argmax(axis=0))].mean(axis=0))


class _Clouds:
    """Points of the objects of a map."""

    def __init__(self, scene: Scene, source: PointSource) -> None:
        self.mesh, self.source = scene.mesh, source
        order = np.argsort(self.mesh.object_of, kind="stable")
        ends = np.searchsorted(self.mesh.object_of[order], np.arange(len(scene) + 1))
        self.triangles = [order[a:b] for a, b in pairwise(ends.tolist())]
        self.areas = np.linalg.norm(self.mesh.normals(), axis=1)

    def vertices(self, row: int) -> NDArray[np.float32]:
        """Return (V, 3) of an object."""
        return self.mesh.vertices[np.unique(self.mesh.triangles[self.triangles[row]])]

    def barycentres(self, rows: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return (n, 3) of objects."""
        return np.array([barycentre(self.vertices(row)) for row in rows.tolist()])

    def sample(
        self, rows: NDArray[np.int64], rng: np.random.Generator
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return points (n, 512, 3) of objects, and the mean (3,) of their room."""
        if self.source == "vertices":
            clouds = [self.vertices(row) for row in rows.tolist()]
            points = np.stack([sample_farthest(cloud, POINTS, rng) for cloud in clouds])
            return points, np.concatenate(clouds).mean(axis=0, dtype=np.float64)
        points = np.stack([self._spread(row, rng) for row in rows.tolist()])
        weights = np.array([self.areas[self.triangles[row]].sum() for row in rows.tolist()])
        weights = np.maximum(weights, 1e-12)
        return points, np.average(points.mean(axis=1), axis=0, weights=weights)

    def _spread(self, row: int, rng: np.random.Generator) -> NDArray[np.float64]:
        """Return (512, 3) on the surface of an object, by area."""
        own = self.triangles[row]
        areas = self.areas[own] + 1e-12
        chosen = own[rng.choice(len(own), POINTS, p=areas / areas.sum())]
        a, b, c = np.moveaxis(self.mesh.vertices[self.mesh.triangles[chosen]], 1, 0)
        u, v = rng.random((2, POINTS, 1))
        u, v = np.where(u + v > 1.0, (1.0 - u, 1.0 - v), (u, v))
        return np.asarray(a + u * (b - a) + v * (c - a), np.float64)


def sample_farthest(
    points: NDArray[np.float32], count: int, rng: np.random.Generator
) -> NDArray[np.float64]:
    """`count` of the points (V, 3), each the farthest from those before; drawn where they are fewer."""
    cloud = points.astype(np.float64)
    if len(cloud) < count:
        return cloud[rng.integers(len(cloud), size=count)]
    chosen = np.empty(count, np.int64)
    chosen[0] = rng.integers(len(cloud))
    distance = np.full(len(cloud), np.inf)
    for k in range(1, count):
        apart = ((cloud - cloud[chosen[k - 1]]) ** 2).sum(axis=1)
        distance = np.minimum(distance, apart)
        chosen[k] = distance.argmax()
    return cloud[chosen]


def _triples(scene: Scene, rows: NDArray[np.int64]) -> list[tuple[int, int, int]]:
    """Return relations among some objects (row, row of the word, row) that 3DSSG has a word for."""
    place = {row: k for k, row in enumerate(rows.tolist())}
    graph = scene.graph
    found = []
    for s, name, t in zip(graph.sources.tolist(), graph.relations, graph.targets.tolist(),
                          strict=True):  # fmt: skip
        word = relation_row(name)
        if word and s in place and t in place and s != t:  # "none" is told by being left out
            found.append((place[s], word, place[t]))
    return found


def _offsets(
    barycentres: NDArray[np.float64], triples: Sequence[tuple[int, int, int]]
) -> NDArray[np.float64]:
    """Convert from each object to the root (n, 3): the object most often in annotated pairs, or the first."""
    ends = [row for s, _, t in triples for row in (s, t)]
    root = int(np.bincount(ends, minlength=len(barycentres)).argmax())
    return barycentres[root] - barycentres


def _counts(rows: NDArray[np.int64], words: NDArray[np.int64], count: int) -> NDArray[np.float32]:
    flat = np.bincount(rows * len(RELATIONS) + words, minlength=count * len(RELATIONS))
    return flat.reshape(count, -1).astype(np.float32)


def _attributes(
    attributes: Sequence[Mapping[str, str]], words: Sequence[str], count: int
) -> NDArray[np.float32]:
    """Return counts (n, A) of the words in all groups of attributes: color, material, state, ..."""
    column = {word: k for k, word in enumerate(words)}
    table = np.zeros((len(attributes), max(count, len(words))), np.float32)
    for row, groups in enumerate(attributes):
        for text in groups.values():
            for word in text.lower().split(","):
                if word.strip() in column:
                    table[row, column[word.strip()]] += 1.0
    return table


def batch_rooms(rooms: Sequence[Room], *, device: Any = "cpu") -> Objects:  # noqa: ANN401
    """Return several rooms as the tensors that the network reads, one after the other."""

    def joined(arrays: list[NDArray[Any]]) -> torch.Tensor:
        return torch.from_numpy(np.concatenate(arrays).astype(np.float32)).to(device)

    sizes = tuple(len(room) for room in rooms)
    starts = np.cumsum((0, *sizes[:-1]))
    owner = [r.owner + start for r, start in zip(rooms, starts.tolist(), strict=True)]
    return Objects(
        points=joined([r.points for r in rooms]),
        offsets=joined([r.offsets for r in rooms]),
        edges=tuple(torch.tensor(r.edges, device=device) for r in rooms),
        sizes=sizes,
        relations=joined([r.relations for r in rooms]),
        attributes=joined([r.attributes for r in rooms]),
        owner=torch.from_numpy(np.concatenate(owner)).to(device),
        views=joined([r.views for r in rooms]),
        poses=joined([r.poses for r in rooms]),
    )
