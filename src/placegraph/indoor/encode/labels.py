"""The encoder of captures that bring their own labels: from a segmentation, or from a simulator."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from placegraph.errors import OptionError
from placegraph.indoor.encode import Patches

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from placegraph.formats.frame import Frame, LabelKind
    from placegraph.indoor.scene_map import SceneMap

GRID = (9, 16)
"""144 patches, as in the paper's Sec. 3.3."""


class LabelsEncoder:
    """Patches by the most frequent label of their pixels.

    ``instances``: values are ids of the map's objects, and a patch agrees with that object alone.
    ``labels``: values are ids of labels, and a patch agrees with every object of that label.
    A patch whose label the map does not know says nothing.

    Raises
    ------
    OptionError
        The grid has no patches, or the kind is unknown.

    """

    def __init__(
        self, scene: SceneMap, kind: LabelKind = "instances", grid: tuple[int, int] = GRID
    ) -> None:
        if kind not in {"instances", "labels"}:
            raise OptionError(f"kind is {kind!r}; it is 'labels' or 'instances'.")
        if min(grid) < 1:
            raise OptionError(f"grid is {grid}; it needs at least one row and one column.")
        self.kind = kind
        self.grid = grid
        graph = scene.graph
        count = len(graph)
        # in a merged map an instance's number may be any scene's: "kitchen/7" and "attic/7"
        merged = len(scene.scenes) > 1
        words = (
            [id_.rpartition("/")[2] if merged else id_ for id_ in graph.ids]
            if kind == "instances"
            else [_word(label) for label in graph.labels]
        )
        self._row_of = {word: i for i, word in enumerate(dict.fromkeys(words))}
        self.table = np.full((len(self._row_of), count), -1.0, np.float32)
        self.table[[self._row_of[word] for word in words], np.arange(count)] = 1.0

    def encode(self, frame: Frame) -> Patches | None:
        """Patches of a frame's label image; None where it has none, or labels for instances."""
        image = frame.labels()
        if image is None or (self.kind == "instances" and frame.label_kind != "instances"):
            return None
        rows = self._rows(image, frame)
        camera = frame.label_camera or frame.camera
        return Patches(camera, self.grid, _majority(rows, self.grid, len(self.table)), self.table)

    def _rows(self, image: NDArray[np.int32], frame: Frame) -> NDArray[np.int32]:
        """Rows of the table (h, w) of each pixel, -1 for what the map does not know."""
        values = np.unique(image)
        known = np.full(len(values), -1, np.int32)
        for i, value in enumerate(values):
            if value >= 0:
                known[i] = self._row(int(value), frame)
        out: NDArray[np.int32] = known[np.searchsorted(values, image)]
        return out

    def _row(self, value: int, frame: Frame) -> int:
        if self.kind == "instances":
            return self._row_of.get(str(value), -1)
        return self._row_of.get(_word(frame.label_names.get(value, "")), -1)


class ClassesOfInstances(LabelsEncoder):
    """Reads a capture of instances as labels: each pixel's object stands for its label.

    In a merged map, a number that may be any scene's stands in each scene for its label there.
    """

    def __init__(self, scene: SceneMap, grid: tuple[int, int] = GRID) -> None:
        super().__init__(scene, "instances", grid)
        graph = scene.graph
        parts = [id_.rpartition("/") for id_ in graph.ids]
        kinds = [(at, _word(label)) for (at, _, _), label in zip(parts, graph.labels, strict=True)]
        number = {kind: i for i, kind in enumerate(dict.fromkeys(kinds))}
        kind_of = np.array([number[kind] for kind in kinds])
        meant: dict[str, set[int]] = {}
        for (_, _, id_), kind in zip(parts, kind_of.tolist(), strict=True):
            meant.setdefault(id_, set()).add(kind)
        rows = {k: i for i, k in enumerate(dict.fromkeys(map(frozenset, meant.values())))}
        self.table = np.full((len(rows), len(graph)), -1.0, np.float32)
        for either, row in rows.items():
            self.table[row, np.isin(kind_of, list(either))] = 1.0
        self._row_of = {id_: rows[frozenset(either)] for id_, either in meant.items()}


def _word(label: str) -> str:
    return label.strip().casefold()


def _majority(rows: NDArray[np.int32], grid: tuple[int, int], count: int) -> NDArray[np.int32]:
    """Most frequent row of each patch; -1 where fewer than half its pixels are known."""
    h, w = rows.shape
    patch = np.add.outer(np.arange(h) * grid[0] // h * grid[1], np.arange(w) * grid[1] // w)
    cells = grid[0] * grid[1]
    flat = np.where(rows >= 0, rows, count) + patch * (count + 1)
    votes = np.bincount(flat.ravel(), minlength=cells * (count + 1)).reshape(cells, count + 1)
    best = votes[:, :count].argmax(axis=1) if count else np.zeros(cells, np.int64)
    pixels = votes.sum(axis=1)  # none, where the grid is finer than the image
    unknown = (votes[:, count] * 2 > pixels) | (pixels == 0)
    out: NDArray[np.int32] = np.where(unknown, -1, best).astype(np.int32)
    return out
