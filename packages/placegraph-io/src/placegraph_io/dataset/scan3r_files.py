"""What lies beside a 3RScan scan: names of its files, 3DSSG's objects and relations."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from placegraph.core.files import regular
from placegraph.errors import InputError
from placegraph.io.capture.camera import read_json
from placegraph.io.capture.labels import Entry, label_table

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
    """What is said of a scan's objects."""

    objects: dict[str, Entry]
    """By the object's id."""
    relations: tuple[tuple[str, str, str], ...]
    """(id, 3DSSG's name of the relation, id), sorted."""


def first_of(folder: Path, names: tuple[str, ...]) -> Path | None:
    """The first of these files that a folder holds."""
    return next((folder / name for name in names if (folder / name).is_file()), None)


def around(folder: Path, names: tuple[str, ...], given: Path | None = None) -> Iterator[Path]:
    """Files of these names that are given, or in the scan's folder, its parents, or beside them."""
    if given is not None:
        places = [given]
    else:
        near = [folder, *folder.absolute().parents[:_PARENTS]]
        places = [parent / beside for parent in near for beside in BESIDE]
    for place in places:
        yield from (place / name for name in names if (place / name).is_file())


def read_annotation(folder: Path, given: Path | None, left_out: Counter[str]) -> Annotation:
    """Objects of `semseg.v2.json` and 3DSSG's `objects.json`, and 3DSSG's relations, of one scan.

    `given` is the folder of 3DSSG's files, if they are not around the scan's. What there is not is
    counted; raises `InputError` where no file names the objects, or one is damaged.
    """
    scan = folder.absolute().name
    groups = first_of(folder, GROUPS)
    objects = label_table(groups) if groups else {}
    described = next(
        (found for file in around(folder, OBJECTS, given) if (found := _objects(file, scan))), {}
    )
    for id_, entry in described.items():
        known = objects.get(id_)
        objects[id_] = Entry(known.label if known else entry.label, "", entry.attributes)
    if not objects:
        raise InputError(
            f"{folder} has no {GROUPS[0]}, and no {OBJECTS[0]} around it names the objects of the scan "
            f"{scan}; download one, or name 3DSSG's folder."
        )
    files = list(around(folder, RELATIONS, given))
    relations = next((told for file in files if (told := _relations(file, scan))), set())
    if not described:
        left_out["3DSSG's attributes, which no objects.json has for this scan"] += 1
    if not relations:
        left_out["3DSSG's relations, which no relationships.json has for this scan"] += 1
    return Annotation(objects, tuple(sorted(relations)))


def segment_objects(segments: Path, groups: Path) -> list[int]:
    """Id of the object of each vertex, -1: none, by over-segmentation and its groups."""
    content, named = read_json(segments), read_json(groups)
    listed = content.get("segIndices") if isinstance(content, dict) else None
    members = named.get("segGroups") if isinstance(named, dict) else None
    if not isinstance(listed, list) or not isinstance(members, list):
        raise InputError(f"{segments} has no list segIndices, or {groups} no list segGroups.")
    owner: dict[object, int] = {}
    for group in members:
        own = group.get("segments") if isinstance(group, dict) else None
        id_ = group.get("objectId", group.get("id")) if isinstance(group, dict) else None
        if not isinstance(own, list) or type(id_) is not int:
            raise InputError(f"{groups}: a group lacks objectId or segments; download it again.")
        owner |= {s: id_ for s in own if type(s) is int}
    return [owner.get(s, -1) if type(s) is int else -1 for s in listed]


def _objects(path: Path, scan: str) -> dict[str, Entry]:
    found = {}
    for entry in _of_scan(path, scan):
        for listed in _list(path, entry, "objects"):
            id_, label = listed.get("id"), listed.get("label")
            if not isinstance(id_, str | int) or not isinstance(label, str) or not label:
                raise InputError(
                    f"{path}: an object of {scan} lacks id or label; download it again."
                )
            found[str(id_)] = Entry(label, "", _attributes(listed))
    return found


def _attributes(listed: dict[str, Any]) -> dict[str, str]:
    """Attributes as 3DSSG names them (color, material, ...), and what the object affords."""
    said = listed.get("attributes")
    values = dict(said) if isinstance(said, dict) else {}
    if listed.get("affordances"):
        values["affordances"] = listed["affordances"]
    return {
        str(key): ", ".join(map(str, value)) if isinstance(value, list) else str(value)
        for key, value in values.items()
        if value
    }


def _relations(path: Path, scan: str) -> set[tuple[str, str, str]]:
    """Of all parts of a scan: 3DSSG's subset lists a scan once a split."""
    found = set()
    for entry in _of_scan(path, scan):
        listed = entry.get("relationships")
        if not isinstance(listed, list):
            raise InputError(f"{path}: `relationships` of {scan} is no list; download it again.")
        for row in listed:
            if not (isinstance(row, list) and len(row) == 4 and isinstance(row[3], str)):
                raise InputError(
                    f"{path}: {str(row)[:60]} of {scan} is no relation; it must be [subject, object, "
                    "number, name]."
                )
            if row[3] and row[3] != _NO_RELATION and row[0] != row[1]:
                found.add((str(row[0]), row[3], str(row[1])))
    return found


def _of_scan(path: Path, scan: str) -> list[dict[str, Any]]:
    """Entries of a scan in a file on all of them: cut out, as the whole would take seconds."""
    try:
        text = regular(path).read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error
    found, at = [], -1
    name = json.dumps(scan).encode()
    while (at := text.find(name, at + 1)) >= 0:
        try:
            entry = json.loads(text[slice(*_around(text, at))])
        except (ValueError, RecursionError):  # a brace in a name, or damage
            return _of_scan_by_all(path, scan)
        if entry.get("scan") == scan:
            found.append(entry)
    return found


def _around(text: bytes, at: int) -> tuple[int, int]:
    """Where the object of a JSON file begins and ends that a place is in; ValueError: nowhere."""
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


def _of_scan_by_all(path: Path, scan: str) -> list[dict[str, Any]]:
    content = read_json(path)
    scans = content.get("scans") if isinstance(content, dict) else None
    if not isinstance(scans, list):
        raise InputError(f"{path} is not 3DSSG's: it must hold a list `scans`; download it again.")
    return [entry for entry in scans if isinstance(entry, dict) and entry.get("scan") == scan]


def _list(path: Path, entry: dict[str, Any], key: str) -> list[dict[str, Any]]:
    listed = entry.get(key)
    if not isinstance(listed, list) or not all(isinstance(v, dict) for v in listed):
        raise InputError(f"{path}: `{key}` of {entry['scan']} is no list of objects.")
    return listed
