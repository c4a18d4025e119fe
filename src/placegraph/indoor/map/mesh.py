"""The coarse mesh of a scene map: triangles that know their object and their colour.

The colour of a point of a triangle is always the interpolated corner colour, as a share of 255,
times the texel under its interpolated texture coordinates: a flat material is a texture of one
texel, a mesh without textures has one white one. All colours are sRGB.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.core.pickling import PickleFields
from placegraph.errors import OptionError

GRAIN = 2.0**-13
"""Step of vertices [m], 0.12 mm; a power of two, so that float32 holds multiples exactly."""
UV_GRAIN = 2.0**-14  # Step of texture coordinates: a sixteenth of a texel of 1024
_PORTION = 1 << 19  # rows
_MAX_STEPS = 1 << 22  # of 24 bits that float32 has: sums of two coordinates are exact too

WHITE = np.full((1, 1, 3), 255, np.uint8)
WHITE.flags.writeable = False


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Mesh(PickleFields):
    """V vertices, T triangles and K textures; arrays are read-only and checked.

    Raises `OptionError`: arrays do not fit each other, a row points nowhere, a number is not
    finite.
    """

    vertices: NDArray[np.float32]
    """(V, 3) float32 [m], map axes."""
    triangles: NDArray[np.int32]
    """(T, 3) int32, rows of vertices."""
    object_of: NDArray[np.int32]
    """(T,) int32, rows of objects."""
    colours: NDArray[np.uint8]
    """(V, 3) uint8, sRGB; 255 where the texture alone speaks."""
    uv: NDArray[np.float32]
    """(V, 2) float32 texture coordinates, v down, repeated beyond [0, 1)."""
    texture_of: NDArray[np.int32]
    """(T,) int32, rows of textures."""
    textures: Sequence[NDArray[np.uint8]]
    """K arrays (h, w, 3) uint8, sRGB; at least one. Those of a map file are decoded on first use."""

    def __post_init__(self) -> None:
        v, t = len(self.vertices), len(self.triangles)
        for name, dtype, shape in (
            ("vertices", np.float32, (v, 3)), ("triangles", np.int32, (t, 3)),
            ("object_of", np.int32, (t,)), ("colours", np.uint8, (v, 3)),
            ("uv", np.float32, (v, 2)), ("texture_of", np.int32, (t,)),
        ):  # fmt: skip
            _put(self, name, _column(name, getattr(self, name), dtype, shape))
        if not self.textures:
            raise OptionError("textures: the list is empty; give at least one white texel.")
        if isinstance(self.textures, tuple | list):
            _put(self, "textures", tuple(_texture(i, a) for i, a in enumerate(self.textures)))
        for name, count in (("triangles", v), ("texture_of", len(self.textures))):
            _rows(name, getattr(self, name), count)
        _rows("object_of", self.object_of, None)
        for name in ("vertices", "uv"):
            if not np.isfinite(getattr(self, name)).all():
                raise OptionError(f"{name}: a number is not finite; drop such vertices.")

    @classmethod
    def plain(
        cls,
        vertices: ArrayLike,
        triangles: ArrayLike,
        object_of: ArrayLike | None = None,
        colours: ArrayLike | None = None,
    ) -> Mesh:
        """Return mesh without textures; of one object and white where nothing else is given."""
        points = np.asarray(vertices, np.float32)
        corners = np.asarray(triangles, np.int32)
        one = np.zeros(len(corners), np.int32)
        return cls(
            vertices=points,
            triangles=corners,
            object_of=one if object_of is None else np.asarray(object_of, np.int32),
            colours=np.full(points.shape, 255, np.uint8)
            if colours is None
            else np.asarray(colours, np.uint8),
            uv=np.zeros((len(points), 2), np.float32),
            texture_of=one,
            textures=(WHITE,),
        )

    def __len__(self) -> int:
        return len(self.triangles)

    def __repr__(self) -> str:
        return (
            f"Mesh({len(self):,} triangles, {len(self.vertices):,} vertices, "
            f"{len(self.textures)} textures)"
        )

    def bounds(self) -> NDArray[np.float64]:
        """Return (2, 3) float64, lowest and highest corner [m]; NaN of a mesh without vertices."""
        if not len(self.vertices):
            return np.full((2, 3), np.nan)
        return np.array([(column.min(), column.max()) for column in self.vertices.T], np.float64).T

    def object_bounds(self, count: int) -> NDArray[np.float64]:
        """Return (count, 2, 3) float64, box of each object's triangles [m]; NaN where it has none.

        Raises `OptionError` where there are more than `count` objects.
        """
        _rows("object_of", self.object_of, count)
        boxes = np.full((count, 2, 3), np.nan)
        order = np.argsort(self.object_of, kind="stable")
        rows, starts = np.unique(self.object_of[order], return_index=True)
        if rows.size:
            corners = self.vertices[self.triangles[order]]  # (T, 3 corners, 3)
            boxes[rows, 0] = np.minimum.reduceat(corners.min(axis=1), starts)
            boxes[rows, 1] = np.maximum.reduceat(corners.max(axis=1), starts)
        return boxes

    def normals(self) -> NDArray[np.float64]:
        """Return (T, 3) float64 normals, twice as long as the triangles' areas [m2]."""
        normals = np.empty((len(self), 3))
        for part in iterate_slices(len(self)):
            a, b, c = np.moveaxis(self.vertices[self.triangles[part]].astype(np.float64), 1, 0)
            normals[part] = np.cross(b - a, c - a)
        return normals

    def colour_at(
        self, triangle: NDArray[np.int32], u: NDArray[np.float32], v: NDArray[np.float32]
    ) -> NDArray[np.uint8]:
        """Return colours (N, 3) uint8 of hits: triangles (N,), barycentrics of corners 1 and 2 (N,).

        The nearest texel speaks. Rows of triangle -1 (nothing hit) are black.
        """
        hit = np.flatnonzero(triangle >= 0)
        out = np.zeros((len(triangle), 3), np.uint8)
        rows = triangle[hit]
        shares = np.stack([1.0 - u[hit] - v[hit], u[hit], v[hit]], axis=1)[:, :, None]
        corners = self.triangles[rows]
        corner_colour = (self.colours[corners] * shares).sum(axis=1) / 255.0
        uv = (self.uv[corners] * shares).sum(axis=1)
        texels, starts, sizes = self.texels()
        which = self.texture_of[rows]
        size = sizes[which]
        at = np.floor(uv * size).astype(np.int64) % size
        texel = texels[starts[which] + at[:, 1] * size[:, 0] + at[:, 0]]
        out[hit] = np.clip(np.rint(corner_colour * texel), 0, 255)
        return out

    def texels(self) -> tuple[NDArray[np.uint8], NDArray[np.int64], NDArray[np.int64]]:
        """Return all textures as one array, for compiled code.

        Returns texels (P, 3) uint8, the first texel of each texture (K,) int64, and widths and
        heights (K, 2) int64; texel (x, y) of texture k is row `start[k] + y * width[k] + x`.
        """
        sizes = np.array([(a.shape[1], a.shape[0]) for a in self.textures], np.int64)
        counts = sizes.prod(axis=1)
        flat = np.concatenate([a.reshape(-1, 3) for a in self.textures])
        return flat, np.cumsum(counts) - counts, sizes

    def translate(self, shift: ArrayLike) -> Mesh:
        """Return mesh shifted by (3,) [m]."""
        return replace(self, vertices=self.vertices + np.asarray(shift, np.float64))

    def quantize(self, grain: float = GRAIN, uv_grain: float = UV_GRAIN) -> Mesh:
        """Return mesh whose coordinates are multiples of steps, as a map file holds them.

        `grain` [m] and `uv_grain` are powers of two from `GRAIN` and `UV_GRAIN` on; steps are
        coarser only where coordinates are so large (beyond 512 m) that float32 demands it.
        """
        rounded = {}
        for name, least in (("vertices", grain), ("uv", uv_grain)):
            values = getattr(self, name)
            step = np.float32(_least_step(values, least))
            rounded[name] = np.rint(values / step).astype(np.float32) * step
        return replace(self, **rounded)

    def steps(self) -> tuple[float, float]:
        """Return steps of vertices [m] and of texture coordinates: the longest whose multiples they are.

        These are `GRAIN` and `UV_GRAIN` or 2^k times them.
        """
        return _step(self.vertices, GRAIN), _step(self.uv, UV_GRAIN)


