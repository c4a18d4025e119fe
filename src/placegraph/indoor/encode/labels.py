"""The encoder of labels: what a segmentation calls a patch against what the map calls its objects."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.core.geometry import Camera
from placegraph.errors import OptionError
from placegraph.indoor.encode.confusion import Confusion
from placegraph.indoor.encode.grid import GRID, cells, checked, looked_up, majority
from placegraph.indoor.encode.segmenter import Segmenter
from placegraph.indoor.encode.words import DIMENSION, digest, vector
from placegraph.indoor.map.scene import Scene
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame

TEMPERATURE = 0.1
"""Cosine that counts one nat: found on windows of the house, by its own words and by others."""


class LabelsEncoder:
    """Patches by what a segmentation says of their pixels, objects by their labels.

    Labels become vectors by `words.vector`, so that what the two sides call differently but alike
    (sofa and couch, armchair and chair) has a high cosine. A patch says nothing where fewer than
    half its pixels have a label that says something.

    Parameters
    ----------
    grid
        Rows and columns of patches.
    confusion
        What labels are said of what is there: a said label then stands for all that it may be.
    segmenter
        Says what the pixels show; the frames' own label images do if not given. Either a callable
        from a frame to probabilities (h, w, L) of `names` in the colour image, or a `Segmenter` of
        colour images.
    names
        The L labels that a callable gives probabilities of.

    Raises
    ------
    OptionError
        The grid has no patches, or `names` are missing, or given without such a callable.

    """

    name = "labels"
    dimension = DIMENSION
    temperature = TEMPERATURE

    def __init__(
        self,
        grid: tuple[int, int] = GRID,
        *,
        confusion: Confusion | None = None,
        segmenter: Segmenter | Callable[[Frame], ArrayLike] | None = None,
        names: Sequence[str] | None = None,
    ) -> None:
        self.grid = checked(grid)
        self.confusion = confusion
        self.segmenter = segmenter
        self.names = tuple(names or ())
        soft = segmenter is not None and not isinstance(segmenter, Segmenter)
        if soft != bool(self.names):
            raise OptionError(
                "names: give the labels of the probabilities that the segmenter, a callable, makes."
                if soft
                else "names: only of a segmenter that is a callable making probabilities."
            )
        self._vectors: dict[str, NDArray[np.float32]] = {}
        self._meant: dict[str, NDArray[np.float32]] = {}

    @property
    def key(self) -> str:
        """Which labels have which vectors; a confusion changes what patches say, not that."""
        return f"labels {digest()}"

    def patches(self, image: Frame) -> NDArray[np.float32] | None:
        """Vectors (rows, columns, d) of a frame's patches, unit or zero: says nothing.

        None where there is neither a segmenter nor a label image whose ids have names. Raises
        `OptionError` where a segmenter's answer is not what it should be, `InputError` where an
        image is broken.
        """
        if self.segmenter is None:
            ids = image.labels() if image.label_names else None
            return None if ids is None else self._of_ids(ids, image.label_names)
        if isinstance(self.segmenter, Segmenter):
            return self._of_ids(_ids(self.segmenter.labels(image.rgb())), self.segmenter.names)
        return self._of_probabilities(np.asarray(self.segmenter(image)))

    def camera(self, image: Frame) -> Camera:
        """Camera of the label images; of the colour images where a segmenter reads these."""
        own = self.segmenter is None and image.label_camera is not None
        return (image.label_camera if own else None) or image.camera

    def objects(self, scene: Scene, captures: Sequence[Capture] = ()) -> NDArray[np.float32]:  # noqa: ARG002
        """Vectors (N, d) of the labels of a map's objects."""
        return np.stack([self.vector(label) for label in scene.graph.labels])

    def vector(self, label: str) -> NDArray[np.float32]:
        """Unit vector (d,) of a label, kept; zero of one that says nothing."""
        if label not in self._vectors:
            self._vectors[label] = vector(label)
        return self._vectors[label]

    def meant(self, said: str) -> NDArray[np.float32]:
        """Unit vector (d,) of what a said label stands for: itself, or what it may truly be."""
        if said not in self._meant:
            self._meant[said] = self._mixture(self._truths(said))
        return self._meant[said]

    def _truths(self, said: str) -> dict[str, float]:
        return (self.confusion.truly(said) if self.confusion else {}) or {said: 1.0}

    def _of_ids(self, ids: NDArray[np.int32], names: dict[int, str]) -> NDArray[np.float32]:
        words = [w for w in dict.fromkeys(names.values()) if self.vector(w).any()]
        number = {word: i for i, word in enumerate(words)}
        known = {id_: number.get(word, -1) for id_, word in names.items()}
        rows = majority(looked_up(ids, known), self.grid, len(words))
        table = np.stack([*map(self.meant, words), np.zeros(self.dimension, np.float32)])
        return table[rows].reshape(*self.grid, self.dimension)

    def _of_probabilities(self, image: NDArray[np.floating]) -> NDArray[np.float32]:
        if image.ndim != 3 or image.shape[2] != len(self.names) or image.dtype.kind != "f":
            raise OptionError(
                f"segmenter: {image.dtype} {image.shape}; probabilities (height, width, "
                f"{len(self.names)}) of its names belong."
            )
        number = self.grid[0] * self.grid[1]
        flat = image.reshape(-1, len(self.names)).astype(np.float64)
        if not (np.isfinite(flat).all() and flat.min(initial=0.0) >= 0):
            raise OptionError("segmenter: probabilities are numbers, not below 0.")
        cell = cells(image.shape[:2], self.grid).ravel()
        pixels = np.maximum(np.bincount(cell, minlength=number), 1)
        mass = [np.bincount(cell, column, number) for column in flat.T]
        share = np.stack(mass, axis=1) / pixels[:, None]
        out = np.zeros((number, self.dimension), np.float32)
        telling = np.array([self.vector(name).any() for name in self.names])
        for i in np.flatnonzero(share[:, telling].sum(axis=1) >= 0.5):
            out[i] = self._mixture(self._truly(share[i]))
        return out.reshape(*self.grid, self.dimension)

    def _truly(self, share: NDArray[np.float64]) -> dict[str, float]:
        """Probabilities of what a patch shows, of those that a segmenter gives its names."""
        truly: dict[str, float] = {}
        for said, p in zip(self.names, share.tolist(), strict=True):
            for word, q in self._truths(said).items():
                truly[word] = truly.get(word, 0.0) + p * q
        return truly

    def _mixture(self, truly: dict[str, float]) -> NDArray[np.float32]:
        """Unit vector (d,) whose cosine with each label is about the root of its probability.

        That is the length of a sum of orthogonal vectors, each as long as the root says.
        """
        total = sum(
            (np.sqrt(p) * self.vector(word) for word, p in truly.items()), np.zeros(self.dimension)
        )
        length = float(np.linalg.norm(total))
        return (total / length if length > 0 else total).astype(np.float32)


def _ids(labels: ArrayLike) -> NDArray[np.int32]:
    ids = np.asarray(labels)
    if ids.ndim != 2 or ids.dtype.kind not in "iu":
        raise OptionError(f"segmenter: {ids.dtype} {ids.shape}; labels (height, width) belong.")
    return ids.astype(np.int32)
