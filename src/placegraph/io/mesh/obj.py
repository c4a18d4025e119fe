"""Reader of Wavefront OBJ meshes with their materials: objects, groups or materials as things."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import OptionError
from placegraph.io.capture.labels import Entry
from placegraph.io.mesh.glb import Z_UP
from placegraph.io.mesh.model import Model, Picture, Thing
from placegraph.io.mesh.mtl import read_materials
from placegraph.io.mesh.obj_text import NAMED, ObjText, read_obj_text
from placegraph.io.mesh.ply import UNKNOWN

Rows = NDArray[np.int64]


Groups = Literal["auto", "o", "g", "usemtl"]


def is_obj(path: Path) -> bool:
    """Whether a path looks like an OBJ file."""
    return path.suffix.lower() == ".obj" and path.is_file()


def read_obj(
    path: str | PathLike[str],
    *,
    up: Literal["y", "z"] = "z",
    groups: Groups = "auto",
    table: Mapping[str, Entry] | None = None,
) -> Model:
    """Read an OBJ mesh, its material files and their textures.

    Polygons become fans of triangles. Faces of one name are one thing, wherever they stand; its id
    is the name, its label the name without a counter such as Blender's `.001`. Faces without a name
    are one thing "unknown". Colours after coordinates are sRGB, 0 to 1 (or 0 to 255).

    Parameters
    ----------
    up
        Axis that points up in it.
    groups
        Which keyword parts the file into things; auto: the first of `o`, `g` and `usemtl` that
        names two or more, else the first that names any.
    table
        What the names are called: `placegraph.io.capture.labels.label_table`.

    Raises
    ------
    InputError
        The file is missing, holds no vertex, or a vertex or a face that is none; or a material
        file cannot be read.
    OptionError
        `groups` is none of its values.

    """
    if groups not in {"auto", *NAMED}:
        raise OptionError(f"groups is {groups!r}; it is 'auto', 'o', 'g' or 'usemtl'.")
    text = read_obj_text(Path(path))
    left_out = text.left_out
    corner, face = fans(text.lengths)
    degenerate = int((text.lengths < 3).sum())
    if degenerate:
        left_out["faces of fewer than three corners"] += degenerate
    vertex, uv, triangles = _shared(text, corner)
    things, thing_of = _things(text, groups, face, table or {})
    pictures, picture_of = _pictures(text, face, left_out)
    vertices = text.vertices[vertex]
    return Model(
        path=text.path,
        things=things,
        vertices=vertices @ Z_UP.T if up == "y" else vertices,
        triangles=triangles,
        thing_of=thing_of,
        colours=_colours(text, left_out)[vertex],
        uv=uv,
        picture_of=picture_of,
        pictures=pictures,
        left_out=left_out,
    )


def fans(lengths: Rows) -> tuple[Rows, Rows]:
    """Triangles (T, 3) of polygons as fans, in rows of all their corners, and the polygon of each.

    `lengths`: (F,) corners of each polygon, whose corners stand one polygon after the other.
    """
    count = np.maximum(lengths - 2, 0)
    face = np.repeat(np.arange(len(lengths)), count)
    step = np.arange(len(face)) - np.repeat(np.cumsum(count) - count, count)
    first = (np.cumsum(lengths) - lengths)[face]
    return np.stack([first, first + step + 1, first + step + 2], axis=1), face


def _shared(text: ObjText, corner: Rows) -> tuple[Rows, NDArray[np.float64], Rows]:
    """Vertex of each of the model's vertices, its texture coordinates (v down), and triangles.

    A vertex that faces give several texture coordinates is there as often.
    """
    rows, mapped = text.corners[corner], text.corner_uv[corner]
    if (mapped < 0).all():
        return np.arange(len(text.vertices)), np.zeros((len(text.vertices), 2)), rows
    table = np.concatenate([text.uv * (1.0, -1.0) + (0.0, 1.0), np.zeros((1, 2))])  # -1: the last
    if _one_each(rows, mapped, len(text.vertices)):
        uv = np.zeros((len(text.vertices), 2))
        uv[rows] = table[mapped]
        return np.arange(len(text.vertices)), uv, rows
    pairs, triangles = np.unique(rows * len(table) + mapped + 1, return_inverse=True)
    return pairs // len(table), table[pairs % len(table) - 1], triangles.reshape(-1, 3)


def _one_each(rows: Rows, mapped: Rows, count: int) -> bool:
    """Whether no vertex has two texture coordinates."""
    of = np.zeros(count, np.int64)
    of[rows] = mapped
    return bool((of[rows] == mapped).all())


def _things(
    text: ObjText, groups: Groups, face: Rows, table: Mapping[str, Entry]
) -> tuple[tuple[Thing, ...], Rows]:
    """Things, and the thing of each triangle."""
    keyword = groups if groups != "auto" else _parting(text, face)
    names, name_of = text.names[keyword], text.name_of[keyword][face]
    used = np.unique(name_of)
    things = tuple(_thing(names[i] if i >= 0 else "", table) for i in used.tolist())
    return things, np.searchsorted(used, name_of)


def _parting(text: ObjText, face: Rows) -> str:
    """Keyword that parts the triangles into things."""
    named = [k for k in NAMED if text.names[k]]
    several = [k for k in named if len(np.unique(text.name_of[k][face])) > 1]
    return (several or named or ["o"])[0]


def _thing(name: str, table: Mapping[str, Entry]) -> Thing:
    entry = table.get(name)
    if entry is not None:
        return Thing(name, entry.label, entry.name or name, entry.attributes)
    return Thing(name or UNKNOWN, re.sub(r"\.\d{3,}$", "", name) or UNKNOWN, name)


def _pictures(
    text: ObjText, face: Rows, left_out: Counter[str]
) -> tuple[tuple[Picture, ...], Rows]:
    """Pictures of the materials that are used, and the picture of each triangle."""
    material = text.name_of["usemtl"][face]
    used = np.unique(material)
    wanted = [text.names["usemtl"][i] for i in used.tolist() if i >= 0]
    libraries = _libraries(text) if wanted else []
    found = read_materials(libraries, wanted, left_out) if libraries else {}
    if wanted and not libraries:
        left_out["materials that no material file holds"] += len(wanted)
    rows: dict[Picture, int] = {}
    row_of = []
    for i in used.tolist():
        picture = found.get(text.names["usemtl"][i]) if i >= 0 else None
        row_of.append(rows.setdefault(picture or Picture(None), len(rows)))
    return tuple(rows) or (Picture(None),), np.array(row_of, np.int64)[
        np.searchsorted(used, material)
    ]


def _libraries(text: ObjText) -> list[Path]:
    """Material files: a line may name several, or one whose name holds blanks."""
    folder, found = text.path.parent, []
    for line in dict.fromkeys(text.libraries):
        whole = line.replace("\\", "/")
        names = [whole] if whole.lower().count(".mtl") < 2 else whole.split()
        found += [folder / name for name in names if name]
    return found


def _colours(text: ObjText, left_out: Counter[str]) -> NDArray[np.uint8]:
    """(V, 3) sRGB; white where there are none."""
    there = np.isfinite(text.colours).all(axis=1)
    colours = np.full(text.vertices.shape, 255, np.uint8)
    if there.any():
        share: NDArray[Any] = text.colours[there]
        share = share if share.max() > 1.0 else share * 255.0
        colours[there] = np.rint(np.clip(share, 0, 255)).astype(np.uint8)
        if not there.all():
            left_out["vertices without the colour that others have"] += int((~there).sum())
    return colours
