"""Reader of 3RScan's annotated scans, with 3DSSG's attributes and relations of objects.

The textured mesh (`mesh.refined.v2.obj`) gives form and colour, the annotated mesh
(`labels.instances.annotated.v2.ply`, whose own colours are those of labels) or the segments the
objects; `semseg.v2.json` and 3DSSG's `objects.json` their names and attributes, 3DSSG's
`relationships.json` their relations. Scans are z up, in metres.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import check_regular
from placegraph.errors import InputError, OptionError
from placegraph.io.capture.json_files import LabelEntry, read_json, read_label_table
from placegraph.io.mesh.model import Model
from placegraph.io.mesh.nearest_kernels import find_nearest
from placegraph.io.mesh.obj import read_obj
from placegraph.io.mesh.ply import majority_vote, make_objects, read_columns, read_ply, to_integers
from placegraph_io.dataset.scannet import is_rigid

MESHES = ("mesh.refined.v2.obj", "mesh.refined.obj")
LABELLED = ("labels.instances.annotated.v2.ply", "labels.instances.annotated.ply")
SEGMENTS = ("mesh.refined.0.010000.segs.v2.json", "mesh.refined.0.010000.segs.json")
GROUPS = ("semseg.v2.json", "semseg.json")
OBJECTS = ("objects.json",)
RELATIONS = (
    "relationships.json", "relationships_train.json", "relationships_validation.json",
    "relationships_test.json",
)  # fmt: skip
BESIDE = (".", "3DSSG", "3DSSG_subset", "files")
"""Folders in which files on all scans are looked for, of the scan's folder and its parents."""
_PARENTS = 3
_NO_RELATION = "none"


@dataclass(frozen=True, slots=True)
class Annotation:
    """Objects of a scan and their relations."""

    objects: dict[str, LabelEntry]  # By the object's id
    relations: tuple[tuple[str, str, str], ...]  # (id, 3DSSG's name of the relation, id), sorted


def find_first(folder: Path, names: tuple[str, ...]) -> Path | None:
    """Return the first of these files that a folder holds."""
    return next((folder / name for name in names if (folder / name).is_file()), None)


def find_around(folder: Path, names: tuple[str, ...], given: Path | None = None) -> Iterator[Path]:
    """Yield the files of these names that are given, or in the scan's folder, its parents, or beside them."""
    if given is not None:
        places = [given]
    else:
        near = [folder, *folder.absolute().parents[:_PARENTS]]
        places = [parent / beside for parent in near for beside in BESIDE]
    for place in places:
        yield from (place / name for name in names if (place / name).is_file())


def read_annotation(folder: Path, given: Path | None, left_out: Counter[str]) -> Annotation:
    """Return the objects of `semseg.v2.json` and 3DSSG's `objects.json`, and 3DSSG's relations, of one scan.

    `given` is the folder of 3DSSG's files, if they are not around the scan's. What there is not is
    counted; raises `InputError` where no file names the objects, or one is damaged.
    """
    scan = folder.absolute().name
    groups = find_first(folder, GROUPS)
    objects = read_label_table(groups) if groups else {}
    described = next(
        (found for file in find_around(folder, OBJECTS, given) if (found := _objects(file, scan))),
        {},
    )
    for id_, entry in described.items():
        known = objects.get(id_)
        objects[id_] = LabelEntry(known.label if known else entry.label, "", entry.attributes)
    if not objects:
        raise InputError(
            f"{folder} has no {GROUPS[0]}, and no {OBJECTS[0]} nearby lists the objects of the "
            f"scan {scan}; download one of them, or give 3DSSG's folder."
        )
    files = list(find_around(folder, RELATIONS, given))
    relations = next((rows for file in files if (rows := _relations(file, scan))), set())
    if not described:
        left_out["3DSSG's attributes, missing for this scan in objects.json"] += 1
    if not relations:
        left_out["3DSSG's relations, missing for this scan in relationships.json"] += 1
    return Annotation(objects, tuple(sorted(relations)))


