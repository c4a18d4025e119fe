"""A model made sound and as detailed as wanted: units, up axis, broken parts, triangles, textures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import InputError
from placegraph.indoor.map import textures
from placegraph.indoor.map.floor import is_floor
from placegraph.indoor.map.mesh import GRAIN, UV_GRAIN, Mesh, iterate_slices
from placegraph.indoor.map.textures import Detail
from placegraph.indoor.mapping.atlas.bake import ColourOf
from placegraph.indoor.mapping.simplify import simplify
from placegraph.io.mesh.model import Z_UP, Model, ModelObject, Texture

TALLEST = 60.0  # What is higher than this is not in metres, unless a scale is given [m]
FLATTEST, WIDEST = 0.3, 300.0  # What is neither wide nor high by this, or wider, is told [m]
TINIEST = 0.02  # What is smaller is refused, unless a scale is given [m]
ROOM = 2.0, 4.0  # Rooms are this high [m]
LARGEST = 1e5  # Coordinates beyond this [m] are another unit, or damage
_SOME = 200_000  # triangles that are looked at to tell unit and axis


def check_model(model: Model) -> None:
    """Raise `InputError` where a model has no triangle, or one with vertices that are no numbers."""
    if not len(model.triangles):
        what = "is empty" if not len(model.vertices) else "contains points, but no triangles"
        raise InputError(f"{model.path} {what}; a scene map needs a mesh.")
    used = np.zeros(len(model.vertices), np.bool_)
    used[model.triangles.ravel()] = True
    for name, values in (("vertices", model.vertices), ("texture coordinates", model.uv)):
        bad = ~np.isfinite(values).all(axis=1) & used
        if bad.any():
            triangle = int(np.flatnonzero(bad[model.triangles].any(axis=1))[0])
            thing = model.objects[int(model.object_of[triangle])]
            raise InputError(
                f"{model.path}: {int(bad.sum())} {name} are not finite, the first in object "
                f"{thing.name or thing.id!r}; repair the mesh, or delete them."
            )


def convert_to_metres(model: Model, scale: float | None, notes: list[str]) -> Model:
    """Convert a model to metres; one whose size cannot be metres is refused where no scale is given."""
    if scale is not None:
        floor = None if model.floor is None else model.floor * scale
        return replace(model, vertices=model.vertices * scale, floor=floor)
    low, high = np.quantile(_sample_corners(model).reshape(-1, 3), (0.01, 0.99), axis=0)
    sides = high - low
    size = " x ".join(f"{side:,.4g}" for side in sides)
    if sides[2] > TALLEST:
        tiny = sides[2] > 10 * TALLEST or sides.max() > 200 * TALLEST
        unit, factor = ("millimetres", 0.001) if tiny else ("centimetres", 0.01)
        raise InputError(
            f"{model.path} is {size} units large, so its unit seems to be {unit}. Pass "
            f"scale={factor} (--scale {factor}; inches: 0.0254), or scale=1 (--scale 1) if "
            "the unit is the metre."
        )
    if sides.max() < TINIEST:
        raise InputError(
            f"{model.path} is only {size} units large. Pass the metres per unit, such as "
            "scale=1000 (--scale 1000), or scale=1 if it really is that small."
        )
    if sides.max() < FLATTEST or sides.max() > WIDEST:
        only = "only " if sides.max() < FLATTEST else ""
        notes.append(
            f"The mesh is {only}{size} m large; if its unit is not the metre, pass --scale."
        )
    return model


def level_model(model: Model, up: str, notes: list[str]) -> Model:
    """Turn a model so that its labelled floor is level, where `up` is "auto"."""
    if up != "auto":
        return model
    rows = np.array([is_floor(t.label) for t in model.objects], np.bool_)[model.object_of]
    if not rows.any():
        low, high = np.quantile(_sample_corners(model).reshape(-1, 3), (0.01, 0.99), axis=0)
        x, y, z = high - low
        if ROOM[0] < y < ROOM[1] and z > ROOM[1] and y < 0.75 * min(x, z):
            notes.append(
                f"The mesh is {z:.1f} m high, but {y:.1f} m along y, which is the height of "
                "a room; if it lies on its side, pass --up y."
            )
        return model
    corners = model.vertices[model.triangles]
    a, b, c = np.moveaxis(corners[rows], 1, 0)
    along = np.abs(np.cross(b - a, c - a)).sum(axis=0)
    if not along[1] > 2.0 * max(along[0], along[2]):
        return model
    below = corners[rows, :, 1].mean() < corners[:, :, 1].mean()
    notes.append(
        "The floor is vertical in the file, so the mesh was rotated to make "
        f"{('+' if below else '-')}y point up. Pass up (--up) to set the axis."
    )
    turn = Z_UP if below else Z_UP.T
    return replace(model, vertices=model.vertices @ turn.T, floor=None)


def clean_model(
    model: Model, left_out: Counter[str]
) -> tuple[Mesh, list[ModelObject], list[Texture], Any]:
    """Drop triangles without area, and what no triangle needs.

    Textures are placeholders of one texel. Returns also the things and pictures that are left, and
    the new row (N,) of every thing of the model, -1 of those that are left out.
    """
    used, _ = _index_used(model.triangles, len(model.vertices))
    reach = float(np.abs(model.vertices[used]).max())
    if reach > LARGEST:
        span = float(np.ptp(model.vertices[used], axis=0).max())
        mend = (
            "its coordinates seem to be those of a national grid; subtract an offset in "
            "whole metres"
            if span < 0.1 * reach
            else "if it is in millimetres, pass scale=0.001; otherwise move it to its origin"
        )
        raise InputError(f"{model.path} reaches {reach:.3g} m from its origin; {mend}.")
    flat = find_flat_triangles(model.vertices, model.triangles, model.object_of)
    if flat.any():
        left_out["triangles without area"] += int(flat.sum())
    rows = np.flatnonzero(~flat)
    if (np.diff(model.object_of[rows]) < 0).any():
        rows = rows[np.argsort(model.object_of[rows], kind="stable")]
    triangles, object_of, picture_of = (
        column[rows] for column in (model.triangles, model.object_of, model.picture_of)
    )
    corner, compact = _index_used(triangles, len(model.vertices))
    thing, things = _index_used(object_of, len(model.objects))
    picture, pictures = _index_used(picture_of, len(model.pictures))
    missing = len(model.objects) - len(thing)
    if missing:
        left_out["objects without a triangle"] += missing
    mesh = Mesh(
        vertices=model.vertices[corner].astype(np.float32),
        triangles=compact,
        object_of=things,
        colours=model.colours[corner],
        uv=model.uv[corner].astype(np.float32),
        texture_of=pictures,
        textures=(np.zeros((1, 1, 3), np.uint8),) * len(picture),
    )
    row = np.full(len(model.objects), -1)
    row[thing] = np.arange(len(thing))
    return (
        mesh.quantize(),
        [model.objects[i] for i in thing.tolist()],
        [model.pictures[i] for i in picture.tolist()],
        row,
    )


def find_flat_triangles(
    vertices: NDArray[Any], triangles: NDArray[Any], object_of: NDArray[Any]
) -> NDArray[np.bool_]:
    """Find triangles (T,) without area once their corners are snapped, but for the last of an object."""
    flat = np.zeros(len(triangles), np.bool_)
    for part in iterate_slices(len(triangles)):
        a, b, c = np.moveaxis(np.rint(vertices[triangles[part]].astype(np.float64) / GRAIN), 1, 0)
        flat[part] = ~np.cross(b - a, c - a).any(axis=1)
    bare = np.setdiff1d(object_of, object_of[~flat])
    flat &= ~np.isin(object_of, bare)  # an object that is nothing but a line stays one
    return flat


def snap_mesh(mesh: Mesh, grain: float, uv_grain: float) -> Mesh:
    """Snap a mesh to its grid, and drop the triangles that lose their area there."""
    mesh = mesh.quantize(grain, uv_grain)
    keep = ~find_flat_triangles(mesh.vertices, mesh.triangles, mesh.object_of)
    if keep.all():
        return mesh
    return replace(
        mesh,
        triangles=mesh.triangles[keep],
        object_of=mesh.object_of[keep],
        texture_of=mesh.texture_of[keep],
    )


def _sample_corners(model: Model) -> NDArray[np.float64]:
    step = max(len(model.triangles) // _SOME, 1)
    corners: NDArray[np.float64] = model.vertices[model.triangles[::step]]
    return corners


def _index_used(rows: NDArray[Any], count: int) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Return the rows that are used, ascending, and `rows` in terms of these."""
    used = np.zeros(count, np.bool_)
    used[rows.ravel()] = True
    place = np.cumsum(used, dtype=np.int32) - np.int32(1)
    return np.flatnonzero(used), place[rows]


