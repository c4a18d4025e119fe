"""What a scene map is built from: 3D files, data sets, predicted graphs, captures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from placegraph.errors import InputError, OptionError
from placegraph.formats.capture.captures import FORMATS, format_of, is_capture
from placegraph.formats.capture.labels import label_table
from placegraph.formats.mesh.model import Model, Picture, Thing

if TYPE_CHECKING:
    from collections import Counter
    from collections.abc import Iterable, Mapping
    from os import PathLike

    from numpy.typing import NDArray

    from placegraph.formats.capture.labels import Entry
    from placegraph.indoor.encode.segmenter import Segmenter
    from placegraph.indoor.mapping.atlas import ColourOf
    from placegraph.indoor.mapping.segment import Segments

Progress = Callable[[str, int, int], None]
"""Is told a stage, how much of it is done, and of how much."""
Labels = "Mapping[str, str] | str | PathLike[str] | None"
Up = Literal["auto", "y", "z"]

UNKNOWN = "unknown"
"""Label of what nobody named."""


@dataclass(frozen=True, slots=True)
class FromCapture:
    """How a capture becomes a mesh."""

    frames: slice = field(default_factory=lambda: slice(None))
    """Which of its frames, such as slice(0, 186)."""
    poses: str | PathLike[str] | None = None
    """'odometry', 'trajectory' or a TUM file, as of `open_capture`; None: trajectory.tum where there
    is one, else what the recorder has."""
    voxel: float = 0.03
    """Edge of a voxel of the fused volume [m]."""
    reach: float = 7.5
    """Greatest depth that is used [m]."""
    segmenter: Segmenter | None = None
    """Labels images that bring no labels; see `placegraph.indoor.encode.segmenter`."""


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """A model, and what else is known of the way it looks."""

    model: Model
    colour_of: ColourOf | None = None
    """Colours of its surface, sharper than those of its vertices."""
    notes: tuple[str, ...] = ()
    """What was found out or taken for granted, in sentences."""
    finish: Callable[[Model], Source] | None = None
    """What is left to be done once the model is in metres and upright."""


class Kind(NamedTuple):
    """One kind of source that is a labelled mesh already."""

    holds: str
    """What it is told by, for the user."""
    module: str
    """Of `placegraph.formats`, with `read_X`, and `is_X` where no ending tells."""
    verb: str
    ending: str = ""
    takes: tuple[str, ...] = ()
    """Options that its reader takes of those that all sources share: up, table, object_property."""
    own: tuple[str, ...] = ()
    """Options of its reader alone."""

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
        return import_module(f"placegraph.formats.{self.module}")


KINDS = (
    Kind(".glb", "mesh.glb", "glb", ".glb", ("up",)),
    Kind(".gltf", "mesh.glb", "glb", ".gltf", ("up",)),
    Kind(".obj", "mesh.obj", "obj", ".obj", ("up", "table"), own=("groups",)),
    Kind(
        "a 3RScan scan's folder",
        "dataset.scan3r",
        "scan3r",
        own=("reference_frame", "undo_moves", "rooms", "annotations"),
    ),
    Kind(
        "a ScanNet scan's folder",
        "dataset.scannet",
        "scannet",
        own=("label_table", "label_column", "align"),
    ),
    Kind(
        "what SceneGraphFusion predicted",
        "dataset.scenegraphfusion",
        "scenegraphfusion",
        own=("mesh",),
    ),
    Kind("Spark-DSG's .json", "mesh.spark_dsg", "spark_dsg"),
    Kind(".ply", "mesh.ply", "ply", ".ply", ("up", "table", "object_property")),
)
"""In the order in which they are asked: what is told by little comes last."""


def read_source(
    path: str | PathLike[str],
    *,
    labels: Any = None,  # noqa: ANN401  # see `label_table`
    up: Up = "auto",
    scale: float | None = None,
    object_property: str | None = None,
    segment: bool | Literal["auto"] = "auto",
    capture: FromCapture | None = None,
    reader: Mapping[str, Any] | None = None,
    left_out: Counter[str],
    progress: Progress | None = None,
) -> Source:
    """Read any source; parameters and errors as of `placegraph.indoor.build.build_scene`."""
    path = Path(path)
    kind = next((k for k in KINDS if k.fits(path)), None)
    if kind is None:
        if not is_capture(path):
            raise InputError(_unknown(path))
        idle = {"up": up != "auto", "scale": scale, "object_property": object_property}
        if any(idle.values()) or segment != "auto":
            raise OptionError(
                f"{path} is a capture, in metres and upright: up, scale, object_property and segment "
                "belong to meshes; leave them out."
            )
        source = captured(path, capture or FromCapture(), left_out, progress, reader=reader)
        return source if labels is None else replace(source, model=named(source.model, labels))
    if capture is not None:
        raise OptionError(
            f"{path} is no capture: frames, poses, voxel and segmenter belong to captures; leave them "
            "out."
        )
    table = None if labels is None else label_table(labels, scan=path.absolute().parent.name)
    options: dict[str, Any] = {"up": _axis(kind, up), "object_property": object_property}
    model = kind.read(path, options | {"table": table} | dict(reader or {}))
    left_out.update(model.left_out)
    alone = len(model.things) == 1 and model.things[0].label == UNKNOWN
    nameless = segment == "auto" and alone and len(model.triangles) > _FEW
    if segment is True or nameless:
        why = ", as its file names none" if nameless else ""
        return Source(model, finish=lambda upright: cut(upright, left_out, progress, table, why))
    return Source(model if table is None else _labelled(model, table))


_FEW = 1000  # triangles: what is one object of fewer is meant to be one


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
    things = _things(found)
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
    return Source(whole if table is None else _labelled(whole, table), notes=(note,))


def captured(
    path: Path,
    how: FromCapture,
    left_out: Counter[str],
    progress: Progress | None = None,
    *,
    reader: Mapping[str, Any] | None = None,
) -> Source:
    """Model of RGB-D frames: fused, and cut into objects by their labels or by geometry and colour.

    `reader`: options of the recorder's own reader, such as `scale` and `up` of COLMAP. Raises
    `InputError` where the capture has no depth.
    """
    from placegraph.indoor.mapping.atlas import frame_colours
    from placegraph.indoor.mapping.fuse import fuse
    from placegraph.indoor.mapping.segment import segment

    told = how.poses is None and (path / "trajectory.tum").exists()
    poses = "trajectory" if told else how.poses
    capture = format_of(path).open(path, {"poses": poses, **(reader or {})})[how.frames]
    if not len(capture):
        raise OptionError(f"frames: {path} has no frame in {_shown(how.frames)}.")
    if capture.depth_camera is None:
        raise InputError(
            f"{path} has no depth images; a map is fused from depth: record them, or build from a mesh."
        )
    left_out.update(capture.left_out)
    try:
        fused = fuse(
            capture.frames, voxel=how.voxel, reach=how.reach,
            progress=_stage(progress, "fusing"), left_out=left_out,
        )  # fmt: skip
    except InputError as error:
        if str(path) in str(error):
            raise
        raise InputError(f"{path}: {error}") from error
    if how.segmenter is not None:
        from placegraph.indoor.encode.segmenter import labelled

        capture = labelled(capture, how.segmenter)
    found = segment(
        fused.vertices, fused.triangles, fused.colours,
        frames=None if capture.label_camera is None else capture.frames,
        progress=progress, left_out=left_out,
    )  # fmt: skip
    model = Model(
        path=path,
        things=_things(found),
        vertices=fused.vertices,
        triangles=fused.triangles,
        thing_of=found.object_of.astype(np.int64),
        colours=fused.colours,
        uv=np.zeros((len(fused.vertices), 2)),
        picture_of=np.zeros(len(fused.triangles), np.int64),
        pictures=(Picture(None),),
        floor=found.floor,
    )
    poses_of: NDArray[np.float64] = np.array([f.odometry for f in capture.frames])
    colour_of = frame_colours(
        capture.frames,
        poses_of,
        fused.vertices,
        fused.triangles,
        progress=_stage(progress, "colours"),
    )
    return Source(
        model, colour_of, (*capture.notes, *_notes(path, told, fused.stats, found.labels))
    )


def named(model: Model, labels: Any) -> Model:  # noqa: ANN401  # see `label_table`
    """Model whose things have a table's labels, by id or name."""
    return _labelled(model, label_table(labels, scan=model.path.absolute().parent.name))


