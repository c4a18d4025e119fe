"""A mesh with as much detail as wanted: fewer triangles, smaller pictures, patterns in an atlas."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from placegraph.indoor.map import textures
from placegraph.indoor.map.detail import Detail
from placegraph.indoor.map.mesh import UV_GRAIN, Mesh
from placegraph.indoor.mapping.atlas import ColourOf
from placegraph.indoor.mapping.clean import snapped
from placegraph.indoor.mapping.simplify.simplify import simplify
from placegraph.io.mesh.model import Picture

VIVID = 0.1
"""Colours of two ends of an edge that differ by more than this share of the range are a pattern."""
PATTERNED = 0.03
"""Where more than this share of the edges have a pattern, colours are baked into textures."""
BAKED = 2.0
"""Triangles of fewer texels than this have colours enough at their vertices."""
MOST_BAKED = 1_000_000
"""Meshes of more triangles keep the colours of their vertices, to save memory."""
MOST_TEXELS = 1 << 24
"""Larger surfaces are coloured by larger texels, to save memory and time."""
_SOME = 500_000  # triangles that are looked at for it


def reduced(
    mesh: Mesh,
    pictures: Sequence[Picture],
    colour_of: ColourOf | None,
    detail: Detail,
    left_out: Counter[str],
    notes: list[str],
) -> tuple[Mesh, tuple[bytes, ...]]:
    """Mesh and encoded textures with as much detail as wanted."""
    if detail.error is None:
        blobs = textures.encode_pictures(pictures, detail)
        return snapped(mesh, detail.grain, detail.uv_grain), blobs
    plain = all(p.data is None for p in pictures)
    if plain and (colour_of is not None or _patterned(mesh)):
        coarse = simplify(mesh, error=detail.error, left_out=left_out)
        coarse = snapped(coarse, detail.grain, UV_GRAIN)
        if len(coarse) <= MOST_BAKED and _area(coarse) > BAKED * len(coarse) * detail.baked**2:
            return _baked(coarse, colour_of or _looks(mesh, pictures, detail), detail, notes)
        return coarse, textures.encode_pictures(pictures, detail)
    needed = textures.needed_texels(mesh, detail.texel)
    blobs = textures.encode_pictures(pictures, detail, needed)
    coarse = simplify(mesh, error=detail.error, colour=VIVID, left_out=left_out)
    return snapped(coarse, detail.grain, detail.uv_grain), blobs


def _looks(mesh: Mesh, pictures: Sequence[Picture], detail: Detail) -> ColourOf:
    """Colours of a mesh's vertices and flat materials."""
    from placegraph.indoor.mapping.atlas import mesh_colours

    flat = textures.decode(textures.encode_pictures(pictures, detail), "a material")
    return mesh_colours(replace(mesh, textures=flat))


def _baked(
    mesh: Mesh, colour_of: ColourOf, detail: Detail, notes: list[str]
) -> tuple[Mesh, tuple[bytes, ...]]:
    """Mesh whose colours stand in a small texture atlas instead of at many vertices."""
    from placegraph.indoor.mapping.atlas import bake

    area = _area(mesh)
    texel = max(detail.baked, float(np.sqrt(area / MOST_TEXELS)))
    if texel > detail.baked:
        notes.append(
            f"Its surface of {area:,.0f} m2 is coloured by texels of {100 * texel:.2g} cm instead of "
            f"{100 * detail.baked:.2g} cm: there would be too many."
        )
    painted = bake(mesh, colour_of, texel=texel)
    return painted, textures.encode_arrays(painted.textures, detail.quality)


def _area(mesh: Mesh) -> float:
    """Area [m2]."""
    return float(np.linalg.norm(mesh.normals(), axis=1).sum()) / 2.0


def _patterned(mesh: Mesh) -> bool:
    """Whether the colours of vertices are a pattern that fewer vertices would lose."""
    some = mesh.triangles[:: len(mesh) // _SOME + 1]
    shades = mesh.colours[some].astype(np.int16)
    steps = np.abs(shades - np.roll(shades, 1, axis=1)).max(axis=2)
    return bool((steps > 255 * VIVID).mean() > PATTERNED)