def iterate_slices(count: int) -> Iterator[slice]:
    """Return slices of `count` rows, so many at a time that what is computed of them stays small."""
    for start in range(0, count, _PORTION):
        yield slice(start, min(start + _PORTION, count))


def _least_step(values: NDArray[np.float32], least: float) -> float:
    largest = float(np.abs(values).max(initial=0.0))
    over = int(np.ceil(np.log2(max(largest / least / _MAX_STEPS, 1.0))))
    return least * 2.0**over


def _step(values: NDArray[np.float32], least: float) -> float:
    step = _least_step(values, least)
    bits = int(np.bitwise_or.reduce(np.rint(values / np.float32(step)).astype(np.int64), axis=None))
    return step * (bits & -bits) if bits else step


def _put(mesh: Mesh, field: str, value: object) -> None:
    object.__setattr__(mesh, field, value)


def _column(name: str, values: Any, dtype: Any, shape: tuple[int, ...]) -> NDArray[Any]:  # noqa: ANN401
    array = np.asarray(values)
    if array.shape != shape and not (array.size == 0 and 0 in shape):
        raise OptionError(f"{name}: shape is {array.shape}, expected {shape}.")
    kinds = "iu" if np.dtype(dtype).kind in "iu" else "fiu"
    if array.size and array.dtype.kind not in kinds:
        raise OptionError(f"{name}: {array.dtype} where {np.dtype(dtype)} belongs.")
    limits = np.iinfo(dtype) if kinds == "iu" else None
    if limits and array.size and not limits.min <= array.min() <= array.max() <= limits.max:
        raise OptionError(f"{name}: a number does not fit into {np.dtype(dtype)}.")
    with np.errstate(over="ignore"):
        column = np.ascontiguousarray(array.reshape(shape), dtype)
    if column is values:
        column = column.view()  # the caller's own array stays writeable
    column.flags.writeable = False
    return column