def segment_objects(segments: Path, groups: Path) -> list[int]:
    """Return the id of the object of each vertex, -1: none, by over-segmentation and its groups."""
    content, named = read_json(segments), read_json(groups)
    listed = content.get("segIndices") if isinstance(content, dict) else None
    members = named.get("segGroups") if isinstance(named, dict) else None
    if not isinstance(listed, list) or not isinstance(members, list):
        raise InputError(
            f"{segments} lacks the list segIndices, or {groups} the list segGroups; download both "
            "again."
        )
    owner: dict[object, int] = {}
    for group in members:
        own = group.get("segments") if isinstance(group, dict) else None
        id_ = group.get("objectId", group.get("id")) if isinstance(group, dict) else None
        if not isinstance(own, list) or type(id_) is not int:
            raise InputError(f"{groups}: a group lacks objectId or segments; download it again.")
        owner |= {s: id_ for s in own if type(s) is int}
    return [owner.get(s, -1) if type(s) is int else -1 for s in listed]


def _objects(path: Path, scan: str) -> dict[str, LabelEntry]:
    found = {}
    for entry in _read_scan_entries(path, scan):
        for object_ in _read_objects_list(path, entry, "objects"):
            id_, label = object_.get("id"), object_.get("label")
            if not isinstance(id_, str | int) or not isinstance(label, str) or not label:
                raise InputError(
                    f"{path}: an object of {scan} lacks id or label; download it again."
                )
            found[str(id_)] = LabelEntry(label, "", _read_attributes(object_))
    return found


def _read_attributes(object_: dict[str, Any]) -> dict[str, str]:
    """Return the attributes as 3DSSG names them (color, material, ...), and what the object affords."""
    attributes = object_.get("attributes")
    values = dict(attributes) if isinstance(attributes, dict) else {}
    if object_.get("affordances"):
        values["affordances"] = object_["affordances"]
    return {
        str(key): ", ".join(map(str, value)) if isinstance(value, list) else str(value)
        for key, value in values.items()
        if value
    }


def _relations(path: Path, scan: str) -> set[tuple[str, str, str]]:
    """Return the relations of all entries of a scan: 3DSSG's subset lists a scan once a split."""
    found = set()
    for entry in _read_scan_entries(path, scan):
        listed = entry.get("relationships")
        if not isinstance(listed, list):
            raise InputError(f"{path}: `relationships` of {scan} is not a list; download it again.")
        for row in listed:
            if not (isinstance(row, list) and len(row) == 4 and isinstance(row[3], str)):
                raise InputError(
                    f"{path}: {str(row)[:60]} of {scan} is not a relation; it must be [subject, "
                    "object, number, name]."
                )
            if row[3] and row[3] != _NO_RELATION and row[0] != row[1]:
                found.add((str(row[0]), row[3], str(row[1])))
    return found


def _read_scan_entries(path: Path, scan: str) -> list[dict[str, Any]]:
    """Return the entries of a scan, cut out of a file on all scans, which would take seconds to parse."""
    try:
        text = check_regular(path).read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error
    found, at = [], -1
    name = json.dumps(scan).encode()
    while (at := text.find(name, at + 1)) >= 0:
        try:
            entry = json.loads(text[slice(*_find_object(text, at))])
        except (ValueError, RecursionError):  # a brace in a name, or damage
            return _read_scan_entries_slowly(path, scan)
        if entry.get("scan") == scan:
            found.append(entry)
    return found


