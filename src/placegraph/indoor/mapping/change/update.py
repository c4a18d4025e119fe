"""Columns of a map while changes are taken over: meshes move along, rooms and relations are found anew."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any, Generic

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import write_file
from placegraph.errors import InputError, OptionError
from placegraph.indoor.map import textures
from placegraph.indoor.map.floor import is_structural
from placegraph.indoor.map.mesh import WHITE, Mesh, sort_triangles
from placegraph.indoor.map.relations import (
    ATTACHED_TO,
    BIGGER,
    PART,
    SAME_ROOM,
    STANDING_ON,
    find_relations,
    normalize_relation,
)
from placegraph.indoor.map.rooms import assign_rooms, find_rooms, most_common_name
from placegraph.indoor.map.scene import S, Scene, make_graph
from placegraph.indoor.map.scene_file import open_scene, save_scene
from placegraph.indoor.mapping.change.align import transform_points
from placegraph.indoor.mapping.change.changes import KINDS, Change, Piece, SceneDiff

_COMPARED = frozenset({
    "messier", "cleaner", "fuller", "emptier", "brighter", "darker", "more", "less", "older",
    "newer", "heavier", "lighter", "softer", "harder",
})  # fmt: skip
"""First words of what 3DSSG compares, but for where things are: "higher than" is left out."""


class MapEdit(Generic[S]):
    """Columns of a map, while it changes."""

    def __init__(self, scene: S) -> None:
        self._before = scene
        graph, count = scene.graph, len(scene)
        self._ids, self._labels = list(graph.ids), list(graph.labels)
        self._names = list(graph.names)
        self._attributes = [dict(a) for a in scene.attributes]
        self._kept = np.ones(count, np.bool_)
        self._stirred: set[int] = set()
        self._motions: dict[int, NDArray[np.float64]] = {}
        self._pieces: list[tuple[int, Piece]] = []

    def take(self, change: Change, row: int, when: str) -> None:
        """Take one change over; `row`: of its object, -1 of what appeared."""
        prefix = f"{when}: " if when else ""
        if change.kind == "moved" and change.after_from_before is not None:
            self._motions[row] = change.after_from_before
            self._tell(
                row, f"{prefix}moved by {change.shift_m:.2f} m and {change.turn_deg:.0f} degrees"
            )
        elif change.kind == "vanished":
            self._kept[row] = False
            thing = change.name or change.id
            for base in self._bases(row):
                self._tell(base, f"{prefix}{change.label} {thing!r} vanished")
        elif change.kind == "appeared" and change.piece is not None:
            row = len(self._ids)
            id_, number = change.other, 1
            while not id_ or id_ in self._ids:
                id_, number = f"new-{number}", number + 1
            self._ids.append(id_)
            self._labels.append(change.label)
            self._names.append(change.name)
            self._attributes.append({})
            self._pieces.append((row, change.piece))
            self._tell(row, f"{prefix}appeared")
        if change.new_label and row >= 0 and change.kind in {"moved", "relabelled"}:
            self._tell(row, f"{prefix}was labelled {self._labels[row]!r}")
            self._labels[row] = change.new_label
        self._stirred.add(row)

    def scene(self) -> S:
        """Make the new map."""
        kept = np.concatenate([self._kept, np.ones(len(self._pieces), np.bool_)])
        rows = np.flatnonzero(kept)
        if not rows.size:
            raise OptionError("diff: it would remove every object; apply fewer changes.")
        place = np.cumsum(kept) - 1
        mesh, encoded = self._mesh()
        mesh = replace(mesh, object_of=place[mesh.object_of].astype(np.int32))
        mesh = sort_triangles(mesh.quantize())
        labels = [self._labels[i] for i in rows]
        attributes = [self._attributes[i] for i in rows]
        room_of = None
        if len(self._before.scenes) == 1:  # of merged scenes rooms stay as they were
            stirred = np.isin(rows, list(self._stirred))
            floor = float(self._before.floors[0])
            room_of, attributes = reassign_rooms(mesh, labels, floor, attributes, stirred)
        edges = self._edges(find_relations(mesh, labels, room_of), rows, place)
        ids, names = ([given[i] for i in rows] for given in (self._ids, self._names))
        graph = make_graph(mesh, ids, labels, names, edges)
        before = self._before
        # of what appeared the merged scene in whose bounds it lies
        scene_of = [
            before.scene_of[row] if row < len(before) else before.scene_at(at[:2])
            for row, at in zip(rows.tolist(), graph.positions, strict=True)
        ]
        vectors, given = before.graph.embeddings, None
        if vectors is not None:  # zeros of what appeared and of what has another label now
            given = np.zeros((len(rows), vectors.shape[1]), np.float32)
            for i, row in enumerate(rows.tolist()):
                if row < len(before) and before.graph.labels[row] == self._labels[row]:
                    given[i] = vectors[row]
        return replace(
            before,
            graph=replace(graph, embeddings=given),
            mesh=mesh,
            attributes=tuple(attributes),
            scene_of=np.array(scene_of, np.int32),
            encoded=encoded,
        )

    def _tell(self, row: int, what: str) -> None:
        history = self._attributes[row].get("history")
        self._attributes[row]["history"] = f"{history}; {what}" if history else what

    def _bases(self, row: int) -> list[int]:
        graph = self._before.graph
        edges = zip(graph.sources.tolist(), graph.relations, graph.targets.tolist(), strict=True)
        return [t for s, r, t in edges if s == row and r in {STANDING_ON, ATTACHED_TO}]

    def _mesh(self) -> tuple[Mesh, tuple[bytes, ...]]:
        old = self._before.mesh
        keep = self._kept[old.object_of]
        triangles, owner = old.triangles[keep].astype(np.int64), old.object_of[keep]
        # vertices may be shared by objects: each thing that moves takes its own ones along
        which, points = [np.arange(len(old.vertices))], [old.vertices.astype(np.float64)]
        count = len(old.vertices)
        for row, motion in self._motions.items():
            own = owner == row
            used, at = np.unique(triangles[own], return_inverse=True)
            triangles[own] = count + at.reshape(-1, 3)
            which.append(used)
            points.append(transform_points(motion, points[0][used]))
            count += len(used)
        source = np.concatenate(which)
        columns: dict[str, list[NDArray[Any]]] = {
            "vertices": points,
            "colours": [old.colours[source]],
            "uv": [old.uv[source]],
            "triangles": [triangles],
            "object_of": [owner],
            "texture_of": [old.texture_of[keep]],
        }
        for row, piece in self._pieces:
            columns["vertices"].append(piece.vertices)
            columns["colours"].append(piece.colours)
            columns["uv"].append(np.zeros((len(piece.vertices), 2), np.float32))
            columns["triangles"].append(piece.triangles + count)
            columns["object_of"].append(np.full(len(piece.triangles), row))
            columns["texture_of"].append(np.full(len(piece.triangles), len(old.textures)))
            count += len(piece.vertices)
        made = {name: np.concatenate(parts) for name, parts in columns.items()}
        used, texture_of = np.unique(made["texture_of"], return_inverse=True)
        pictures = (*old.textures, WHITE)
        blobs = self._before.encoded
        if self._pieces:
            blobs = (*blobs, *textures.encode_arrays([WHITE]))
        mesh = Mesh(
            vertices=made["vertices"].astype(np.float32),
            triangles=made["triangles"].astype(np.int32),
            object_of=made["object_of"].astype(np.int32),
            colours=made["colours"],
            uv=made["uv"].astype(np.float32),
            texture_of=texture_of.astype(np.int32),
            textures=tuple(pictures[i] for i in used),
        )
        return mesh, tuple(blobs[i] for i in used)

    def _edges(
        self,
        new_edges: Sequence[tuple[int, str, int]],
        rows: NDArray[np.int64],
        place: NDArray[np.int64],
    ) -> list[tuple[int, str, int]]:
        """Return relations that stay, and `new_edges` between what changed."""
        graph = self._before.graph
        stirred = np.isin(rows, list(self._stirred))
        before = zip(graph.sources.tolist(), graph.relations, graph.targets.tolist(), strict=True)
        edges = [
            (int(place[s]), relation, int(place[t]))
            for s, relation, t in before
            if self._kept[s] and self._kept[t]
            if is_lasting(relation) or not {s, t} & self._stirred
            if relation != SAME_ROOM or len(self._before.scenes) > 1
        ]
        known = {(s, t) for s, relation, t in edges if not is_lasting(relation)}
        # what stood on, or hung at, what is gone from there now
        loose = [r < len(self._kept) and self._stirred & {*self._bases(r)} for r in rows.tolist()]
        edges += [
            (s, relation, t)
            for s, relation, t in new_edges
            if relation == SAME_ROOM
            or ((stirred[s] or stirred[t] or loose[s]) and (s, t) not in known)
        ]
        return sorted(edges)


def is_lasting(relation: str) -> bool:
    """Return whether a relation says nothing of place, so that it holds wherever the two things are."""
    name = normalize_relation(relation)[0]
    if name in {BIGGER, PART}:
        return True
    words = name.split()
    return bool(words) and name != SAME_ROOM and (words[0] == "same" or words[0] in _COMPARED)


def reassign_rooms(
    mesh: Mesh,
    labels: Sequence[str],
    floor: float,
    attributes: Sequence[Mapping[str, str]],
    stirred: NDArray[np.bool_],
) -> tuple[NDArray[np.int32], list[dict[str, str]]]:
    """Assign rooms (N,) after some objects changed, and attributes that name them.

    What did not change keeps the name of its room; what did, (N,) `stirred`, takes that of most
    things in the room where it is now, or of the nearest thing where it is in no room that is found.
    Where no attribute names a room, rooms are found.
    """
    if not any(a.get("room") for a in attributes):
        return assign_rooms(mesh, labels, floor, attributes)
    named = [dict(a) for a in attributes]
    if stirred.any():
        now = find_rooms(mesh, labels, floor).room_of
        boxes = mesh.object_bounds(len(labels))
        is_unchanged = ~stirred & ~is_structural(labels)
        for row in np.flatnonzero(stirred).tolist():
            near = is_unchanged & (now == now[row])
            if now[row] < 0:  # the nearest object, by their boxes
                apart = np.maximum(boxes[:, 0] - boxes[row, 1], boxes[row, 0] - boxes[:, 1])
                gap = np.linalg.norm(np.maximum(apart, 0.0), axis=1)
                nearest = np.where(is_unchanged, gap, np.inf).argmin()
                near = is_unchanged & (np.arange(len(boxes)) == nearest)
            name = most_common_name(
                [named[i].get("room", "") for i in np.flatnonzero(near).tolist()]
            )
            named[row].pop("room", None)
            named[row] |= {"room": name} if name else {}
    return assign_rooms(mesh, labels, floor, named)


LEAST = 0.5  # Findings less sure than this are not taken over, unless that is asked for


def update(
    scene: S,
    diff: SceneDiff,
    *,
    take: Collection[str] = KINDS,
    least_confidence: float = LEAST,
    when: str = "",
) -> S:
    """Map that has taken over what a diff found; the map given stays as it is.

    What moved is moved, with its surface; what vanished is left out; what appeared is added with
    the surface the diff has of it; labels are changed. Where what changed is, its room and its
    relations, is found anew; what says nothing of place ("bigger than") is kept.
    Each object that changed, and what a vanished one stood on or hung at, tells of it in its
    attribute ``history``.

    Raises `OptionError`: the diff is of another map; `take` names nothing there is; no object would
    be left.

    `scene`: the map the diff starts from.
    `diff`: of `diff` or `diff_capture`, or read from a file.
    `take`: kinds of changes, or ids of objects, that are taken over.
    `least_confidence`: changes less sure than this are left alone.
    `when`: when it changed, for the history: such as 2026-11-21.
    """
    wanted = {take} if isinstance(take, str) else set(take)
    known = {*KINDS, *(c.id for c in diff if c.id), *(c.other for c in diff if c.other)}
    if unknown := sorted(wanted - known):
        raise OptionError(
            f"take: {unknown[0]!r} is neither a kind of change ({', '.join(KINDS)}) nor an "
            "id in the diff."
        )
    chosen = [
        c
        for c in diff
        if (c.kind in wanted and c.confidence >= least_confidence)
        or {c.id, c.other} & (wanted - {""})
    ]
    rows = {id_: i for i, id_ in enumerate(scene.graph.ids)}
    if strange := [c.id for c in chosen if c.id and c.id not in rows]:
        raise OptionError(
            f"diff: {strange[0]!r} is not an object of {scene.source or 'the map'}; use the "
            f"map that the diff was made from, {diff.before or 'another map'}."
        )
    edit = MapEdit(scene)
    for change in chosen:
        edit.take(change, rows.get(change.id, -1), when)
    return edit.scene()


def update_file(
    path: str | PathLike[str],
    diff: SceneDiff,
    out: str | PathLike[str],
    *,
    in_place: bool = False,
    take: Collection[str] = KINDS,
    least_confidence: float = LEAST,
    when: str = "",
) -> Scene:
    """Update a map file into another; the file is complete, or it is not there.

    With `in_place` both may be one: what it was before is then kept beside it, as `NAME.bak`.
    Other parameters as of `update`.

    Raises `OptionError`: `out` is the map itself, and `in_place` is not set; or as `update` does;
    `InputError`, `MapError` or `MapLockedError`: the map cannot be read; the new one, or the copy,
    cannot be written.
    """
    same = os.path.realpath(path) == os.path.realpath(out)
    if same and not in_place:
        raise OptionError(f"{out} is the input map; name another output file, or use --in-place.")
    scene = update(
        open_scene(path, Scene), diff, take=take, least_confidence=least_confidence, when=when
    )
    if same:
        copy = Path(path).with_name(f"{Path(path).name}.bak")
        try:
            write_file(copy, [Path(path).read_bytes()])
        except OSError as error:
            raise InputError(f"{path} cannot be read: {error.strerror}.") from error
    save_scene(scene, out)
    return scene
