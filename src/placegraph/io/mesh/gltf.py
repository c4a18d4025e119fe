"""Reader of glTF 2.0 files (.glb, .gltf): one object a node, with its label, mesh and colours.

The object of a mesh is the nearest node above it, itself included, whose `extras` hold `label` or
`id`; without such a node it is the mesh's own. glTF is y-up, and x, y, z become x, -z, y. No number
of a file is believed before it is checked against the file's size.
"""

from __future__ import annotations

import base64
import binascii
import json
import re
import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from math import cos, sin
from os import PathLike
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, Literal
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.errors import InputError
from placegraph.io.mesh.model import Z_UP, Model, ModelObject, Texture, read_bytes

Json = dict[str, Any]

EXTRAS_KEY = "placegraph"
"""Key of `extras` for what a node cannot say plainly: `attributes` whose names are taken, and the
`name` "" of an object whose node is called by its label."""
_MAGIC, _JSON, _BIN = 0x46546C67, 0x4E4F534A, 0x004E4942
_DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_CLAMP, _MIRROR = 33071, 33648
_EDGE = 1e-4  # of a texture: within the outermost texel of any texture a map holds
_SRGB_WRITERS = ("trimesh", "open3d")  # write COLOR_0 as sRGB, where the standard says linear
_REMEDIES = {
    "KHR_draco_mesh_compression": "export it without Draco compression",
    "EXT_meshopt_compression": "export it without meshopt compression (gltfpack without -c)",
    "KHR_meshopt_compression": "export it without meshopt compression (gltfpack without -c)",
    "KHR_texture_basisu": "export it with JPEG or PNG textures",
    "EXT_mesh_gpu_instancing": "export instances as nodes",
}  # extensions without which nothing can be drawn, and what to do
_KNOWN = {"KHR_mesh_quantization", "KHR_texture_transform", "EXT_texture_webp"}
_HARMLESS = ("KHR_materials_", "KHR_lights_", "KHR_xmp", "EXT_lights_")


def read_glb(path: str | PathLike[str], *, up: Literal["y", "z"] = "y") -> Model:
    """Read a .glb file, or a .gltf with its buffers and images inside, beside it or below.

    Parameters
    ----------
    up
        Axis that points up in it: y by the standard; z for exporters that forgot to turn.

    Raises
    ------
    InputError
        The file is missing, truncated, damaged, not glTF 2.0, or needs what is not read: Draco or
        meshopt compression, Basis textures, sparse accessors; a file it names is missing, or
        outside its folder.

    """
    gltf = _Gltf.read(Path(path))
    try:
        return _ModelReader(gltf).read(np.eye(3) if up == "z" else Z_UP)
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
        raise gltf.error(f"it is not valid glTF ({error!r}); export it again") from error


def _parse_json(path: Path, data: bytes) -> Json:
    try:
        content = json.loads(data.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"{path} has no JSON that can be read; copy or export it again."
        ) from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: its JSON is not an object; export it again.")
    return content


def _split_chunks(path: Path, data: memoryview) -> tuple[Json, memoryview]:
    """Return the JSON and the binary chunk of a .glb file; `InputError` where it is none."""
    if not len(data):
        raise InputError(f"{path} is empty; export it again.")
    if len(data) < 20 or struct.unpack_from("<I", data)[0] != _MAGIC:
        if bytes(data[:1]) == b"{":
            raise InputError(f"{path} is glTF in JSON form; rename it to .gltf.")
        raise InputError(f"{path} is not glTF 2.0 binary; export it as one .glb file.")
    version, total = struct.unpack_from("<II", data, 4)
    if version != 2:
        raise InputError(f"{path} is glTF {version}; export it as glTF 2.0.")
    if total > len(data):
        raise InputError(
            f"{path} has {len(data)} of {total} bytes: it is truncated; copy it again."
        )
    parts: dict[int, memoryview] = {}
    at = 12
    while at + 8 <= total:
        length, kind = struct.unpack_from("<II", data, at)
        if at + 8 + length > total:
            raise InputError(f"{path} ends within a chunk: it is damaged; copy it again.")
        parts.setdefault(kind, data[at + 8 : at + 8 + length])
        at += 8 + length + (-length % 4)
    return _parse_json(path, bytes(parts.get(_JSON, b""))), parts.get(_BIN, memoryview(b""))


