"""Writer of binary PLY meshes with vertex colours and object ids by face."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import write_file
from placegraph.errors import OptionError

OBJECT_ID = "objectId"
"""Property of a face that holds its object's id, as 3RScan calls it."""


def write_ply(
    path: str | PathLike[str],
    vertices: NDArray[Any],
    triangles: NDArray[Any],
    colours: NDArray[np.uint8] | None = None,
    *,
    objects: NDArray[Any] | None = None,
    comments: tuple[str, ...] = (),
) -> Path:
    """Write a mesh as binary PLY; the old file stays until the new one is complete.

    Parameters
    ----------
    vertices
        (V, 3) [m], written as float32.
    triangles
        (T, 3) rows of vertices.
    colours
        (V, 3) uint8, sRGB.
    objects
        (T,) whole numbers below 2^31, written as `objectId` of each face.
    comments
        Lines of the header.

    Raises
    ------
    OptionError
        Arrays do not fit each other, or a comment is not one line of ASCII.
    MapError, MapLockedError
        The file cannot be written.

    """
    for name, column, shape in (
        ("vertices", vertices, (len(vertices), 3)),
        ("triangles", triangles, (len(triangles), 3)),
        ("colours", colours, (len(vertices), 3)),
        ("objects", objects, (len(triangles),)),
    ):
        if column is not None and column.shape != shape:
            raise OptionError(f"{name}: shape {column.shape} where {shape} belongs.")
    if not all(line.isascii() and line.isprintable() for line in comments):
        raise OptionError(f"comments: {comments!r}; a comment is one line of ASCII.")
    points = [("at", "<f4", 3)] + ([] if colours is None else [("colour", "u1", 3)])
    rows = np.empty(len(vertices), points)
    rows["at"] = vertices
    if colours is not None:
        rows["colour"] = colours
    corners = [("count", "u1"), ("corners", "<i4", 3)]
    faces = np.empty(len(triangles), corners + ([] if objects is None else [("object", "<i4")]))
    faces["count"], faces["corners"] = 3, triangles
    if objects is not None:
        faces["object"] = objects
    head = _head(len(vertices), len(triangles), colours is not None, objects is not None, comments)
    return write_file(path, [head.encode("ascii"), rows.tobytes(), faces.tobytes()])


def _head(
    vertices: int, triangles: int, coloured: bool, owned: bool, comments: tuple[str, ...]
) -> str:
    """Header of a file of so many vertices and triangles."""
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {line}" for line in comments),
        f"element vertex {vertices}",
        *(f"property float {axis}" for axis in "xyz"),
        *(f"property uchar {c}" for c in ("red", "green", "blue") if coloured),
        f"element face {triangles}",
        "property list uchar int vertex_indices",
        *(f"property int {name}" for name in (OBJECT_ID,) if owned),
        "end_header\n",
    ]
    return "\n".join(lines)
