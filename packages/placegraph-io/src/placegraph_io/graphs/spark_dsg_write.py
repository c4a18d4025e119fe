"""Writer of Spark-DSG's JSON: objects, rooms, camera paths and one mesh, for Hydra and its kin."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import quaternion_from_rotation
from placegraph.io.mesh.model import Model
from placegraph_io.graphs.spark_dsg import (
    BUILDINGS,
    HEADER,
    NO_LABEL,
    OBJECTS,
    OWN,
    PLACES,
    ROOMS,
)

Json = dict[str, Any]


VERSION = (1, 1, 3)  # Of the layout that is written; Spark-DSG 1.1.1, 1.1.2 and 1.1.3 load it
AGENT = ord("a")  # Partition and prefix of the first camera path; the next are b, c,
MOST_PATHS = ord("z") - AGENT + 1
_DECIMALS = 6  # of coordinates: a micrometre


def encode_spark_dsg(
    model: Model,
    rooms: Sequence[str],
    *,
    camera_paths: Mapping[str, NDArray[np.float64]] | None = None,
    note: Mapping[str, Any] | None = None,
) -> bytes:
    """Return the text of a scene graph as Spark-DSG 1.1.3 saves it.

    Each thing becomes an object with its box, the vertices of the mesh that are its own, and its
    label's number in the layer's label space; its id, name and attributes stand in its metadata.
    Relations become edges, whose metadata name them. Colours are those of the vertices.

    `model`: things with triangles, and relations between them; `rooms`: (N,) name of the room of each
    thing; things of one name share a room; `camera_paths`: names and (T, 4, 4) map_from_camera: each
    becomes a chain of agents; `note`: more metadata of the graph, under ``placegraph``.
    """
    corners, triangles, vertex_thing, vertex = _owned(model)
    labels = sorted({t.label for t in model.objects})
    number = {label: i for i, label in enumerate(labels)}
    semantic = np.array([number[t.label] for t in model.objects], np.int64)
    boxes = _boxes(corners, vertex_thing, len(model.objects))
    colours = model.colours[vertex]
    ends = np.searchsorted(vertex_thing, np.arange(len(model.objects) + 1))
    own = [np.arange(low, high) for low, high in pairwise(ends.tolist())]
    objects = [
        _object(i, model, int(semantic[i]), boxes[i], rows, colours[rows])
        for i, rows in enumerate(own)
    ]
    levels = [OBJECTS, PLACES, ROOMS, BUILDINGS]
    room_nodes, room_edges = _rooms(rooms, boxes)
    agents, agent_edges = _agents(camera_paths or {})
    keys = [_key(level) for level in levels]
    keys += [_key(OBJECTS, AGENT + k) for k in range(len(camera_paths or {}))]
    spaces = {f"_l{OBJECTS}p0": [[i, label] for i, label in enumerate(labels)]}
    content = {
        HEADER: _header(),
        "metadata": {OWN: dict(note or {}), "labelspaces": spaces},
        "directed": False,
        "multigraph": False,
        "layer_keys": sorted(keys, key=lambda k: (k["layer"], k["partition"])),
        "layer_ids": levels,  # what version 1.1.1 asks for
        "layer_names": {
            "OBJECTS": _key(OBJECTS), "AGENTS": _key(OBJECTS), "PLACES": _key(PLACES),
            "ROOMS": _key(ROOMS), "BUILDINGS": _key(BUILDINGS),
        },
        "nodes": objects + room_nodes + agents,
        "edges": _relations(model) + room_edges + agent_edges,
        "mesh": _mesh(corners, triangles, colours, semantic[vertex_thing]),
    }  # fmt: skip
    return json.dumps(content, separators=(",", ":"), ensure_ascii=False).encode()


def node_id(prefix: str, row: int) -> int:
    """Return the id of a node by its layer's letter and its row."""
    return ord(prefix) << 56 | row


def _header() -> Json:
    numbers = dict(zip(("major", "minor", "patch"), VERSION, strict=True))
    return {"project_name": "main", "version": numbers}


def _key(layer: int, partition: int = 0) -> Json:
    return {"layer": layer, "partition": partition}


