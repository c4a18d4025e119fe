"""Reader of Spark-DSG's JSON: the hierarchical scene graphs of Hydra, Khronos and Clio.

Layers are objects, places, rooms, buildings; a mesh of the whole scene may be there. What is known
of the layout, version by version, stands in `docs/formats.md`; `spark_dsg_write` writes it.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import check_regular
from placegraph.core.geometry import rotation_from_quaternion
from placegraph.errors import InputError
from placegraph.io.capture.json_files import read_json
from placegraph.io.mesh.model import Model, ModelObject, Texture
from placegraph.io.mesh.ply import majority_vote

Floats = NDArray[np.float64]
Box = tuple[Floats, Floats, Floats]  # Centre and lengths (3,) [m], and world_from_box (3, 3)


MARGIN = 0.05
"""Distance by which an object's triangles may exceed its box [m]: about a voxel of Hydra's mesh."""
GREY = 200  # of surfaces without a colour
_QUADS = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))


@dataclass(frozen=True, slots=True, eq=False)
class DsgMesh:
    """Mesh of a scene graph file."""

    points: Floats  # (V, 3) [m]
    faces: NDArray[np.int64]  # (T, 3)
    colours: NDArray[np.uint8]  # (V, 3)
    labels: NDArray[np.int64]  # (V,) semantic labels, -1 where there are none


@dataclass(slots=True, eq=False)
class Piece:
    """Triangles of one object, with vertices of their own."""

    row: int  # of the object, or -1
    vertices: Floats
    triangles: NDArray[np.int64]
    colours: NDArray[np.uint8]

    @classmethod
    def from_mesh(cls, mesh: DsgMesh, row: int, turn: Floats, shift: Floats) -> Piece:
        """Return all triangles of a mesh, rotated (3, 3) and translated (3,)."""
        return cls(row, mesh.points @ turn.T + shift, mesh.faces, mesh.colours)


def read_mesh(entry: Any) -> DsgMesh | None:  # noqa: ANN401  # JSON
    """Return the mesh of a file's entry; None where there is no triangle.

    Raises KeyError, TypeError, ValueError or IndexError where the entry makes no sense.
    """
    if not isinstance(entry, dict) or not entry.get("faces"):
        return None
    if "vertices" in entry:  # before version 1.0.2
        points = [[v[axis] for axis in "xyz"] for v in entry["vertices"]]
        tints = entry["vertices"]
    else:
        points, tints = entry["points"], entry.get("colors")
    at = np.array(points, np.float64).reshape(-1, 3)
    faces = np.array(entry["faces"], np.int64).reshape(-1, 3)
    if not 0 <= int(faces.min()) <= int(faces.max()) < len(at):
        raise ValueError(f"a face refers to a vertex outside 0 to {len(at) - 1}")
    colours = np.full((len(at), 3), GREY, np.uint8)
    if tints and len(tints) == len(at):
        colours = np.array([[t["r"], t["g"], t["b"]] for t in tints], np.uint8)
    labels = np.full(len(at), -1)
    if len(entry.get("labels") or []) == len(at):
        labels = np.array(entry["labels"], np.int64)
        labels[(labels < 0) | (labels >= (1 << 32) - 1)] = -1
    return DsgMesh(at, faces, colours, labels)


def split_mesh(
    mesh: DsgMesh,
    owner: NDArray[np.int64],
    wanted: Iterable[tuple[int, int, Box | None]],
) -> tuple[list[Piece], list[tuple[int, Piece]]]:
    """Split the mesh of a scene into the pieces of its objects.

    `owner` is (V,) the row of the object that each vertex is connected with, or -1; `wanted` are row,
    semantic label and box of each object that may own triangles. Returns a piece for each object that
    owns triangles, and semantic label and piece (whose row is -1) of the others.
    """
    face_owner = majority_vote(owner[mesh.faces])
    face_label = majority_vote(mesh.labels[mesh.faces])
    has = set(np.unique(face_owner).tolist())
    for row, label, box in wanted:
        if row in has or label < 0 or box is None:
            continue
        free = np.flatnonzero((face_owner < 0) & (face_label == label))
        inside = _are_inside(mesh.points[mesh.faces[free]], box)
        face_owner[free[inside]] = row
    owned = [
        _cut_faces(mesh, face_owner == row, row)
        for row in np.unique(face_owner).tolist()
        if row >= 0
    ]
    unowned = face_owner < 0
    rest = [
        (label, _cut_faces(mesh, unowned & (face_label == label), -1))
        for label in np.unique(face_label[unowned]).tolist()
    ]
    return owned, rest


def box_corners(centre: Floats, lengths: Floats, turn: Floats) -> Floats:
    """Return (8, 3) corners of a box; corner 4 i + 2 j + k lies low or high along x, y, z by i, j, k."""
    signs = np.array([(i >> 2 & 1, i >> 1 & 1, i & 1) for i in range(8)]) - 0.5
    corners: Floats = (signs * lengths) @ turn.T + centre
    return corners


def box_piece(corners: Floats, row: int) -> Piece:
    """Return twelve triangles, seen from outside, of a box's corners (8, 3)."""
    faces = np.array([f for a, b, c, d in _QUADS for f in ((a, b, c), (a, c, d))])
    return Piece(row, corners, faces, np.full((8, 3), GREY, np.uint8))