VIVID = 0.1
"""Colours of two ends of an edge that differ by more than this share of the range are a pattern."""
PATTERNED = 0.03
"""Share of patterned edges above which colours are baked into textures."""
BAKED = 2.0  # Triangles of fewer texels than this have colours enough at their vertices
MOST_BAKED = 1_000_000
"""Meshes of more triangles keep the colours of their vertices, to save memory."""
MOST_TEXELS = 1 << 24  # Larger surfaces are coloured by larger texels, to save memory and time
_SAMPLED = 500_000  # triangles that are looked at for it


def reduce_mesh(
    mesh: Mesh,
    pictures: Sequence[Texture],
    colour_of: ColourOf | None,
    detail: Detail,
    left_out: Counter[str],
    notes: list[str],
) -> tuple[Mesh, tuple[bytes, ...]]:
    """Reduce a mesh to the detail that is wanted; also encodes its textures."""
    if detail.error is None:
        blobs = textures.encode_pictures(pictures, detail)
        return snap_mesh(mesh, detail.grain, detail.uv_grain), blobs
    plain = all(p.data is None for p in pictures)
    if plain and (colour_of is not None or _is_patterned(mesh)):
        coarse = simplify(mesh, error=detail.error, left_out=left_out)
        coarse = snap_mesh(coarse, detail.grain, UV_GRAIN)
        if (
            len(coarse) <= MOST_BAKED
            and _measure_area(coarse) > BAKED * len(coarse) * detail.baked**2
        ):
            return _bake_atlas(
                coarse, colour_of or _vertex_colours(mesh, pictures, detail), detail, notes
            )
        return coarse, textures.encode_pictures(pictures, detail)
    needed = textures.measure_needed_texels(mesh, detail.texel)
    with ThreadPoolExecutor(1) as pool:
        encoded = pool.submit(textures.encode_pictures, pictures, detail, needed)
        coarse = simplify(mesh, error=detail.error, colour=VIVID, left_out=left_out)
        return snap_mesh(coarse, detail.grain, detail.uv_grain), encoded.result()


