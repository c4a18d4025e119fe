"""Faces of a mesh as cutting sees them, and the smooth patches of one colour they form."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.core.geometry import Floats
from placegraph.indoor.map.textures import linear_from_srgb
from placegraph.indoor.mapping.segment import segment_kernels as kernels

if TYPE_CHECKING:
    from placegraph.indoor.mapping.segment import SegmentOptions

Ints = NDArray[np.int64]

_WELD = 1e-4  # Corners closer than about this are one [m]: seams of textures come as two
_FARTHEST = 1e9 * _WELD
_MOST = 6_000_000  # More points than this are not spread: their distance grows instead


@dataclass(frozen=True, slots=True, eq=False)
class Faces:
    """F faces with W corners and P pairs of neighbours."""

    points: Floats  # (W, 3) [m]
    corners: Ints  # (F, 3) rows of points
    normals: Floats  # (F, 3) unit
    areas: Floats  # (F,) [m2]
    centres: Floats  # (F, 3) [m]
    lab: Floats  # (F, 3) CIELAB
    pairs: Ints  # (P, 2) rows of faces that share an edge
    lengths: Floats  # (P,) of that edge [m]
    turned: NDArray[np.bool_]  # (P,) whether the two are wound against each other
    of_triangle: Ints
    """(T,) row of each triangle of the mesh; -1: it has no area, or is no triangle at all."""

    def __len__(self) -> int:
        return len(self.areas)

    @classmethod
    def of(cls, vertices: ArrayLike, triangles: ArrayLike, colours: ArrayLike) -> Faces:
        """Return faces of a mesh: vertices (V, 3) [m], triangles (T, 3), colours (V, 3) uint8."""
        spots, rows = np.asarray(vertices, np.float64), np.asarray(triangles, np.int64)
        of_triangle = np.full(len(rows), -1, np.int64)
        with np.errstate(invalid="ignore"):
            good = np.asarray((np.abs(spots) < _FARTHEST).all(axis=1))
        sound = np.flatnonzero(good[rows].all(axis=1)) if len(rows) else np.zeros(0, np.int64)
        points, corner_of = _weld_corners(spots, rows[sound])
        corners = corner_of[rows[sound]]
        crossed = _cross(points, corners)
        a, b, c = corners.T
        apart = (a != b) & (b != c) & (c != a)
        whole = (np.linalg.norm(crossed, axis=1) > 0) & apart
        sound, corners = sound[whole], corners[whole]
        first, face_of = _drop_twins(corners)
        of_triangle[sound] = face_of
        sums = np.zeros((len(first), 3))
        shades = np.asarray(colours, np.float64)[rows[sound]].sum(axis=1) if len(sound) else sums
        counts = np.maximum(3.0 * np.bincount(face_of, minlength=len(first)), 1.0)
        for axis in range(3):  # whole numbers: their sums do not depend on the order
            sums[:, axis] = np.bincount(face_of, shades[:, axis], len(first)) / counts
        corners = corners[first]
        crossed = _cross(points, corners)
        doubled = np.linalg.norm(crossed, axis=1)
        pairs, lengths, turned = _find_neighbours(points, corners)
        return cls(
            points=points,
            corners=corners,
            normals=crossed / doubled[:, None],
            areas=doubled / 2.0,
            centres=points[corners].mean(axis=1) if len(corners) else np.zeros((0, 3)),
            lab=convert_to_lab(sums),
            pairs=pairs,
            lengths=lengths,
            turned=turned,
            of_triangle=of_triangle,
        )

    def smooth(self, rounds: int) -> tuple[Floats, Floats]:
        """Return normals (F, 3) and colours (F, 3) CIELAB, levelled over neighbours that bend little."""
        return kernels.smooth(self.normals, self.lab, self.areas, self.pairs, self.turned, rounds)

    def bends(self, normals: Floats) -> Floats:
        """Return angles (P,) between neighbours [rad]: above 0 concave, below convex, by these normals."""
        a, b = self.pairs.T
        other = np.where(self.turned[:, None], -normals[b], normals[b])
        cosine = np.clip(np.einsum("ij,ij->i", normals[a], other), -1.0, 1.0)
        way = self.centres[b] - self.centres[a]
        inward = np.einsum("ij,ij->i", way, normals[a] - other) > 0
        angle = np.arccos(cosine)
        out: Floats = np.where(inward, angle, -angle)
        return out


def convert_to_lab(rgb: Floats) -> Floats:
    """Convert sRGB colours (N, 3), 0 to 255, to CIELAB (N, 3), D65."""
    linear = linear_from_srgb(np.asarray(rgb, np.float64) / 255.0)
    # rows of the sRGB matrix, divided by the white point
    matrix = np.array(
        [
            [0.4339533, 0.3762192, 0.1898275],
            [0.2126729, 0.7151522, 0.0721750],
            [0.0177566, 0.1094687, 0.8727747],
        ]
    )
    # element by element: a product of matrices may round otherwise in other places of the array
    xyz = np.stack([sum(linear[:, k] * row[k] for k in range(3)) for row in matrix], axis=1)
    f = np.where(xyz > 216 / 24389, np.cbrt(xyz), (24389 / 27 * xyz + 16) / 116)
    x, y, z = f.T
    out: Floats = np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=1)
    return out


def _cross(points: Floats, corners: Ints) -> Floats:
    a, b, c = points[corners[:, 0]], points[corners[:, 1]], points[corners[:, 2]]
    out: Floats = np.cross(b - a, c - a).reshape(-1, 3)
    return out


def _weld_corners(vertices: Floats, triangles: Ints) -> tuple[Floats, Ints]:
    """Weld corners to points (W, 3), ordered by coordinates; also the point of each vertex (V,)."""
    used = np.zeros(len(vertices), np.bool_)
    used[triangles.ravel()] = True
    rows = np.flatnonzero(used)
    spots = vertices[rows]
    grid = np.rint(spots / _WELD).astype(np.int64)
    order = np.lexsort((*spots.T, *grid.T))
    changes = np.zeros(len(rows), np.bool_)
    if len(rows):
        changes[0] = True
        changes[1:] = (np.diff(grid[order], axis=0) != 0).any(axis=1)
    corner_of = np.zeros(len(vertices), np.int64)
    corner_of[rows[order]] = np.cumsum(changes) - 1
    return spots[order[changes]], corner_of


def _drop_twins(corners: Ints) -> tuple[Ints, Ints]:
    """First triangle (F,) of each set of corners, and the set of each triangle (T,).

    What is modelled from both sides comes twice, wound both ways; the same winding comes first
    whatever the order of the file.
    """
    low_first = np.sort(corners, axis=1)
    turns = (np.argmin(corners, axis=1) + np.array([[0], [1], [2]])) % 3
    a, b, c = (np.take_along_axis(corners, t[:, None], axis=1)[:, 0] for t in turns)
    odd = b > c
    order = np.lexsort((odd, low_first[:, 2], low_first[:, 1], a))
    changes = np.zeros(len(corners), np.bool_)
    if len(corners):
        changes[0] = True
        changes[1:] = (np.diff(low_first[order], axis=0) != 0).any(axis=1)
    face_of = np.empty(len(corners), np.int64)
    face_of[order] = np.cumsum(changes) - 1
    return order[changes], face_of


def _find_neighbours(points: Floats, corners: Ints) -> tuple[Ints, Floats, NDArray[np.bool_]]:
    """Find pairs of faces (P, 2) with a common edge, its length (P,), and whether both run along it alike.

    At an edge of more than two faces each is paired with the next.
    """
    count = len(corners)
    start = corners[:, [0, 1, 2]].ravel()
    end = corners[:, [1, 2, 0]].ravel()
    low, high = np.minimum(start, end), np.maximum(start, end)
    key = low * max(len(points), 1) + high
    order = np.argsort(key, kind="stable")
    same = np.flatnonzero(np.diff(key[order]) == 0) if count else np.zeros(0, np.int64)
    one, two = order[same], order[same + 1]
    pairs = np.stack([one // 3, two // 3], axis=1)
    along = points[low[one]] - points[high[one]]
    return pairs, np.sqrt((along * along).sum(axis=1)), start[one] == start[two]


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """S points, each in one face."""

    spots: Floats  # (S, 3) [m]
    face: Ints  # (S,) rows of faces
    step: float  # About their distance [m]

    @classmethod
    def of(cls, faces: Faces, rows: Ints, step: float) -> Samples:
        """Return points about `step` [m] apart on the faces `rows` (R,); at least one on each."""
        corners = faces.corners[rows]
        parts = kernels.sample_counts(faces.points, corners, step)
        while (parts.astype(np.float64) ** 2).sum() > _MOST + len(rows):
            step *= 1.5
            parts = kernels.sample_counts(faces.points, corners, step)
        spots, row = kernels.samples(faces.points, corners, parts)
        return cls(spots, rows[row], step)

    def find_touching(self, group: Ints, reach: float) -> Ints:
        """Return rows (K, 2) of points of different groups (F,) of faces that are within `reach` [m]."""
        if not len(self.spots):
            return np.zeros((0, 2), np.int64)
        reach = max(reach, self.step)
        low = self.spots.min(axis=0) - reach
        kept = self._thinned(group, low)
        spots, own = self.spots[kept], group[self.face[kept]]
        shape = ((self.spots.max(axis=0) - low) / reach).astype(np.int64) + 3
        keys = kernels.cell_keys(spots, low, reach, shape)
        order = np.argsort(keys, kind="stable")
        return kept[kernels.find_touching(spots, own, order, keys[order], shape, reach)]

    def _thinned(self, group: Ints, low: Floats) -> Ints:
        """Return one point (N,) of each group in a cube of side `step`, the first of them."""
        shape = ((self.spots.max(axis=0) - low) / self.step).astype(np.int64) + 3
        keys = kernels.cell_keys(self.spots, low, self.step, shape)
        order = np.lexsort((group[self.face], keys))
        where, whose = keys[order], group[self.face[order]]
        fresh = np.ones(len(order), np.bool_)
        fresh[1:] = (np.diff(where) != 0) | (np.diff(whose) != 0)
        return np.sort(order[fresh])


_CONVEX = 0.4  # A convex edge is worth this share of a concave one of the same angle
_CONCAVE = 0.3  # Neighbours that bend inwards by more than this are in a concave contact [rad]
_SPECK = 0.1  # Patches below this share of `SegmentOptions.patch` are none


@dataclass(frozen=True, slots=True, eq=False)
class PatchGraph:
    """N patches and E contacts between them."""

    of_face: Ints  # (F,)
    areas: Floats  # (N,) [m2]
    normals: Floats  # (N,) mean, shorter than 1 where the patch is curved (N, 3)
    low: Floats  # (N, 3) lowest corner of the box [m]
    high: Floats  # (N, 3)
    lab: Floats  # (N, 3) mean colour
    plane: Ints  # (N,) row of the structure's plane, -1: none
    ends: Ints  # (E, 2) rows of patches, each contact in both directions
    lengths: Floats  # (E,) of contact [m]
    concave: Floats  # (E,) share in which the second lies on the outer side of the first

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
    """Cut faces into patches (F,), numbered from 0; none spans two planes of the structure."""
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
    """Weigh the steps from face to face (P,): 1 at the options' bend or contrast."""
    bends = faces.bends(normals) * (1.0 if outward else -1.0)
    bends = np.where(bends < 0, -_CONVEX * bends, bends)
    a, b = faces.pairs.T
    shade = np.sqrt(((lab[a] - lab[b]) ** 2).sum(axis=1))
    out: Floats = np.hypot(bends / options.crease, shade / options.contrast)
    return out