def _are_inside(corners: Floats, box: Box) -> NDArray[np.bool_]:
    """Return whether triangles (T, 3, 3) lie within a box and its margin."""
    centre, lengths, turn = box
    away = np.abs((corners - centre) @ turn) - lengths / 2
    within: NDArray[np.bool_] = away.max(axis=(1, 2), initial=-np.inf) <= MARGIN
    return within


def _cut_faces(mesh: DsgMesh, faces: NDArray[np.bool_], row: int) -> Piece:
    used, corners = np.unique(mesh.faces[faces], return_inverse=True)
    return Piece(row, mesh.points[used], corners.reshape(-1, 3), mesh.colours[used])


def read_box(entry: object, version: tuple[int, int, int]) -> Box | None:
    """Return centre, lengths (3,) [m] and world_from_box (3, 3) of a box; None where it is invalid."""
    box: dict[str, Any] = entry if isinstance(entry, dict) else {}
    if box.get("type") in {None, "INVALID"}:
        return None
    if version < (1, 0, 3) and "min" in box:
        low, high = _vector(box["min"]), _vector(box["max"])
        lengths = high - low
        centre = (low + high) / 2 if box["type"] == "AABB" else _vector(box["world_P_center"])
    else:
        centre, lengths = _vector(box["world_P_center"]), _vector(box["dimensions"])
    turn = np.eye(3)
    if box["type"] != "AABB":
        with np.errstate(invalid="ignore"):  # of a zero quaternion: refused below
            turn = rotation_from_quaternion([float(box["world_R_center"][k]) for k in "xyzw"])
    if not np.isfinite([centre, lengths, *turn]).all() or (lengths < 0).any() or not lengths.any():
        return None
    return centre, lengths, turn


def _vector(values: Any) -> Floats:  # noqa: ANN401  # JSON
    return np.array(values, np.float64).reshape(3)


def join_pieces(pieces: list[Piece]) -> dict[str, NDArray[Any]]:
    """Return the columns of the model that pieces make."""
    starts = np.cumsum([0, *(len(p.vertices) for p in pieces)])
    faces = [p.triangles + start for p, start in zip(pieces, starts, strict=False)]
    return {
        "vertices": np.concatenate([np.zeros((0, 3)), *(p.vertices for p in pieces)]),
        "triangles": np.concatenate([np.zeros((0, 3), np.int64), *faces]),
        "object_of": np.concatenate(
            [np.zeros(0, np.int64), *(np.full(len(p.triangles), p.row) for p in pieces)]
        ),
        "colours": np.concatenate([np.zeros((0, 3), np.uint8), *(p.colours for p in pieces)]),
        "uv": np.zeros((int(starts[-1]), 2)),
    }


