"""From a 3D file to a scene map: read, clean, find floor and relations, store."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from placegraph.errors import InputError, OptionError
from placegraph.formats.labels import label_table
from placegraph.formats.model import Thing
from placegraph.indoor import textures
from placegraph.indoor.floor import floor_height
from placegraph.indoor.mesh import GRAIN, Mesh
from placegraph.indoor.relations import relate
from placegraph.indoor.scene_map import SceneMap

if TYPE_CHECKING:
    from collections import Counter
    from collections.abc import Mapping
    from os import PathLike

    from numpy.typing import NDArray

    from placegraph.formats.labels import Entry
    from placegraph.formats.model import Model, Picture

    Labels = Mapping[str, str] | str | PathLike[str] | None

ENDINGS = (".glb", ".ply")
LARGEST = 1e5
"""Coordinates beyond this [m] are another unit, or damage."""


def build_scene(
    path: str | PathLike[str],
    out_path: str | PathLike[str] | None,
    *,
    labels: Labels = None,
    floor: float | None = None,
    up: Literal["auto", "y", "z"] = "auto",
    scale: float = 1.0,
    max_texture: int = textures.MAX_TEXTURE,
    quality: int = textures.QUALITY,
    object_property: str | None = None,
    left_out: Counter[str] | None = None,
) -> SceneMap:
    """Build a scene map from a .glb or .ply file and write it to `out_path`.

    Parameters
    ----------
    path
        GLB with one node an object, or PLY with object ids by vertex or face: `docs/formats.md`.
    out_path
        Map file to write (atomically); None writes nothing.
    labels
        Label of each object by its id or its name: a mapping, or a JSON file as
        `placegraph.formats.labels.label_table` reads it. It wins over what the file says.
    floor
        Height of the floor [m, map]; found where not given.
    up
        Axis of the file that points up; auto: y of GLB, as glTF has it, z of PLY.
    scale
        Metres in one unit of the file: 0.001 for millimetres.
    max_texture
        Longer sides of textures are brought to this many texels.
    quality
        JPEG quality of textures that are encoded anew.
    object_property
        Property of the PLY's vertices or faces that holds object ids; the known ones if not given.
    left_out
        Is told what of the file could not be used, by reason.

    Raises
    ------
    InputError
        The file cannot be read, holds no triangle, or vertices that are no numbers; or no floor is
        found, and `floor` is not given.
    OptionError
        An option is out of range.
    MapError, MapLockedError
        The map cannot be written.

    """
    path = Path(path)
    textures.check_options(max_texture, quality)
    if not (np.isfinite(scale) and scale > 0):
        raise OptionError(f"scale is {scale}; it must be greater than 0.")
    if up not in {"auto", "y", "z"}:
        raise OptionError(f"up is {up!r}; it is 'auto', 'y' or 'z'.")
    if out_path is None:
        model = _read(path, labels, up, object_property)
        return scene_of_model(
            model,
            floor=floor,
            scale=scale,
            max_texture=max_texture,
            quality=quality,
            left_out=left_out,
        )
    if os.path.realpath(path) == os.path.realpath(out_path):
        raise OptionError(f"{path} would be overwritten by its map; name another file.")
    from placegraph.indoor.scene_file import columns
    from placegraph.indoor.scene_map import KIND, VERSION
    from placegraph.store import writing

    with writing(out_path) as write:
        model = _read(path, labels, up, object_property)
        scene = scene_of_model(
            model,
            floor=floor,
            scale=scale,
            max_texture=max_texture,
            quality=quality,
            left_out=left_out,
        )
        write(KIND, VERSION, *columns(scene))
    return scene


def scene_of_model(
    model: Model,
    *,
    floor: float | None = None,
    scale: float = 1.0,
    max_texture: int = textures.MAX_TEXTURE,
    quality: int = textures.QUALITY,
    left_out: Counter[str] | None = None,
) -> SceneMap:
    """Scene map of a model in memory; parameters and errors as of `build_scene`."""
    counts = model.left_out if left_out is None else left_out
    counts.update(model.left_out if left_out is not None else ())
    _check(model)
    mesh, things, pictures = _clean(model, scale, counts)
    labels = [t.label for t in things]
    height = floor_height(mesh, labels) if floor is None else float(floor)
    if height is None:
        raise InputError(
            f"{model.path} shows no floor: no object is labelled floor, and no level surface lies low "
            "and wide enough; pass its height (floor=0.0, or --floor 0)."
        )
    return SceneMap.create(
        mesh,
        [t.id for t in things],
        labels,
        floor=height,
        names=[t.name for t in things],
        attributes=[t.attributes for t in things],
        relations=relate(mesh, labels),
        scene=model.path.stem or "scene",
        source=model.path.name,
        encoded=textures.encode_pictures(pictures, max_texture, quality),
    )


def _read(path: Path, labels: Labels, up: str, object_property: str | None) -> Model:
    ending = path.suffix.lower()
    if ending not in ENDINGS:
        raise InputError(
            f"{path} has an unknown ending; a scene is built from {' or '.join(ENDINGS)}."
        )
    table = None if labels is None else label_table(labels, scan=path.absolute().parent.name)
    if ending == ".glb":
        from placegraph.formats.glb import read_glb

        model = read_glb(path, up="z" if up == "z" else "y")
    else:
        from placegraph.formats.ply import read_ply

        model = read_ply(
            path, up="y" if up == "y" else "z", object_property=object_property, table=table
        )
    return model if table is None else _labelled(model, table)


def _labelled(model: Model, table: Mapping[str, Entry]) -> Model:
    """Model whose things have the table's labels, by id or name."""
    entries = [table.get(t.id) or table.get(t.name) for t in model.things]
    if not any(entries):
        raise InputError(
            f"labels: none of the {len(table)} ids ({', '.join(list(table)[:3])}, ...) is an object "
            f"of {model.path} ({', '.join(t.id for t in model.things[:3])}, ...)."
        )
    things = tuple(
        t if e is None else Thing(t.id, e.label, e.name or t.name, t.attributes | e.attributes)
        for t, e in zip(model.things, entries, strict=True)
    )
    return replace(model, things=things)


