"""Encoders of captures whose labels are ids of the map's objects, as a simulator or a tracker gives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from placegraph.indoor.encode import Patches
from placegraph.indoor.encode.grid import GRID, checked, looked_up, majority
from placegraph.indoor.map.scene import Scene
from placegraph.io.capture.frame import Frame

_FOREIGN = 0.2
"""Share of the ids of frames that a map may lack: things come and go."""
_AGREE = 0.5
"""Of patches that name an object, the share that see it, below which they may name another."""


class InstancesEncoder:
    """Patches by the most frequent object of their pixels, each agreeing with that object alone.

    In a merged map a number may be any scene's, and agrees with all of them: "kitchen/7", "attic/7".
    A patch whose number the map does not know says nothing.

    Raises
    ------
    OptionError
        The grid has no patches.

    """

    def __init__(self, scene: Scene, grid: tuple[int, int] = GRID) -> None:
        self.grid = checked(grid)
        graph = scene.graph
        merged = len(scene.scenes) > 1
        ids = [id_.rpartition("/")[2] if merged else id_ for id_ in graph.ids]
        self.row_of = {id_: i for i, id_ in enumerate(dict.fromkeys(ids))}
        """Row of the table of each id."""
        self.table = np.full((len(self.row_of), len(graph)), -1.0, np.float32)
        self.table[[self.row_of[id_] for id_ in ids], np.arange(len(graph))] = 1.0

    def encode(self, frame: Frame) -> Patches | None:
        """Patches of a frame's label image; None where it has none, or has ids of labels."""
        image = frame.labels() if frame.label_kind == "instances" else None
        if image is None:
            return None
        known = {
            int(id_): row
            for id_, row in self.row_of.items()
            if id_.isdecimal() and len(id_) < 20 and str(int(id_)) == id_
        }
        rows = majority(looked_up(image, known), self.grid, len(self.table))
        return Patches(frame.label_camera or frame.camera, self.grid, rows, self.table)


class ClassesOfInstances(InstancesEncoder):
    """Reads a capture of instances as labels: each pixel's object stands for its label.

    In a merged map, a number that may be any scene's stands in each scene for its label there.
    """

    def __init__(self, scene: Scene, grid: tuple[int, int] = GRID) -> None:
        super().__init__(scene, grid)
        graph = scene.graph
        parts = [id_.rpartition("/") for id_ in graph.ids]
        kinds = [
            (at, label.strip().casefold())
            for (at, _, _), label in zip(parts, graph.labels, strict=True)
        ]
        number = {kind: i for i, kind in enumerate(dict.fromkeys(kinds))}
        kind_of = np.array([number[kind] for kind in kinds])
        meant: dict[str, set[int]] = {}
        for (_, _, id_), kind in zip(parts, kind_of.tolist(), strict=True):
            meant.setdefault(id_, set()).add(kind)
        rows = {k: i for i, k in enumerate(dict.fromkeys(map(frozenset, meant.values())))}
        self.table = np.full((len(rows), len(graph)), -1.0, np.float32)
        for either, row in rows.items():
            self.table[row, np.isin(kind_of, list(either))] = 1.0
        self.row_of = {id_: rows[frozenset(either)] for id_, either in meant.items()}


def foreign(scene: Scene, frames: Sequence[Frame], agree: float | None) -> str:
    """Why ids of instances seem to be another map's, in a sentence; empty: nothing says so.

    `agree`: of the patches that name an object, the share that see it at the best pose; None: none
    does.
    """
    seen: set[int] = set()
    for frame in frames:
        image = frame.labels() if frame.label_kind == "instances" else None
        if image is not None:
            seen.update(np.unique(image[image >= 0]).tolist())
    known = InstancesEncoder(scene).row_of
    strange = sorted(id_ for id_ in seen if str(id_) not in known)
    mend = (
        "Localize in the map that the ids are of, or leave them out "
        '(`open_capture(path, labels=None)`, or labels="labels" where there are some).'
    )
    if len(strange) > _FOREIGN * len(seen):
        some = ", ".join(map(str, strange[:5])) + (", ..." if len(strange) > 5 else "")
        return (
            f"Of the {len(seen)} instance ids in the frames, {len(strange)} are no objects of this "
            f"map ({some}): they seem to be another map's. {mend}"
        )
    if seen and (agree is None or agree < _AGREE):
        return f"The instance ids in the frames may be another map's. {mend}"
    return ""
