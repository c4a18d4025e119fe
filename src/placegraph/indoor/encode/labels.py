"""Encoders of label images: names of things, or ids of the map's objects."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.core.geometry import Camera
from placegraph.errors import OptionError
from placegraph.indoor.encode import Patches
from placegraph.indoor.encode.confusion import Confusion
from placegraph.indoor.encode.networks import Segmenter
from placegraph.indoor.encode.words import DIMENSION, embed_label, hash_tree
from placegraph.indoor.map.scene import Scene
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame

GRID = (9, 16)  # 144 patches, as in the paper's Sec. 3.3.
_DIRECT = 1 << 16  # values below this are looked up in a table


def check_grid(grid: tuple[int, int]) -> tuple[int, int]:
    """Return rows and columns of a grid; `OptionError` where it has no patches."""
    if min(grid) < 1:
        raise OptionError(f"grid is {grid}; it needs at least one row and one column.")
    return grid


def assign_cells(shape: tuple[int, int], grid: tuple[int, int]) -> NDArray[np.int64]:
    """Return cell (h, w) of a grid that each pixel of an image lies in, row by row."""
    h, w = shape
    return np.add.outer(np.arange(h) * grid[0] // h * grid[1], np.arange(w) * grid[1] // w)


def look_up_rows(image: NDArray[np.int32], row_of: dict[int, int]) -> NDArray[np.int32]:
    """Return row (h, w) of each pixel's value, -1 for those that have none."""
    top = max(row_of, default=0) + 1
    if top < _DIRECT:  # a table is ten times as fast as sorting the pixels
        table = np.full(top + 1, -1, np.int32)
        for value, row in row_of.items():
            if value >= 0:
                table[value] = row
        return table[np.where((image >= 0) & (image < top), image, top)]
    values = np.unique(image)
    rows = np.array([row_of.get(value, -1) for value in values.tolist()], np.int32)
    out: NDArray[np.int32] = rows[np.searchsorted(values, image)]
    return out


def find_majority(rows: NDArray[np.int32], grid: tuple[int, int], count: int) -> NDArray[np.int32]:
    """Return most frequent row (rows * columns,) of each patch, of `count` rows that there are.

    -1 where fewer than half of a patch's pixels have one.
    """
    number = grid[0] * grid[1]
    flat = np.where(rows >= 0, rows, count) + assign_cells(rows.shape, grid) * (count + 1)
    votes = np.bincount(flat.ravel(), minlength=number * (count + 1)).reshape(number, count + 1)
    best = votes[:, :count].argmax(axis=1) if count else np.zeros(number, np.int64)
    pixels = votes.sum(axis=1)  # none, where the grid is finer than the image
    unknown = (votes[:, count] * 2 > pixels) | (pixels == 0)
    out: NDArray[np.int32] = np.where(unknown, -1, best).astype(np.int32)
    return out


_FOREIGN = 0.2  # Share of the ids of frames that a map may lack: things come and go
_AGREE = 0.5
"""Least share of patches naming an object that must see it; below, they may name another object."""


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
        self.grid = check_grid(grid)
        graph = scene.graph
        merged = len(scene.scenes) > 1
        ids = [id_.rpartition("/")[2] if merged else id_ for id_ in graph.ids]
        self.row_of = {id_: i for i, id_ in enumerate(dict.fromkeys(ids))}
        """Row of the table of each id."""
        self.table = np.full((len(self.row_of), len(graph)), -1.0, np.float32)
        self.table[[self.row_of[id_] for id_ in ids], np.arange(len(graph))] = 1.0

    def encode(self, frame: Frame) -> Patches | None:
        """Return patches of a frame's label image; None where it has none, or has ids of labels."""
        image = frame.labels() if frame.label_kind == "instances" else None
        if image is None:
            return None
        known = {
            int(id_): row
            for id_, row in self.row_of.items()
            if id_.isdecimal() and len(id_) < 20 and str(int(id_)) == id_
        }
        rows = find_majority(look_up_rows(image, known), self.grid, len(self.table))
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