Json = dict[str, Any]
_LOGGED = ("dsg_with_mesh.json", "dsg.json")  # Files in `backend/` of Hydra's log folder


def find_graph_file(path: Path) -> Path:
    """Return the graph in a log folder of Hydra, with its mesh if possible; else the path itself."""
    try:
        tried = (path / part / name for name in _LOGGED for part in ("backend", ""))
        return next((file for file in tried if file.is_file()), path) if path.is_dir() else path
    except (OSError, ValueError):
        return path


def find_rooms(content: Json, layer: int, top: int) -> dict[int, str]:
    """Return the name of the room (layer `top`) of each object (`layer`), direct or through its place."""
    level = {int(n["id"]): int(n["layer"]) for n in content["nodes"]}
    parent: dict[int, int] = {}
    for edge in content.get("edges") or []:
        ends = sorted((int(edge["source"]), int(edge["target"])), key=lambda i: level.get(i, 0))
        if level.get(ends[0], 0) < level.get(ends[1], 0):
            parent.setdefault(ends[0], ends[1])
    title = {
        int(n["id"]): str(n["attributes"].get("name") or node_name(int(n["id"])))
        for n in content["nodes"]
        if int(n["layer"]) == top
    }
    rooms = {}
    for number in (i for i, at in level.items() if at == layer):
        above = parent.get(number)
        while above is not None and level[above] < top:
            above = parent.get(above)
        if above in title:
            rooms[number] = title[above]
    return rooms


def node_name(number: int) -> str:
    """Return the name of a node: O3 for an object, R0 for a room."""
    return f"{chr(number >> 56)}{number & (1 << 56) - 1}" if 0 < number >> 56 < 128 else str(number)


def as_object(value: object) -> Json:
    """Return a JSON object, or an empty one where the value is none."""
    return value if isinstance(value, dict) else {}


def text_attributes(attributes: Json) -> dict[str, str]:
    """Return the attributes that are texts or numbers, as text."""
    return {
        str(k): v if isinstance(v, str) else json.dumps(v)
        for k, v in attributes.items()
        if isinstance(v, str | int | float)
    }


HEADER = "SPARK_DSG_header"
OWN = "placegraph"  # Key of the metadata with values that the format has no field for
OBJECTS, PLACES, ROOMS, BUILDINGS = 2, 3, 4, 5  # Default numbers of the layers
NO_LABEL = (1 << 32) - 1
UNKNOWN = "unknown"
LARGEST = 512 << 20  # Bytes of the largest file that is read: JSON needs five times as much memory

_SIGNS = (HEADER.encode(), b'"layer_keys"', b'"layer_ids"', b'"EdgeAttributes"')
_SYMBOL = re.compile(r"[A-Za-z]\(?\d+\)?")  # O3, O(3): a node's number, no name
_DAMAGED = (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError)


def is_spark_dsg(path: str | PathLike[str]) -> bool:
    """Return whether a file is a scene graph as Spark-DSG writes it in JSON, or a folder of Hydra's log.

    Never raises.
    """
    file_of = find_graph_file(Path(path))
    try:
        if file_of.suffix.lower() != ".json" or not file_of.is_file():
            return False
        with check_regular(file_of).open("rb") as file:
            head = file.read(1 << 16)
    except (OSError, ValueError):
        return False
    return head.lstrip().startswith(b"{") and any(sign in head for sign in _SIGNS)


