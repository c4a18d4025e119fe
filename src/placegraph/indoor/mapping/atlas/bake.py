"""Baking: the colours of a mesh, seen at every texel, become a small texture atlas."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.core.threads import run_parallel
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.mapping.atlas import bake_kernels as kernels

Ints = NDArray[np.int64]

CONE = np.cos(np.radians(45.0))  # Normals of a chart lie within this of their mean as it grows
STEEP = np.cos(np.radians(75.0))
"""No triangle of a chart is steeper than this to its plane: it would get too few texels."""
SMALL = 150.0  # Charts of a smaller area [texels] rather join a neighbour
ROUNDS = 6
_ANGLES = np.radians(np.arange(0.0, 90.0, 3.0))
_GAIN = 0.1  # a rectangle that is not upright must be this much smaller


@dataclass(frozen=True, eq=False)
class Charts:
    """C charts of T triangles."""

    of: Ints  # (T,) chart of each triangle
    corners: Floats
    """(T, 3, 2) corners on the chart's plane, from the lowest corner of its rectangle [m]."""
    sizes: Floats  # (C, 2) width and height of each chart's rectangle [m]

    def group_triangles(self) -> tuple[Ints, Ints]:
        """Group triangles by chart; also where each chart starts (C + 1,)."""
        return _group_rows(self.of, len(self.sizes), None)


def cut_charts(mesh: Mesh, neighbours: Ints, texel: float, longest: int) -> Charts:
    """Cut a mesh into charts without overlaps, none longer than `longest` texels.

    A triangle that is longer than that by itself is a chart of its own. `neighbours` as from
    `find_neighbours`; `texel` [m].
    """
    doubled = mesh.normals()
    areas = 0.5 * np.linalg.norm(doubled, axis=1)
    normals = doubled / np.maximum(2.0 * areas, 1e-30)[:, None]
    points = mesh.vertices[mesh.triangles].astype(np.float64)
    order = np.argsort(-areas, kind="stable")
    of = np.full(len(mesh), -1, np.int64)
    laid = _Layout(np.zeros((0, 2, 3)), np.zeros((0, 2)), np.zeros((0, 2)))
    for round_ in range(ROUNDS):
        first = len(laid.axes)
        count = kernels.grow(normals, areas, neighbours, order, of, first, CONE)
        if round_ == 0:
            planes = _mean_normals(doubled, of, count)
            small = np.bincount(of, areas, count) < SMALL * texel**2
            kernels.absorb(normals, neighbours, of, planes, small, STEEP)
        laid = laid.with_new(points, doubled, of, texel * longest)
        plane = np.cross(laid.axes[:, 0], laid.axes[:, 1])  # away from who looks at the surface
        steep = -np.einsum("tk,tk->t", normals, plane[of]) < STEEP
        rows, starts = _group_rows(of, len(laid.axes), -areas)
        extents = laid.sizes / texel
        grids = np.maximum(np.ceil(extents - 1e-6), 1.0)
        corners = laid.corners(points, of) / texel + (0.5 * (grids - extents))[of][:, None]
        twice = np.zeros(len(of), bool)  # lies over a larger one of its chart, at texels' centres
        run_parallel(kernels.mark_overlaps, len(grids), corners, rows, starts, grids, twice)
        bad = (of >= first) & ((steep & (areas > 0)) | twice)
        if not bad.any():
            break
        of[bad] = -1
    single = np.flatnonzero(of < 0)  # whatever cannot lie with others lies alone
    if len(single):
        of[single] = len(laid.axes) + np.arange(len(single))
        laid = laid.with_new(points, doubled, of, np.inf)
    used, of = np.unique(of, return_inverse=True)
    laid = _Layout(laid.axes[used], laid.low[used], laid.sizes[used])
    return Charts(of.reshape(-1), laid.corners(points, of.reshape(-1)), laid.sizes)