def _texture(row: int, values: Any) -> NDArray[np.uint8]:  # noqa: ANN401
    array = np.asarray(values)
    if array.dtype != np.uint8 or array.ndim != 3 or array.shape[2] != 3 or not array.size:
        raise OptionError(
            f"textures: {row} is {array.dtype} {array.shape}, expected uint8 of shape (h, w, 3)."
        )
    texture = np.ascontiguousarray(array).view()
    texture.flags.writeable = False
    return texture


def _rows(name: str, rows: NDArray[np.int32], count: int | None) -> None:
    if rows.size and (int(rows.min()) < 0 or (count is not None and int(rows.max()) >= count)):
        raise OptionError(
            f"{name}: a row index is outside 0 to {('...' if count is None else count - 1)}."
        )


def sort_triangles(mesh: Mesh) -> Mesh:
    """Sort a mesh part by connected part and fan by fan; drops unused vertices."""
    from placegraph.indoor.map.map_kernels import order_fans

    by_object = np.argsort(mesh.object_of, kind="stable")
    corners = mesh.triangles[by_object].astype(np.int64)
    order, number, count = order_fans(corners, len(mesh.vertices))
    rows = by_object[order]
    vertex = np.empty(count, np.int64)
    used = np.flatnonzero(number >= 0)
    vertex[number[used]] = used
    return replace(
        mesh,
        vertices=mesh.vertices[vertex],
        triangles=number[corners[order]].astype(np.int32),
        object_of=mesh.object_of[rows],
        colours=mesh.colours[vertex],
        uv=mesh.uv[vertex],
        texture_of=mesh.texture_of[rows],
    )