def read_spark_dsg(path: str | PathLike[str]) -> Model:
    """Read a scene graph that Spark-DSG saved as JSON, version 1.0 to 1.x, or Hydra's log folder.

    An object's triangles are those of the scene's mesh whose vertices it is connected with, or its
    own mesh (Khronos); else those of its label within its box; else its box. Other triangles become
    one object for each semantic label, such as floor and walls. An object's room becomes its attribute
    ``room``; edges become relations where their metadata name one. Raises `InputError` where the file is
    missing, truncated, larger than 512 MB, of a newer version, or no such graph.
    """
    path = find_graph_file(Path(path))
    if path.is_file() and path.stat().st_size > LARGEST:
        raise InputError(
            f"{path} has {path.stat().st_size >> 20} MB, but the limit is {LARGEST >> 20} MB. Save "
            "it with a coarser mesh, or without one (include_mesh=False)."
        )
    content = read_json(path)
    if not isinstance(content, dict) or not isinstance(content.get("nodes"), list):
        raise InputError(f"{path} has no nodes, so it is not a scene graph of Spark-DSG.")
    try:
        return _Reader(path, content).read()
    except _DAMAGED as error:
        raise InputError(
            f"{path} is damaged, or not a scene graph of Spark-DSG ({error!r}); save it again."
        ) from error


@dataclass(slots=True)
class _Node:
    """One object of the graph."""

    id: int
    label: int  # Semantic label, or -1
    model_object: ModelObject
    box: Box | None
    connections: NDArray[np.int64]
    mesh: DsgMesh | None  # Mesh of a Khronos object, in the frame of its box


