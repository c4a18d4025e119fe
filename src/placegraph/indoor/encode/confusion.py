"""Confusion matrices of segmentations: probabilities of predicted given true labels."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.core.files import check_regular, write_output
from placegraph.errors import InputError, OptionError
from placegraph.indoor.encode.words import join_words
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

    Raises
    ------
    OptionError
        The matrix is not (L, L) of numbers from 0 on, or a name stands there twice.

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

        Parameters
        ----------
        scene
            The map; its objects' labels are true.
        captures
            With label images of labels; their odometry is map_from_camera.
        step
            Pixels between those that are compared.
        smoothing
            Pixels of every true label that are taken to be said as labels are said at all.

        Raises
        ------
        OptionError
            The captures have no label images of labels, or none of them shows the map.
        InputError
            An image is broken.

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
