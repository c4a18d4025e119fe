"""Encoders of label images, names of things or ids of objects, and confusion matrices of segmentations."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.core.files import check_regular, write_output
from placegraph.core.geometry import Camera
from placegraph.errors import InputError, OptionError
from placegraph.indoor.encode import Patches
from placegraph.indoor.encode.networks import Segmenter
from placegraph.indoor.encode.words import DIMENSION, embed_label, hash_tree, join_words
from placegraph.indoor.map.scene import Scene
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame
from placegraph.io.capture.json_files import read_json

STEP = 8  # Pixels between those whose labels are compared with the map
SMOOTHING = 2.0  # Pixels of a label that count as much as how often labels are said at all
_LEAST = 0.02  # truths less likely than this are none


@dataclass(frozen=True, eq=False)
class Confusion:
    """P(said | true) of labels.

    Raises `OptionError`: the matrix is not (L, L) of numbers from 0 on, or a name stands there
    twice.
    """

    names: tuple[str, ...]
    """L labels."""
    matrix: NDArray[np.float64]
    """(L, L) P(said | true), a row for each true label; counts become shares of their row. A row of
    zeros: this label is said, but never true."""
    _row_of: dict[str, int] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        names, matrix = tuple(self.names), np.array(self.matrix, np.float64)
        count = len(names)
        if not count or matrix.shape != (count, count):
            raise OptionError(f"matrix: shape is {matrix.shape}, expected {(count, count)}.")
        if not (np.isfinite(matrix).all() and matrix.min() >= 0):
            raise OptionError(
                "matrix: a share or count is negative or not a number; give numbers of at least 0."
            )
        row_of = {join_words(name): i for i, name in enumerate(names)}
        if len(row_of) < count:
            twice = next(n for i, n in enumerate(names) if row_of[join_words(n)] != i)
            raise OptionError(f"names: {twice!r} occurs twice; give each label once.")
        total = matrix.sum(axis=1, keepdims=True)
        matrix /= np.where(total > 0, total, 1.0)
        matrix.flags.writeable = False
        object.__setattr__(self, "names", names)
        object.__setattr__(self, "matrix", matrix)
        object.__setattr__(self, "_row_of", row_of)

    def find_true_labels(self, predicted: str) -> dict[str, float]:
        """Return probability of each label that a said one may truly be; empty: nothing is known of it.

        Every label that may be true is taken to be equally frequent.
        """
        column = self._row_of.get(join_words(predicted))
        if column is None:
            return {}
        share = self.matrix[:, column]
        share = np.where(share >= _LEAST * share.sum(), share, 0.0)
        if not share.sum() > 0:
            return {}
        share = share / share.sum()
        return {self.names[i]: float(share[i]) for i in np.flatnonzero(share)}

    @classmethod
    def open(cls, path: str | PathLike[str]) -> Confusion:
        """Read what `save` writes: .json `{"names": [...], "matrix": [[...]]}`, or else .csv.

        The first line of a CSV names the labels said, after an empty cell; every other line is a
        true label, and the shares or counts of what was said of it. Raises `InputError` where the
        file is missing or not so.
        """
        path = Path(path)
        names, matrix = (
            _read_json_matrix(path) if path.suffix == ".json" else _read_csv_matrix(path)
        )
        try:
            return cls(names, np.asarray(matrix))
        except OptionError as error:
            raise InputError(f"{path}: {error}") from error

    def save(self, path: str | PathLike[str]) -> None:
        """Write .json, or else .csv; raises `InputError` where that is not possible."""
        path = Path(path)
        rows = self.matrix.round(6).tolist()
        if path.suffix == ".json":
            text = json.dumps({"names": self.names, "matrix": rows}, indent=1) + "\n"
        else:
            lines = io.StringIO()
            writer = csv.writer(lines, lineterminator="\n")
            writer.writerow(["", *self.names])
            writer.writerows([name, *row] for name, row in zip(self.names, rows, strict=True))
            text = lines.getvalue()
        write_output(path, text.encode())

    @classmethod
    def estimate(
        cls,
        scene: Scene,
        captures: Sequence[Capture],
        *,
        step: int = STEP,
        smoothing: float = SMOOTHING,
    ) -> Confusion:
        """Estimate the confusion of label images with a map's objects, by rays from the images' poses.

        Raises `OptionError`: the captures have no label images of labels, or none of them shows the
        map; `InputError`: an image is broken.

        `scene`: the map; its objects' labels are true.
        `captures`: with label images of labels; their odometry is map_from_camera.
        `step`: pixels between those that are compared.
        `smoothing`: pixels of every true label that are taken to be said as labels are said at all.
        """
        if step < 1 or not (np.isfinite(smoothing) and smoothing >= 0):
            raise OptionError("step must be at least 1, and smoothing at least 0.")
        pairs: dict[tuple[str, str], float] = {}
        for capture in captures:
            for frame in capture:
                for pair, count in _count_pairs(scene, frame, step).items():
                    pairs[pair] = pairs.get(pair, 0.0) + count
        if not pairs:
            raise OptionError(
                "captures: no label image shows the map; give labelled frames with poses "
                "map_from_camera as odometry."
            )
        names = {join_words(name): name for pair in pairs for name in reversed(pair)}
        row = {word: i for i, word in enumerate(names)}
        counts = np.zeros((len(row), len(row)))
        for (true, predicted), count in pairs.items():
            counts[row[join_words(true)], row[join_words(predicted)]] += count
        often = counts.sum(axis=0) / counts.sum()
        counts[counts.any(axis=1)] += smoothing * often
        return cls(tuple(names.values()), counts)


def _count_pairs(scene: Scene, frame: Frame, step: int) -> dict[tuple[str, str], float]:
    """Count pixels of one frame by pairs of true and given label."""
    ids = frame.labels() if frame.label_kind == "labels" else None
    if ids is None:
        return {}
    v, u = np.mgrid[step // 2 : ids.shape[0] : step, step // 2 : ids.shape[1] : step]
    predicted = ids[v, u].ravel()
    camera = frame.label_camera or frame.camera
    rays = camera.directions(np.stack([u.ravel(), v.ravel()], axis=1) + 0.5)
    pose = frame.odometry
    directions = rays @ pose[:3, :3].T
    hits = scene.caster.cast(np.broadcast_to(pose[:3, 3], directions.shape), directions)
    seen = (hits.triangle >= 0) & np.isin(predicted, list(frame.label_names))
    true = scene.mesh.object_of[hits.triangle[seen]]
    found, counts = np.unique(np.stack([true, predicted[seen]]), axis=1, return_counts=True)
    total: dict[tuple[str, str], float] = {}
    for object_, id_, count in zip(*found.tolist(), counts.tolist(), strict=True):
        pair = scene.graph.labels[object_], frame.label_names[id_]
        if all(map(join_words, pair)):
            total[pair] = total.get(pair, 0) + count
    return total


def _read_json_matrix(path: Path) -> tuple[tuple[str, ...], ArrayLike]:
    content = read_json(path)
    names, matrix = (
        (content.get("names"), content.get("matrix")) if isinstance(content, dict) else (None, None)
    )
    texts = isinstance(names, list) and all(isinstance(name, str) for name in names)
    if not texts or not isinstance(matrix, list):
        raise InputError(f'{path} must be a JSON object {{"names": [...], "matrix": [[...]]}}.')
    return tuple(names or ()), _check_matrix(path, matrix)


def _read_csv_matrix(path: Path) -> tuple[tuple[str, ...], ArrayLike]:
    try:
        text = check_regular(path).read_text(encoding="utf-8-sig")
        rows = [row for row in csv.reader(text.splitlines()) if row]
    except FileNotFoundError as error:
        raise InputError(f"{path} does not exist; name a .csv or .json file.") from error
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path} cannot be read as CSV ({error}).") from error
    names = tuple(name.strip() for name in rows[0][1:]) if rows else ()
    true = [row[0].strip() for row in rows[1:]]
    if not names or sorted(true) != sorted(names):
        raise InputError(
            f"{path}: the header must list the predicted labels, and every other line must "
            "begin with one of them, the true label."
        )
    order = [true.index(name) for name in names]
    return names, _check_matrix(path, [rows[1 + i][1:] for i in order])


def _check_matrix(path: Path, rows: list[Any]) -> NDArray[np.float64]:
    try:
        return np.array(rows, np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{path}: all rows of the matrix must have the same number of values."
        ) from error


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

    Raises `OptionError`: the grid has no patches.
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

    Raises `OptionError`: the grid has no patches, or `names` are missing, or given without such a
    callable.

    `grid`: rows and columns of patches.
    `confusion`: what labels are said of what is there: a said label then stands for all that it may
        be.
    `segmenter`: says what the pixels show; the frames' own label images do if not given. Either a
        callable from a frame to probabilities (h, w, L) of `names` in the colour image, or a
        `Segmenter` of colour images.
    `names`: the L labels that a callable gives probabilities of.
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
