"""Label images vote for the faces they show, and votes become one label a face."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera
from placegraph.errors import OptionError
from placegraph.indoor.map.structure import nameless
from placegraph.indoor.mapping.segment.segment_kernels import elect
from placegraph.indoor.rays import RayCaster
from placegraph.io.capture.frame import Frame, LabelKind

if TYPE_CHECKING:
    from placegraph.indoor.mapping.segment.faces import Faces


Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


NOTHING = 0
"""What a pixel without a label votes for."""
_RAYS = 20_000  # of a frame: one in so many pixels is asked that there are about these
_NEAR = 0.05  # a depth reading may differ from the mesh by this [m] ...
_SLOPE = 0.03  # ... and by this share of the depth, else something else is seen
_HALF = 3.0  # at this depth a view counts half as much as close by [m]
_GRAZING = 0.1  # least cosine of incidence that counts
_HELD = 4_000_000  # votes held before those for one face and label are added up
_DOUBT = 0.2
"""Votes that a face has for no label at all: few votes count less than their share."""
_PATCH = 1.0
"""What the opinion of the patch around it is worth to the face's own."""
_CELL = 0.2
"""Side of the cubes that patches fall into for this [m]: pictures may lie in a wall's patch."""
_NEIGHBOURS = 0.7
"""What its neighbours' labels are worth."""
_ROUNDS = 6


@dataclass(frozen=True, slots=True, eq=False)
class Votes:
    """Votes for the labels of faces; a face seen straight on and close by has one a frame."""

    kind: LabelKind
    words: tuple[str, ...]
    """Of the labels; the first is `NOTHING`."""
    ids: tuple[int, ...]
    """Of the labels, as the images have them; -1 of `NOTHING`."""
    starts: Ints
    """(F + 1,) first vote of each face."""
    labels: Ints
    """(K,) rows of words."""
    weights: Floats
    """(K,)"""


def collect(
    faces: Faces,
    frames: Sequence[Frame],
    poses: Floats,
    tell: Callable[[int, int], None],
    left_out: Counter[str],
) -> Votes | None:
    """Votes of frames at poses (T, 4, 4) map_from_camera; None where none of them has labels.

    Rays through pixels find the faces; one that the frame's depth contradicts has no vote. Raises
    `OptionError` where some frames hold labels and others instances.
    """
    kinds = {f.label_kind for f in frames if f.label_kind is not None}
    if not kinds:
        return None
    if len(kinds) > 1:
        raise OptionError("frames: some hold labels, others instances; give those of one kind.")
    box = _Box(kinds.pop(), len(faces))
    caster = RayCaster(faces.points, faces.corners)
    for i, (frame, pose) in enumerate(zip(frames, poses, strict=True)):
        tell(i, len(frames))
        image = frame.labels()
        if image is None:
            left_out["frames without labels"] += 1
            continue
        if not np.isfinite(pose).all():
            left_out["frames without a pose"] += 1
            continue
        face, pixel, weight = _seen(faces, caster, frame, pose, image.shape[:2], i)
        label = box.rows(frame, image)[pixel]
        if (label < 0).any():
            left_out["pixels whose label has no name"] += int((label < 0).sum())
        box.put(face[label >= 0], label[label >= 0], weight[label >= 0])
    return box.votes()


class _Box:
    """Votes as they come in."""

    def __init__(self, kind: LabelKind, count: int) -> None:
        self.kind = kind
        self.count = count
        self.words = [""]
        self.ids = [-1]
        self._row: dict[object, int] = {}
        self._keys: list[Ints] = []
        self._weights: list[Floats] = []
        self._held = 0

    def rows(self, frame: Frame, image: NDArray[np.int32]) -> Ints:
        """Rows of words (H * W,) of an image's pixels; -1 where a label has no name."""
        values, back = np.unique(image.ravel(), return_inverse=True)
        meant = [self._row_of(int(v), frame.label_names) for v in values]
        return np.array(meant, np.int64)[back]

    def _row_of(self, value: int, names: dict[int, str]) -> int:
        if value < 0:
            return NOTHING
        word = names.get(value, "")
        if self.kind == "labels" and not word:
            return -1
        if nameless(word):
            if self.kind == "labels":
                return NOTHING
            word = ""
        key: object = value if self.kind == "instances" else word.strip().casefold()
        if key not in self._row:
            self._row[key] = len(self.words)
            self.words.append(word.strip())
            self.ids.append(value)
        return self._row[key]

    def put(self, face: Ints, label: Ints, weight: Floats) -> None:
        """Votes of one frame: each face has its mean weight, shared by its labels."""
        if not len(face):
            return
        key, row, hits = np.unique(face << 20 | label, return_inverse=True, return_counts=True)
        own = key >> 20
        of_face = np.bincount(face, minlength=self.count)
        mean = np.bincount(row, weight, len(key)) / hits
        self._keys.append(key)
        self._weights.append(mean * hits / of_face[own])
        self._held += len(key)
        if self._held > _HELD:
            self._settle()

    def _settle(self) -> None:
        key, row = np.unique(
            np.concatenate([np.zeros(0, np.int64), *self._keys]), return_inverse=True
        )
        weights = np.concatenate([np.zeros(0), *self._weights])
        sums = np.asarray(np.bincount(row, weights, len(key)), np.float64)
        self._keys, self._weights = [key], [sums]
        self._held = 0

    def votes(self) -> Votes:
        """All votes, by face."""
        self._settle()
        (key,), (weights,) = self._keys, self._weights
        starts = np.searchsorted(key >> 20, np.arange(self.count + 1))
        labels = key & ((1 << 20) - 1)
        return Votes(self.kind, tuple(self.words), tuple(self.ids), starts, labels, weights)