def _check(model: Model) -> None:
    if not len(model.triangles):
        what = "is empty" if not len(model.vertices) else "holds points, but no triangle"
        raise InputError(f"{model.path} {what}; a scene map needs a mesh.")
    used = np.zeros(len(model.vertices), np.bool_)
    used[model.triangles.ravel()] = True
    for name, values in (("vertices", model.vertices), ("texture coordinates", model.uv)):
        bad = ~np.isfinite(values).all(axis=1) & used
        if bad.any():
            triangle = int(np.flatnonzero(bad[model.triangles].any(axis=1))[0])
            thing = model.things[int(model.thing_of[triangle])]
            raise InputError(
                f"{model.path}: {int(bad.sum())} {name} are not numbers, the first in object "
                f"{thing.name or thing.id!r}; repair the mesh, or delete them."
            )


def _clean(
    model: Model, scale: float, left_out: Counter[str]
) -> tuple[Mesh, list[Thing], list[Picture]]:
    """Mesh without triangles that have no area, and without what no triangle needs."""
    vertices = model.vertices * scale
    reach = float(np.abs(vertices[model.triangles.ravel()]).max())
    if reach > LARGEST:
        raise InputError(
            f"{model.path} reaches {reach:.3g} m from its origin; is it in millimetres? Then pass "
            "scale=0.001; else move it to its origin."
        )
    order = np.argsort(model.thing_of, kind="stable")
    triangles, thing_of, picture_of = (
        column[order] for column in (model.triangles, model.thing_of, model.picture_of)
    )
    flat = _flat(vertices, triangles)
    bare = np.setdiff1d(thing_of, thing_of[~flat])
    flat &= ~np.isin(thing_of, bare)  # an object that is nothing but a line stays one
    if flat.any():
        left_out["triangles without area"] += int(flat.sum())
        keep = ~flat
        triangles, thing_of, picture_of = triangles[keep], thing_of[keep], picture_of[keep]
    corner, compact = _used(triangles, len(vertices))
    thing, things = _used(thing_of, len(model.things))
    picture, pictures = _used(picture_of, len(model.pictures))
    missing = len(model.things) - len(thing)
    if missing:
        left_out["objects without a triangle"] += missing
    mesh = Mesh(
        vertices=vertices[corner].astype(np.float32),
        triangles=compact.astype(np.int32),
        object_of=things.astype(np.int32),
        colours=model.colours[corner],
        uv=model.uv[corner].astype(np.float32),
        texture_of=pictures.astype(np.int32),
        textures=(np.zeros((1, 1, 3), np.uint8),) * len(picture),
    )
    return (
        mesh.snapped(),
        [model.things[i] for i in thing.tolist()],
        [model.pictures[i] for i in picture.tolist()],
    )


def _flat(vertices: NDArray[np.float64], triangles: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Triangles (T,) without area once their corners are snapped."""
    a, b, c = np.moveaxis(np.rint(vertices[triangles] / GRAIN), 1, 0)
    return ~np.asarray(np.cross(b - a, c - a).any(axis=1))


def _used(rows: NDArray[Any], count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows that are used, ascending, and `rows` in terms of these."""
    used = np.zeros(count, np.bool_)
    used[rows.ravel()] = True
    place = np.cumsum(used) - 1
    return np.flatnonzero(used), place[rows]