@dataclass(frozen=True, slots=True)
class _Gltf:
    """Container of a file: JSON, buffers, accessors and nodes, checked but not interpreted."""

    path: Path
    content: Json
    chunk: memoryview  # the binary part of a .glb
    buffers: dict[int, memoryview] = field(default_factory=dict)

    @classmethod
    def read(cls, path: Path) -> _Gltf:
        """Read a file; raises `InputError` where it is not glTF 2.0, or unreadable."""
        data = memoryview(read_bytes(path))
        if path.suffix.lower() == ".gltf" and bytes(data[:4]) != _MAGIC.to_bytes(4, "little"):
            gltf = cls(path, _parse_json(path, bytes(data)), memoryview(b""))
            version = str(gltf.object_of(gltf.content, "asset").get("version"))
            if version.partition(".")[0] != "2":
                raise InputError(f"{path} is glTF {version[:20]}; export it as glTF 2.0.")
        else:
            gltf = cls(path, *_split_chunks(path, data))
        for name in map(str, gltf.list_of(gltf.content, "extensionsRequired")):
            if name in _REMEDIES:
                raise gltf.error(f"it needs {name}; {_REMEDIES[name]}")
            if name not in _KNOWN and not name.startswith(_HARMLESS):
                raise gltf.error(
                    f"it needs the extension {name!r}, unknown here; export without it"
                )
        return gltf

    def error(self, what: str) -> InputError:
        """Return an error about this file; `what` is half a sentence."""
        return InputError(f"{self.path}: {what}.")

    def item(self, kind: str, row: object) -> Json:
        """Return entry `row` of a top-level list such as ``meshes``."""
        items = self.list_of(self.content, kind)
        if type(row) is not int or not 0 <= row < len(items) or not isinstance(items[row], dict):
            raise self.error(f"it refers to the missing {kind}[{row!r}]; export it again")
        entry: Json = items[row]
        return entry

    def list_of(self, entry: Json, key: str) -> list[Any]:
        """Return the list under `key`, empty where there is none."""
        found = entry.get(key, [])
        if not isinstance(found, list):
            raise self.error(f"{key!r} is not a list; export it again")
        return found

    def object_of(self, entry: Json, key: str) -> Json:
        """Return the object under `key`, empty where there is none."""
        found = entry.get(key, {})
        if not isinstance(found, dict):
            raise self.error(f"{key!r} is not an object; export it again")
        return found

    def integer(self, entry: Json, key: str) -> int:
        """Return the whole number from 0 under `key`, 0 where there is none."""
        value = entry.get(key, 0)
        if isinstance(value, float) and value.is_integer():
            value = int(value)
        if type(value) is not int or not 0 <= value < 1 << 40:
            raise self.error(f"{key} is {str(value)[:40]!r}; it must be a whole number")
        return value

    def floats(self, entry: Json, key: str, default: tuple[float, ...]) -> Floats:
        """Return as many numbers under `key` as `default` has, or `default`."""
        value = entry.get(key)
        if value is None:
            return np.array(default)
        good = isinstance(value, list) and len(value) == len(default)
        if not good or any(type(v) not in {int, float} or abs(v) > 1e30 for v in value):
            raise self.error(f"{key} is {str(value)[:60]!r}; it must be {len(default)} numbers")
        return np.array(value, np.float64)

    def accessor(self, row: object, *, raw: bool = False) -> NDArray[Any]:
        """Return numbers (count, width) of an accessor.

        Normalised integers become float32 in [-1, 1], unless they are wanted `raw`.
        """
        accessor = self.item("accessors", row)
        if "sparse" in accessor or "bufferView" not in accessor:
            raise self.error(f"accessors[{row}] is sparse; export it without sparse accessors")
        dtype = _DTYPES.get(self.integer(accessor, "componentType"))
        width = _WIDTHS.get(str(accessor.get("type")))
        if dtype is None or width is None:
            raise self.error(f"accessors[{row}] has an unknown type; export it again")
        kind = np.dtype(dtype)
        view = self.view(accessor["bufferView"])
        entry = self.item("bufferViews", accessor["bufferView"])
        count, offset = self.integer(accessor, "count"), self.integer(accessor, "byteOffset")
        stride = self.integer(entry, "byteStride") or kind.itemsize * width
        end = offset + (count - 1) * stride + kind.itemsize * width
        if count and (end > len(view) or stride < kind.itemsize * width):
            raise self.error(
                f"accessors[{row}] ends beyond its data; it is damaged: export it again"
            )
        if not count:
            return np.zeros((count, width), kind)
        shape, steps = (count, width), (stride, kind.itemsize)
        array: NDArray[Any] = np.ndarray(shape, kind, view, offset, steps)
        if accessor.get("normalized") is True and kind.kind in "iu" and not raw:
            scaled: NDArray[Any] = np.maximum(array.astype(np.float32) / np.iinfo(kind).max, -1.0)
            return scaled
        return array

    def view(self, row: object) -> memoryview:
        """Return the bytes of a buffer view."""
        entry = self.item("bufferViews", row)
        for name in _REMEDIES.keys() & self.object_of(entry, "extensions").keys():
            raise self.error(f"it needs {name}; {_REMEDIES[name]}")
        number = self.integer(entry, "buffer")
        buffer = self.item("buffers", number)
        if "uri" in buffer:
            if number not in self.buffers:
                content = self.resolve(buffer["uri"], f"buffers[{number}]")
                self.buffers[number] = memoryview(content)
            data = self.buffers[number]
        elif number or not len(self.chunk):
            raise self.error(f"buffers[{number}] is not in the file; export it again")
        else:
            data = self.chunk
        start, length = self.integer(entry, "byteOffset"), self.integer(entry, "byteLength")
        if start + length > len(data):
            raise self.error(
                f"bufferViews[{row}] ends beyond the file; it is truncated: copy it again"
            )
        return data[start : start + length]

    def resolve(self, uri: object, what: str) -> bytes:
        """Return the bytes of a URI: base64 in it, or a file in the same folder or below."""
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
                f"{what} is {text[:60]!r}, which lies outside its folder; export it with "
                "its files beside it"
            )
        if not there:
            raise self.error(
                f"{what} lies in {name[:60]!r}, which is missing; copy the files beside it too"
            )
        return read_bytes(file)

    def extras(self, row: int) -> Json:
        """Return the extras of a node."""
        extras = self.item("nodes", row).get("extras")
        return extras if isinstance(extras, dict) else {}

    def walk(self) -> list[tuple[tuple[int, ...], Floats]]:
        """Return the scene's nodes, parents first: path of rows to each, and world_from_node (4, 4)."""
        if self.list_of(self.content, "scenes"):
            scene = self.item("scenes", self.content.get("scene", 0))
            roots = self.list_of(scene, "nodes")
        else:  # a library of parts: every node that no other node holds
            rows = range(len(self.list_of(self.content, "nodes")))
            held = [c for row in rows for c in self.list_of(self.item("nodes", row), "children")]
            children = {c for c in held if type(c) is int}
            roots = [row for row in rows if row not in children]
        for row in roots:
            self.item("nodes", row)
        stack: list[tuple[tuple[int, ...], Floats]]
        stack = [((row,), np.eye(4)) for row in reversed(roots)]
        found, seen = [], set()
        while stack:
            path, parent = stack.pop()
            node = self.item("nodes", path[-1])
            if path[-1] in seen:
                raise self.error(f"nodes[{path[-1]}] has two parents; export it again")
            seen.add(path[-1])
            world = parent @ self.local_transform(node)
            found.append((path, world))
            for child in reversed(self.list_of(node, "children")):
                self.item("nodes", child)
                stack.append(((*path, child), world))
        return found

    def local_transform(self, node: Json) -> Floats:
        """Return parent_from_node (4, 4) from a matrix, or translation, rotation and scale."""
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