def _labelled(model: Model, table: Mapping[str, Entry]) -> Model:
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


def _things(found: Segments) -> tuple[Thing, ...]:
    return tuple(map(Thing, found.ids, found.labels, found.names))


def _notes(path: Path, told: bool, stats: Any, labels: tuple[str, ...]) -> list[str]:  # noqa: ANN401
    rate = stats.frames / max(stats.seconds, 1e-9)
    apart = 100 * stats.agreement
    notes = [f"{stats.frames} frames fused, {rate:.0f} a second."]
    notes.append(f"Their depth lies within {apart:.1f} cm of the surface (median).")
    if told:
        notes.append(f"Poses are those of {path / 'trajectory.tum'}.")
    if stats.coarser:
        notes.append(stats.coarser)
    known = sum(label != UNKNOWN for label in labels)
    notes.append(f"It was cut into {len(labels)} objects, {known} of them with a label.")
    return notes


def _axis(kind: Kind, up: Up) -> str:
    """The axis that a reader takes for up: y of GLB, as glTF has it, else z."""
    return up if up != "auto" else "y" if kind.module == "glb" else "z"


def _stage(progress: Progress | None, stage: str) -> Callable[[int, int], None] | None:
    return None if progress is None else lambda done, total: progress(stage, done, total)


def _shown(frames: slice) -> str:
    parts = [frames.start, frames.stop, *([frames.step] if frames.step else [])]
    return ":".join("" if part is None else str(part) for part in parts)


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
