"""Reader of PLY meshes whose vertices or faces carry object ids."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import InputError
from placegraph.io.capture.labels import Entry
from placegraph.io.mesh.glb import Z_UP
from placegraph.io.mesh.model import Model, Picture, Thing
from placegraph.io.mesh.ply_file import Columns, read_columns

OBJECT_PROPERTIES = (
    "objectid", "object_id", "object", "instanceid", "instance_id", "instance", "segment_id",
    "segmentid", "label", "label_id",
)  # fmt: skip
"""Names of properties that hold object ids, first come first; upper and lower case are alike."""
UNKNOWN = "unknown"
"""Id and label of the object made of faces that belong to none."""


def read_ply(
    path: str | PathLike[str],
    *,
    up: Literal["y", "z"] = "z",
    object_property: str | None = None,
    table: Mapping[str, Entry] | None = None,
) -> Model:
    """Read a PLY mesh, text or binary.

    A face belongs to the object its own property names, else to the one most of its vertices name
    (all different: the first). Faces without an object (a negative id, the largest of an unsigned
    type, an id that a given table with others does not hold) become one object "unknown".

    Parameters
    ----------
    up
        Axis that points up in it.
    object_property
        Property of faces or vertices that holds object ids; one of `OBJECT_PROPERTIES` if not given.
    table
        What the ids are called: `placegraph.io.capture.labels.label_table`.

    Raises
    ------
    InputError
        The file is missing, truncated, not PLY, holds no vertex positions, or lacks the property.

    """
    path = Path(path)
    elements = read_columns(path)
    vertex = elements.get("vertex")
    if vertex is None or not {"x", "y", "z"} <= vertex.single.keys():
        raise InputError(f"{path} has no vertices with x, y, z; export it as a mesh.")
    face = elements.get("face", Columns({}, {}))
    vertices = np.stack([vertex.single[axis].astype(np.float64) for axis in "xyz"], axis=1)
    triangles, face_of = _triangles(path, face, len(vertices))
    ids = _object_ids(path, vertex, face, triangles, face_of, object_property)
    colours = _colours(path, vertex.single)
    if colours is None:
        by_face = _colours(path, face.single)
        if by_face is not None:  # colours belong to corners: faces no longer share them
            vertices = vertices[triangles.ravel()]
            colours = np.repeat(by_face[face_of], 3, axis=0)
            triangles = np.arange(len(vertices)).reshape(-1, 3)
    things, thing_of, left_out = things_of_ids(ids, len(triangles), table or {})
    return Model(
        path=path,
        things=things,
        vertices=vertices @ Z_UP.T if up == "y" else vertices,
        triangles=triangles,
        thing_of=thing_of,
        colours=np.full(vertices.shape, 255, np.uint8) if colours is None else colours,
        uv=np.zeros((len(vertices), 2)),
        picture_of=np.zeros(len(triangles), np.int64),
        pictures=(Picture(None),),
        left_out=left_out,
    )


def _triangles(
    path: Path, face: Columns, count: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Triangles (T, 3) of the faces, polygons as fans, and the face of each."""
    names = ("vertex_indices", "vertex_index")
    found = next((face.lists[name] for name in names if name in face.lists), None)
    if found is None:
        return np.zeros((0, 3), np.int64), np.zeros(0, np.int64)
    lengths, entries = found[0], found[1].astype(np.int64)
    if entries.size and not 0 <= int(entries.min()) <= int(entries.max()) < count:
        raise InputError(
            f"{path}: a face names a vertex outside 0 to {count - 1}; export it again."
        )
    starts = np.cumsum(lengths) - lengths
    fans = np.maximum(lengths - 2, 0)
    face_of = np.repeat(np.arange(len(lengths)), fans)
    step = np.arange(len(face_of)) - np.repeat(np.cumsum(fans) - fans, fans)
    first = starts[face_of]
    corners = [entries[first], entries[first + step + 1], entries[first + step + 2]]
    return np.stack(corners, axis=1), face_of


