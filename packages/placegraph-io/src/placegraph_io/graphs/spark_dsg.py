"""Reader of Spark-DSG's JSON: the hierarchical scene graphs of Hydra, Khronos and Clio.

Layers are objects, places, rooms, buildings; a mesh of the whole scene may be there. What is known
of the layout, version by version, stands in `docs/formats.md`; `spark_dsg_write` writes it.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import regular
from placegraph.errors import InputError
from placegraph.io.capture.camera import read_json
from placegraph.io.mesh.model import Model, Picture, Thing
from placegraph_io.graphs.spark_dsg_mesh import (
    DsgMesh,
    Json,
    Piece,
    box_corners,
    box_of,
    box_piece,
    joined,
    logged,
    object_of,
    pieces_of,
    plain,
    read_mesh,
    rooms_of,
    symbol,
)

HEADER = "SPARK_DSG_header"
OWN = "placegraph"
"""Key of the metadata under which `spark_dsg_write` puts what the format has no field for."""
OBJECTS, PLACES, ROOMS, BUILDINGS = 2, 3, 4, 5
"""Numbers of the layers, where a file does not say otherwise."""
NO_LABEL = (1 << 32) - 1
UNKNOWN = "unknown"
LARGEST = 512 << 20
"""Bytes of the largest file: JSON needs five times as much memory."""

_SIGNS = (HEADER.encode(), b'"layer_keys"', b'"layer_ids"', b'"EdgeAttributes"')
_SYMBOL = re.compile(r"[A-Za-z]\(?\d+\)?")  # O3, O(3): a node's number, no name
_DAMAGED = (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError)


def is_spark_dsg(path: str | PathLike[str]) -> bool:
    """Whether a file is a scene graph as Spark-DSG writes it in JSON, or a folder of Hydra's log.

    Never raises.
    """
    file_of = logged(Path(path))
    try:
        if file_of.suffix.lower() != ".json" or not file_of.is_file():
            return False
        with regular(file_of).open("rb") as file:
            head = file.read(1 << 16)
    except (OSError, ValueError):
        return False
    return head.lstrip().startswith(b"{") and any(sign in head for sign in _SIGNS)


def read_spark_dsg(path: str | PathLike[str]) -> Model:
    """Read a scene graph that Spark-DSG saved as JSON, version 1.0 to 1.x, or Hydra's log folder.

    An object's triangles are those of the scene's mesh whose vertices it is connected with, or its
    own mesh (Khronos); else those of its label within its box; else its box stands for it. What
    of the scene's mesh no object owns becomes one object for each semantic label, such as floor
    and walls. An object's room becomes its attribute ``room``; edges become relations where their
    metadata name one.

    Raises
    ------
    InputError
        The file is missing, truncated, larger than 512 MB, of a newer version, or not such a graph.

    """
    path = logged(Path(path))
    if path.is_file() and path.stat().st_size > LARGEST:
        raise InputError(
            f"{path} has {path.stat().st_size >> 20} MB, more than {LARGEST >> 20}; save a coarser "
            "mesh with it, or none (include_mesh=False)."
        )
    content = read_json(path)
    if not isinstance(content, dict) or not isinstance(content.get("nodes"), list):
        raise InputError(f"{path} is no scene graph of Spark-DSG: it has no nodes.")
    try:
        return _Reader(path, content).read()
    except _DAMAGED as error:
        raise InputError(
            f"{path} is not a sound scene graph of Spark-DSG ({error!r}); save it again."
        ) from error


@dataclass(slots=True)
class _Node:
    """One object of the graph."""

    id: int
    label: int
    """Semantic label, -1 where there is none."""
    thing: Thing
    box: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]] | None
    """Centre and lengths (3,) [m], and world_from_box (3, 3)."""
    connections: NDArray[np.int64]
    mesh: DsgMesh | None
    """Of a Khronos object, in the frame of its box."""


@dataclass(slots=True)
class _Reader:
    path: Path
    content: Json
    left_out: Counter[str] = field(default_factory=Counter)

    def read(self) -> Model:
        version = self._version()
        layer = self._layer("OBJECTS", OBJECTS)
        names = self._label_names(layer)
        found = [n for n in self.content["nodes"] if _is_object(n, layer)]
        rooms = rooms_of(self.content, layer, self._layer("ROOMS", ROOMS))
        taken: set[str] = set()
        nodes = [self._node(n, version, names, rooms, taken) for n in found]
        scene = read_mesh(self.content.get("mesh"))
        pieces, things = self._pieces(nodes, scene, names)
        return Model(
            path=self.path,
            things=things,
            picture_of=np.zeros(sum(len(p.triangles) for p in pieces), np.int64),
            pictures=(Picture(None),),
            left_out=self.left_out,
            relations=self._relations([n.id for n in nodes], [n.thing.id for n in nodes]),
            floor=self._floor(),
            **joined(pieces),
        )

    # ------------------------------------------------------------------------------- the head

    def _version(self) -> tuple[int, int, int]:
        header = self.content.get(HEADER)
        if header is None:
            return 1, 0, 0
        numbers = header["version"]
        version = int(numbers["major"]), int(numbers["minor"]), int(numbers["patch"])
        if version[0] > 1:
            raise InputError(
                f"{self.path} is Spark-DSG {'.'.join(map(str, version))}; versions 1.x are read."
            )
        return version

    def _layer(self, name: str, default: int) -> int:
        found = object_of(self.content.get("layer_names")).get(name, default)
        return int(found["layer"] if isinstance(found, dict) else found)

    def _label_names(self, layer: int) -> dict[int, str]:
        spaces = object_of(object_of(self.content.get("metadata")).get("labelspaces"))
        space = spaces.get(f"_l{layer}p0") or {}
        pairs = space.items() if isinstance(space, dict) else space
        return {int(number): str(name) for number, name in pairs}

    def _floor(self) -> float | None:
        own = object_of(object_of(self.content.get("metadata")).get(OWN))
        floor = own.get("floor")
        return float(floor) if isinstance(floor, int | float) else None

    # ---------------------------------------------------------------------------------- nodes

    def _node(
        self,
        node: Json,
        version: tuple[int, int, int],
        names: dict[int, str],
        rooms: dict[int, str],
        taken: set[str],
    ) -> _Node:
        attributes, number = node["attributes"], int(node["id"])
        metadata = object_of(attributes.get("metadata"))
        own = object_of(metadata.get(OWN))
        name = str(attributes.get("name") or "")
        label = int(attributes.get("semantic_label", NO_LABEL))
        label = -1 if label == NO_LABEL else label
        said = names.get(label, "")
        if not said and name and not _SYMBOL.fullmatch(name):
            said = name
        if not said and label >= 0:
            said = f"label {label}"
            self.left_out["labels without a name"] += 1
        id_ = str(own["id"]) if "id" in own else symbol(number)
        while id_ in taken:
            id_ += "'"
        taken.add(id_)
        known = object_of(own.get("attributes")) if own else metadata
        if not own and number in rooms:
            known = {"room": rooms[number], **known}
        return _Node(
            number,
            label,
            Thing(
                id_,
                said or UNKNOWN,
                str(own["name"]) if "name" in own else name,
                plain(known),
            ),
            box_of(attributes.get("bounding_box"), version),
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
            metadata = object_of(object_of(edge.get("info")).get("metadata"))
            own = metadata.get(OWN)
            if own:
                found += [
                    (by_id[a], str(said), by_id[b]) for a, said, b in own if {a, b} <= by_id.keys()
                ]
            elif isinstance(metadata.get("relation"), str):
                found.append((ends[0], metadata["relation"], ends[1]))
            else:
                self.left_out["edges between objects that name no relation"] += 1
        return tuple(found)

    # --------------------------------------------------------------------------------- meshes

    def _pieces(
        self, nodes: list[_Node], scene: DsgMesh | None, names: dict[int, str]
    ) -> tuple[list[Piece], tuple[Thing, ...]]:
        """Triangles of the things, and the things: objects first, then what no object owns."""
        things = [n.thing for n in nodes]
        pieces = []
        bare = []
        for i, node in enumerate(nodes):
            if node.mesh is not None and node.box is not None:
                centre, _, turn = node.box
                pieces.append(Piece.of(node.mesh, i, turn, centre))
            else:
                bare.append(i)
        if scene is not None:
            owner = self._owners(len(scene.points), [(i, nodes[i]) for i in bare])
            wanted = [(i, nodes[i].label, nodes[i].box) for i in bare]
            owned, rest = pieces_of(scene, owner, wanted)
            pieces += owned
            for label, piece in rest:
                said = names.get(label, UNKNOWN if label < 0 else f"label {label}")
                piece.thing = len(things)
                things.append(Thing("mesh" if label < 0 else f"mesh {label}", said))
                pieces.append(piece)
        meshed = {piece.thing for piece in pieces}
        for i in bare:
            if i in meshed:
                continue
            box = nodes[i].box
            if box is None:
                self.left_out["objects with neither mesh nor box"] += 1
                continue
            self.left_out["objects without a mesh, for which their box stands"] += 1
            pieces.append(box_piece(box_corners(*box), i))
        return pieces, tuple(things)

    def _owners(self, count: int, nodes: list[tuple[int, _Node]]) -> NDArray[np.int64]:
        """Row of the object that each vertex of the scene's mesh is connected with, or -1."""
        owner = np.full(count, -1)
        row = {node.id: i for i, node in nodes}
        for i, node in nodes:
            owner[_within(node.connections, count)] = i
        for edge in self.content.get("mesh_edges") or []:  # before version 1.0.2
            source, vertex = row.get(int(edge["source"])), int(edge["target"])
            if source is not None and 0 <= vertex < count:
                owner[vertex] = source
        return owner


def _is_object(node: Json, layer: int) -> bool:
    """Whether a node is an object: agents share its layer, in other partitions."""
    return int(node["layer"]) == layer and "bounding_box" in node["attributes"]


def _within(rows: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    return rows[(rows >= 0) & (rows < count)]
