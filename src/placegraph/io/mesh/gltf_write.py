"""Writer of glTF 2.0 binary files (.glb): one node a part, one primitive a material.

The counterpart of `placegraph.io.mesh.gltf`: what is written here is read there. glTF is y-up:
x, y, z of the map become x, z, -y.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import OptionError

GLTF_FROM_MAP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
GENERATOR = "placegraph"

_FLOAT, _UINT32, _UINT16 = 5126, 5125, 5123
_VERTICES, _INDICES = 34962, 34963
_LINES = 1
_WEBP = "image/webp"
_MIMES = {b"\xff\xd8\xff": "image/jpeg", b"\x89PNG": "image/png", b"RIFF": _WEBP}
_NEEDED = ("extensionsUsed", "extensionsRequired")
_LARGEST = 1 << 32


@dataclass(frozen=True, slots=True)
class Material:
    """Colour of a surface, without light: an encoded image times a factor, or a factor alone."""

    image: bytes | None = None
    """JPEG, PNG or WebP, as the file will hold it; not every program reads WebP in a .glb."""
    factor: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Linear, 0 to 1."""


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Triangles of one material."""

    vertices: NDArray[Any]
    """(V, 3) [m], map axes."""
    triangles: NDArray[Any]
    """(T, 3) rows of vertices."""
    material: int
    """Row of the materials."""
    uv: NDArray[Any] | None = None
    """(V, 2) texture coordinates, v down, repeated beyond [0, 1)."""
    colours: NDArray[np.uint8] | None = None
    """(V, 3) uint8, sRGB; None: white."""


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """One node: an object, or something drawn of lines."""

    name: str
    surfaces: Sequence[Surface] = ()
    extras: Mapping[str, Any] = field(default_factory=dict)
    lines: NDArray[Any] | None = None
    """(L, 2, 3) line segments [m], map axes."""


def encode_glb(
    parts: Sequence[Part],
    materials: Sequence[Material],
    *,
    extras: Mapping[str, Any] | None = None,
    generator: str = GENERATOR,
    turned: bool = True,
) -> bytes:
    """Return the bytes of a .glb file; equal parts give equal bytes.

    Parameters
    ----------
    parts
        Nodes, in this order.
    materials
        What their surfaces name; each image stands in the file once.
    extras
        What is to be known of the scene as a whole.
    generator
        Name of the program for `asset.generator`.
    turned
        Whether to turn the map's z-up into glTF's y-up; False for what wants the map's axes.

    Raises
    ------
    OptionError
        The file would be larger than the format allows (4 GiB).

    """
    document = _Document(GLTF_FROM_MAP if turned else np.eye(3))
    for material in materials:
        document.material(material)
    for part in parts:
        document.part(part)
    return document.encode(extras or {}, generator)


class _Document:
    """JSON and binary part of a file while it is written."""

    def __init__(self, gltf_from_map: NDArray[np.float64]) -> None:
        self.gltf_from_map = gltf_from_map
        self.data = bytearray()
        self.images: dict[bytes, int] = {}
        self.extensions: set[str] = set()
        self.tables: dict[str, list[Any]] = {
            name: []
            for name in (
                "nodes", "meshes", "materials", "textures", "images", "accessors", "bufferViews",
            )
        }  # fmt: skip

    def put(self, table: str, entry: dict[str, Any]) -> int:
        """Add an entry to a table and return its row."""
        self.tables[table].append(entry)
        return len(self.tables[table]) - 1

    def view(self, data: bytes, **entry: int) -> int:
        """Add bytes, aligned to 4, and return the row of their view."""
        self.data += bytes(-len(self.data) % 4)
        start = len(self.data)
        self.data += data
        return self.put(
            "bufferViews", {"buffer": 0, "byteOffset": start, "byteLength": len(data)} | entry
        )

    def accessor(self, values: NDArray[Any], kind: str, **entry: Any) -> int:  # noqa: ANN401  # JSON
        """Add an array (n,) or (n, k) of float32, uint16 or uint32."""
        component = {"f": _FLOAT, "u": _UINT32 if values.itemsize == 4 else _UINT16}
        target = _INDICES if kind == "SCALAR" else _VERTICES
        return self.put(
            "accessors",
            {
                "bufferView": self.view(values.tobytes(), target=target),
                "componentType": component[values.dtype.kind],
                "count": len(values),
                "type": kind,
                **entry,
            },
        )

    def positions(self, points: NDArray[Any]) -> int:
        """Add positions (n, 3) with their bounds, which the standard demands."""
        turned = (points @ self.gltf_from_map.T).astype("<f4")
        ends = {"min": turned.min(axis=0).tolist(), "max": turned.max(axis=0).tolist()}
        return self.accessor(turned, "VEC3", **ends)

    def material(self, material: Material) -> None:
        """Add a material, and its image where it is new."""
        shading: dict[str, Any] = {"metallicFactor": 0, "roughnessFactor": 1}
        if material.factor != (1.0, 1.0, 1.0):
            shading["baseColorFactor"] = [*material.factor, 1.0]
        if material.image is not None:
            if material.image not in self.images:
                self.images[material.image] = self._texture(material.image)
            shading["baseColorTexture"] = {"index": self.images[material.image]}
        self.put("materials", {"doubleSided": True, "pbrMetallicRoughness": shading})

    def _texture(self, image: bytes) -> int:
        mime = next((m for head, m in _MIMES.items() if image.startswith(head)), "")
        row = self.put("images", {"bufferView": self.view(image), "mimeType": mime})
        if mime != _WEBP:
            return self.put("textures", {"source": row, "sampler": 0})
        self.extensions.add("EXT_texture_webp")
        held = {"EXT_texture_webp": {"source": row}}
        return self.put("textures", {"sampler": 0, "extensions": held})

    def part(self, part: Part) -> None:
        """Add a node and its mesh."""
        primitives = [self._surface(s) for s in part.surfaces if len(s.triangles)]
        if part.lines is not None and len(part.lines):
            ends = np.asarray(part.lines, np.float64).reshape(-1, 3)
            attributes = {"POSITION": self.positions(ends)}
            primitives.append({"attributes": attributes, "mode": _LINES})
        node: dict[str, Any] = {"name": part.name}
        if primitives:
            node["mesh"] = self.put("meshes", {"name": part.name, "primitives": primitives})
        if part.extras:
            node["extras"] = dict(part.extras)
        self.put("nodes", node)

    def _surface(self, surface: Surface) -> dict[str, Any]:
        attributes = {"POSITION": self.positions(surface.vertices)}
        if surface.uv is not None:
            attributes["TEXCOORD_0"] = self.accessor(surface.uv.astype("<f4"), "VEC2")
        if surface.colours is not None and (surface.colours != 255).any():
            channels = _to_linear(surface.colours)
            attributes["COLOR_0"] = self.accessor(channels, "VEC4", normalized=True)
        corners = surface.triangles.astype("<u4").ravel()
        return {
            "attributes": attributes,
            "indices": self.accessor(corners, "SCALAR"),
            "material": surface.material,
        }

    def encode(self, extras: Mapping[str, Any], generator: str) -> bytes:
        """Return header, JSON chunk and binary chunk."""
        repeat, linear, mipmaps = 10497, 9729, 9987
        scene = {"nodes": list(range(len(self.tables["nodes"])))}
        sampler = {"magFilter": linear, "minFilter": mipmaps, "wrapS": repeat, "wrapT": repeat}
        content = {
            "asset": {"version": "2.0", "generator": generator},
            "scene": 0,
            "scenes": [scene | ({"extras": dict(extras)} if extras else {})],
            **{name: table for name, table in self.tables.items() if table},
            **({"samplers": [sampler]} if self.images else {}),
            **dict.fromkeys(_NEEDED if self.extensions else (), sorted(self.extensions)),
            **({"buffers": [{"byteLength": len(self.data)}]} if self.data else {}),
        }
        text = json.dumps(content, separators=(",", ":"), ensure_ascii=False).encode()
        text += b" " * (-len(text) % 4)
        chunks = [struct.pack("<I4s", len(text), b"JSON"), text]
        if self.data:
            data = bytes(self.data) + bytes(-len(self.data) % 4)
            chunks += [struct.pack("<I4s", len(data), b"BIN\0"), data]
        length = 12 + sum(map(len, chunks))
        if length >= _LARGEST:
            raise OptionError("The .glb file would be larger than 4 GiB; export fewer triangles.")
        return b"".join([struct.pack("<4sII", b"glTF", 2, length), *chunks])


def _to_linear(colours: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """Convert sRGB (V, 3) to COLOR_0: (V, 4) uint16 linear intensities and opacity."""
    steps = np.arange(256) / 255.0
    linear = np.where(steps <= 0.04045, steps / 12.92, ((steps + 0.055) / 1.055) ** 2.4)
    table = np.rint(65535.0 * linear).astype("<u2")
    opaque = np.full((len(colours), 1), 65535, "<u2")
    return np.concatenate([table[colours], opaque], axis=1)