def _find_object(text: bytes, at: int) -> tuple[int, int]:
    """Return the span of the JSON object around an offset; ValueError where there is none."""
    ends = []
    for step, opening, closing in ((-1, b"{", b"}"), (1, b"}", b"{")):
        depth, place = 1, at
        while depth:
            seek = text.rfind if step < 0 else text.find
            span = (0, place) if step < 0 else (place,)
            one, other = seek(opening, *span), seek(closing, *span)
            if one < 0:
                raise ValueError(at)
            nearer = other < 0 or (one > other if step < 0 else one < other)
            depth += -1 if nearer else 1
            place = (one if nearer else other) + (step > 0)
        ends.append(place)
    return ends[0], ends[1]


def _read_scan_entries_slowly(path: Path, scan: str) -> list[dict[str, Any]]:
    content = read_json(path)
    scans = content.get("scans") if isinstance(content, dict) else None
    if not isinstance(scans, list):
        raise InputError(
            f"{path} is not from 3DSSG, because it has no list `scans`; download it again."
        )
    return [entry for entry in scans if isinstance(entry, dict) and entry.get("scan") == scan]


def _read_objects_list(path: Path, entry: dict[str, Any], key: str) -> list[dict[str, Any]]:
    listed = entry.get(key)
    if not isinstance(listed, list) or not all(isinstance(v, dict) for v in listed):
        raise InputError(
            f"{path}: `{key}` of {entry['scan']} is not a list of objects; download it again."
        )
    return listed


NAME = "3RScan.json"
_RIGID = 1e-2  # matrices are written with few digits
_MAX_SHIFT = 100.0  # Largest shift between two scans of a room [m]; beyond, units are wrong


@dataclass(frozen=True, slots=True, eq=False)
class Move:
    """An object that stands elsewhere in a rescan."""

    reference_id: str  # Its id in the reference
    scan_id: str  # Its id in the rescan
    scan_from_reference: NDArray[np.float64]
    """(4, 4) of the object's points [m], from the reference's axes to the rescan's."""
    symmetry: int  # 0: none; else 3RScan's code of the rotations that look alike


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """One scan of a room."""

    id: str
    reference_from_scan: NDArray[np.float64] | None
    """(4, 4) [m]; None where the file keeps it back, as of the hidden test scans."""
    moves: tuple[Move, ...] = ()
    nonrigid: tuple[str, ...] = ()  # Ids, in the reference, of objects that changed their form
    removed: tuple[str, ...] = ()  # Ids, in the reference, of objects that are gone


@dataclass(frozen=True, slots=True, eq=False)
class Room:
    """Scans of the same room at different times, the reference first."""

    reference: str
    kind: str  # 3RScan's `type`: train, validation or test
    scans: tuple[Scan, ...]


@dataclass(frozen=True)
class Rooms:
    """Rooms of a `3RScan.json`."""

    path: Path
    rooms: tuple[Room, ...]

    @cached_property
    def _places(self) -> dict[str, tuple[Room, Scan]]:
        return {scan.id: (room, scan) for room in self.rooms for scan in room.scans}

    def room_of(self, scan: str) -> Room:
        """Return the room that a scan shows; `InputError` where the file does not know the scan."""
        return self._place(scan)[0]

    def scan(self, scan: str) -> Scan:
        """Return the scan by its id; `InputError` where the file does not know it."""
        return self._place(scan)[1]

    def reference_from(self, scan: str) -> NDArray[np.float64]:
        """Return (4, 4) reference_from_scan [m]; `InputError` where the file does not say it."""
        found = self.scan(scan).reference_from_scan
        if found is None:
            raise InputError(
                f"{self.path} has no transform for the rescan {scan} (hidden test scans "
                "have none); use the scan's own axes."
            )
        return found

    def _place(self, scan: str) -> tuple[Room, Scan]:
        if scan not in self._places:
            raise InputError(
                f"{self.path} has no scan {scan!r}; name the scan's folder by its id, as in 3RScan."
            )
        return self._places[scan]


