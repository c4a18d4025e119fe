"""Nodes and meshes of Spark-DSG's JSON, and which of their triangles are whose."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import rotation_from_quaternion

Floats = NDArray[np.float64]
Box = tuple[Floats, Floats, Floats]


MARGIN = 0.05
"""How far beyond its box an object's triangles may reach [m]: about a voxel of Hydra's mesh."""
GREY = 200
"""Of what has no colour."""
_QUADS = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))


@dataclass(frozen=True, slots=True, eq=False)
class DsgMesh:
    """A mesh as the file has it."""

    points: Floats
    """(V, 3) [m]"""
    faces: NDArray[np.int64]
    """(T, 3)"""
    colours: NDArray[np.uint8]
    """(V, 3)"""
    labels: NDArray[np.int64]
    """(V,) semantic labels, -1 where there are none."""


@dataclass(slots=True, eq=False)
class Piece:
    """Triangles of one thing, with vertices of their own."""

    thing: int
    vertices: Floats
    triangles: NDArray[np.int64]
    colours: NDArray[np.uint8]

    @classmethod
    def of(cls, mesh: DsgMesh, thing: int, turn: Floats, shift: Floats) -> Piece:
        """All triangles of a mesh whose frame is turned (3, 3) and shifted (3,)."""
        return cls(thing, mesh.points @ turn.T + shift, mesh.faces, mesh.colours)


def read_mesh(entry: Any) -> DsgMesh | None:  # noqa: ANN401  # JSON
    """Mesh of a file's entry; None where there is no triangle.

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
        raise ValueError(f"a face names a vertex outside 0 to {len(at) - 1}")
    colours = np.full((len(at), 3), GREY, np.uint8)
    if tints and len(tints) == len(at):
        colours = np.array([[t["r"], t["g"], t["b"]] for t in tints], np.uint8)
    labels = np.full(len(at), -1)
    if len(entry.get("labels") or []) == len(at):
        labels = np.array(entry["labels"], np.int64)
        labels[(labels < 0) | (labels >= (1 << 32) - 1)] = -1
    return DsgMesh(at, faces, colours, labels)


def pieces_of(
    mesh: DsgMesh,
    owner: NDArray[np.int64],
    wanted: Iterable[tuple[int, int, Box | None]],
) -> tuple[list[Piece], list[tuple[int, Piece]]]:
    """Share a scene's mesh out.

    Parameters
    ----------
    mesh
        Of the scene.
    owner
        (V,) row of the object that each vertex is connected with, or -1.
    wanted
        Row, semantic label and box of each object that may own triangles.

    Returns
    -------
    owned
        A piece for each object that owns some.
    rest
        Semantic label and piece of what none owns; their thing is -1.

    """
    face_owner = _majority(owner[mesh.faces])
    face_label = _majority(mesh.labels[mesh.faces])
    has = set(np.unique(face_owner).tolist())
    for row, label, box in wanted:
        if row in has or label < 0 or box is None:
            continue
        free = np.flatnonzero((face_owner < 0) & (face_label == label))
        inside = _inside(mesh.points[mesh.faces[free]], box)
        face_owner[free[inside]] = row
    owned = [
        _cut(mesh, face_owner == row, row) for row in np.unique(face_owner).tolist() if row >= 0
    ]
    nobodys = face_owner < 0
    rest = [
        (label, _cut(mesh, nobodys & (face_label == label), -1))
        for label in np.unique(face_label[nobodys]).tolist()
    ]
    return owned, rest


def box_corners(centre: Floats, lengths: Floats, turn: Floats) -> Floats:
    """(8, 3) corners of a box; corner 4 i + 2 j + k lies low or high along x, y, z by i, j, k."""
    signs = np.array([(i >> 2 & 1, i >> 1 & 1, i & 1) for i in range(8)]) - 0.5
    corners: Floats = (signs * lengths) @ turn.T + centre
    return corners


def box_piece(corners: Floats, thing: int) -> Piece:
    """Twelve triangles, seen from outside, of a box's corners (8, 3)."""
    faces = np.array([f for a, b, c, d in _QUADS for f in ((a, b, c), (a, c, d))])
    return Piece(thing, corners, faces, np.full((8, 3), GREY, np.uint8))


def _majority(values: NDArray[np.int64]) -> NDArray[np.int64]:
    """(T,) what two of three corners (T, 3) say, or else the first."""
    a, b, c = values.T
    voted: NDArray[np.int64] = np.where(b == c, b, a)
    return voted