def explain_foreign_ids(scene: Scene, frames: Sequence[Frame], agree: float | None) -> str:
    """Return a sentence why ids of instances seem to be another map's; empty: they do not.

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
        "Localize in the map that they belong to, or ignore them (`open_capture(path, "
        'labels=None)`, or labels="labels" if there are label images).'
    )
    if len(strange) > _FOREIGN * len(seen):
        some = ", ".join(map(str, strange[:5])) + (", ..." if len(strange) > 5 else "")
        return (
            f"Of the {len(seen)} instance ids in the frames, {len(strange)} are unknown in "
            f"this map ({some}); they probably belong to another map. {mend}"
        )
    if seen and (agree is None or agree < _AGREE):
        return f"The instance ids in the frames may belong to another map. {mend}"
    return ""


TEMPERATURE = 0.1
"""Cosine that counts one nat: found on windows of the house, by its own words and by others."""


class LabelsEncoder:
    """Patches by what a segmentation says of their pixels, objects by their labels.

    Labels become vectors by `words.embed_label`, so that what the two sides call differently but alike
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
        self.grid = check_grid(grid)
        self.confusion = confusion
        self.segmenter = segmenter
        self.names = tuple(names or ())
        soft = segmenter is not None and not isinstance(segmenter, Segmenter)
        if soft != bool(self.names):
            raise OptionError(
                "names: they are missing; list the labels of the probabilities that the "
                "segmenter returns."
                if soft
                else "names: they apply only to a callable segmenter that returns probabilities; "
                "remove them."
            )
        self._vectors: dict[str, NDArray[np.float32]] = {}
        self._meant: dict[str, NDArray[np.float32]] = {}

    @property
    def key(self) -> str:
        """Cache key of the labels and their vectors; a confusion matrix does not change it."""
        return f"labels {hash_tree()}"

    def patches(self, image: Frame) -> NDArray[np.float32] | None:
        """Return vectors (rows, columns, d) of a frame's patches, unit or zero: says nothing.

        None where there is neither a segmenter nor a label image whose ids have names. Raises
        `OptionError` where a segmenter's answer is not what it should be, `InputError` where an
        image is broken.
        """
        if self.segmenter is None:
            ids = image.labels() if image.label_names else None
            return None if ids is None else self._of_ids(ids, image.label_names)
        if isinstance(self.segmenter, Segmenter):
            return self._of_ids(
                _check_ids(self.segmenter.labels(image.rgb())), self.segmenter.names
            )
        return self._of_probabilities(np.asarray(self.segmenter(image)))

    def camera(self, image: Frame) -> Camera:
        """Return camera of the label images; of the colour images where a segmenter reads these."""
        own = self.segmenter is None and image.label_camera is not None
        return (image.label_camera if own else None) or image.camera

    def objects(self, scene: Scene, captures: Sequence[Capture] = ()) -> NDArray[np.float32]:  # noqa: ARG002
        """Return vectors (N, d) of the labels of a map's objects."""
        return np.stack([self.vector(label) for label in scene.graph.labels])

    def vector(self, label: str) -> NDArray[np.float32]:
        """Return unit vector (d,) of a label, kept; zero of one that says nothing."""
        if label not in self._vectors:
            self._vectors[label] = embed_label(label)
        return self._vectors[label]

    def embed_meaning(self, predicted: str) -> NDArray[np.float32]:
        """Return unit vector (d,) of what a said label stands for: itself, or what it may truly be."""
        if predicted not in self._meant:
            self._meant[predicted] = self._mixture(self._truths(predicted))
        return self._meant[predicted]

    def _truths(self, predicted: str) -> dict[str, float]:
        return (self.confusion.find_true_labels(predicted) if self.confusion else {}) or {
            predicted: 1.0
        }

    def _of_ids(self, ids: NDArray[np.int32], names: dict[int, str]) -> NDArray[np.float32]:
        words = [w for w in dict.fromkeys(names.values()) if self.vector(w).any()]
        number = {word: i for i, word in enumerate(words)}
        known = {id_: number.get(word, -1) for id_, word in names.items()}
        rows = find_majority(look_up_rows(ids, known), self.grid, len(words))
        table = np.stack([*map(self.embed_meaning, words), np.zeros(self.dimension, np.float32)])
        return table[rows].reshape(*self.grid, self.dimension)

    def _of_probabilities(self, image: NDArray[np.floating]) -> NDArray[np.float32]:
        if image.ndim != 3 or image.shape[2] != len(self.names) or image.dtype.kind != "f":
            raise OptionError(
                f"segmenter: it returned {image.dtype} {image.shape}, expected "
                f"probabilities (height, width, {len(self.names)}), one per name."
            )
        number = self.grid[0] * self.grid[1]
        flat = image.reshape(-1, len(self.names)).astype(np.float64)
        if not (np.isfinite(flat).all() and flat.min(initial=0.0) >= 0):
            raise OptionError(
                "segmenter: a probability is negative or not a number; return values of at least 0."
            )
        cell = assign_cells(image.shape[:2], self.grid).ravel()
        pixels = np.maximum(np.bincount(cell, minlength=number), 1)
        mass = [np.bincount(cell, column, number) for column in flat.T]
        share = np.stack(mass, axis=1) / pixels[:, None]
        out = np.zeros((number, self.dimension), np.float32)
        telling = np.array([self.vector(name).any() for name in self.names])
        for i in np.flatnonzero(share[:, telling].sum(axis=1) >= 0.5):
            out[i] = self._mixture(self._truly(share[i]))
        return out.reshape(*self.grid, self.dimension)

    def _truly(self, share: NDArray[np.float64]) -> dict[str, float]:
        """Return probabilities of what a patch shows, of those that a segmenter gives its names."""
        truly: dict[str, float] = {}
        for predicted, p in zip(self.names, share.tolist(), strict=True):
            for word, q in self._truths(predicted).items():
                truly[word] = truly.get(word, 0.0) + p * q
        return truly

    def _mixture(self, truly: dict[str, float]) -> NDArray[np.float32]:
        """Return unit vector (d,) whose cosine with each label is about the root of its probability.

        That is the length of a sum of orthogonal vectors, each as long as the root says.
        """
        total = sum(
            (np.sqrt(p) * self.vector(word) for word, p in truly.items()), np.zeros(self.dimension)
        )
        length = float(np.linalg.norm(total))
        return (total / length if length > 0 else total).astype(np.float32)


def _check_ids(labels: ArrayLike) -> NDArray[np.int32]:
    ids = np.asarray(labels)
    if ids.ndim != 2 or ids.dtype.kind not in "iu":
        raise OptionError(
            f"segmenter: it returned {ids.dtype} {ids.shape}, expected labels (height, width)."
        )
    return ids.astype(np.int32)
