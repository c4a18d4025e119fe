"""Reader of 3RScan's annotated scans, with what 3DSSG says of their objects.

The textured mesh (`mesh.refined.v2.obj`) gives form and colour, the annotated mesh
(`labels.instances.annotated.v2.ply`, whose own colours are those of labels) or the segments the
objects; `semseg.v2.json` and 3DSSG's `objects.json` their names and attributes, 3DSSG's
`relationships.json` their relations. Scans are z up, in metres.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import InputError, OptionError
from placegraph.io.mesh.model import Model
from placegraph.io.mesh.nearest_kernels import nearest
from placegraph.io.mesh.obj import read_obj
from placegraph.io.mesh.ply import majority, read_columns, read_ply, things_of_ids, whole
from placegraph_io.dataset.scan3r_files import (
    GROUPS,
    LABELLED,
    MESHES,
    SEGMENTS,
    Annotation,
    around,
    first_of,
    read_annotation,
    segment_objects,
)
from placegraph_io.dataset.scan3r_rooms import NAME, Rooms, read_rooms

REACH = 0.05
"""A vertex has the label of the annotated mesh's nearest one within this [m]."""
_SAME = 1e-3
"""Vertices in one order differ by less [m]: by the digits they are written with."""


def is_scan3r(path: Path) -> bool:
    """Whether a path is a folder with one of 3RScan's meshes and one of its files of labels."""
    try:
        return first_of(path, MESHES + LABELLED) is not None and (
            first_of(path, LABELLED + GROUPS) is not None
        )
    except (OSError, ValueError):
        return False


def read_scan3r(
    path: str | PathLike[str],
    *,
    reference_frame: bool = False,
    undo_moves: bool = False,
    rooms: Rooms | str | PathLike[str] | None = None,
    annotations: str | PathLike[str] | None = None,
) -> Model:
    """Read the folder of a scan, which bears the scan's id as its name.

    Vertices take the labels of the annotated mesh in its order where both meshes have the same
    vertices, as the second version of 3RScan has; else of its nearest vertex within `REACH`.
    Faces of no object, or of one that no file names, are one thing "unknown".

    Parameters
    ----------
    reference_frame
        Bring a rescan into the axes of its room's reference, by `3RScan.json`.
    undo_moves
        Bring back, too, each object that `3RScan.json` says was moved to where the reference has it.
    rooms
        `3RScan.json`, or what `read_rooms` read of it; looked for around the folder if not given.
    annotations
        Folder of 3DSSG's files; looked for around the folder if not given.

    Raises
    ------
    InputError
        A file is missing or damaged: no mesh, no labels, no names of objects; most of the mesh has
        no label near it; or `3RScan.json` does not know the scan.
    OptionError
        `undo_moves` without `reference_frame`.

    """
    folder = Path(path)
    if undo_moves and not reference_frame:
        raise OptionError("undo_moves asks for reference_frame=True: moves are told by it.")
    if not folder.is_dir():
        raise InputError(f"{folder} is no folder of a scan; give the one that its mesh lies in.")
    left_out: Counter[str] = Counter()
    annotation = read_annotation(
        folder, None if annotations is None else Path(annotations), left_out
    )
    model = _labelled(folder, annotation, left_out)
    if not reference_frame:
        return model
    known = rooms if isinstance(rooms, Rooms) else read_rooms(_rooms_file(folder, rooms))
    return _placed(model, known, folder.absolute().name, undo_moves=undo_moves)


def _rooms_file(folder: Path, given: str | PathLike[str] | None) -> Path:
    if given is not None:
        return Path(given)
    found = next(around(folder, (NAME,)), None)
    if found is None:
        raise InputError(
            f"{folder}: there is no {NAME} around it, which says how scans are aligned; download it, or "
            "pass its path."
        )
    return found


def _labelled(folder: Path, annotation: Annotation, left_out: Counter[str]) -> Model:
    """Model with things, and relations between them."""
    mesh, labelled = first_of(folder, MESHES), first_of(folder, LABELLED)
    if mesh is not None:
        model = read_obj(mesh, groups="usemtl")
        ids = _ids(folder, model, labelled, left_out)[model.triangles]
        things, thing_of, missing = things_of_ids(
            majority(ids), len(model.triangles), annotation.objects
        )
        model = replace(model, things=things, thing_of=thing_of)
        left_out += model.left_out + missing
    elif labelled is not None:
        model = read_ply(labelled, object_property="objectId", table=annotation.objects)
        model = replace(model, colours=np.full(model.vertices.shape, 255, np.uint8))
        left_out += model.left_out
        left_out[f"colours, which {MESHES[0]} would have"] += 1
    else:
        raise InputError(f"{folder} has neither {MESHES[0]} nor {LABELLED[0]}; download the mesh.")
    row = {thing.id: i for i, thing in enumerate(model.things)}
    pairs = [(row.get(a), name, row.get(b)) for a, name, b in annotation.relations]
    relations = tuple((a, name, b) for a, name, b in pairs if a is not None and b is not None)
    if len(relations) < len(pairs):
        left_out["relations of objects that are not there"] += len(pairs) - len(relations)
    return replace(model, path=folder, relations=relations, left_out=left_out)