def describe_patches(
    faces: Faces,
    normals: Floats,
    patch: Ints,
    plane_of: Ints,
    outward: bool,
    options: SegmentOptions,
) -> PatchGraph:
    """Describe patches and their contacts: edges, and gaps between parts that no edge joins."""
    count = int(patch.max()) + 1 if len(patch) else 0
    areas = np.asarray(np.bincount(patch, faces.areas, count), np.float64)
    order = np.argsort(patch, kind="stable")
    starts = np.searchsorted(patch[order], np.arange(count))
    corners = faces.points[faces.corners[order]]
    plane = plane_of[order[starts]]
    ends, lengths, concave = _find_contacts(faces, normals, patch, plane, outward, options)
    return PatchGraph(
        of_face=patch,
        areas=areas,
        normals=_average_patches(patch, normals, faces.areas, areas) * (1.0 if outward else -1.0),
        low=np.minimum.reduceat(corners.min(axis=1), starts),
        high=np.maximum.reduceat(corners.max(axis=1), starts),
        lab=_average_patches(patch, faces.lab, faces.areas, areas),
        plane=plane,
        ends=ends,
        lengths=lengths,
        concave=concave,
    )


def _average_patches(patch: Ints, values: Floats, weights: Floats, areas: Floats) -> Floats:
    sums = [np.bincount(patch, values[:, k] * weights, len(areas)) for k in range(3)]
    out: Floats = np.stack(sums, axis=1) / areas[:, None]
    return out


def _find_contacts(
    faces: Faces, normals: Floats, patch: Ints, plane: Ints, outward: bool, options: SegmentOptions
) -> tuple[Ints, Floats, Floats]:
    """Find contacts in both directions: ends (E, 2), lengths (E,) [m], concave shares (E,)."""
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
    rows = spread.find_touching(shell, options.gap)
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
