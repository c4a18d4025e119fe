"""Writes a furnished flat as a binary glTF 2.0 file, as scanners and CAD programs do.

One node per object, with its label, id and room in `extras`; a primitive per texture, base colours
only, no light baked in. glTF is y-up: x, y, z of the map become x, z, -y.
"""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from placegraph.synthetic.interior import Interior, Surface, Thing

GLTF_FROM_MAP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
QUALITY = 90
"""Of the textures' JPEG images."""

_FLOAT, _UINT32 = 5126, 5125
_VERTICES, _INDICES = 34962, 34963


class _Document:
    """JSON and binary part of a file while it is written."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.tables: dict[str, list[Any]] = {
            name: []
            for name in (
                "nodes", "meshes", "materials", "textures", "images", "accessors", "bufferViews",
            )
        }  # fmt: skip

    def put(self, table: str, entry: dict[str, Any]) -> int:
        """Append an entry to a table and return its row."""
        self.tables[table].append(entry)
        return len(self.tables[table]) - 1

    def view(self, data: bytes, **entry: int) -> int:
        """Append bytes, aligned to 4, and return the row of their view."""
        self.data += bytes(-len(self.data) % 4)
        start = len(self.data)
        self.data += data
        return self.put(
            "bufferViews", {"buffer": 0, "byteOffset": start, "byteLength": len(data)} | entry
        )

    def accessor(self, values: NDArray[Any], kind: str, *, bounds: bool = False) -> int:
        """Append an array (n,) or (n, k) of float32 or uint32."""
        indices = values.dtype == np.uint32
        entry: dict[str, Any] = {
            "bufferView": self.view(values.tobytes(), target=_INDICES if indices else _VERTICES),
            "componentType": _UINT32 if indices else _FLOAT,
            "count": len(values),
            "type": kind,
        }
        if bounds:  # demanded of positions
            entry |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        return self.put("accessors", entry)

    def thing(self, thing: Thing) -> None:
        """Append an object: node, mesh, and a primitive and material for every surface."""
        primitives = [self._primitive(surface) for surface in thing.surfaces]
        mesh = self.put("meshes", {"name": thing.name, "primitives": primitives})
        extras = {"label": thing.label, "id": thing.id, "room": thing.room}
        self.put("nodes", {"name": thing.name, "mesh": mesh, "extras": extras})

    def _primitive(self, surface: Surface) -> dict[str, Any]:
        positions = (surface.vertices @ GLTF_FROM_MAP.T).astype("<f4")
        return {
            "attributes": {
                "POSITION": self.accessor(positions, "VEC3", bounds=True),
                "TEXCOORD_0": self.accessor(surface.uv.astype("<f4"), "VEC2"),
            },
            "indices": self.accessor(surface.triangles.astype("<u4").ravel(), "SCALAR"),
            "material": self._material(surface.texture),
        }

    def _material(self, texture: NDArray[np.uint8]) -> int:
        encoded = io.BytesIO()
        Image.fromarray(texture).save(encoded, "JPEG", quality=QUALITY, subsampling=0)
        image = {"bufferView": self.view(encoded.getvalue()), "mimeType": "image/jpeg"}
        row = self.put("textures", {"source": self.put("images", image), "sampler": 0})
        shading = {"baseColorTexture": {"index": row}, "metallicFactor": 0, "roughnessFactor": 1}
        return self.put("materials", {"doubleSided": True, "pbrMetallicRoughness": shading})

    def encoded(self) -> bytes:
        """Header, JSON chunk and binary chunk."""
        repeat, linear, mipmaps = 10497, 9729, 9987
        content = {
            "asset": {"version": "2.0", "generator": "placegraph"},
            "scene": 0,
            "scenes": [{"nodes": list(range(len(self.tables["nodes"])))}],
            **self.tables,
            "samplers": [
                {"magFilter": linear, "minFilter": mipmaps, "wrapS": repeat, "wrapT": repeat}
            ],
            "buffers": [{"byteLength": len(self.data)}],
        }
        text = json.dumps(content, separators=(",", ":"), ensure_ascii=False).encode()
        text += b" " * (-len(text) % 4)
        data = bytes(self.data) + bytes(-len(self.data) % 4)
        return b"".join(
            [
                struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(data)),
                struct.pack("<I4s", len(text), b"JSON"),
                text,
                struct.pack("<I4s", len(data), b"BIN\0"),
                data,
            ]
        )


def write_glb(interior: Interior, path: str | Path) -> Path:
    """Write the things of a flat as a .glb file; the same flat gives the same bytes."""
    document = _Document()
    for thing in interior.things:
        document.thing(thing)
    Path(path).write_bytes(document.encoded())
    return Path(path)