def _object_ids(
    path: Path,
    vertex: Columns,
    face: Columns,
    triangles: NDArray[np.int64],
    face_of: NDArray[np.int64],
    wanted: str | None,
) -> NDArray[np.int64] | None:
    """Object id of each triangle, -1 where it has none; None where the file has no ids."""
    names = OBJECT_PROPERTIES if wanted is None else (wanted.lower(),)
    for columns, by_face in ((face.single, True), (vertex.single, False)):
        known = {name.lower(): column for name, column in columns.items()}
        for name in names:
            if name in known:
                ids = whole(known[name])
                return ids[face_of] if by_face else majority(ids[triangles])
    if wanted is not None:
        there = ", ".join(sorted(vertex.single.keys() | face.single.keys()))
        raise InputError(f"{path} has no property {wanted!r}; it has {there}.")
    return None


def whole(column: NDArray[Any]) -> NDArray[np.int64]:
    """Ids as int64, -1 where there is none."""
    if column.dtype.kind == "f":
        good = np.isfinite(column) & (np.abs(column) < 2**53)
        return np.where(good, np.where(good, column, 0), -1).astype(np.int64)
    top = np.iinfo(column.dtype).max
    ids = column.astype(np.int64)  # what uint64 holds beyond becomes negative: no id
    none = ids < 0
    if column.dtype.kind == "u":  # where -1 did not fit
        none |= column == top
    return np.where(none, -1, ids)


def majority(ids: NDArray[np.int64]) -> NDArray[np.int64]:
    """(T,) what two of three corners (T, 3) say, or else the first."""
    a, b, c = ids.T
    voted: NDArray[np.int64] = np.where(b == c, b, a)
    return voted


def _colours(path: Path, columns: Mapping[str, NDArray[Any]]) -> NDArray[np.uint8] | None:
    """(N, 3) uint8 of red, green, blue: integers as they are, fractions times 255."""
    for prefix in ("", "diffuse_"):
        names = [f"{prefix}{c}" for c in ("red", "green", "blue")]
        if set(names) <= columns.keys():
            stacked: NDArray[Any] = np.stack([columns[name] for name in names], axis=1)
            if stacked.dtype.kind == "f":
                if not np.isfinite(stacked).all():
                    raise InputError(f"{path}: a colour is not a number; export it again.")
                stacked = np.rint(stacked * (255.0 if stacked.max(initial=0.0) <= 1.0 else 1.0))
            elif stacked.dtype == np.uint16:
                stacked = stacked >> 8
            colours: NDArray[np.uint8] = np.clip(stacked, 0, 255).astype(np.uint8)
            return colours
    return None


def things_of_ids(
    ids: NDArray[np.int64] | None, count: int, table: Mapping[str, Entry]
) -> tuple[tuple[Thing, ...], NDArray[np.int64], Counter[str]]:
    """Things, the thing of each of `count` triangles, and what was left out.

    `ids` are those of the triangles, negative where there is none; None makes one unknown thing.
    """
    if ids is None:
        return (Thing("0", UNKNOWN),), np.zeros(count, np.int64), Counter()
    unique, inverse = np.unique(ids, return_inverse=True)
    strange = not any(str(number) in table for number in unique.tolist())  # another file's table
    things: list[Thing] = []
    row = np.empty(len(unique), np.int64)
    unknown = -1
    for i, number in enumerate(unique.tolist()):
        entry = table.get(str(number))
        if number < 0 or (table and entry is None and not strange):
            if unknown < 0:
                unknown = len(things)
                things.append(Thing(UNKNOWN, UNKNOWN))
            row[i] = unknown
            continue
        row[i] = len(things)
        things.append(
            Thing(str(number), UNKNOWN)
            if entry is None
            else Thing(str(number), entry.label, entry.name, entry.attributes)
        )
    found = {t.id for t in things}
    left_out: Counter[str] = Counter()
    missing = sum(id_ not in found for id_ in table)
    if missing:
        left_out["labels of objects that are not there"] = missing
    return tuple(things), row[inverse], left_out
