"""Surfels of SceneGraphFusion: squares of their own, or labels for a mesh of the same place."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import InputError
from placegraph.io.mesh.model import Model, Picture
from placegraph.io.mesh.nearest_kernels import nearest
from placegraph.io.mesh.ply import majority, read_columns, read_ply, whole

Rows = NDArray[np.int64]
Floats = NDArray[np.float64]


SURFELS = ("inseg.ply", "node_semantic.ply")
"""The first has the colours of the place, the second those of labels."""
REACH = 0.1
"""A vertex of a mesh has the label of the nearest surfel within this [m]."""
GRID = 0.04
"""Surfels of a thing are brought together in cubes of this side [m]."""
_OVERLAP = 1.2
_NUMBERS = ("x", "y", "z", "nx", "ny", "nz")


@dataclass(frozen=True, slots=True, eq=False)
class Surfels:
    """Points with the numbers of their segments."""

    path: Path
    points: Floats
    """(S, 3) [m]"""
    normals: Floats
    """(S, 3)"""
    colours: NDArray[np.uint8]
    """(S, 3) sRGB"""
    segments: Rows
    """(S,)"""


def read_surfels(path: Path, left_out: Counter[str]) -> Surfels:
    """Read the surfels of a PLY file; `InputError` where it lacks what they have."""
    vertex = read_columns(path).get("vertex")
    columns = {} if vertex is None else vertex.single
    missing = {*_NUMBERS, "label"} - columns.keys()
    if missing:
        raise InputError(
            f"{path} lacks {', '.join(sorted(missing))} of its points; give what SceneGraphFusion wrote."
        )
    numbers = np.stack([columns[name].astype(np.float64) for name in _NUMBERS], axis=1)
    names = ("red", "green", "blue")
    colours = np.full((len(numbers), 3), 255, np.uint8)
    if path.name == SURFELS[0] and set(names) <= columns.keys():
        colours = np.stack([np.clip(columns[n], 0, 255) for n in names], axis=1).astype(np.uint8)
    else:
        left_out[f"colours, which {SURFELS[0]} would have"] += 1
    good = np.isfinite(numbers).all(axis=1)
    if not good.all():
        left_out["surfels that are no numbers"] += int((~good).sum())
    return Surfels(
        path, numbers[good, :3], numbers[good, 3:], colours[good], whole(columns["label"])[good]
    )


def lent(path: Path, surfels: Surfels, ids: Rows, left_out: Counter[str]) -> tuple[Model, Rows]:
    """A mesh, and the number of the thing of each of its triangles."""
    from placegraph.io.mesh.obj import is_obj, read_obj

    model = read_obj(path) if is_obj(path) else read_ply(path)
    rows = nearest(model.vertices, surfels.points, REACH)
    far = rows < 0
    if far.all():
        raise InputError(
            f"{path} has no vertex within {REACH:g} m of a surfel of {surfels.path}; give the mesh of "
            "that scan, in the axes of its poses."
        )
    if far.any():
        left_out[f"vertices of the mesh without a surfel within {REACH:g} m"] += int(far.sum())
    of = np.where(far, -1, ids[rows])
    return model, majority(of[model.triangles])


def squares(surfels: Surfels, ids: Rows) -> Model:
    """Squares that lie as the surfels of a thing in each cube do on the whole.

    `thing_of` holds numbers of things, not rows.
    """
    cells = np.floor(surfels.points / GRID)
    low = cells.min(axis=0)
    span = cells.max(axis=0) - low + 1
    unique, thing = np.unique(ids, return_inverse=True)
    if not float(span.prod()) * len(unique) < 2.0**62:
        raise InputError(
            f"{surfels.path} reaches over {span.max() * GRID:.3g} m; it must be in metres."
        )
    x, y, z = (cells - low).astype(np.int64).T
    nx, ny, nz = span.astype(np.int64)
    _, group = np.unique(((thing * nx + x) * ny + y) * nz + z, return_inverse=True)
    count = np.bincount(group)

    def mean(values: NDArray[Any]) -> Floats:
        return np.stack([np.bincount(group, column) / count for column in values.T], axis=1)

    centre, normal = mean(surfels.points), mean(surfels.normals)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.where(length > 1e-6, normal / np.maximum(length, 1e-6), (0.0, 0.0, 1.0))
    least = np.eye(3)[np.abs(normal).argmin(axis=1)]
    along = np.cross(normal, least)
    along *= _OVERLAP * GRID / 2 / np.linalg.norm(along, axis=1, keepdims=True)
    across = np.cross(normal, along)
    corners = [centre - along - across, centre + along - across]
    corners += [centre + along + across, centre - along + across]
    first = 4 * np.arange(len(count))[:, None]
    vertices = np.stack(corners, axis=1).reshape(-1, 3)
    of = np.empty(len(count), np.int64)
    of[group] = ids
    return Model(
        path=surfels.path,
        things=(),
        vertices=vertices,
        triangles=np.concatenate([first + (0, 1, 2), first + (0, 2, 3)], axis=1).reshape(-1, 3),  # noqa: RUF005
        thing_of=np.repeat(of, 2),
        colours=np.repeat(np.rint(mean(surfels.colours)).astype(np.uint8), 4, axis=0),
        uv=np.zeros((len(vertices), 2)),
        picture_of=np.zeros(2 * len(count), np.int64),
        pictures=(Picture(None),),
    )