def _ids(
    folder: Path, model: Model, labelled: Path | None, left_out: Counter[str]
) -> NDArray[np.int64]:
    """Id of the object of each vertex of the textured mesh, -1: none."""
    if labelled is not None:
        return _ids_of_mesh(model, labelled, left_out)
    segments, groups = first_of(folder, SEGMENTS), first_of(folder, GROUPS)
    if segments is None or groups is None:
        raise InputError(
            f"{folder} has a mesh, but no labels of it: neither {LABELLED[0]} nor {SEGMENTS[0]} with "
            f"{GROUPS[0]}; download one."
        )
    ids = np.array(segment_objects(segments, groups), np.int64)
    if len(ids) != len(model.vertices):
        raise InputError(
            f"{segments} labels {len(ids)} vertices, but {model.path} has {len(model.vertices)}; take "
            f"both from one version of 3RScan, or add {LABELLED[0]}."
        )
    return ids


def _ids_of_mesh(model: Model, path: Path, left_out: Counter[str]) -> NDArray[np.int64]:
    vertex = read_columns(path).get("vertex")
    columns = {} if vertex is None else {name.lower(): v for name, v in vertex.single.items()}
    if not {"x", "y", "z", "objectid"} <= columns.keys():
        raise InputError(
            f"{path} has no vertices with x, y, z and objectId; download 3RScan's annotated mesh again."
        )
    ids = whole(columns["objectid"])
    points = np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=1)
    if points.shape == model.vertices.shape and (np.abs(points - model.vertices) <= _SAME).all():
        return ids
    rows = nearest(model.vertices, points, REACH)
    far = rows < 0
    bare: NDArray[np.bool_] = np.asarray(far[model.triangles].any(axis=1))
    if bare.sum() > bare.size / 2:
        raise InputError(
            f"{path} and {model.path} do not lie over each other: {bare.mean():.0%} of the faces have no "
            f"label within {REACH:g} m; take both of one scan, neither of them aligned."
        )
    left_out["vertices that took the label of the nearest, as the meshes differ"] += int(
        (~far).sum()
    )
    if far.any():
        left_out[f"vertices without a label within {REACH:g} m"] += int(far.sum())
    return np.where(far, -1, np.append(ids, -1)[rows])


def _placed(model: Model, rooms: Rooms, scan: str, *, undo_moves: bool) -> Model:
    """Model in the axes of its room's reference."""
    vertices = _moved(model.vertices, rooms.reference_from(scan))
    model = replace(model, vertices=vertices)
    if not undo_moves:
        return model
    back = {m.scan_id: np.linalg.inv(m.scan_from_reference) for m in rooms.scan(scan).moves}
    scan_from_reference = np.linalg.inv(rooms.reference_from(scan))
    for row, thing in enumerate(model.things):
        if thing.id in back:
            model = _with_moved(model, row, back[thing.id] @ scan_from_reference)
    return model


def _with_moved(model: Model, row: int, moved: NDArray[np.float64]) -> Model:
    """Model with one thing elsewhere; vertices it shares with others are there twice."""
    own = model.thing_of == row
    used, corners = np.unique(model.triangles[own], return_inverse=True)
    triangles = model.triangles.copy()
    triangles[own] = corners.reshape(-1, 3) + len(model.vertices)
    placed = _moved(model.vertices[used], moved)
    return replace(
        model,
        triangles=triangles,
        vertices=np.concatenate([model.vertices, placed]),
        colours=np.concatenate([model.colours, model.colours[used]]),
        uv=np.concatenate([model.uv, model.uv[used]]),
    )


def _moved(points: NDArray[np.float64], transform: NDArray[np.float64]) -> NDArray[np.float64]:
    with np.errstate(invalid="ignore", over="ignore"):
        placed: NDArray[np.float64] = points @ transform[:3, :3].T + transform[:3, 3]
    return placed
