"""What a scene map is built from: 3D files, data sets, predicted graphs, captures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from importlib import import_module
from itertools import islice
from os import PathLike
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from placegraph.errors import InputError, OptionError
from placegraph.indoor.mapping.from_capture import (
    UNKNOWN,
    FromCapture,
    Progress,
    Source,
    captured,
    things_of,
)
from placegraph.indoor.mapping.osm_rooms import rooms_source
from placegraph.io.capture.capture import FORMATS, is_capture
from placegraph.io.capture.json_files import LabelEntry as Entry
from placegraph.io.capture.json_files import label_table
from placegraph.io.mesh.model import Model, Thing
from placegraph.io.osm.indoor_osm import is_indoor_osm

Up = Literal["auto", "y", "z"]


class SourceKind(NamedTuple):
    """One kind of source that is a labelled mesh already."""

    holds: str
    """What it is told by, for the user."""
    module: str
    """Of `placegraph.io`, with `read_X`, and `is_X` where no ending tells."""
    verb: str
    ending: str = ""
    takes: tuple[str, ...] = ()
    """Options that its reader takes of those that all sources share: up, table, object_property."""
    own: tuple[str, ...] = ()
    """Options of its reader alone."""
    is_graph: bool = False
    """Whether it is another program's scene graph."""

    def fits(self, path: Path) -> bool:
        """Whether a path looks like it."""
        if self.ending:
            return path.suffix.lower() == self.ending
        return bool(getattr(self._module(), f"is_{self.verb}")(path))

    def read(self, path: Path, options: Mapping[str, Any]) -> Model:
        """Model of a path."""
        strange = set(options) - {"up", "table", "object_property", *self.own}
        if strange:
            known = f"it has {', '.join(self.own)}" if self.own else "it has none of its own"
            raise OptionError(f"{', '.join(sorted(strange))}: no option of {self.holds}; {known}.")
        given = {k: v for k, v in options.items() if k in self.takes or k in self.own}
        model: Model = getattr(self._module(), f"read_{self.verb}")(path, **given)
        return model

    def _module(self) -> Any:  # noqa: ANN401  # a module
        return import_module(self.module)


KINDS = (
    SourceKind(".glb", "placegraph.io.mesh.gltf", "glb", ".glb", ("up",)),
    SourceKind(".gltf", "placegraph.io.mesh.gltf", "glb", ".gltf", ("up",)),
    SourceKind(".obj", "placegraph.io.mesh.obj", "obj", ".obj", ("up", "table"), own=("groups",)),
    SourceKind(
        "a 3RScan scan's folder",
        "placegraph_io.dataset.scan3r",
        "scan3r",
        own=("reference_frame", "undo_moves", "rooms", "annotations"),
    ),
    SourceKind(
        "a ScanNet scan's folder",
        "placegraph_io.dataset.scannet",
        "scannet",
        own=("label_table", "label_column", "align"),
    ),
    SourceKind(
        "what SceneGraphFusion predicted",
        "placegraph_io.dataset.scenegraphfusion",
        "scenegraphfusion",
        own=("mesh",),
    ),
    SourceKind(
        "Spark-DSG's .json, or Hydra's log folder", "placegraph_io.graphs.spark_dsg", "spark_dsg"
    ),
    SourceKind(
        "ConceptGraphs' obj_json_*.json, or its folder",
        "placegraph_io.graphs.conceptgraphs",
        "conceptgraphs",
        takes=("up",),
        own=("mesh",),
    ),
    SourceKind(".ply", "placegraph.io.mesh.ply", "ply", ".ply", ("up", "table", "object_property")),
)
"""In the order in which they are asked: what is told by little comes last."""


GRAPHS = ("spark_dsg", "conceptgraphs")
"""Verbs of the kinds that are scene graphs already."""
_FEW = 1000  # triangles: what is one object of fewer is meant to be one


@dataclass(frozen=True, slots=True)
class Reading:
    """How a source is read: what `build_scene` was told of it."""

    labels: Any = None
    """As `label_table` takes them."""
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
            raise OptionError(f"up is {self.up!r}; it is 'auto', 'y' or 'z'.")


def is_scene_graph(path: Path) -> bool:
    """Whether another program's scene graph lies there."""
    return any(kind.verb in GRAPHS and kind.fits(path) for kind in KINDS)