def _seen(
    faces: Faces, caster: RayCaster, frame: Frame, pose: Floats, shape: tuple[int, ...], turn: int
) -> tuple[Ints, Ints, Floats]:
    """Faces (N,) that a frame shows, the pixels (N,) that show them, and what these weigh (N,)."""
    camera = frame.label_camera or frame.camera
    height, width = shape
    step = max(int(np.ceil(np.sqrt(height * width / _RAYS))), 1)
    # other pixels in every frame: small faces are hit in some
    v, u = np.mgrid[turn % step : height : step, turn // step % step : width : step]
    v, u = v.ravel(), u.ravel()
    rays = camera.directions(np.stack([u, v], axis=1) + 0.5)
    ways = rays @ pose[:3, :3].T
    hits = caster.cast(pose[:3, 3], ways)
    depth = hits.distance.astype(np.float64)
    good = (hits.triangle >= 0) & ~_contradicted(frame, rays, depth)
    face = hits.triangle[good].astype(np.int64)
    along = ways[good] / np.linalg.norm(ways[good], axis=1, keepdims=True)
    cosine = np.abs((along * faces.normals[face]).sum(axis=1))
    weight = np.maximum(cosine, _GRAZING) / (1.0 + (depth[good] / _HALF) ** 2)
    return face, (v * width + u)[good], weight


def _contradicted(frame: Frame, rays: Floats, depth: Floats) -> NDArray[np.bool_]:
    """Rays (N,) on which the frame measured another depth (N,) [m] than the mesh has."""
    out = np.zeros(len(rays), np.bool_)
    measured, camera = frame.depth(), frame.depth_camera
    if measured is None or camera is None:
        return out
    column, row, inside = _pixels(camera, rays)
    reading = measured[row[inside], column[inside]].astype(np.float64)
    with np.errstate(invalid="ignore"):
        off = np.abs(reading - depth[inside]) > _NEAR + _SLOPE * reading
    out[inside] = off & np.isfinite(reading)
    return out


def _pixels(camera: Camera, rays: Floats) -> tuple[Ints, Ints, NDArray[np.bool_]]:
    """Columns and rows (N,) of rays in an image, and whether they lie in it (N,)."""
    uv = np.floor(camera.project(rays))
    inside = (uv >= 0).all(axis=1) & (uv[:, 0] < camera.width) & (uv[:, 1] < camera.height)
    whole = np.where(inside[:, None], uv, 0.0).astype(np.int64)
    return whole[:, 0], whole[:, 1], inside


def label_faces(faces: Faces, votes: Votes, patch: Ints, steps: Floats) -> Ints:
    """Row of `votes.words` (F,) of each face; `NOTHING` where none is said or known.

    A face's score for a label is its own share of votes, that of its patch around it by area, and
    the share of its neighbours that bear the label, across steps (P,) less.
    """
    patch = _local(faces, patch)
    count = len(votes.words)
    face = np.repeat(np.arange(len(faces)), np.diff(votes.starts))
    total = np.bincount(face, votes.weights, len(faces)) + _DOUBT
    share = votes.weights / total[face]
    patches = int(patch.max()) + 1
    weighed = share * faces.areas[face]
    table = np.bincount(patch[face] * count + votes.labels, weighed, patches * count)
    seen = np.zeros(len(faces), np.bool_)
    seen[face] = True
    area = np.bincount(patch, faces.areas * seen, patches)
    shares = table.reshape(patches, count) / np.maximum(area, 1e-12)[:, None]
    links = np.exp(-(np.minimum(steps, 20.0) ** 2)) * faces.lengths
    labels = np.where(area[patch] > 0, np.argmax(shares, axis=1)[patch], -1)
    for _ in range(_ROUNDS):
        labels = elect(
            votes.starts, votes.labels, share, patch, shares, faces.pairs, links, labels,
            _PATCH, _NEIGHBOURS,
        )  # fmt: skip
    return np.maximum(labels, 0)


def _local(faces: Faces, patch: Ints) -> Ints:
    """Patches (F,) cut by a grid of cubes."""
    columns = [patch, *np.floor(faces.centres / _CELL).astype(np.int64).T]
    order = np.lexsort(columns)
    fresh = np.ones(len(patch), np.bool_)
    fresh[1:] = np.any([np.diff(column[order]) != 0 for column in columns], axis=0)
    out = np.empty(len(patch), np.int64)
    out[order] = np.cumsum(fresh) - 1
    return out