@dataclass(frozen=True, slots=True)
class _Shading:
    """Colouring of a primitive: row of its picture, and how texture coordinates are read."""

    picture: int
    texcoord: int = 0  # which TEXCOORD
    affine: Floats | None = None  # (2, 3) to be applied to texture coordinates
    clamped: tuple[bool, bool] = (False, False)
    mirrored: tuple[bool, bool] = (False, False)

    def transform(self, uv: Floats) -> Floats:
        """Return texture coordinates (V, 2) for a picture that is plainly repeated.

        Coordinates beyond a clamped edge are clamped at the vertices, so inside a triangle that
        reaches beyond it the texture is stretched a little.
        """
        if self.affine is not None:
            uv = uv @ self.affine[:, :2].T + self.affine[:, 2]
        for axis in (0, 1):
            if self.clamped[axis]:
                uv[:, axis] = np.clip(uv[:, axis], _EDGE, 1.0 - _EDGE)
            if self.mirrored[axis]:
                uv[:, axis] /= 2.0
        return uv


class _ModelReader:
    """Collects objects, triangles and pictures while walking over the nodes."""

    def __init__(self, gltf: _Gltf) -> None:
        self.gltf = gltf
        self.left_out: Counter[str] = Counter()
        self.objects: list[ModelObject] = []
        self.object_rows: dict[str, int] = {}
        self.shadings: dict[int | None, _Shading] = {}
        self.pictures: dict[Texture, int] = {}
        self.images: dict[int, bytes] = {}
        self.columns: dict[str, list[NDArray[Any]]] = {
            "vertices": [np.zeros((0, 3))],
            "triangles": [np.zeros((0, 3), np.int64)],
            "object_of": [np.zeros(0, np.int64)],
            "colours": [np.zeros((0, 3), np.uint8)],
            "uv": [np.zeros((0, 2))],
            "picture_of": [np.zeros(0, np.int64)],
        }
        self.vertex_count = 0

    def read(self, map_from_gltf: Floats) -> Model:
        gltf = self.gltf
        nodes = [(p, world) for p, world in gltf.walk() if "mesh" in gltf.item("nodes", p[-1])]
        owners = [
            next((r for r in reversed(path) if {"label", "id"} & gltf.extras(r).keys()), path[-1])
            for path, _ in nodes
        ]
        taken = {_read_id(gltf.extras(row)) for row in owners}
        free = (str(n) for n in range(len(owners) + len(taken)) if str(n) not in taken)
        rows: dict[int, int] = {}
        for owner, (path, world) in zip(owners, nodes, strict=True):
            if owner not in rows:
                rows[owner] = self.add_thing(owner, free)
            turned = world.copy()
            turned[:3] = map_from_gltf @ world[:3]
            mesh = gltf.item("meshes", gltf.item("nodes", path[-1])["mesh"])
            for primitive in gltf.list_of(mesh, "primitives"):
                self.add_primitive(primitive, turned, rows[owner])
        scenes = gltf.list_of(gltf.content, "scenes")
        told = gltf.item("scenes", gltf.content.get("scene", 0)).get("extras") if scenes else None
        relations, floor = self.read_scene(told if isinstance(told, dict) else {})
        joined = {name: np.concatenate(arrays) for name, arrays in self.columns.items()}
        return Model(
            path=gltf.path,
            objects=tuple(self.objects),
            pictures=tuple(self.pictures) or (Texture(None),),
            left_out=self.left_out,
            relations=relations,
            floor=floor,
            **joined,
        )

    def read_scene(self, extras: Json) -> tuple[tuple[tuple[int, str, int], ...], float | None]:
        """Return relations by rows of objects, and the floor's height along the map's z.

        Both as `placegraph scene export` writes them; relations of objects that are gone are
        dropped, and of several scenes no floor is known.
        """
        entries = extras.get("relations")
        relations = tuple(
            (self.object_rows[r[0]], r[1], self.object_rows[r[2]])
            for r in (entries if isinstance(entries, list) else [])
            if isinstance(r, list)
            and len(r) == 3
            and all(isinstance(word, str) for word in r)
            and {r[0], r[2]} <= self.object_rows.keys()
        )
        scenes = extras.get("scenes")
        if not isinstance(scenes, list) or len(scenes) != 1 or not isinstance(scenes[0], dict):
            return relations, None
        floor = scenes[0].get("floor")
        if isinstance(floor, int | float) and abs(floor) < 1e6:
            return relations, float(floor)
        return relations, None

    def add_thing(self, row: int, free: Iterator[str]) -> int:
        """Return the row of a node's object; nodes that share `extras.id` share their object."""
        node, extras = self.gltf.item("nodes", row), self.gltf.extras(row)
        name = str(node.get("name") or "")
        bare = re.sub(r"\.\d{3,}$", "", name)
        label = str(extras.get("label") or "") or bare or "unknown"
        id_ = _read_id(extras) or next(free)
        if id_ in self.object_rows:
            other = self.objects[self.object_rows[id_]]
            if other.label != label:
                raise self.gltf.error(
                    f"nodes {other.name!r} and {name!r} share extras.id {id_!r} but not their label; "
                    "give each object its own id"
                )
            return self.object_rows[id_]
        own = extras.get(EXTRAS_KEY)
        own = own if isinstance(own, dict) else {}
        if own.get("name") == "" and bare == label:
            name = ""
        plain = {k: v for k, v in extras.items() if k not in {"label", "id"}}
        attributes = {
            str(k): v if isinstance(v, str) else json.dumps(v)
            for k, v in [*plain.items(), *self.gltf.object_of(own, "attributes").items()]
            if isinstance(v, str | int | float)
        }
        self.object_rows[id_] = len(self.objects)
        self.objects.append(ModelObject(id_, label, name, attributes))
        return len(self.objects) - 1

    def add_primitive(self, primitive: Json, map_from_node: Floats, object_row: int) -> None:
        gltf = self.gltf
        for name in _REMEDIES.keys() & gltf.object_of(primitive, "extensions").keys():
            raise gltf.error(f"it needs {name}; {_REMEDIES[name]}")
        attributes = gltf.object_of(primitive, "attributes")
        mode = gltf.integer(primitive, "mode") if "mode" in primitive else _TRIANGLES
        if mode not in {_TRIANGLES, _STRIP, _FAN} or "POSITION" not in attributes:
            self.left_out["primitives that are not triangles"] += 1
            return
        points = gltf.accessor(attributes["POSITION"]).astype(np.float64)
        if points.shape[1] != 3:
            raise gltf.error("a POSITION does not have three coordinates; export it again")
        corners = self.read_corners(primitive, mode, len(points))
        if np.linalg.det(map_from_node[:3, :3]) < 0:  # a mirrored part is turned inside out
            corners = corners[:, ::-1]
        material = primitive.get("material")
        if material not in self.shadings:
            self.shadings[material] = self.read_shading(material)
        shading = self.shadings[material]
        uv = np.zeros((len(points), 2))
        coordinates = attributes.get(f"TEXCOORD_{shading.texcoord}")
        if coordinates is not None:
            column = self.read_column(coordinates, len(points))
            uv = shading.transform(column[:, :2].astype(np.float64))
        colours = np.full(points.shape, 255, np.uint8)
        if "COLOR_0" in attributes:
            colours = self.read_colours(attributes["COLOR_0"], len(points))
        with np.errstate(over="ignore", invalid="ignore"):
            placed = points @ map_from_node[:3, :3].T + map_from_node[:3, 3]
        for name, array in (
            ("vertices", placed), ("triangles", corners + self.vertex_count), ("colours", colours),
            ("uv", uv), ("object_of", np.full(len(corners), object_row)),
            ("picture_of", np.full(len(corners), shading.picture)),
        ):  # fmt: skip
            self.columns[name].append(array)
        self.vertex_count += len(points)

    def read_column(self, accessor: object, count: int, *, raw: bool = False) -> NDArray[Any]:
        column = self.gltf.accessor(accessor, raw=raw)
        if len(column) != count or column.shape[1] < 2:
            raise self.gltf.error(
                f"accessors[{accessor}] has {column.shape} numbers for {count} vertices; export it again"
            )
        return column

    def read_corners(self, primitive: Json, mode: int, count: int) -> NDArray[np.int64]:
        """Return triangles (T, 3) of a primitive in rows of its vertices."""
        row = np.arange(count)
        if "indices" in primitive:
            rows = self.gltf.accessor(primitive["indices"])
            if rows.dtype.kind != "u" or rows.shape[1] != 1:
                raise self.gltf.error("indices are not unsigned integers; export it again")
            row = rows[:, 0].astype(np.int64)
        if row.size and row.max() >= count:
            raise self.gltf.error(f"an index is {row.max()} of {count} vertices; export it again")
        if mode == _TRIANGLES:
            return row[: row.size // 3 * 3].reshape(-1, 3)
        first = np.arange(max(row.size - 2, 0))
        if mode == _FAN:
            return np.stack([row[np.zeros_like(first)], row[first + 1], row[first + 2]], axis=1)
        odd = first % 2  # of a strip every other triangle is wound the other way
        return np.stack([row[first], row[first + 1 + odd], row[first + 2 - odd]], axis=1)

    def read_shading(self, row: int | None) -> _Shading:
        """Return the shading of a material: base colour, and texture; plain white where it is None."""
        gltf = self.gltf
        material = {} if row is None else gltf.item("materials", row)
        base = gltf.object_of(material, "pbrMetallicRoughness")
        keys = ("baseColorTexture", "baseColorFactor")
        older = gltf.object_of(material, "extensions").get("KHR_materials_pbrSpecularGlossiness")
        if isinstance(older, dict) and keys[0] not in base:
            base, keys = older, ("diffuseTexture", "diffuseFactor")
        r, g, b, _ = np.clip(gltf.floats(base, keys[1], (1.0,) * 4), 0.0, 1.0).tolist()
        info = gltf.object_of(base, keys[0])
        if not info:
            return _Shading(self.add_picture(Texture(None, (r, g, b))))
        texture = gltf.item("textures", info.get("index"))
        wraps = [0, 0]
        if "sampler" in texture:
            sampler = gltf.item("samplers", texture["sampler"])
            wraps = [gltf.integer(sampler, key) for key in ("wrapS", "wrapT")]
        mirrored = (wraps[0] == _MIRROR, wraps[1] == _MIRROR)
        data, name = self.read_image(texture)
        moved = gltf.object_of(gltf.object_of(info, "extensions"), "KHR_texture_transform")
        affine = None
        if moved:  # scale, then rotation (counter-clockwise of v down), then offset
            scale = gltf.floats(moved, "scale", (1.0, 1.0))
            offset = gltf.floats(moved, "offset", (0.0, 0.0))
            turn = {"rotation": [moved.get("rotation", 0.0)]}
            (angle,) = gltf.floats(turn, "rotation", (0.0,))
            c, s = cos(angle), sin(angle)
            affine = np.column_stack([np.array([[c, s], [-s, c]]) * scale, offset])
        return _Shading(
            picture=self.add_picture(Texture(data, (r, g, b), mirrored, name)),
            texcoord=gltf.integer(moved if "texCoord" in moved else info, "texCoord"),
            affine=affine,
            clamped=(wraps[0] == _CLAMP, wraps[1] == _CLAMP),
            mirrored=mirrored,
        )

    def add_picture(self, picture: Texture) -> int:
        return self.pictures.setdefault(picture, len(self.pictures))

    def read_image(self, texture: Json) -> tuple[bytes, str]:
        """Return the encoded bytes of a texture's image, and its name for messages."""
        source = texture.get("source")
        webp = self.gltf.object_of(texture, "extensions").get("EXT_texture_webp")
        if isinstance(webp, dict):
            source = webp.get("source", source)
        entry = self.gltf.item("images", source)
        row = self.gltf.integer({"source": source}, "source")
        if row not in self.images:
            uri = entry.get("uri")
            self.images[row] = (
                bytes(self.gltf.view(entry.get("bufferView")))
                if uri is None
                else self.gltf.resolve(uri, f"images[{row}]")
            )
        return self.images[row], f"{self.gltf.path}: images[{row}] {entry.get('name', '')}".strip()

    def read_colours(self, accessor: object, count: int) -> NDArray[np.uint8]:
        """Return colours (V, 3) uint8, sRGB, of COLOR_0, which is linear by the standard."""
        values = self.read_column(accessor, count, raw=True)
        if values.shape[1] < 3:
            raise self.gltf.error("a COLOR_0 does not have three channels; export it again")
        values, kind, rows = values[:, :3], values.dtype, None
        if kind.kind == "u" and kind.itemsize <= 2:  # a table of all there can be is smaller
            values, rows = np.arange(np.iinfo(kind).max + 1).astype(kind), values
        normalized = self.gltf.item("accessors", accessor).get("normalized") is True
        share = values.astype(np.float64)
        if kind.kind in "iu" and normalized:
            share = np.maximum(values.astype(np.float32) / np.iinfo(kind).max, -1.0).astype(float)
        elif kind.kind == "u":  # integers that forgot to say that they are normalised
            share /= np.iinfo(kind).max
        share = np.clip(np.nan_to_num(share), 0.0, 1.0)
        asset = self.gltf.object_of(self.gltf.content, "asset")
        generator = str(asset.get("generator", "")).lower()
        if not any(writer in generator for writer in _SRGB_WRITERS):
            share = np.where(share <= 0.0031308, 12.92 * share, 1.055 * share ** (1 / 2.4) - 0.055)
        colours = np.rint(255.0 * share).astype(np.uint8)
        return colours if rows is None else colours[rows]


def _read_id(extras: Json) -> str:
    """Return `extras.id` as text; empty where there is none."""
    value = extras.get("id")
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    return str(value) if isinstance(value, str | int | float) else ""