def _owned(
    model: Model,
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Split vertices that several things share.

    Returns vertices (W, 3), triangles (T, 3), and for each vertex its thing (W,) and the row it
    had (W,).
    """
    count = len(model.vertices)
    pairs = model.object_of[:, None] * count + model.triangles
    unique, corners = np.unique(pairs, return_inverse=True)
    thing, vertex = np.divmod(unique, max(count, 1))
    return model.vertices[vertex], corners.reshape(-1, 3), thing, vertex


def _boxes(
    corners: NDArray[np.float64], owner: NDArray[np.int64], count: int
) -> NDArray[np.float64]:
    """Return (N, 2, 3) lowest and highest corner of each thing's vertices [m]; 0 where it has none."""
    boxes = np.zeros((count, 2, 3))
    rows, starts = np.unique(owner, return_index=True)
    if rows.size:
        boxes[rows, 0] = np.minimum.reduceat(corners, starts)
        boxes[rows, 1] = np.maximum.reduceat(corners, starts)
    return boxes


def _semantic(
    name: str, box: NDArray[np.float64], label: int, colour: tuple[int, ...], own: Json, kind: str
) -> Json:
    """Return the attributes that objects and rooms share; a box without extent is invalid."""
    middle = np.round(box.mean(axis=0), _DECIMALS).tolist()
    lengths = np.round(box[1] - box[0], _DECIMALS).tolist()
    identity = {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0}
    return {
        "type": kind,
        "position": middle,
        "last_update_time_ns": 0,
        "is_active": False,
        "is_predicted": False,
        "metadata": {OWN: own} if own else {},
        "name": name,
        "color": dict(zip("rgba", (*colour, 255), strict=True)),
        "bounding_box": {
            "type": "AABB" if any(lengths) else "INVALID",
            "dimensions": lengths, "world_P_center": middle, "world_R_center": identity,
        },
        "semantic_label": label,
        "semantic_feature": {"rows": 0, "cols": 0, "data": None},
    }  # fmt: skip


def _object(
    row: int,
    model: Model,
    label: int,
    box: NDArray[np.float64],
    vertices: NDArray[np.int64],
    colours: NDArray[np.uint8],
) -> Json:
    thing = model.objects[row]
    mean = colours.mean(axis=0) if len(colours) else np.zeros(3)
    own = {"id": thing.id, "name": thing.name, "attributes": thing.attributes}
    tint = tuple(int(v) for v in np.rint(mean))
    attributes = _semantic(
        thing.name or thing.label, box, label, tint, own, "ObjectNodeAttributes"
    ) | {
        "mesh_connections": vertices.tolist(),
        "registered": False,
        "world_R_object": {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0},
    }
    return {"id": node_id("O", row), **_key(OBJECTS), "attributes": attributes}


def _rooms(rooms: Sequence[str], boxes: NDArray[np.float64]) -> tuple[list[Json], list[Json]]:
    """Return a node for each room, and an edge to each of its things."""
    nodes, edges = [], []
    for k, name in enumerate(dict.fromkeys(rooms)):
        members = [i for i, room in enumerate(rooms) if room == name]
        box = np.stack([boxes[members, 0].min(axis=0), boxes[members, 1].max(axis=0)])
        attributes = _semantic(name, box, NO_LABEL, (255, 255, 255), {}, "RoomNodeAttributes")
        attributes["semantic_class_probabilities"] = {}
        nodes.append({"id": node_id("R", k), **_key(ROOMS), "attributes": attributes})
        edges += [_edge(node_id("R", k), node_id("O", i)) for i in members]
    return nodes, edges


def _relations(model: Model) -> list[Json]:
    """Return an edge for each pair of related things: the format has at most one a pair."""
    entries_of: dict[tuple[int, int], list[list[str]]] = {}
    for a, relation, b in model.relations:
        if a != b:
            entry = [model.objects[a].id, relation, model.objects[b].id]
            entries_of.setdefault((min(a, b), max(a, b)), []).append(entry)
    return [
        _edge(node_id("O", a), node_id("O", b), {OWN: entries})
        for (a, b), entries in entries_of.items()
    ]


def _edge(source: int, target: int, metadata: Json | None = None) -> Json:
    info = {"type": "EdgeAttributes", "weighted": False, "weight": 1.0, "metadata": metadata or {}}
    return {"source": source, "target": target, "info": info}


def _agents(paths: Mapping[str, NDArray[np.float64]]) -> tuple[list[Json], list[Json]]:
    """Return a chain of nodes for each path, in a partition of its own."""
    nodes, edges = [], []
    for k, (name, poses) in enumerate(paths.items()):
        partition = AGENT + k
        turns = quaternion_from_rotation(poses[:, :3, :3])
        for row, (pose, xyzw) in enumerate(zip(poses, turns, strict=True)):
            number = node_id(chr(partition), row)
            attributes = {
                "type": "AgentNodeAttributes",
                "position": np.round(pose[:3, 3], _DECIMALS).tolist(),
                "last_update_time_ns": 0,
                "is_active": False,
                "is_predicted": False,
                "metadata": {OWN: {"path": name, "frame": "map_from_camera"}},
                "timestamp": 0,
                "world_R_body": dict(zip("xyzw", xyzw.tolist(), strict=True)),
                "external_key": number,
                "dbow_ids": None,
                "dbow_values": None,
            }
            nodes.append({"id": number, **_key(OBJECTS, partition), "attributes": attributes})
            if row:
                edges.append(_edge(number - 1, number))
    return nodes, edges


def _mesh(
    corners: NDArray[np.float64],
    triangles: NDArray[np.int64],
    colours: NDArray[np.uint8],
    labels: NDArray[np.int64],
) -> Json:
    return {
        "header": _header(),
        "has_colors": True,
        "has_timestamps": False,
        "has_labels": True,
        "has_first_seen_stamps": False,
        "points": np.round(corners, _DECIMALS).tolist(),
        "colors": [{"r": r, "g": g, "b": b, "a": 255} for r, g, b in colours.tolist()],
        "labels": labels.tolist(),
        "faces": triangles.tolist(),
    }
