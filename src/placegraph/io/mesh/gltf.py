"""The container of glTF 2.0 files (.glb, or .gltf with files beside it): buffers, accessors, nodes.

What the pieces mean for a map is `glb`'s; this module believes no number it has not checked.
"""

from __future__ import annotations

import base64
import binascii
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import InputError
from placegraph.io.mesh.gltf_file import MAGIC, Json, chunks_of, content_of, json_of

_DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}

MENDS = {
    "KHR_draco_mesh_compression": "export it without Draco compression",
    "EXT_meshopt_compression": "export it without meshopt compression (gltfpack without -c)",
    "KHR_meshopt_compression": "export it without meshopt compression (gltfpack without -c)",
    "KHR_texture_basisu": "export it with JPEG or PNG textures",
    "EXT_mesh_gpu_instancing": "export instances as nodes",
}
"""Extensions without which nothing can be drawn, and what to do."""
_KNOWN = {"KHR_mesh_quantization", "KHR_texture_transform", "EXT_texture_webp"}
_HARMLESS = ("KHR_materials_", "KHR_lights_", "KHR_xmp", "EXT_lights_")


@dataclass(frozen=True, slots=True)
class Gltf:
    """A .glb or .gltf file, read but not interpreted."""

    path: Path
    content: Json
    chunk: memoryview
    """The binary part of a .glb."""
    _buffers: dict[int, memoryview] = field(default_factory=dict)

    @classmethod
    def read(cls, path: Path) -> Gltf:
        """Read a file; raises `InputError` where it is not glTF 2.0, or unreadable."""
        data = memoryview(content_of(path))
        if path.suffix.lower() == ".gltf" and bytes(data[:4]) != MAGIC.to_bytes(4, "little"):
            gltf = cls(path, json_of(path, bytes(data)), memoryview(b""))
            version = str(gltf.object_of(gltf.content, "asset").get("version"))
            if version.partition(".")[0] != "2":
                raise InputError(f"{path} is glTF {version[:20]}; export it as glTF 2.0.")
        else:
            gltf = cls(path, *chunks_of(path, data))
        content = gltf.content
        for name in gltf.list_of(content, "extensionsRequired"):
            if name in MENDS:
                raise gltf.error(f"it needs {name}; {MENDS[name]}")
            if name not in _KNOWN and not str(name).startswith(_HARMLESS):
                raise gltf.error(
                    f"it needs the extension {name!r}, unknown here; export without it"
                )
        return gltf

    def error(self, what: str) -> InputError:
        """Error about this file; `what` is half a sentence."""
        return InputError(f"{self.path}: {what}.")

    def item(self, kind: str, row: object) -> Json:
        """Entry `row` of a top-level list such as ``meshes``; `InputError` where there is none."""
        items = self.list_of(self.content, kind)
        if type(row) is not int or not 0 <= row < len(items) or not isinstance(items[row], dict):
            raise self.error(f"it names {kind}[{row!r}], which is not there; export it again")
        entry: Json = items[row]
        return entry

    def list_of(self, entry: Json, key: str) -> list[Any]:
        """List under `key`, empty where there is none."""
        found = entry.get(key, [])
        if not isinstance(found, list):
            raise self.error(f"{key!r} is not a list; export it again")
        return found

    def object_of(self, entry: Json, key: str) -> Json:
        """Object under `key`, empty where there is none."""
        found = entry.get(key, {})
        if not isinstance(found, dict):
            raise self.error(f"{key!r} is not an object; export it again")
        return found

    def accessor(self, row: object) -> NDArray[Any]:
        """Numbers (count, width) of an accessor; normalised integers as float32 in [-1, 1]."""
        accessor = self.item("accessors", row)
        if "sparse" in accessor or "bufferView" not in accessor:
            raise self.error(f"accessors[{row}] is sparse; export it without sparse accessors")
        dtype = _DTYPES.get(self.whole(accessor, "componentType"))
        width = _WIDTHS.get(str(accessor.get("type")))
        if dtype is None or width is None:
            raise self.error(f"accessors[{row}] is of no known type; export it again")
        kind = np.dtype(dtype)
        view = self.view(accessor["bufferView"])
        entry = self.item("bufferViews", accessor["bufferView"])
        count, offset = self.whole(accessor, "count"), self.whole(accessor, "byteOffset")
        stride = self.whole(entry, "byteStride") or kind.itemsize * width
        end = offset + (count - 1) * stride + kind.itemsize * width
        if count and (end > len(view) or stride < kind.itemsize * width):
            raise self.error(
                f"accessors[{row}] ends beyond its data; it is damaged: export it again"
            )
        shape = (count, width)
        if not count:
            return np.zeros(shape, kind)
        array: NDArray[Any] = np.ndarray(shape, kind, view, offset, (stride, kind.itemsize))
        if accessor.get("normalized") is True and kind.kind in "iu":
            scaled: NDArray[Any] = np.maximum(array.astype(np.float32) / np.iinfo(kind).max, -1.0)
            return scaled
        return array

    def view(self, row: object) -> memoryview:
        """Bytes of a buffer view."""
        entry = self.item("bufferViews", row)
        for name in MENDS.keys() & self.object_of(entry, "extensions").keys():
            raise self.error(f"it needs {name}; {MENDS[name]}")
        number = self.whole(entry, "buffer")
        buffer = self._buffer(number)
        start, length = self.whole(entry, "byteOffset"), self.whole(entry, "byteLength")
        if start + length > len(buffer):
            raise self.error(
                f"bufferViews[{row}] ends beyond the file; it is truncated: copy it again"
            )
        return buffer[start : start + length]

    def _buffer(self, row: int) -> memoryview:
        """Bytes of a buffer: the binary part of a .glb, a data URI, or a file beside this one."""
        entry = self.item("buffers", row)
        if "uri" not in entry:
            if row or not len(self.chunk):
                raise self.error(f"buffers[{row}] is not in the file; export it again")
            return self.chunk
        if row not in self._buffers:
            self._buffers[row] = memoryview(self._bytes(entry["uri"], f"buffers[{row}]"))
        return self._buffers[row]

    def _bytes(self, uri: object, what: str) -> bytes:
        """What a URI of this file names: base64 in it, or a file in the same folder or below."""
        text = str(uri)
        if text.startswith("data:"):
            head, _, packed = text.partition(",")
            if not head.endswith(";base64"):
                raise self.error(f"{what} is {head[:40]!r}, not base64; export it again")
            try:
                return base64.b64decode(packed, validate=True)
            except (binascii.Error, ValueError) as error:
                raise self.error(f"{what} is not base64 ({error}); export it again") from error
        name = unquote(text)
        folder, file = self.path.parent, self.path.parent / name
        try:
            below = file.resolve().is_relative_to(folder.resolve())
            there = file.is_file()
        except (OSError, ValueError, RuntimeError):
            below = there = False
        strange = PurePosixPath(name).is_absolute() or PureWindowsPath(name).drive
        if strange or not below or ":" in text or ".." in PurePosixPath(name).parts:
            raise self.error(
                f"{what} is {text[:60]!r}, which leads out of its folder; "
                "export it with its files beside it"
            )
        if not there:
            raise self.error(
                f"{what} lies in {name[:60]!r}, which is not there; copy the files beside it too"
            )
        return content_of(file)

    def image(self, row: object) -> bytes:
        """Encoded bytes of an image."""
        entry = self.item("images", row)
        uri = entry.get("uri")
        if uri is None:
            return bytes(self.view(entry.get("bufferView")))
        return self._bytes(uri, f"images[{row}]")

    def whole(self, entry: Json, key: str) -> int:
        """Whole number from 0 under `key`, 0 where there is none."""
        value = entry.get(key, 0)
        if isinstance(value, float) and value.is_integer():
            value = int(value)
        if type(value) is not int or not 0 <= value < 1 << 40:
            raise self.error(f"{key} is {str(value)[:40]!r}; it must be a whole number")
        return value

    def floats(self, entry: Json, key: str, default: tuple[float, ...]) -> NDArray[np.float64]:
        """As many numbers under `key` as `default` has, or `default`."""
        value = entry.get(key)
        if value is None:
            return np.array(default)
        good = isinstance(value, list) and len(value) == len(default)
        if not good or any(type(v) not in {int, float} or abs(v) > 1e30 for v in value):
            raise self.error(f"{key} is {str(value)[:60]!r}; it must be {len(default)} numbers")
        return np.array(value, np.float64)

    def walk(self) -> list[tuple[tuple[int, ...], NDArray[np.float64]]]:
        """Nodes of the scene, parents first: the path of rows to each, and world_from_node (4, 4)."""
        stack: list[tuple[tuple[int, ...], NDArray[np.float64]]]
        stack = [((row,), np.eye(4)) for row in reversed(self._roots())]
        found, seen = [], set()
        while stack:
            path, parent = stack.pop()
            node = self.item("nodes", path[-1])
            if path[-1] in seen:
                raise self.error(f"nodes[{path[-1]}] has two parents; export it again")
            seen.add(path[-1])
            world = parent @ self._local(node)
            found.append((path, world))
            for child in reversed(self.list_of(node, "children")):
                self.item("nodes", child)
                stack.append(((*path, child), world))
        return found

    def _roots(self) -> list[int]:
        if self.list_of(self.content, "scenes"):
            scene = self.item("scenes", self.content.get("scene", 0))
            roots = self.list_of(scene, "nodes")
        else:  # a library of parts: every node that no other node holds
            nodes = self.list_of(self.content, "nodes")
            rows = range(len(nodes))
            held = [c for row in rows for c in self.list_of(self.item("nodes", row), "children")]
            children = {c for c in held if type(c) is int}
            roots = [row for row in rows if row not in children]
        for row in roots:
            self.item("nodes", row)
        return roots

    def _local(self, node: Json) -> NDArray[np.float64]:
        """parent_from_node (4, 4) from a matrix, or from translation, rotation and scale."""
        if "matrix" in node:
            return self.floats(node, "matrix", (0.0,) * 16).reshape(4, 4).T
        x, y, z, w = self.floats(node, "rotation", (0.0, 0.0, 0.0, 1.0))
        norm = x * x + y * y + z * z + w * w
        s = 2.0 / norm if norm > 0 else 0.0
        rotation = np.array([
            [1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
            [s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)],
            [s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)],
        ])  # fmt: skip
        local = np.eye(4)
        local[:3, :3] = rotation * self.floats(node, "scale", (1.0, 1.0, 1.0))
        local[:3, 3] = self.floats(node, "translation", (0.0, 0.0, 0.0))
        return local