def read_rooms(path: str | PathLike[str]) -> Rooms:
    """Read a `3RScan.json`; `InputError` where it is missing, or is not what this module says."""
    path = Path(path)
    content = read_json(path)
    if not isinstance(content, list):
        raise InputError(f"{path} is not 3RScan.json, which is a list of rooms; download it again.")
    rooms = Rooms(path, tuple(_read_room(path, entry) for entry in content))
    seen: set[str] = set()
    for room in rooms.rooms:
        for scan in room.scans:
            if scan.id in seen:
                raise InputError(f"{path} lists the scan {scan.id} twice; keep one of them.")
            seen.add(scan.id)
    return rooms


def _read_room(path: Path, entry: object) -> Room:
    reference = _read_scan_id(path, entry, "reference")
    scans = entry.get("scans", []) if isinstance(entry, dict) else []
    kind = entry.get("type", "") if isinstance(entry, dict) else ""
    if not isinstance(scans, list) or not isinstance(kind, str):
        raise InputError(
            f"{path}: `scans` of {reference} is not a list, or `type` is not text; download it "
            "again."
        )
    first = Scan(reference, np.eye(4))
    return Room(reference, kind, (first, *(_read_scan(path, rescan) for rescan in scans)))


def _read_scan(path: Path, entry: Any) -> Scan:  # noqa: ANN401  # of a JSON list
    name = _read_scan_id(path, entry, "reference")
    matrix = entry.get("transform")
    moves = entry.get("rigid") or []
    if not isinstance(moves, list):
        raise InputError(f"{path}: `rigid` of {name} is not a list; download it again.")
    return Scan(
        name,
        None if matrix is None else _read_transform(path, matrix, name),
        tuple(_read_move(path, move, name) for move in moves),
        _room_ids(entry.get("nonrigid")),
        _room_ids(entry.get("removed")),
    )


def _read_move(path: Path, entry: Any, scan: str) -> Move:  # noqa: ANN401  # of a JSON list
    if not isinstance(entry, dict) or "transform" not in entry:
        raise InputError(
            f"{path}: an entry of `rigid` of {scan} lacks its transform; download it again."
        )
    reference, own = (entry.get(key) for key in ("instance_reference", "instance_rescan"))
    if not all(isinstance(v, int | str) for v in (reference, own)):
        raise InputError(
            f"{path}: an entry of `rigid` of {scan} lacks its instances; download it again."
        )
    where = f"{scan}, instance {reference}"
    symmetry = entry.get("symmetry")
    return Move(
        str(reference),
        str(own),
        _read_transform(path, entry["transform"], where),
        symmetry if isinstance(symmetry, int) else 0,
    )


def _read_transform(path: Path, numbers: object, where: str) -> NDArray[np.float64]:
    good = isinstance(numbers, list) and len(numbers) == 16
    if not good or not all(type(v) in {int, float} for v in numbers):  # type: ignore[attr-defined]
        raise InputError(f"{path}: the transform of {where} is not 16 numbers; download it again.")
    with np.errstate(over="ignore"):
        matrix = np.array([float(min(max(v, -1e300), 1e300)) for v in numbers])  # type: ignore[attr-defined]
    matrix = matrix.reshape(4, 4).T
    if not is_rigid(matrix, _RIGID):
        raise InputError(
            f"{path}: the transform of {where} is not rigid; it must be stored column by column, "
            "as in 3RScan. Download it again."
        )
    if np.abs(matrix[:3, 3]).max() > _MAX_SHIFT:
        raise InputError(
            f"{path}: the transform of {where} shifts by {np.abs(matrix[:3, 3]).max():.0f} m, so "
            "it may be in millimetres; divide its translation by 1000."
        )
    u, _, vt = np.linalg.svd(matrix[:3, :3])
    matrix[:3, :3] = u @ vt
    matrix[3] = (0, 0, 0, 1)
    matrix.flags.writeable = False
    return matrix


