"""The encoder of labels: what a segmentation calls a patch against what the map calls its objects."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from placegraph.indoor.encode.grid import GRID, checked, looked_up, majority
from placegraph.indoor.encode.words import DIMENSION, vector

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from placegraph.formats.capture import Capture
    from placegraph.formats.frame import Frame
    from placegraph.geometry import Camera
    from placegraph.indoor.scene_map import SceneMap


class LabelsEncoder:
    """Patches by the most frequent label of their pixels, objects by their labels.

    Raises
    ------
    OptionError
        The grid has no patches.

    """

    name = "labels"
    key = "labels"
    dimension = DIMENSION
    temperature = 0.1

    def __init__(self, grid: tuple[int, int] = GRID) -> None:
        self.grid = checked(grid)
        self._vectors: dict[str, NDArray[np.float32]] = {}

    def patches(self, image: Frame) -> NDArray[np.float32] | None:
        """Vectors (rows, columns, d) of a frame's labels; None where it has no label image."""
        ids = image.labels()
        if ids is None:
            return None
        names = [n for n in dict.fromkeys(image.label_names.values()) if self.vector(n).any()]
        number = {name: i for i, name in enumerate(names)}
        known = {id_: number.get(name, -1) for id_, name in image.label_names.items()}
        rows = majority(looked_up(ids, known), self.grid, len(names))
        table = np.stack([*map(self.vector, names), np.zeros(self.dimension, np.float32)])
        return table[rows].reshape(*self.grid, self.dimension)

    def camera(self, image: Frame) -> Camera:
        """Camera of the label images."""
        return image.label_camera or image.camera

    def objects(self, scene: SceneMap, captures: Sequence[Capture] = ()) -> NDArray[np.float32]:  # noqa: ARG002
        """Vectors (N, d) of the labels of a map's objects."""
        return np.stack([self.vector(label) for label in scene.graph.labels])

    def vector(self, label: str) -> NDArray[np.float32]:
        """Unit vector (d,) of a label, kept; zero of one that says nothing."""
        if label not in self._vectors:
            self._vectors[label] = vector(label)
        return self._vectors[label]
