"""From whatever the user has to a scene map: read, clean, simplify, colour, relate, store."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from os import PathLike
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import resolve_path
from placegraph.errors import InputError, OptionError
from placegraph.indoor.map.floor import find_floor_height, is_floor
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.map.relations import MAX_RELATED_OBJECTS, SAME_ROOM, find_relations
from placegraph.indoor.map.rooms import assign_rooms
from placegraph.indoor.map.scene_file import is_near_box
from placegraph.indoor.map.textures import Detail, get_detail
from placegraph.indoor.mapping.clean import (
    check_model,
    clean_model,
    convert_to_metres,
    level_model,
    reduce_mesh,
)
from placegraph.indoor.mapping.from_capture import FromCapture, Progress, Source
from placegraph.indoor.mapping.sources import ReadOptions, Up, read_source
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.mesh.model import Model, ModelObject

FAR = 5000.0  # Farther from the origin [m] coordinates lose what can be seen, and this is told


def build_scene(
    source: str | PathLike[str],
    out_path: str | PathLike[str] | None,
    *,
    labels: Mapping[str, str] | str | PathLike[str] | None = None,
    floor: float | None = None,
    up: Up = "auto",
    scale: float | None = None,
    detail: str | Detail = "default",
    object_property: str | None = None,
    segment: bool | Literal["auto"] = "auto",
    capture: FromCapture | None = None,
    reader: Mapping[str, Any] | None = None,
    left_out: Counter[str] | None = None,
    notes: list[str] | None = None,
    progress: Progress | None = None,
) -> SceneMap:
    """Build a scene map from what the user has, and write it to `out_path`.

    Parameters
    ----------
    source
        A mesh with objects (GLB with one node an object; PLY or OBJ with ids or groups), a scan's
        folder of 3RScan or ScanNet, a graph of SceneGraphFusion or Spark-DSG, or an RGB-D capture
        with poses of any recorder that `open_capture` knows: `docs/sources.md`. An OpenStreetMap
        file becomes a rough map of one level of its rooms: `docs/howto-osm-indoor.md`.
    out_path
        Map file to write (atomically); None writes nothing.
    labels
        Label of each object by its id or its name: a mapping, or a JSON file as
        `placegraph.io.capture.json_files.read_label_table` reads it. It wins over what the source says.
    floor
        Height of the floor [m, map]; found where not given.
    up
        Axis of a mesh that points up; auto: y of GLB, as glTF has it, else z; unless the object
        labelled floor says otherwise.
    scale
        Metres in one unit of a mesh: 0.001 for millimetres. If not given the unit is the metre, and
        what cannot be in metres is refused.
    detail
        How much is kept: "full", "fine", "default", "small", "tiny", or a `Detail`.
    object_property
        Property of a PLY's vertices or faces that holds object ids; the known ones if not given.
    segment
        Whether a mesh is cut into objects by geometry and colour; auto: if its file names none.
    capture
        How a capture becomes a mesh.
    reader
        Options of the source's own reader, as `reference_frame` of `read_scan3r`, `label_column` of
        `read_scannet`, `scale` and `up` of `read_colmap`, or `level` of OpenStreetMap's rooms.
    left_out
        Is told what of the source could not be used, by reason.
    notes
        Is told what was found out or taken for granted, in sentences.
    progress
        Is told a stage, how much of it is done, and of how much.

    Raises
    ------
    InputError
        The source cannot be read, holds no triangle, vertices that are no numbers, or cannot be in
        metres; or no floor is found, and `floor` is not given.
    OptionError
        An option is out of range.
    MapError, MapLockedError
        The map cannot be written.

    """
    how = ReadOptions(labels, up, scale, object_property, segment, capture, reader or {})
    detail = get_detail(detail)
    counts = Counter() if left_out is None else left_out

    def made() -> SceneMap:
        read = read_source(source, how, counts, progress)
        return make_scene(
            read, floor=floor, up=up, scale=scale, detail=detail, left_out=counts, notes=notes,
            progress=progress,
        )  # fmt: skip

    if out_path is None:
        return made()
    target = resolve_path(out_path)
    for given in (source, labels):
        if isinstance(given, str | os.PathLike) and os.path.realpath(given) == str(target):
            raise OptionError(
                f"{given} is the input and would be overwritten by the map; choose another "
                "output file."
            )
    from placegraph.core.mapfile import map_writer
    from placegraph.indoor.map.scene_file import KIND, VERSION, pack_scene

    with map_writer(out_path) as write:
        scene = made()
        write(KIND, VERSION, *pack_scene(scene), ())
    return scene


def scene_of_model(model: Model, **options: Any) -> SceneMap:  # noqa: ANN401  # of `make_scene`
    """Return scene map of a model in memory; options and errors as of `make_scene`."""
    return make_scene(Source(model), **options)


def make_scene(
    source: Source,
    *,
    floor: float | None = None,
    up: Up = "z",
    scale: float | None = None,
    detail: str | Detail = "default",
    left_out: Counter[str] | None = None,
    notes: list[str] | None = None,
    progress: Progress | None = None,
) -> SceneMap:
    """Make scene map of a source in memory; parameters and errors as of `build_scene`."""
    detail = get_detail(detail)
    notes_out: list[str] = [] if notes is None else notes
    notes_out.extend(source.notes)
    check_model(source.model)
    model = level_model(convert_to_metres(source.model, scale, notes_out), up, notes_out)
    if source.finish is not None:
        source = source.finish(model)
        model = source.model
        notes_out.extend(source.notes)
    left = model.left_out if left_out is None else left_out
    mesh, objects, pictures, row = clean_model(model, left)
    labels = [t.label for t in objects]
    height = _find_floor(model, mesh, labels, floor)
    if progress is not None:
        progress("simplifying", 0, 1)
    if source.anchors:  # drawn from a plan: there is nothing to leave out
        detail = get_detail("full")
    coarse, blobs = reduce_mesh(mesh, pictures, source.colour_of, detail, left, notes_out)
    _note_oddities(coarse, objects, notes_out)
    room_of, attributes = assign_rooms(coarse, labels, height, [t.attributes for t in objects])
    scene = SceneMap.create(
        coarse,
        [t.id for t in objects],
        labels,
        floor=height,
        names=[t.name for t in objects],
        attributes=attributes,
        relations=_merge_relations(model, row, find_relations(coarse, labels, room_of)),
        scene=model.path.stem or "scene",
        source=model.path.name,
        encoded=blobs,
    )
    seen_from = source.viewpoints[is_near_box(source.viewpoints, scene.bounds)]
    scene = replace(scene, landmarks=source.landmarks, viewpoints=seen_from, anchors=source.anchors)
    return replace(scene, own_agreement=source.measure(scene)[None]) if source.measure else scene


def _find_floor(model: Model, mesh: Mesh, labels: Sequence[str], floor: float | None) -> float:
    known = floor if floor is not None else model.floor
    height = find_floor_height(mesh, labels) if known is None else float(known)
    if height is None:
        why = "no object is labelled floor"
        if any(map(is_floor, labels)):
            why = "the surface labelled floor is not level (check the up axis, --up)"
        raise InputError(
            f"{model.path}: no floor was found ({why}, and no large level surface lies "
            "low); give its height (floor=0.0, or --floor 0)."
        )
    return height


def _merge_relations(
    model: Model, row: NDArray[np.int64], computed: list[tuple[int, str, int]]
) -> list[tuple[int, str, int]]:
    """Merge the source's relations with those computed between pairs that it says nothing of.

    `same room` stands beside any other: its edges are a tree, which no branch may be missing of.
    """
    own = [
        (int(row[a]), name, int(row[b]))
        for a, name, b in model.relations
        if row[a] >= 0 and row[b] >= 0 and a != b
    ]
    known_pairs = {frozenset((a, b)) for a, _, b in own}
    return sorted(
        {*own, *(e for e in computed if e[1] == SAME_ROOM or frozenset(e[::2]) not in known_pairs)}
    )


def _note_oddities(mesh: Mesh, objects: Sequence[ModelObject], notes: list[str]) -> None:
    """Note an object that is nearly everything, very many of them, and coordinates from afar."""
    reach = float(np.abs(mesh.bounds()).max())
    if reach > FAR:
        notes.append(
            f"The mesh lies {reach:,.0f} m from its origin, where coordinates are only "
            f"accurate to {1000.0 * mesh.steps()[0]:.0f} mm; subtract an offset in whole "
            "metres."
        )
    if len(objects) > MAX_RELATED_OBJECTS:
        notes.append(
            f"The mesh has {len(objects):,} objects, so no relations are computed (limit: "
            f"{MAX_RELATED_OBJECTS:,}). Check that --object-property names the object ids."
        )
    area = np.bincount(mesh.object_of, np.linalg.norm(mesh.normals(), axis=1), len(objects))
    most = int(area.argmax())
    share = float(area[most] / max(area.sum(), 1e-12))
    if share > 0.9 and len(mesh) > 1000:
        thing = objects[most]
        notes.append(
            f"Object {thing.name or thing.id!r} is {100 * share:.0f} % of the surface, so "
            "it cannot distinguish places. Segment the mesh (--segment), or label its parts."
        )