@dataclass(slots=True)
class _Reader:
    path: Path
    content: Json
    left_out: Counter[str] = field(default_factory=Counter)

    def read(self) -> Model:
        version = self._version()
        layer = self._layer("OBJECTS", OBJECTS)
        names = self._label_names(layer)
        found = [
            n
            for n in self.content["nodes"]
            if (int(n["layer"]) == layer and "bounding_box" in n["attributes"])
        ]
        rooms = find_rooms(self.content, layer, self._layer("ROOMS", ROOMS))
        used_ids: set[str] = set()
        nodes = [self._node(n, version, names, rooms, used_ids) for n in found]
        scene = read_mesh(self.content.get("mesh"))
        pieces, objects = self._pieces(nodes, scene, names)
        return Model(
            path=self.path,
            objects=objects,
            picture_of=np.zeros(sum(len(p.triangles) for p in pieces), np.int64),
            pictures=(Texture(None),),
            left_out=self.left_out,
            relations=self._relations([n.id for n in nodes], [n.model_object.id for n in nodes]),
            floor=self._floor(),
            **join_pieces(pieces),
        )

    def _version(self) -> tuple[int, int, int]:
        header = self.content.get(HEADER)
        if header is None:
            return 1, 0, 0
        numbers = header["version"]
        version = int(numbers["major"]), int(numbers["minor"]), int(numbers["patch"])
        if version[0] > 1:
            raise InputError(
                f"{self.path} is of version {'.'.join(map(str, version))} of Spark-DSG, but only "
                "1.x is supported."
            )
        return version

    def _layer(self, name: str, default: int) -> int:
        found = as_object(self.content.get("layer_names")).get(name, default)
        return int(found["layer"] if isinstance(found, dict) else found)

    def _label_names(self, layer: int) -> dict[int, str]:
        spaces = as_object(as_object(self.content.get("metadata")).get("labelspaces"))
        space = spaces.get(f"_l{layer}p0") or {}
        pairs = space.items() if isinstance(space, dict) else space
        return {int(number): str(name) for number, name in pairs}

    def _floor(self) -> float | None:
        own = as_object(as_object(self.content.get("metadata")).get(OWN))
        floor = own.get("floor")
        return float(floor) if isinstance(floor, int | float) else None

    def _node(
        self,
        node: Json,
        version: tuple[int, int, int],
        names: dict[int, str],
        rooms: dict[int, str],
        used_ids: set[str],
    ) -> _Node:
        attributes, number = node["attributes"], int(node["id"])
        metadata = as_object(attributes.get("metadata"))
        own = as_object(metadata.get(OWN))
        name = str(attributes.get("name") or "")
        label = int(attributes.get("semantic_label", NO_LABEL))
        label = -1 if label == NO_LABEL else label
        word = names.get(label, "")
        if not word and name and not _SYMBOL.fullmatch(name):
            word = name
        if not word and label >= 0:
            word = f"label {label}"
            self.left_out["labels without a name"] += 1
        id_ = str(own["id"]) if "id" in own else node_name(number)
        while id_ in used_ids:
            id_ += "'"
        used_ids.add(id_)
        known = as_object(own.get("attributes")) if own else metadata
        if not own and number in rooms:
            known = {"room": rooms[number], **known}
        return _Node(
            number,
            label,
            ModelObject(
                id_,
                word or UNKNOWN,
                str(own["name"]) if "name" in own else name,
                text_attributes(known),
            ),
            read_box(attributes.get("bounding_box"), version),
            np.array(attributes.get("mesh_connections") or [], np.int64).reshape(-1),
            read_mesh(attributes.get("mesh")),
        )

    def _relations(self, numbers: list[int], ids: list[str]) -> tuple[tuple[int, str, int], ...]:
        row = {number: i for i, number in enumerate(numbers)}
        by_id = {id_: i for i, id_ in enumerate(ids)}
        found: list[tuple[int, str, int]] = []
        for edge in self.content.get("edges") or []:
            ends = row.get(int(edge["source"])), row.get(int(edge["target"]))
            if ends[0] is None or ends[1] is None:
                continue
            metadata = as_object(as_object(edge.get("info")).get("metadata"))
            own = metadata.get(OWN)
            if own:
                found += [
                    (by_id[a], str(word), by_id[b]) for a, word, b in own if {a, b} <= by_id.keys()
                ]
            elif isinstance(metadata.get("relation"), str):
                found.append((ends[0], metadata["relation"], ends[1]))
            else:
                self.left_out["edges between objects without a relation's name"] += 1
        return tuple(found)

    def _pieces(
        self, nodes: list[_Node], scene: DsgMesh | None, names: dict[int, str]
    ) -> tuple[list[Piece], tuple[ModelObject, ...]]:
        """Return the pieces, and their objects, then one object for each label of unowned surfaces."""
        objects = [n.model_object for n in nodes]
        pieces = []
        bare = []
        for i, node in enumerate(nodes):
            if node.mesh is not None and node.box is not None:
                centre, _, turn = node.box
                pieces.append(Piece.from_mesh(node.mesh, i, turn, centre))
            else:
                bare.append(i)
        if scene is not None:
            owner = self._owners(len(scene.points), [(i, nodes[i]) for i in bare])
            wanted = [(i, nodes[i].label, nodes[i].box) for i in bare]
            owned, rest = split_mesh(scene, owner, wanted)
            pieces += owned
            for label, piece in rest:
                word = names.get(label, UNKNOWN if label < 0 else f"label {label}")
                piece.row = len(objects)
                objects.append(ModelObject("mesh" if label < 0 else f"mesh {label}", word))
                pieces.append(piece)
        meshed = {piece.row for piece in pieces}
        for i in (i for i in bare if i not in meshed):
            if (box := nodes[i].box) is None:
                self.left_out["objects without a mesh or box"] += 1
                continue
            self.left_out["objects without a mesh, shown as boxes"] += 1
            pieces.append(box_piece(box_corners(*box), i))
        return pieces, tuple(objects)

    def _owners(self, count: int, nodes: list[tuple[int, _Node]]) -> NDArray[np.int64]:
        """Return the row of the object that each vertex of the scene's mesh is connected with, or -1."""
        owner = np.full(count, -1)
        row = {node.id: i for i, node in nodes}
        for i, node in nodes:
            rows = node.connections
            owner[rows[(rows >= 0) & (rows < count)]] = i
        for edge in self.content.get("mesh_edges") or []:  # before version 1.0.2
            source, vertex = row.get(int(edge["source"])), int(edge["target"])
            if source is not None and 0 <= vertex < count:
                owner[vertex] = source
        return owner