def _room_ids(ids: object) -> tuple[str, ...]:
    """Return the ids of a list of numbers, or of objects with `instance_reference`."""
    found = [
        entry.get("instance_reference") if isinstance(entry, dict) else entry
        for entry in (ids if isinstance(ids, list) else [])
    ]
    return tuple(str(i) for i in found if isinstance(i, int | str))


def _read_scan_id(path: Path, entry: object, key: str) -> str:
    value = entry.get(key) if isinstance(entry, dict) else None
    if not isinstance(value, str) or not value:
        raise InputError(f"{path}: an entry lacks {key!r}, the id of its scan; download it again.")
    return value


REACH = 0.05  # A vertex has the label of the annotated mesh's nearest one within this [m]
_SAME = 1e-3  # Vertices in one order differ by less [m]: by the digits they are written with


def is_scan3r(path: Path) -> bool:
    """Return whether a path is a folder with one of 3RScan's meshes and one of its files of labels."""
    try:
        return find_first(path, MESHES + LABELLED) is not None and (
            find_first(path, LABELLED + GROUPS) is not None
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

    `reference_frame`: bring a rescan into the axes of its room's reference, by `3RScan.json`;
    `undo_moves`: bring back, too, each object that `3RScan.json` says was moved to where the reference
    has it; `rooms`: `3RScan.json`, or what `read_rooms` read of it; looked for around the folder if not
    given; `annotations`: folder of 3DSSG's files; looked for around the folder if not given.

    Raises `InputError`: a file is missing or damaged: no mesh, no labels, no names of objects; most of
    the mesh has no label near it; or `3RScan.json` does not know the scan; `OptionError`: `undo_moves`
    without `reference_frame`.
    """
    folder = Path(path)
    if undo_moves and not reference_frame:
        raise OptionError(
            "undo_moves needs reference_frame=True, because the moves are given in that frame."
        )
    if not folder.is_dir():
        raise InputError(
            f"{folder} is not the folder of a scan; give the folder that contains its mesh."
        )
    left_out: Counter[str] = Counter()
    annotation = read_annotation(
        folder, None if annotations is None else Path(annotations), left_out
    )
    model = _read_labelled(folder, annotation, left_out)
    if not reference_frame:
        return model
    known = rooms if isinstance(rooms, Rooms) else read_rooms(_rooms_file(folder, rooms))
    return _transform_model(model, known, folder.absolute().name, undo_moves=undo_moves)


def _rooms_file(folder: Path, given: str | PathLike[str] | None) -> Path:
    if given is not None:
        return Path(given)
    found = next(find_around(folder, (NAME,)), None)
    if found is None:
        raise InputError(
            f"{folder}: there is no {NAME} nearby to align the scans; download it, or give its "
            "path."
        )
    return found


def _read_labelled(folder: Path, annotation: Annotation, left_out: Counter[str]) -> Model:
    """Return the model with things, and relations between them."""
    mesh, labelled = find_first(folder, MESHES), find_first(folder, LABELLED)
    if mesh is not None:
        model = read_obj(mesh, groups="usemtl")
        ids = _find_vertex_ids(folder, model, labelled, left_out)[model.triangles]
        things, object_of, missing = make_objects(
            majority_vote(ids), len(model.triangles), annotation.objects
        )
        model = replace(model, objects=things, object_of=object_of)
        left_out += model.left_out + missing
    elif labelled is not None:
        model = read_ply(labelled, object_property="objectId", table=annotation.objects)
        model = replace(model, colours=np.full(model.vertices.shape, 255, np.uint8))
        left_out += model.left_out
        left_out[f"colours; add {MESHES[0]} to have them"] += 1
    else:
        raise InputError(f"{folder} has no mesh; download {MESHES[0]} or {LABELLED[0]}.")
    row = {thing.id: i for i, thing in enumerate(model.objects)}
    pairs = [(row.get(a), name, row.get(b)) for a, name, b in annotation.relations]
    relations = tuple((a, name, b) for a, name, b in pairs if a is not None and b is not None)
    if len(relations) < len(pairs):
        left_out["relations of missing objects"] += len(pairs) - len(relations)
    return replace(model, path=folder, relations=relations, left_out=left_out)


def _find_vertex_ids(
    folder: Path, model: Model, labelled: Path | None, left_out: Counter[str]
) -> NDArray[np.int64]:
    """Return the id of the object of each vertex of the textured mesh, -1: none."""
    if labelled is not None:
        return _transfer_ids(model, labelled, left_out)
    segments, groups = find_first(folder, SEGMENTS), find_first(folder, GROUPS)
    if segments is None or groups is None:
        raise InputError(
            f"{folder} has a mesh, but no labels; download {LABELLED[0]}, or {SEGMENTS[0]} with "
            f"{GROUPS[0]}."
        )
    ids = np.array(segment_objects(segments, groups), np.int64)
    if len(ids) != len(model.vertices):
        raise InputError(
            f"{segments} labels {len(ids)} vertices, but {model.path} has {len(model.vertices)}; take "
            f"both from one version of 3RScan, or add {LABELLED[0]}."
        )
    return ids


def _transfer_ids(model: Model, path: Path, left_out: Counter[str]) -> NDArray[np.int64]:
    vertex = read_columns(path).get("vertex")
    columns = {} if vertex is None else {name.lower(): v for name, v in vertex.single.items()}
    if not {"x", "y", "z", "objectid"} <= columns.keys():
        raise InputError(
            f"{path} has no vertices with x, y, z and objectId; download 3RScan's annotated mesh again."
        )
    ids = to_integers(columns["objectid"])
    points = np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=1)
    if points.shape == model.vertices.shape and (np.abs(points - model.vertices) <= _SAME).all():
        return ids
    rows = find_nearest(model.vertices, points, REACH)
    far = rows < 0
    bare: NDArray[np.bool_] = np.asarray(far[model.triangles].any(axis=1))
    if bare.sum() > bare.size / 2:
        raise InputError(
            f"{path} and {model.path} do not coincide: {bare.mean():.0%} of the faces have "
            f"no label within {REACH:g} m; use two files of the same scan, neither of them "
            "aligned."
        )
    left_out["vertices labelled like their nearest neighbour, because the meshes differ"] += int(
        (~far).sum()
    )
    if far.any():
        left_out[f"vertices without a label within {REACH:g} m"] += int(far.sum())
    return np.where(far, -1, np.append(ids, -1)[rows])


def _transform_model(model: Model, rooms: Rooms, scan: str, *, undo_moves: bool) -> Model:
    """Return the model in the axes of its room's reference."""
    vertices = _transform_points(model.vertices, rooms.reference_from(scan))
    model = replace(model, vertices=vertices)
    if not undo_moves:
        return model
    back = {m.scan_id: np.linalg.inv(m.scan_from_reference) for m in rooms.scan(scan).moves}
    scan_from_reference = np.linalg.inv(rooms.reference_from(scan))
    for row, thing in enumerate(model.objects):
        if thing.id in back:
            moved = back[thing.id] @ scan_from_reference
            own = model.object_of == row
            used, corners = np.unique(model.triangles[own], return_inverse=True)
            triangles = model.triangles.copy()
            triangles[own] = corners.reshape(-1, 3) + len(model.vertices)
            placed = _transform_points(model.vertices[used], moved)
            model = replace(
                model,
                triangles=triangles,
                vertices=np.concatenate([model.vertices, placed]),
                colours=np.concatenate([model.colours, model.colours[used]]),
                uv=np.concatenate([model.uv, model.uv[used]]),
            )
    return model


def _transform_points(
    points: NDArray[np.float64], transform: NDArray[np.float64]
) -> NDArray[np.float64]:
    with np.errstate(invalid="ignore", over="ignore"):
        placed: NDArray[np.float64] = points @ transform[:3, :3].T + transform[:3, 3]
    return placed