def read_source(
    path: str | PathLike[str],
    how: Reading,
    left_out: Counter[str],
    progress: Progress | None = None,
) -> Source:
    """Read any source; errors as of `placegraph.indoor.build.build_scene`."""
    path = Path(path)
    if is_indoor_osm(path):
        return rooms_source(path, how.reader, left_out)
    kind = next((k for k in KINDS if k.fits(path)), None)
    if kind is None:
        return _capture(path, how, left_out, progress)
    if how.capture is not None:
        plain = FromCapture()
        given = [
            f.name
            for f in fields(how.capture)
            if getattr(how.capture, f.name) != getattr(plain, f.name)
        ]
        raise OptionError(
            f"{path} is no capture: {' and '.join(given) or 'capture'} can only be used with captures; "
            "leave it out."
        )
    table = _table(path, how.labels)
    options: dict[str, Any] = {"up": _axis(kind, how.up), "object_property": how.object_property}
    model = kind.read(path, options | {"table": table} | dict(how.reader))
    left_out.update(model.left_out)
    alone = len(model.things) == 1 and model.things[0].label == UNKNOWN
    nameless = how.segment == "auto" and alone and len(model.triangles) > _FEW
    if how.segment is True or nameless:
        why = ", as its file names none" if nameless else ""
        return Source(model, finish=lambda upright: cut(upright, left_out, progress, table, why))
    return Source(_labelled(model, table))


def _capture(path: Path, how: Reading, left_out: Counter[str], progress: Progress | None) -> Source:
    if not is_capture(path):
        raise InputError(_unknown(path))
    idle = {"up": how.up != "auto", "scale": how.scale, "property": how.object_property}
    if any(idle.values()) or how.segment != "auto":
        raise OptionError(
            f"{path} is a capture, in metres and upright: up, scale, object_property and segment "
            "belong to meshes; leave them out."
        )
    source = captured(path, how.capture or FromCapture(), left_out, progress, reader=how.reader)
    return replace(source, model=_labelled(source.model, _table(path, how.labels)))


def cut(
    model: Model,
    left_out: Counter[str],
    progress: Progress | None = None,
    table: Mapping[str, Entry] | None = None,
    why: str = "",
) -> Source:
    """Model in metres whose objects are found by geometry and colour instead of the file's."""
    from placegraph.indoor.mapping.segment import segment

    found = segment(model.vertices, model.triangles, model.colours, progress=progress)
    things = things_of(found)
    if model.relations:
        left_out["relations of objects that were cut anew"] += len(model.relations)
    note = f"It was cut into {len(things)} objects by geometry and colour{why}."
    whole = replace(
        model,
        things=things,
        thing_of=found.object_of.astype(np.int64),
        floor=found.floor,
        relations=(),
    )
    return Source(_labelled(whole, table), notes=(note,))


def _table(path: Path, labels: Any) -> dict[str, Entry] | None:  # noqa: ANN401  # see `label_table`
    return None if labels is None else label_table(labels, scan=path.absolute().parent.name)


def _labelled(model: Model, table: Mapping[str, Entry] | None) -> Model:
    """Model whose things have a table's labels, by id or name."""
    if table is None:
        return model
    entries = [table.get(t.id) or table.get(t.name) for t in model.things]
    if not any(entries):
        raise InputError(
            f"labels: none of the {len(table)} ids ({_few(table)}) is an object of {model.path} "
            f"({_few(t.id for t in model.things)}); is it the table of another mesh?"
        )
    things = tuple(
        t if e is None else Thing(t.id, e.label, e.name or t.name, t.attributes | e.attributes)
        for t, e in zip(model.things, entries, strict=True)
    )
    return replace(model, things=things)


def _axis(kind: SourceKind, up: Up) -> str:
    """The axis that a reader takes for up: y of GLB, as glTF has it, else z."""
    return up if up != "auto" else "y" if kind.verb == "glb" else "z"


def _few(words: Iterable[str]) -> str:
    """The first of some words, for messages."""
    listed = list(islice(words, 4))
    return ", ".join([*listed[:3], "..."] if len(listed) > 3 else listed) or "none"


def _unknown(path: Path) -> str:
    if not path.exists():
        return f"{path} does not exist."
    known = [kind.holds for kind in KINDS] + [f"{f.name} ({f.holds})" for f in FORMATS]
    if path.is_file():
        what = "has an unknown ending"
        if path.suffix.lower() == ".json":
            what = "holds no scene graph" if path.stat().st_size else "is empty"
        return (
            f"{path} {what}; a scene is built from {'; '.join(known)}. Save other meshes as .glb."
        )
    return f"{path} has nothing that is known in it; a scene is built from {'; '.join(known)}."
