"""Reader of the object graphs that ConceptGraphs saves beside its pickles (Gu et al., 2024).

A run's folder holds `obj_json_RUN.json` (`object_1`: `id`, `object_tag`, `object_caption`, `bbox_center`,
`bbox_extent`), `edge_json_RUN.json` (`edge_0`: `object_1_id`, `relationship`, `object_2_id`),
`config_params*.json`, and the objects' points in `pcd_RUN.pkl.gz`, a pickle, which is never opened. So
shapes are known as boxes alone, unless a mesh of the place is given. Boxes of most runs are rotated, and
the JSON does not say how: with a mesh, the rotation that encloses most of it is taken.
(save_obj_json, save_edge_json of conceptgraph/utils/general_utils.py, get_bounding_box of slam/utils.py.)
"""

from __future__ import annotations

import itertools
from collections import Counter
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import rotation_z
from placegraph.errors import InputError
from placegraph.io.capture.json_files import read_json
from placegraph.io.capture.posed import read_numbers
from placegraph.io.mesh.model import Model, ModelObject, Texture
from placegraph_io.graphs.spark_dsg import MARGIN, box_corners, box_piece, join_pieces

Floats = NDArray[np.float64]
Up = Literal["y", "z"]


UNKNOWN = "unknown"
_OBJECTS, _EDGES, _PICKLES = "obj_json_*.json", "edge_json_*.json", "pcd_*.pkl.gz"
_TURNED = ("overlap", "accurate")  # Words of `spatial_sim_type` whose boxes are rotated
_HEADINGS = 12  # of a box, within half a turn
_MIN_VERTICES = 20  # near an object, that determine how its box is rotated


class _Object(NamedTuple):
    model_object: ModelObject
    centre: Floats  # (3,) [m]
    extent: Floats  # (3,) full lengths [m]


def is_conceptgraphs(path: str | PathLike[str]) -> bool:
    """Return whether a path is the folder of a run of ConceptGraphs, or its `obj_json_RUN.json`."""
    path = Path(path)
    try:
        if path.is_dir():
            return any(next(path.glob(name), None) for name in (_OBJECTS, _PICKLES))
        return path.match(_OBJECTS) and path.is_file()
    except (OSError, ValueError):
        return False


def read_conceptgraphs(
    path: str | PathLike[str], *, up: Up = "z", mesh: str | PathLike[str] | None = None
) -> Model:
    """Read the objects of a run with relations and shapes.

    `path`: folder of the run, or its `obj_json_RUN.json`; `up`: up axis of the poses that ConceptGraphs
    was given: "z", or "y" as in ARKit; `mesh`: mesh of the place (PLY or OBJ) in those axes. Triangles
    in an object's box belong to it, the others to one object "unknown". Without a mesh, objects are
    boxes.

    Raises `InputError`: the folder holds only pickles; a file is missing, damaged, or holds no object;
    no object lies where the mesh does.
    """
    path = Path(path)
    file = path if path.is_file() else _find_objects_file(path)
    left_out: Counter[str] = Counter()
    objects = _objects(file, left_out)
    turn = np.eye(3)
    if up == "y":
        turn = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    objects = [
        held._replace(centre=turn @ held.centre, extent=np.abs(turn) @ held.extent)
        for held in objects
    ]
    relations = _relations(file, [held.model_object for held in objects], left_out)
    turned = _is_turned(file.parent)
    if mesh is not None:
        model = _cut_mesh(file, Path(mesh), objects, turned, up)
    else:
        model = _boxes(file, objects)
        if turned:
            left_out["rotations of boxes, which the JSON lacks"] += len(objects)
    return replace(model, left_out=left_out + model.left_out, relations=relations)


def _find_objects_file(folder: Path) -> Path:
    found = sorted(folder.glob(_OBJECTS))
    if not found:
        raise InputError(
            f"{folder} contains only ConceptGraphs' pickles, which are never opened, because a "
            "pickle can run any code. Write the objects as JSON with `save_obj_json` and "
            "`save_edge_json` of conceptgraph.utils.general_utils where ConceptGraphs runs."
        )
    if len(found) > 1:
        listed = ", ".join(f.name for f in found[:4])
        raise InputError(f"{folder} contains several runs ({listed}); give the file of one.")
    return found[0]


def _objects(file: Path, left_out: Counter[str]) -> list[_Object]:
    content = read_json(file)
    if not isinstance(content, dict) or not content:
        raise InputError(f"{file} must be a JSON object of objects: object_1, object_2.")
    held: list[_Object] = []
    taken: set[str] = set()
    for key, entry in content.items():
        where = Path(f"{file}, {key[:40]}")
        if not isinstance(entry, dict):
            raise InputError(f"{where} must be a JSON object with id, object_tag and bbox_center.")
        centre, extent = (
            np.array(read_numbers(where, entry, name, 3)) for name in ("bbox_center", "bbox_extent")
        )
        if not (np.isfinite([centre, extent]).all() and (extent >= 0).all() and extent.any()):
            left_out["objects whose box has no size"] += 1
            continue
        id_ = str(entry.get("id", key))
        if id_ in taken:
            raise InputError(
                f"{where}: the id {id_[:40]} occurs twice; give every object its own id."
            )
        taken.add(id_)
        label = entry.get("object_tag")
        caption = entry.get("object_caption")
        attributes = {"caption": caption} if isinstance(caption, str) and caption else {}
        name = label if isinstance(label, str) and label else UNKNOWN
        held.append(
            _Object(ModelObject(id_, name, attributes=attributes), centre, np.maximum(extent, 0.01))
        )
    if not held:
        raise InputError(f"{file} contains no object with a box; run ConceptGraphs again.")
    return held