def find_neighbours(mesh: Mesh) -> Ints:
    """Find the triangle across each side (T, 3), of the same object; -1: none.

    Vertices at one place count as one. Where more than two triangles share a side, two and two do.
    """
    places = np.ascontiguousarray(mesh.vertices + np.float32(0.0))  # no -0
    _, welded = np.unique(places.view([("", "V12")]).ravel(), return_inverse=True)
    corners = welded.reshape(-1)[mesh.triangles.astype(np.int64)]
    ends = np.sort(corners[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edge = ends[:, 0] * len(mesh.vertices) + ends[:, 1]
    object_of = np.repeat(mesh.object_of, 3)
    order = np.lexsort((object_of, edge))
    edge, object_of = edge[order], object_of[order]
    new = np.r_[True, (edge[1:] != edge[:-1]) | (object_of[1:] != object_of[:-1])]
    first = np.maximum.accumulate(np.where(new, np.arange(len(edge)), 0))
    odd = (np.arange(len(edge)) - first) % 2 == 1
    second = np.flatnonzero(odd)
    out = np.full(len(edge), -1, np.int64)
    out[order[second]] = order[second - 1] // 3
    out[order[second - 1]] = order[second] // 3
    return out.reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class _Layout:
    """Layout of C charts. It stays when a triangle is taken out, so that what was checked holds."""

    axes: Floats  # (C, 2, 3) right and down, unit vectors
    low: Floats  # (C, 2) where each chart's rectangle starts along them [m]
    sizes: Floats  # (C, 2) [m]

    def corners(self, points: Floats, of: Ints) -> Floats:
        """Return corners (T, 3, 2) on the charts' rectangles of triangles (T, 3, 3) [m]."""
        return np.einsum("tkn,tan->tka", points, self.axes[of]) - self.low[of][:, None]

    def with_new(self, points: Floats, doubled: Floats, of: Ints, limit: float) -> _Layout:
        """Add the new charts, halved where they are longer than `limit` [m]; changes `of`."""
        first = len(self.axes)
        _renumber(of, first)
        fresh = np.flatnonzero(of >= first)
        placed = points[fresh]
        while True:
            own = of[fresh] - first
            count = int(own.max()) + 1
            upright = _upright_axes(_mean_normals(doubled[fresh], own, count))
            rows, starts = _group_rows(own, count, None)
            corners = np.einsum("tkn,tan->tka", placed, upright[own])
            angle = kernels.turns(corners, rows, starts, _ANGLES, _GAIN)
            cosine, sine = np.cos(angle)[:, None], np.sin(angle)[:, None]
            right, down = upright[:, 0], upright[:, 1]
            axes = np.stack([cosine * right + sine * down, cosine * down - sine * right], axis=1)
            corners = np.einsum("tkn,tan->tka", placed, axes[own])[rows]
            low = np.minimum.reduceat(corners.min(axis=1), starts[:-1])
            made = _Layout(axes, low, np.maximum.reduceat(corners.max(axis=1), starts[:-1]) - low)
            middle = made.corners(placed, own).mean(axis=1)  # (F, 2)
            length, side = made.sizes.max(axis=1), made.sizes.argmax(axis=1)
            along = np.take_along_axis(middle, side[own][:, None], axis=1)[:, 0]
            beyond = (length[own] > limit) & (along > 0.5 * length[own])
            # a chart whose triangles all lie on one side cannot be halved there
            beyond &= (np.bincount(own, beyond) < np.bincount(own))[own]
            if not beyond.any():
                pairs = ((self.axes, made.axes), (self.low, made.low), (self.sizes, made.sizes))
                return _Layout(*(np.concatenate(pair) for pair in pairs))
            of[fresh[beyond]] += len(made.axes)
            _renumber(of, first)


def _renumber(of: Ints, first: int) -> None:
    """Renumber charts from `first` on so that none is empty, in place."""
    fresh = of >= first
    of[fresh] = np.unique(of[fresh], return_inverse=True)[1].reshape(-1) + first


def _mean_normals(doubled: Floats, of: Ints, count: int) -> Floats:
    """Return mean unit normals (C, 3); up where a chart has no area."""
    total = np.stack([np.bincount(of, doubled[:, k], count) for k in range(3)], axis=1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 0, total / np.maximum(length, 1e-30), (0.0, 0.0, 1.0))


def _upright_axes(planes: Floats) -> Floats:
    """Return axes right and down (C, 2, 3) of planes (C, 3) as seen from in front; upright for walls."""
    down = np.broadcast_to([0.0, 0.0, -1.0], planes.shape)
    level = np.abs(planes[:, 2:]) > 0.95
    down = np.where(level, (0.0, -1.0, 0.0), down)
    down = down - planes * np.einsum("ck,ck->c", down, planes)[:, None]
    down = down / np.linalg.norm(down, axis=1, keepdims=True)
    return np.stack([np.cross(planes, down), down], axis=1)


def _group_rows(of: Ints, count: int, within: Floats | None) -> tuple[Ints, Ints]:
    """Group triangles chart by chart, ascending by `within` (T,), and where each chart starts (C + 1,)."""
    rows = np.argsort(of, kind="stable") if within is None else np.lexsort((within, of))
    starts = np.searchsorted(of[rows], np.arange(count + 1))
    return rows, starts.astype(np.int64)


Bytes = NDArray[np.uint8]

SHADES = 4  # Charts of one colour share a texel with those that differ by less than this [of 255]
_PATCH = 4  # texels a side of one shared colour: a block of chroma and its surrounding
_SHEET = 16  # patches a side of a sheet of shared colours
GRAIN = 2  # Rectangles lie on multiples of this: chroma of 2 x 2 texels is never that of two charts
SIDE = 16
"""A page's sides are multiples of this: its first four halves are exact, and JPEG's blocks whole."""


@dataclass(eq=False)
class ChartImages:
    """Images of C charts."""

    step: Floats  # (C,) width of a texel of level 0 [m]
    levels: NDArray[np.int32]
    """(C,) halvings of the resolution; FLAT: one colour; DARK: nothing seen."""
    means: Floats  # (C, 3) mean colours
    sizes: Ints
    """(C, 2) width and height of the images, margins included; 0 of charts of one colour."""
    texels: list[Bytes]  # (h * w, 3) of each batch of charts
    valid: list[NDArray[np.bool_]]
    sums: Floats  # (T, 3) of the colours seen on each triangle
    counts: Floats  # (T,)

    def light_up(self, charts: Charts, neighbours: Ints, object_of: NDArray[np.int32]) -> None:
        """Give charts of which nothing is known their neighbours' colour, or their object's."""
        dark = self.levels == kernels.DARK
        if not dark.any():
            return
        valid = self.counts > 0
        colours = self.sums / np.maximum(self.counts, 1)[:, None]
        of_object = _average_groups(object_of, colours, valid)
        kernels.spread(neighbours, colours, valid)
        colours = np.where(valid[:, None], colours, of_object[object_of])
        every = np.ones(len(colours), bool)
        self.means[dark] = _average_groups(charts.of, colours, every, len(self.levels))[dark]
        self.levels[dark] = kernels.FLAT


def assemble_mesh(mesh: Mesh, charts: Charts, sheets: ChartImages, largest: int) -> Mesh:
    """Return mesh with all images on pages."""
    flat = sheets.levels < 0
    drawn = np.flatnonzero(~flat)
    cells, of = np.unique(np.rint(sheets.means[flat] / SHADES), axis=0, return_inverse=True)
    of = of.reshape(-1)
    number = np.maximum(np.bincount(of, minlength=len(cells)), 1)
    sums = [np.bincount(of, sheets.means[flat][:, k], len(cells)) for k in range(3)]
    shades = np.rint(np.stack(sums, axis=1) / number[:, None]).astype(np.uint8)
    order = np.argsort(shades.astype(np.int64).sum(axis=1), kind="stable")
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    shades, shade_of = shades[order], rank[of]
    across = max(min(_SHEET, int(np.ceil(np.sqrt(len(shades))))), 1)  # patches side by side
    each = across**2
    cards = -(-len(shades) // each)
    page, places, pages = pack(
        np.concatenate([sheets.sizes[drawn], np.full((cards, 2), across * _PATCH, np.int64)]),
        largest,
        np.append(sheets.means[drawn].sum(axis=1), np.zeros(cards)),
    )
    canvases = [np.zeros((h, w, 3), np.uint8) for w, h in pages.tolist()]
    masks = [np.zeros((h, w), bool) for w, h in pages.tolist()]
    _paste_images(sheets, drawn, page, places, canvases, masks)
    for card in range(cards):
        k, (x, y) = int(page[len(drawn) + card]), places[len(drawn) + card]
        for i, shade in enumerate(shades[card * each : (card + 1) * each]):
            row, column = divmod(i, across)
            area = np.s_[y + row * _PATCH :, x + column * _PATCH :]
            canvases[k][area][:_PATCH, :_PATCH] = shade
            masks[k][area][:_PATCH, :_PATCH] = True
    # where each chart lies: its corner on the page, or the middle of its shade
    count = len(sheets.levels)
    page_of, origin = np.zeros(count, np.int64), np.zeros((count, 2))
    page_of[drawn] = page[: len(drawn)]
    card_of, at = np.divmod(shade_of, each)
    page_of[flat] = page[len(drawn) + card_of]
    cell = np.stack([at % across, at // across], axis=1)
    origin[flat] = places[len(drawn) + card_of] + (cell + 0.5) * _PATCH
    scale = np.where(flat, 0.0, 1.0 / (sheets.step * np.exp2(np.maximum(sheets.levels, 0))))
    inner = sheets.sizes[drawn] - 2 * MARGIN
    centring = 0.5 * (inner - charts.sizes[drawn] * scale[drawn, None])
    origin[drawn] = places[: len(drawn)] + MARGIN + centring
    key = np.arange(count)
    key[flat] = count + shade_of  # charts of one shade share their vertices
    uv = origin[charts.of][:, None] + charts.corners * scale[charts.of][:, None, None]
    uv /= pages[page_of][charts.of][:, None]
    return _split_vertices(mesh, key[charts.of], uv, page_of[charts.of], [
        fill_unknown(canvas, mask) for canvas, mask in zip(canvases, masks, strict=True)
    ])  # fmt: skip


def _average_groups(
    of: NDArray[Any], colours: Floats, valid: NDArray[np.bool_], count: int | None = None
) -> Floats:
    """Average the known colours of each group (N, 3); of everything where none is known."""
    count = int(of.max()) + 1 if count is None else count
    number = np.bincount(of[valid], minlength=count)
    sums = np.stack([np.bincount(of[valid], colours[valid, k], count) for k in range(3)], axis=1)
    overall = colours[valid].mean(axis=0) if valid.any() else np.full(3, 128.0)
    return np.where(number[:, None] > 0, sums / np.maximum(number, 1)[:, None], overall)


def _paste_images(
    sheets: ChartImages,
    drawn: Ints,
    page: Ints,
    places: Ints,
    canvases: list[Bytes],
    masks: list[NDArray[np.bool_]],
) -> None:
    texels, valid = np.concatenate(sheets.texels), np.concatenate(sheets.valid)
    start = 0
    for i, (w, h) in enumerate(sheets.sizes[drawn].tolist()):
        x, y = places[i].tolist()
        area, part = np.s_[y : y + h, x : x + w], np.s_[start : start + w * h]
        canvases[int(page[i])][area] = texels[part].reshape(h, w, 3)
        masks[int(page[i])][area] = valid[part].reshape(h, w)
        start += w * h


def _split_vertices(mesh: Mesh, key: Ints, uv: Floats, page: Ints, pages: list[Bytes]) -> Mesh:
    span = int(key.max()) + 1
    corner = mesh.triangles.astype(np.int64) * span + key[:, None]
    used, first, rows = np.unique(corner, return_index=True, return_inverse=True)
    return Mesh(
        vertices=mesh.vertices[used // span],
        triangles=rows.reshape(-1, 3).astype(np.int32),
        object_of=mesh.object_of,
        colours=np.full((len(used), 3), 255, np.uint8),
        uv=uv.reshape(-1, 2)[first].astype(np.float32),
        texture_of=page.astype(np.int32),
        textures=tuple(pages),
    )


def pack(sizes: Ints, largest: int, shade: NDArray[Any]) -> tuple[Ints, Ints, Ints]:
    """Pack rectangles (R, 2) width, height on pages no longer than `largest`.

    Returns the page (R,) and corner (R, 2) of each, and sizes (K, 2) of the pages. Rectangles of one
    height lie beside those of like `shade` (R,): coarse copies of a page mix neighbours.
    """
    room = -(-sizes // GRAIN) * GRAIN
    order = np.lexsort((shade, -room[:, 1]))
    width = max(int(np.sqrt(1.05 * room.prod(axis=1).sum())), int(room[:, 0].max(initial=1)))
    width = min(-(-width // SIDE) * SIDE, largest)
    page, places = np.zeros(len(sizes), np.int64), np.zeros((len(sizes), 2), np.int64)
    x = y = shelf = k = 0
    heights = []
    for row, (wide, high) in zip(order.tolist(), room[order].tolist(), strict=True):
        if x + wide > width:  # a new shelf, as high as its first rectangle
            x, y, shelf = 0, y + shelf, 0
        if x == 0 and y + high > largest:
            heights.append(y)
            y, k = 0, k + 1
        shelf = max(shelf, high)
        page[row], places[row] = k, (x, y)
        x += wide
    heights.append(y + shelf)
    pages = [(width, min(-(-max(h, 1) // SIDE) * SIDE, largest)) for h in heights]
    return page, places, np.array(pages, np.int64)


def fill_unknown(texels: NDArray[np.uint8], valid: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Fill the unknown texels of a page (h, w, 3) smoothly from those that are known (h, w).

    Means of known texels are taken over squares that double, then handed down: what lies next to a
    chart has its colour, what is far from all costs next to nothing.
    """
    weights = [valid.astype(np.float32)]
    means = [texels * weights[0][:, :, None]]
    while max(weights[-1].shape) > 1:
        weight, mean = (_halve(a) for a in (weights[-1], means[-1]))
        mean /= np.maximum(weight, 1e-6)[:, :, None]
        weight = np.minimum(weight, 1.0)
        weights.append(weight)
        means.append(mean * weight[:, :, None])
    below: NDArray[Any] = means[-1] / np.maximum(weights[-1], 1e-6)[:, :, None]
    for weight, mean in zip(weights[-2::-1], means[-2::-1], strict=True):
        wide = _double(below, weight.shape)
        below = mean + (1.0 - weight[:, :, None]) * wide
    out = np.clip(np.rint(below), 0, 255).astype(np.uint8)
    out[valid] = texels[valid]
    return out


def _halve(array: NDArray[Any]) -> NDArray[Any]:
    """Return sums over squares of 2 x 2; what is missing at the edge is 0."""
    h, w = array.shape[:2]
    padded = np.pad(array, [(0, h % 2), (0, w % 2), *[(0, 0)] * (array.ndim - 2)])
    rows = padded[::2] + padded[1::2]
    out: NDArray[Any] = rows[:, ::2] + rows[:, 1::2]
    return out


def _double(array: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    """Return array twice as large, cut to `shape`, smooth between the texels' centres."""
    for axis in (0, 1):
        before, after = (np.roll(array, s, axis) for s in (1, -1))
        index: list[Any] = [slice(None)] * 3
        index[axis] = slice(0, 1)
        before[tuple(index)] = array[tuple(index)]
        index[axis] = slice(-1, None)
        after[tuple(index)] = array[tuple(index)]
        pair = np.stack([0.75 * array + 0.25 * before, 0.75 * array + 0.25 * after], axis + 1)
        new = list(array.shape)
        new[axis] *= 2
        array = pair.reshape(new)
    return array[: shape[0], : shape[1]]


ColourOf: TypeAlias = Callable[[Floats, Floats, Ints], tuple[Bytes, NDArray[np.bool_]]]
"""Colours (N, 3) uint8 sRGB of a surface, and whether they are known (N,), at points (N, 3) [m, map]
with unit normals (N, 3) on triangles (N,)."""

TOLERANCE = 5.0
"""Maximum error of a smaller chart, of 255 (root mean square over 8 x 8 texels)."""
LONGEST = 256
"""Charts longer than this [texels] are cut, so that the dull part of a wall can be smaller."""
_BATCH = 1 << 19  # texels a call of `colour_of`
MARGIN = 1  # Texels around each chart, which bilinear filters touch


def bake(
    mesh: Mesh,
    colour_of: ColourOf,
    *,
    texel: float = 0.01,
    largest: int = 2048,
    tolerance: float = TOLERANCE,
) -> Mesh:
    """Bake the colours of a mesh into a texture atlas; triangles stay.

    Charts of similar normal are laid flat, coloured by `colour_of` at every texel of `texel` [m],
    made as coarse as their content allows (within `tolerance` of 255), and packed on pages of at most
    `largest` texels a side. Charts of one colour share a few texels, so that blank walls cost
    nothing. Unseen parts look like their neighbours. Vertices are doubled where charts meet.
    """
    if not len(mesh):
        return mesh
    neighbours = find_neighbours(mesh)
    room = largest - 2 * MARGIN - 2
    charts = cut_charts(mesh, neighbours, texel, min(room, LONGEST))
    step = np.maximum(texel, charts.sizes.max(axis=1) / room)  # one triangle may be a whole hall
    sheets = _paint_charts(mesh, charts, colour_of, step, tolerance)
    sheets.light_up(charts, neighbours, mesh.object_of)
    return assemble_mesh(mesh, charts, sheets, largest)


def _paint_charts(
    mesh: Mesh, charts: Charts, colour_of: ColourOf, step: Floats, tolerance: float
) -> ChartImages:
    extents = charts.sizes / step[:, None]
    grids = np.maximum(np.ceil(extents - 1e-6), 1).astype(np.int64) + 2 * MARGIN
    rows, starts = charts.group_triangles()
    corners = charts.corners / step[charts.of][:, None, None]
    count, ends = len(grids), np.cumsum(grids.prod(axis=1))
    sheets = ChartImages(
        step, np.zeros(count, np.int32), np.zeros((count, 3)), np.zeros((count, 2), np.int64), [],
        [], np.zeros((len(mesh), 3)), np.zeros(len(mesh)),
    )  # fmt: skip
    points, normals = mesh.vertices[mesh.triangles].astype(np.float64), mesh.normals()
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    first = 0
    while first < count:
        done = int(ends[first - 1]) if first else 0
        last = max(int(np.searchsorted(ends, done + _BATCH, "right")), first + 1)
        part = slice(first, last)
        firsts = ends[part] - grids[part].prod(axis=1) - done
        total = int(ends[last - 1]) - done
        owner, shares = np.full(total, -1, np.int32), np.zeros((total, 2), np.float32)
        run_parallel(
            kernels.cover, last - first, corners, rows, starts[first : last + 1], grids[part],
            extents[part], firsts, MARGIN, owner, shares,
        )  # fmt: skip
        at = np.flatnonzero(owner >= 0)
        own = owner[at].astype(np.int64)
        u, v = (shares[at, k, None].astype(np.float64) for k in (0, 1))
        a, b, c = np.moveaxis(points[own], 1, 0)
        found, seen = colour_of(a + u * (b - a) + v * (c - a), normals[own], own)
        colours, state = np.zeros((total, 3), np.uint8), np.zeros(total, np.uint8)
        colours[at], state[at] = found, np.where(seen, kernels.SEEN, kernels.UNSEEN)
        np.add.at(sheets.counts, own[seen], 1)
        for k in range(3):
            sheets.sums[:, k] += np.bincount(own[seen], found[seen, k], len(mesh))
        _coarsen_charts(
            sheets, part, (colours, state, grids[part], extents[part], firsts, MARGIN), tolerance
        )
        first = last
    return sheets


def _coarsen_charts(
    sheets: ChartImages, part: slice, grids: tuple[Any, ...], tolerance: float
) -> None:
    levels, means = sheets.levels[part], sheets.means[part]  # views
    run_parallel(kernels.choose, len(levels), *grids, tolerance, levels, means)
    scale = np.exp2(np.maximum(levels, 0))[:, None]
    sizes = np.maximum(np.ceil(grids[3] / scale - 1e-6), 1).astype(np.int64) + 2 * MARGIN
    sizes[levels < 0] = 0
    sheets.sizes[part] = sizes
    counts = sizes.prod(axis=1)
    texels = np.zeros((int(counts.sum()), 3), np.uint8)
    valid = np.zeros(len(texels), bool)
    run_parallel(
        kernels.draw, len(levels), *grids, levels, np.cumsum(counts) - counts, texels, valid
    )
    sheets.texels.append(texels)
    sheets.valid.append(valid)
