"""Reader of glTF 2.0 files (.glb, .gltf): one object a node, with its label, mesh and colours.

The object of a mesh is the nearest node above it, itself included, whose `extras` hold `label` or
`id`; without such a node it is the mesh's own. glTF is y-up, and x, y, z become x, -z, y.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from os import PathLike
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from placegraph.io.mesh.gltf import MENDS, Gltf
from placegraph.io.mesh.gltf_file import Json
from placegraph.io.mesh.materials import Materials, vertex_colours
from placegraph.io.mesh.model import Model, Thing

OWN = "placegraph"
"""Key of `extras` for what a node cannot say plainly: `attributes` whose names are taken, and the
`name` "" of an object whose node is called by its label."""
Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Rotation from y-up to z-up."""
_TRIANGLES, _STRIP, _FAN = 4, 5, 6


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
    gltf = Gltf.read(Path(path))
    try:
        return _Reader(gltf).read(np.eye(3) if up == "z" else Z_UP)
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
        raise gltf.error(f"it is not sound glTF ({error!r}); export it again") from error


class _Reader:
    """Collects things and triangles while walking over the nodes."""

    def __init__(self, gltf: Gltf) -> None:
        self.gltf = gltf
        self.left_out: Counter[str] = Counter()
        self.materials = Materials(gltf)
        self.things: list[Thing] = []
        self.thing_rows: dict[str, int] = {}
        self.columns: dict[str, list[NDArray[Any]]] = {
            name: []
            for name in ("vertices", "triangles", "thing_of", "colours", "uv", "picture_of")
        }
        self.vertex_count = 0

    def read(self, map_from_gltf: NDArray[np.float64]) -> Model:
        nodes = self.gltf.walk()
        meshed = [
            (path, world) for path, world in nodes if "mesh" in self.gltf.item("nodes", path[-1])
        ]
        owners = [self._owner(path) for path, _ in meshed]
        taken = {_id(_extras(self.gltf, row)) for row in owners}
        free = (str(n) for n in range(len(owners) + len(taken)) if str(n) not in taken)
        rows: dict[int, int] = {}
        for owner, (path, world) in zip(owners, meshed, strict=True):
            if owner not in rows:
                rows[owner] = self._thing(owner, free)
            turned = world.copy()
            turned[:3] = map_from_gltf @ world[:3]
            mesh = self.gltf.item("meshes", self.gltf.item("nodes", path[-1])["mesh"])
            for primitive in self.gltf.list_of(mesh, "primitives"):
                self._primitive(primitive, turned, rows[owner])
        joined = {
            name: np.concatenate([_EMPTY[name], *arrays]) for name, arrays in self.columns.items()
        }
        return Model(
            path=self.gltf.path,
            things=tuple(self.things),
            pictures=self.materials.pictures(),
            left_out=self.left_out,
            relations=self._relations(),
            floor=self._floor(),
            **joined,
        )

    def _told(self) -> Json:
        """`extras` of the scene, as `placegraph scene export` fills them."""
        scenes = self.gltf.list_of(self.gltf.content, "scenes")
        row = self.gltf.content.get("scene", 0)
        extras = self.gltf.item("scenes", row).get("extras") if scenes else None
        return extras if isinstance(extras, dict) else {}

    def _floor(self) -> float | None:
        """Height of the floor along the map's z, where the file tells it of a single scene."""
        scenes = self._told().get("scenes")
        if not isinstance(scenes, list) or len(scenes) != 1 or not isinstance(scenes[0], dict):
            return None
        floor = scenes[0].get("floor")
        return float(floor) if isinstance(floor, int | float) and abs(floor) < 1e6 else None

    def _relations(self) -> tuple[tuple[int, str, int], ...]:
        """Relations between objects by their `extras.id`; such of objects that are gone are dropped."""
        told = self._told().get("relations")
        rows = [r for r in told if isinstance(r, list)] if isinstance(told, list) else []
        return tuple(
            (self.thing_rows[r[0]], r[1], self.thing_rows[r[2]])
            for r in rows
            if len(r) == 3
            and all(isinstance(word, str) for word in r)
            and {r[0], r[2]} <= self.thing_rows.keys()
        )

    def _owner(self, path: tuple[int, ...]) -> int:
        for row in reversed(path):
            if {"label", "id"} & _extras(self.gltf, row).keys():
                return row
        return path[-1]

    def _thing(self, row: int, free: Any) -> int:  # noqa: ANN401  # an iterator of free ids
        """Row of the thing of a node; nodes that share `extras.id` share their thing."""
        node, extras = self.gltf.item("nodes", row), _extras(self.gltf, row)
        name = str(node.get("name") or "")
        label = str(extras.get("label") or "") or re.sub(r"\.\d{3,}$", "", name) or "unknown"
        id_ = _id(extras) or next(free)
        if id_ in self.thing_rows:
            other = self.things[self.thing_rows[id_]]
            if other.label != label:
                raise self.gltf.error(
                    f"nodes {other.name!r} and {name!r} share extras.id {id_!r} but not their label; "
                    "give each object its own id"
                )
            return self.thing_rows[id_]
        own = extras.get(OWN)
        own = own if isinstance(own, dict) else {}
        if own.get("name") == "" and re.sub(r"\.\d{3,}$", "", name) == label:
            name = ""
        plain = {k: v for k, v in extras.items() if k not in {"label", "id"}}
        attributes = {
            str(k): v if isinstance(v, str) else json.dumps(v)
            for k, v in [*plain.items(), *self.gltf.object_of(own, "attributes").items()]
            if isinstance(v, str | int | float)
        }
        self.thing_rows[id_] = len(self.things)
        self.things.append(Thing(id_, label, name, attributes))
        return len(self.things) - 1

    def _primitive(self, primitive: Json, map_from_node: NDArray[np.float64], thing: int) -> None:
        gltf = self.gltf
        for name in MENDS.keys() & gltf.object_of(primitive, "extensions").keys():
            raise gltf.error(f"it needs {name}; {MENDS[name]}")
        attributes = gltf.object_of(primitive, "attributes")
        mode = gltf.whole(primitive, "mode") if "mode" in primitive else _TRIANGLES
        if mode not in {_TRIANGLES, _STRIP, _FAN} or "POSITION" not in attributes:
            self.left_out["primitives that are no triangles"] += 1
            return
        points = gltf.accessor(attributes["POSITION"]).astype(np.float64)
        if points.shape[1] != 3:
            raise gltf.error("a POSITION has not three coordinates; export it again")
        corners = self._corners(primitive, mode, len(points))
        if np.linalg.det(map_from_node[:3, :3]) < 0:  # a mirrored part is turned inside out
            corners = corners[:, ::-1]
        look = self.materials.look(primitive.get("material"))
        uv = np.zeros((len(points), 2))
        coordinates = attributes.get(f"TEXCOORD_{look.texcoord}")
        if coordinates is not None:
            uv = look.place(self._column(coordinates, len(points))[:, :2].astype(np.float64))
        colours = np.full(points.shape, 255, np.uint8)
        if "COLOR_0" in attributes:
            colours = vertex_colours(gltf, self._column(attributes["COLOR_0"], len(points)))
        with np.errstate(over="ignore", invalid="ignore"):
            placed = points @ map_from_node[:3, :3].T + map_from_node[:3, 3]
        self._append(placed, corners, thing, colours, uv, look.picture)

    def _append(
        self,
        vertices: NDArray[np.float64],
        corners: NDArray[np.int64],
        thing: int,
        colours: NDArray[np.uint8],
        uv: NDArray[np.float64],
        picture: int,
    ) -> None:
        count = len(corners)
        for name, array in (
            ("vertices", vertices), ("triangles", corners + self.vertex_count),
            ("thing_of", np.full(count, thing)), ("colours", colours), ("uv", uv),
            ("picture_of", np.full(count, picture)),
        ):  # fmt: skip
            self.columns[name].append(array)
        self.vertex_count += len(vertices)

    def _column(self, accessor: object, count: int) -> NDArray[Any]:
        column = self.gltf.accessor(accessor)
        if len(column) != count or column.shape[1] < 2:
            raise self.gltf.error(
                f"accessors[{accessor}] has {column.shape} numbers for {count} vertices; export it again"
            )
        return column

    def _corners(self, primitive: Json, mode: int, count: int) -> NDArray[np.int64]:
        """Triangles (T, 3) of a primitive in rows of its vertices."""
        if "indices" in primitive:
            rows = self.gltf.accessor(primitive["indices"])
            if rows.dtype.kind != "u" or rows.shape[1] != 1:
                raise self.gltf.error("indices are not unsigned integers; export it again")
            row = rows[:, 0].astype(np.int64)
        else:
            row = np.arange(count)
        if row.size and row.max() >= count:
            raise self.gltf.error(f"an index is {row.max()} of {count} vertices; export it again")
        if mode == _TRIANGLES:
            return row[: row.size // 3 * 3].reshape(-1, 3)
        first = np.arange(max(row.size - 2, 0))
        if mode == _FAN:
            return np.stack([row[np.zeros_like(first)], row[first + 1], row[first + 2]], axis=1)
        odd = first % 2  # of a strip every other triangle is wound the other way
        return np.stack([row[first], row[first + 1 + odd], row[first + 2 - odd]], axis=1)


_EMPTY: dict[str, Any] = {
    "vertices": np.zeros((0, 3)),
    "triangles": np.zeros((0, 3), np.int64),
    "thing_of": np.zeros(0, np.int64),
    "colours": np.zeros((0, 3), np.uint8),
    "uv": np.zeros((0, 2)),
    "picture_of": np.zeros(0, np.int64),
}


def _extras(gltf: Gltf, row: int) -> Json:
    extras = gltf.item("nodes", row).get("extras")
    return extras if isinstance(extras, dict) else {}


def _id(extras: Json) -> str:
    """`extras.id` as text; empty where there is none."""
    value = extras.get("id")
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    return str(value) if isinstance(value, str | int | float) else ""
