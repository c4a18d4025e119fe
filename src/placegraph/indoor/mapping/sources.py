"""Sources of scene maps: 3D files, data sets, predicted graphs, captures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from itertools import islice
from os import PathLike
from pathlib import Path
from typing import Any, Literal

import numpy as np

from placegraph.core.plugins import SOURCES, plugins
from placegraph.errors import InputError, OptionError
from placegraph.indoor.mapping.from_capture import (
    UNKNOWN,
    FromCapture,
    Progress,
    Source,
    make_things,
    read_capture,
)
from placegraph.indoor.mapping.osm import read_rooms
from placegraph.io.capture.capture import capture_formats, is_capture
from placegraph.io.capture.json_files import LabelEntry as Entry
from placegraph.io.capture.json_files import read_label_table
from placegraph.io.formats import Format
from placegraph.io.mesh.model import Model, ModelObject
from placegraph.io.osm.indoor_osm import is_indoor_osm

Up = Literal["auto", "y", "z"]
_FEW = 1000  # triangles: one object of fewer is meant to be one


_SHARED = ("up", "table", "object_property")
"""Options of `build_scene` that readers need not take."""
_MESHES = (
    Format(".glb", "", "placegraph.io.mesh.gltf", "glb", ("up",), ".glb"),
    Format(".gltf", "", "placegraph.io.mesh.gltf", "glb", ("up",), ".gltf"),
    Format(".obj", "", "placegraph.io.mesh.obj", "obj", ("up", "table", "groups"), ".obj"),
)
_PLY = Format(".ply", "", "placegraph.io.mesh.ply", "ply", _SHARED, ".ply")


def source_formats() -> tuple[Format, ...]:
    """Return all formats of labelled meshes, plugins' included, in the order in which they are tried.

    Data sets also use .ply, which comes last.
    """
    added = (format_ for point in plugins(SOURCES).values() for format_ in point.load())
    return (*_MESHES, *added, _PLY)


def is_scene_graph(path: Path) -> bool:
    """Return whether another program's scene graph lies there."""
    return any(f.is_graph and f.matches(path) for f in source_formats())


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """Options of `build_scene` for reading a source."""

    labels: Any = None
    """Label table, as a path or mapping that `read_label_table` accepts."""
    up: Up = "auto"
    scale: float | None = None
    object_property: str | None = None
    segment: bool | Literal["auto"] = "auto"
    capture: FromCapture | None = None
    reader: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.scale is not None and not (np.isfinite(self.scale) and self.scale > 0):
            raise OptionError(f"scale is {self.scale}; it must be greater than 0.")
        if self.up not in {"auto", "y", "z"}:
            raise OptionError(f"up is {self.up!r}; it must be 'auto', 'y' or 'z'.")


def read_source(
    path: str | PathLike[str],
    options: ReadOptions,
    left_out: Counter[str],
    progress: Progress | None = None,
) -> Source:
    """Read any source; raises as `placegraph.indoor.build.build_scene`."""
    path = Path(path)
    if is_indoor_osm(path):
        return read_rooms(path, options.reader, left_out)
    kind = next((f for f in source_formats() if f.matches(path)), None)
    if kind is None and not is_capture(path):
        raise InputError(_describe_unknown(path))
    table = None
    if options.labels is not None:
        table = read_label_table(options.labels, scan=path.absolute().parent.name)
    if kind is None:
        if (
            options.up != "auto"
            or options.scale
            or options.object_property
            or options.segment != "auto"
        ):
            raise OptionError(
                f"{path} is a capture, but up, scale, object_property and segment apply "
                "only to meshes; remove them."
            )
        how = options.capture or FromCapture()
        source = read_capture(path, how, left_out, progress, reader=options.reader)
        return replace(source, model=_label(source.model, table))
    if options.capture is not None:
        plain = FromCapture()
        given = [
            f.name
            for f in fields(plain)
            if getattr(options.capture, f.name) != getattr(plain, f.name)
        ]
        raise OptionError(
            f"{path} is not a capture, but {' and '.join(given) or 'capture'} applies only "
            "to captures; remove it."
        )
    # glTF is y-up, all others are z-up
    axis = options.up if options.up != "auto" else "y" if kind.verb == "glb" else "z"
    shared_options = {"up": axis, "object_property": options.object_property, "table": table}
    model: Model = kind.read(path, shared_options | dict(options.reader), _SHARED)
    left_out.update(model.left_out)
    alone = len(model.objects) == 1 and model.objects[0].label == UNKNOWN
    nameless = options.segment == "auto" and alone and len(model.triangles) > _FEW
    if options.segment is True or nameless:
        why = ", because the file names none" if nameless else ""
        return Source(model, finish=lambda upright: cut(upright, left_out, progress, table, why))
    return Source(_label(model, table))


def cut(
    model: Model,
    left_out: Counter[str],
    progress: Progress | None = None,
    table: Mapping[str, Entry] | None = None,
    why: str = "",
) -> Source:
    """Find the objects of a model in metres by geometry and colour instead of the file's."""
    from placegraph.indoor.mapping.segment import segment

    found = segment(model.vertices, model.triangles, model.colours, progress=progress)
    things = make_things(found)
    if model.relations:
        left_out["relations of objects that were segmented again"] += len(model.relations)
    note = f"The mesh was segmented into {len(things)} objects by geometry and colour{why}."
    object_of = found.object_of.astype(np.int64)
    model = replace(model, objects=things, object_of=object_of, floor=found.floor, relations=())
    return Source(_label(model, table), notes=(note,))


def _label(model: Model, table: Mapping[str, Entry] | None) -> Model:
    if table is None:
        return model
    entries = [table.get(t.id) or table.get(t.name) for t in model.objects]
    if not any(entries):
        raise InputError(
            f"labels: none of the {len(table)} ids ({_list_some(table)}) is an object of "
            f"{model.path} ({_list_some(t.id for t in model.objects)}); check that the "
            "table belongs to this mesh."
        )
    things = tuple(
        t
        if e is None
        else ModelObject(t.id, e.label, e.name or t.name, t.attributes | e.attributes)
        for t, e in zip(model.objects, entries, strict=True)
    )
    return replace(model, objects=things)


def _list_some(words: Iterable[str]) -> str:
    listed = list(islice(words, 4))
    return ", ".join([*listed[:3], "..."] if len(listed) > 3 else listed) or "none"


def _describe_unknown(path: Path) -> str:
    if not path.exists():
        return f"{path} does not exist."
    what, mend = "contains no known files", ""
    if path.is_file():
        what, mend = "has an unknown ending", " Save other meshes as .glb."
        if path.suffix.lower() == ".json":
            what = "contains no scene graph" if path.stat().st_size else "is empty"
    if "io" not in plugins(SOURCES):
        mend += (
            " Data sets and scene graphs of other programs need placegraph-io, which is not "
            "installed; run `pip install 'placegraph[io]'`."
        )
    known = "; ".join(map(str, (*source_formats(), *capture_formats())))
    return f"{path} {what}; a scene is built from {known}.{mend}"