def _relations(
    file: Path, objects: list[ModelObject], left_out: Counter[str]
) -> tuple[tuple[int, str, int], ...]:
    edges = file.with_name(file.name.replace("obj_json_", "edge_json_", 1))
    if not edges.is_file():
        return ()
    content = read_json(edges)
    if not isinstance(content, dict) or not all(isinstance(e, dict) for e in content.values()):
        raise InputError(f"{edges} must be a JSON object of edges: edge_0, edge_1.")
    row = {each.id: i for i, each in enumerate(objects)}
    found = []
    for entry in content.values():
        ends = [row.get(str(entry.get(name))) for name in ("object_1_id", "object_2_id")]
        word = entry.get("relationship")
        if ends[0] is None or ends[1] is None or not isinstance(word, str) or not word:
            left_out["edges without two objects and a relationship"] += 1
            continue
        found.append((ends[0], word, ends[1]))
    return tuple(found)


def _is_turned(folder: Path) -> bool:
    """Return whether a run's boxes are rotated; True where its configuration is silent."""
    for file in sorted(folder.glob("config_params*.json")):
        content = read_json(file)
        kind = content.get("spatial_sim_type") if isinstance(content, dict) else None
        if isinstance(kind, str):
            return any(word in kind for word in _TURNED)
    return True


def _boxes(file: Path, objects: list[_Object]) -> Model:
    """Return the model of axis-aligned boxes."""
    straight = np.eye(3)
    pieces = [
        box_piece(box_corners(o.centre, o.extent, straight), i) for i, o in enumerate(objects)
    ]
    columns: dict[str, Any] = dict(join_pieces(pieces))
    return Model(
        path=file,
        objects=tuple(held.model_object for held in objects),
        picture_of=np.zeros(12 * len(pieces), np.int64),
        pictures=(Texture(None),),
        **columns,
    )


def _cut_mesh(file: Path, mesh: Path, objects: list[_Object], turned: bool, up: Up) -> Model:
    """Return the model of a mesh whose triangles belong to the smallest box around them."""
    from placegraph.io.mesh.obj import is_obj, read_obj
    from placegraph.io.mesh.ply import read_ply

    model = read_obj(mesh, up=up) if is_obj(mesh) else read_ply(mesh, up=up)
    middles = model.vertices[model.triangles].mean(axis=1)
    of = np.full(len(middles), len(objects))
    size = np.full(len(middles), np.inf)
    for i, held in enumerate(objects):
        reach = np.linalg.norm(held.extent) / 2 + MARGIN
        near = np.flatnonzero(np.linalg.norm(middles - held.centre, axis=1) <= reach)
        mine = near[_are_inside(middles[near] - held.centre, held.extent, turned)]
        mine = mine[size[mine] > held.extent.prod()]
        of[mine], size[mine] = i, held.extent.prod()
    owned = np.bincount(of, minlength=len(objects) + 1)[: len(objects)]
    if not owned.any():
        raise InputError(
            f"{mesh} has no triangle in any box of {file}; give a mesh of the same place, in the "
            "frame of ConceptGraphs' poses."
        )
    bare = Counter({"objects that the mesh does not show": int((owned == 0).sum())})
    parts = (*(held.model_object for held in objects), ModelObject("mesh", UNKNOWN))
    return replace(
        model, path=file, objects=parts, object_of=of, relations=(), left_out=+bare + model.left_out
    )


def _are_inside(away: Floats, extent: Floats, turned: bool) -> NDArray[np.bool_]:
    """Return which points (N, 3), relative to a box's centre, lie in the rotation that holds most.

    Objects stand upright: any of the three lengths is the height, and the heading is one of twelve.
    """
    ways = [(extent, 0.0)]
    if turned and len(away) >= _MIN_VERTICES:
        heights = [np.roll(extent, k) for k in range(3)]
        headings = np.arange(_HEADINGS) * np.pi / _HEADINGS
        ways = list(itertools.product(heights, headings.tolist()))
    best: NDArray[np.bool_] = np.zeros(len(away), np.bool_)
    for lengths, heading in ways:
        off = np.abs(away @ rotation_z(heading)) - lengths / 2
        inside: NDArray[np.bool_] = off.max(axis=1, initial=-np.inf) <= MARGIN
        if inside.sum() > best.sum():
            best = inside
    return best