def _vertex_colours(mesh: Mesh, pictures: Sequence[Texture], detail: Detail) -> ColourOf:
    from placegraph.indoor.mapping.atlas.colours import mesh_colours

    flat = textures.decode_textures(textures.encode_pictures(pictures, detail), "a material")
    return mesh_colours(replace(mesh, textures=flat))


def _bake_atlas(
    mesh: Mesh, colour_of: ColourOf, detail: Detail, notes: list[str]
) -> tuple[Mesh, tuple[bytes, ...]]:
    from placegraph.indoor.mapping.atlas.bake import bake

    area = _measure_area(mesh)
    texel = max(detail.baked, float(np.sqrt(area / MOST_TEXELS)))
    if texel > detail.baked:
        notes.append(
            f"The surface of {area:,.0f} m2 has texels of {100 * texel:.2g} cm instead of "
            f"{100 * detail.baked:.2g} cm, because there would be too many."
        )
    painted = bake(mesh, colour_of, texel=texel)
    return painted, textures.encode_arrays(painted.textures, detail.quality)


def _measure_area(mesh: Mesh) -> float:
    return float(np.linalg.norm(mesh.normals(), axis=1).sum()) / 2.0


def _is_patterned(mesh: Mesh) -> bool:
    """Return whether the colours of vertices are a pattern that fewer vertices would lose."""
    some = mesh.triangles[:: len(mesh) // _SAMPLED + 1]
    shades = mesh.colours[some].astype(np.int16)
    steps = np.abs(shades - np.roll(shades, 1, axis=1)).max(axis=2)
    return bool((steps > 255 * VIVID).mean() > PATTERNED)
