"""Smooth patches of one colour, and the graph of their contacts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from placegraph.indoor.mapping.segment import segment_kernels as kernels
from placegraph.indoor.mapping.segment.faces import Faces, Samples

if TYPE_CHECKING:
    from placegraph.indoor.mapping.segment.segments import SegmentOptions


Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


_CONVEX = 0.4
"""A convex edge is worth this share of a concave one of the same angle."""
_CONCAVE = 0.3
"""Neighbours that bend inwards by more than this are in a concave contact [rad]."""
_SPECK = 0.1
"""Patches below this share of `SegmentOptions.patch` are none."""


@dataclass(frozen=True, slots=True, eq=False)
class PatchGraph:
    """N patches and E contacts between them."""

    of_face: Ints
    """(F,)"""
    areas: Floats
    """(N,) [m2]"""
    normals: Floats
    """(N,) mean, shorter than 1 where the patch is curved (N, 3)."""
    low: Floats
    """(N, 3) lowest corner of the box [m]."""
    high: Floats
    """(N, 3)"""
    lab: Floats
    """(N, 3) mean colour."""
    plane: Ints
    """(N,) row of the structure's plane, -1: none."""
    ends: Ints
    """(E, 2) rows of patches, each contact in both directions."""
    lengths: Floats
    """(E,) of contact [m]."""
    concave: Floats
    """(E,) share in which the second lies on the outer side of the first."""

    def __len__(self) -> int:
        return len(self.areas)


def cut_patches(
    faces: Faces,
    normals: Floats,
    lab: Floats,
    plane_of: Ints,
    outward: bool,
    options: SegmentOptions,
) -> Ints:
    """Patch (F,) of each face, numbered from 0; none spans two planes of the structure."""
    weights = step_weights(faces, normals, lab, outward, options)
    a, b = faces.pairs.T
    weights[plane_of[a] != plane_of[b]] = np.inf
    order = np.argsort(weights, kind="stable")
    root = kernels.join(
        faces.pairs, weights, order, faces.areas, 0.5 * options.patch, _SPECK * options.patch
    )
    return np.unique(root, return_inverse=True)[1]


def step_weights(
    faces: Faces, normals: Floats, lab: Floats, outward: bool, options: SegmentOptions
) -> Floats:
    """How much of a step there is from face to face (P,): 1 at the options' bend or contrast."""
    bends = faces.bends(normals) * (1.0 if outward else -1.0)
    bends = np.where(bends < 0, -_CONVEX * bends, bends)
    a, b = faces.pairs.T
    shade = np.sqrt(((lab[a] - lab[b]) ** 2).sum(axis=1))
    out: Floats = np.hypot(bends / options.bend, shade / options.contrast)
    return out


def describe(
    faces: Faces,
    normals: Floats,
    patch: Ints,
    plane_of: Ints,
    outward: bool,
    options: SegmentOptions,
) -> PatchGraph:
    """Patches with their contacts: edges, and gaps between parts that no edge joins."""
    count = int(patch.max()) + 1 if len(patch) else 0
    areas = np.asarray(np.bincount(patch, faces.areas, count), np.float64)
    order = np.argsort(patch, kind="stable")
    starts = np.searchsorted(patch[order], np.arange(count))
    corners = faces.points[faces.corners[order]]
    plane = plane_of[order[starts]]
    ends, lengths, concave = _contacts(faces, normals, patch, plane, outward, options)
    return PatchGraph(
        of_face=patch,
        areas=areas,
        normals=_means(patch, normals, faces.areas, areas) * (1.0 if outward else -1.0),
        low=np.minimum.reduceat(corners.min(axis=1), starts),
        high=np.maximum.reduceat(corners.max(axis=1), starts),
        lab=_means(patch, faces.lab, faces.areas, areas),
        plane=plane,
        ends=ends,
        lengths=lengths,
        concave=concave,
    )


def _means(patch: Ints, values: Floats, weights: Floats, areas: Floats) -> Floats:
    sums = [np.bincount(patch, values[:, k] * weights, len(areas)) for k in range(3)]
    out: Floats = np.stack(sums, axis=1) / areas[:, None]
    return out


def _contacts(
    faces: Faces, normals: Floats, patch: Ints, plane: Ints, outward: bool, options: SegmentOptions
) -> tuple[Ints, Floats, Floats]:
    """Contacts in both directions: ends (E, 2), lengths (E,) [m], concave shares (E,)."""
    side = 1.0 if outward else -1.0
    a, b = patch[faces.pairs].T
    bends = faces.bends(normals) * side
    across = a != b
    edge = np.stack([a, b], axis=1)[across]
    inward = (bends > _CONCAVE)[across].astype(np.float64)
    length = faces.lengths[across]

    shell = kernels.connect(len(faces), faces.pairs)
    loose = np.flatnonzero(plane[patch] < 0)
    spread = Samples.of(faces, loose, 0.8 * options.gap)
    rows = spread.touching(shell, options.gap)
    way = spread.spots[rows[:, 1]] - spread.spots[rows[:, 0]]
    far = np.sqrt((way * way).sum(axis=1))
    own = normals[spread.face[rows[:, 0]]] * side
    other = normals[spread.face[rows[:, 1]]] * side
    over = (way * own).sum(axis=1) > 0.2 * np.maximum(far, 1e-9)
    over |= (own * other).sum(axis=1) < -0.7  # one lies flat on the other
    touch = patch[spread.face[rows]]
    each = spread.step**2 / max(options.gap, spread.step)

    ends = np.concatenate([edge, edge[:, ::-1], touch])
    lengths = np.concatenate([length, length, np.full(len(touch), each)])
    concave = np.concatenate([inward, inward, over.astype(np.float64)])
    key, row = np.unique(ends[:, 0] * (len(plane) + 1) + ends[:, 1], return_inverse=True)
    total = np.asarray(np.bincount(row, lengths, len(key)), np.float64)
    share = np.bincount(row, lengths * concave, len(key)) / np.maximum(total, 1e-12)
    out = np.stack([key // (len(plane) + 1), key % (len(plane) + 1)], axis=1)
    return out, total, share
