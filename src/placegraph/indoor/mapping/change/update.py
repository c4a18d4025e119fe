"""A map brought up to date: what a diff found is taken over into a new map."""

from __future__ import annotations

import os
from collections.abc import Collection
from os import PathLike
from pathlib import Path

from placegraph.core.files import write_file
from placegraph.errors import InputError, OptionError
from placegraph.indoor.map.scene import S, Scene
from placegraph.indoor.map.scene_file import open_scene, save_scene
from placegraph.indoor.mapping.change.changes import KINDS, Change, SceneDiff
from placegraph.indoor.mapping.change.edit import Edit

LEAST = 0.5
"""Findings less sure than this are not taken over, unless that is asked for."""


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

    Parameters
    ----------
    scene
        The map the diff starts from.
    diff
        Of `diff` or `diff_capture`, or read from a file.
    take
        Kinds of changes, or ids of objects, that are taken over.
    least_confidence
        Changes less sure than this are left alone.
    when
        When it changed, for the history: such as 2026-11-21.

    Raises
    ------
    OptionError
        The diff is of another map; `take` names nothing there is; no object would be left.

    """
    chosen = _chosen(diff, take, least_confidence)
    rows = {id_: i for i, id_ in enumerate(scene.graph.ids)}
    if strange := [c.id for c in chosen if c.id and c.id not in rows]:
        raise OptionError(
            f"diff: {strange[0]!r} is no object of {scene.source or 'the map'}; it was made from "
            f"{diff.before or 'another map'}."
        )
    edit = Edit(scene)
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

    Raises
    ------
    OptionError
        `out` is the map itself, and `in_place` is not set; or as `update` does.
    InputError, MapError, MapLockedError
        The map cannot be read; the new one, or the copy, cannot be written.

    """
    same = os.path.realpath(path) == os.path.realpath(out)
    if same and not in_place:
        raise OptionError(f"{out} is the map itself; name another file, or say --in-place.")
    scene = update(
        open_scene(path, Scene), diff, take=take, least_confidence=least_confidence, when=when
    )
    if same:
        _keep(Path(path))
    save_scene(scene, out)
    return scene


def _keep(path: Path) -> None:
    """Copy a file to `NAME.bak`, whole or not at all."""
    copy = path.with_name(f"{path.name}.bak")
    try:
        write_file(copy, [path.read_bytes()])
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error


def _chosen(diff: SceneDiff, take: Collection[str], least: float) -> list[Change]:
    wanted = {take} if isinstance(take, str) else set(take)
    known = {*KINDS, *(c.id for c in diff if c.id), *(c.other for c in diff if c.other)}
    if unknown := sorted(wanted - known):
        raise OptionError(
            f"take: {unknown[0]!r} is no kind of change ({', '.join(KINDS)}), and no id in the diff."
        )
    return [
        c
        for c in diff
        if (c.kind in wanted and c.confidence >= least) or {c.id, c.other} & (wanted - {""})
    ]
