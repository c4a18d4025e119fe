"""Writes a furnished flat as a binary glTF 2.0 file, as scanners and CAD programs do.

One node per object, with its label, id and room in `extras`; a primitive per texture, base colours
only, no light baked in.
"""

from __future__ import annotations

import io
from pathlib import Path

from PIL import Image

from placegraph.io.mesh.gltf_write import Material, Part, Surface, encode_glb
from placegraph_lab.worlds.flat.interior import Interior

QUALITY = 90  # of the textures' JPEG images


def write_glb(interior: Interior, path: str | Path) -> Path:
    """Write the things of a flat as a .glb file; the same flat gives the same bytes."""
    materials: list[Material] = []
    parts = []
    for thing in interior.objects:
        surfaces = []
        for surface in thing.surfaces:
            surfaces.append(
                Surface(surface.vertices, surface.triangles, len(materials), surface.uv)
            )
            encoded = io.BytesIO()
            Image.fromarray(surface.texture).save(encoded, "JPEG", quality=QUALITY, subsampling=0)
            materials.append(Material(encoded.getvalue()))
        extras = {"label": thing.label, "id": thing.id, "room": thing.room}
        parts.append(Part(thing.name, surfaces, extras))
    Path(path).write_bytes(encode_glb(parts, materials))
    return Path(path)