def _inside(corners: Floats, box: Box) -> NDArray[np.bool_]:
    """Whether triangles (T, 3, 3) lie within a box and its margin."""
    centre, lengths, turn = box
    away = np.abs((corners - centre) @ turn) - lengths / 2
    within: NDArray[np.bool_] = away.max(axis=(1, 2), initial=-np.inf) <= MARGIN
    return within


def _cut(mesh: DsgMesh, faces: NDArray[np.bool_], thing: int) -> Piece:
    used, corners = np.unique(mesh.faces[faces], return_inverse=True)
    return Piece(thing, mesh.points[used], corners.reshape(-1, 3), mesh.colours[used])


def box_of(
    entry: object, version: tuple[int, int, int]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]] | None:
    """Centre, lengths and rotation of a box; None of an invalid one."""
    box: dict[str, Any] = entry if isinstance(entry, dict) else {}
    if box.get("type") in {None, "INVALID"}:
        return None
    if version < (1, 0, 3) and "min" in box:
        low, high = _three(box["min"]), _three(box["max"])
        lengths = high - low
        centre = (low + high) / 2 if box["type"] == "AABB" else _three(box["world_P_center"])
    else:
        centre, lengths = _three(box["world_P_center"]), _three(box["dimensions"])
    turn = np.eye(3)
    if box["type"] != "AABB":
        with np.errstate(invalid="ignore"):  # of no rotation at all: not finite, refused below
            turn = rotation_from_quaternion([float(box["world_R_center"][k]) for k in "xyzw"])
    if not np.isfinite([centre, lengths, *turn]).all() or (lengths < 0).any() or not lengths.any():
        return None
    return centre, lengths, turn


def _three(values: Any) -> NDArray[np.float64]:  # noqa: ANN401  # JSON
    return np.array(values, np.float64).reshape(3)


def joined(pieces: list[Piece]) -> dict[str, NDArray[Any]]:
    """Columns of a model."""
    starts = np.cumsum([0, *(len(p.vertices) for p in pieces)])
    faces = [p.triangles + start for p, start in zip(pieces, starts, strict=False)]
    return {
        "vertices": np.concatenate([np.zeros((0, 3)), *(p.vertices for p in pieces)]),
        "triangles": np.concatenate([np.zeros((0, 3), np.int64), *faces]),
        "thing_of": np.concatenate(
            [np.zeros(0, np.int64), *(np.full(len(p.triangles), p.thing) for p in pieces)]
        ),
        "colours": np.concatenate([np.zeros((0, 3), np.uint8), *(p.colours for p in pieces)]),
        "uv": np.zeros((int(starts[-1]), 2)),
    }


Json = dict[str, Any]
_LOGGED = ("dsg_with_mesh.json", "dsg.json")
"""What Hydra saves in `backend/` of its log folder when it ends."""


def logged(path: Path) -> Path:
    """The graph in a folder that Hydra logged to, with its mesh if there is one; else the path itself."""
    try:
        if path.is_dir():
            tried = (path / part / name for name in _LOGGED for part in ("backend", ""))
            return next((file for file in tried if file.is_file()), path)
    except (OSError, ValueError):
        pass
    return path


def rooms_of(content: Json, layer: int, top: int) -> dict[int, str]:
    """Name of the room of each object (`layer`) that lies in one (`top`), itself or by its place."""
    level = {int(n["id"]): int(n["layer"]) for n in content["nodes"]}
    parent: dict[int, int] = {}
    for edge in content.get("edges") or []:
        ends = sorted((int(edge["source"]), int(edge["target"])), key=lambda i: level.get(i, 0))
        if level.get(ends[0], 0) < level.get(ends[1], 0):
            parent.setdefault(ends[0], ends[1])
    title = {
        int(n["id"]): str(n["attributes"].get("name") or symbol(int(n["id"])))
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


def symbol(number: int) -> str:
    """Name of a node by its number: O3 of an object, R0 of a room."""
    return f"{chr(number >> 56)}{number & (1 << 56) - 1}" if 0 < number >> 56 < 128 else str(number)


def object_of(value: object) -> Json:
    """The JSON object that a value is, or an empty one."""
    return value if isinstance(value, dict) else {}


def plain(attributes: Json) -> dict[str, str]:
    """Attributes as text, those that are lists or objects left out."""
    return {
        str(k): v if isinstance(v, str) else json.dumps(v)
        for k, v in attributes.items()
        if isinstance(v, str | int | float)
    }