def encode_high_water(triangles: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return codes (3 T,) of triangles (T, 3)."""
    from placegraph.indoor.map.map_kernels import encode_rows

    codes = np.empty(triangles.size, np.int32)
    encode_rows(triangles.ravel(), codes)
    return codes


def decode_high_water(codes: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return triangles (T, 3) of `encode_high_water` codes (3 T,)."""
    new = codes == 0
    level = np.cumsum(new, dtype=np.int32) - new
    return (level - codes).reshape(-1, 3)


MIN_ATLAS_CHARTS = 100
"""A texture of more charts than this is an atlas; in one of fewer, neighbours look alike."""

BLEED = 0.1  # Share of a texture's surface whose charts may be mixed with their neighbours


class Surface(NamedTuple):
    """T triangles of V vertices with K textures of up to L mip levels, as plain arrays."""

    triangles: NDArray[np.int32]  # (T, 3)
    object_of: NDArray[np.int32]  # (T,)
    colours: NDArray[np.uint8]  # (V, 3) sRGB
    uv: NDArray[np.float32]  # (V, 2)
    texture_of: NDArray[np.int32]  # (T,)
    texels_per_metre: NDArray[np.float32]  # (T,) at level 0
    levels: NDArray[np.int32]  # (K, L, 3) first texel, width, height; the last level is repeated
    texels: NDArray[np.uint8]  # (M, 3) sRGB of all levels of all textures

    @classmethod
    def of(cls, mesh: Mesh) -> Surface:
        """Return surface of a mesh."""
        most = _useful_levels(mesh)
        pyramids = [_pyramid(t, n) for t, n in zip(mesh.textures, most.tolist(), strict=True)]
        depth = max(len(p) for p in pyramids)
        levels = np.zeros((len(pyramids), depth, 3), np.int32)
        first = 0
        for k, pyramid in enumerate(pyramids):
            for level in range(depth):
                h, w = pyramid[min(level, len(pyramid) - 1)].shape[:2]
                if level < len(pyramid):
                    start, first = first, first + w * h
                levels[k, level] = start, w, h
        return cls(
            triangles=mesh.triangles,
            object_of=mesh.object_of,
            colours=mesh.colours,
            uv=mesh.uv,
            texture_of=mesh.texture_of,
            texels_per_metre=_density(mesh, levels[:, 0, 1:]),
            levels=levels,
            texels=np.concatenate([level.reshape(-1, 3) for p in pyramids for level in p]),
        )


def _useful_levels(mesh: Mesh) -> NDArray[np.int64]:
    """Return mip levels (K,) of each texture beyond the first that hold what belongs together.

    A texture of many charts mixes neighbours that have nothing to do with each other as soon as a
    texel is as wide as half a chart: the shorter side that all but `BLEED` of the surface has decides.
    """
    sizes = np.array([(a.shape[1], a.shape[0]) for a in mesh.textures], np.float64)
    most = np.ceil(np.log2(sizes.max(axis=1))).astype(np.int64)
    if not len(mesh) or (most == 0).all():
        return most
    from placegraph.indoor.map.map_kernels import label_charts  # compiled

    chart = label_charts(mesh.triangles, len(mesh.vertices))[mesh.triangles[:, 0]]
    rows, chart = np.unique(chart, return_inverse=True)
    uv = mesh.uv[mesh.triangles]
    low, high = np.full((len(rows), 2), np.inf), np.full((len(rows), 2), -np.inf)
    np.minimum.at(low, chart, uv.min(axis=1))
    np.maximum.at(high, chart, uv.max(axis=1))
    texture = np.zeros(len(rows), np.int64)
    texture[chart] = mesh.texture_of
    side = np.minimum((high - low) * sizes[texture], sizes[texture]).min(axis=1)
    area = np.bincount(chart, np.linalg.norm(mesh.normals(), axis=1), len(rows))
    for k in np.flatnonzero(most > 0).tolist():
        own = np.flatnonzero((texture == k) & (side > 0))
        whole = (side[own] >= 0.5 * sizes[k].min()).any()  # one chart has it all
        if own.size > MIN_ATLAS_CHARTS and not whole:
            order = own[np.argsort(side[own])]
            total = np.cumsum(area[order])
            least = side[order[np.searchsorted(total, BLEED * total[-1])]]
            most[k] = min(most[k], max(int(np.log2(max(least, 2.0) / 2.0)), 1))
    return most


def _pyramid(texture: NDArray[np.uint8], most: int) -> list[NDArray[np.uint8]]:
    """Return texture (h, w, 3) and its halves, quarters, ... down to one texel, or `most` of them."""
    from PIL import Image

    out = [texture]
    while max(out[-1].shape[:2]) > 1 and len(out) <= most:
        h, w = out[-1].shape[:2]
        smaller = Image.fromarray(out[-1]).resize(
            (max(1, w // 2), max(1, h // 2)), Image.Resampling.BOX
        )
        out.append(np.asarray(smaller))
    return out


def _density(mesh: Mesh, sizes: NDArray[np.int32]) -> NDArray[np.float32]:
    """Return texels per metre (T,) along the denser side of each triangle's texture."""
    density = np.empty(len(mesh), np.float32)
    for part in iterate_slices(len(mesh)):
        corners, uv = mesh.vertices[mesh.triangles[part]], mesh.uv[mesh.triangles[part]]
        uv = uv * sizes[mesh.texture_of[part]][:, None, :]
        edges, spans = (np.linalg.norm(c - np.roll(c, 1, axis=1), axis=2) for c in (corners, uv))
        with np.errstate(divide="ignore", invalid="ignore"):
            density[part] = np.where(edges > 0, spans / edges, 0.0).max(axis=1)
    return density
