"""Segmenters of images, captures whose frames they label, and one that runs TensorFlow Lite models."""

from __future__ import annotations

from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import InputError, OptionError
from placegraph.indoor.encode.network import ImageNetwork, answered
from placegraph.io.capture.camera import read_json
from placegraph.io.capture.capture import Capture

PASCAL = (
    "", "aeroplane", "bicycle", "bird", "boat", "bottle", "bus", "car", "cat", "chair", "cow",
    "table", "dog", "horse", "motorbike", "person", "potted plant", "sheep", "sofa", "train", "tv",
)  # fmt: skip
"""Classes of Pascal VOC 2012 by number; the first, background, says nothing."""


@runtime_checkable
class Segmenter(Protocol):
    """Anything that says of each pixel of an image what it shows."""

    @property
    def names(self) -> dict[int, str]:
        """Names of the labels it gives."""

    def labels(self, rgb: NDArray[np.uint8]) -> NDArray[np.int32]:
        """Labels (h, w) of an image (H, W, 3) sRGB, as large or smaller; -1: nothing."""

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Width and height of the labels of images of a width and height [px]."""


def labelled(capture: Capture, segmenter: Segmenter) -> Capture:
    """Capture whose frames' labels are what a segmenter says of their colours.

    Images are segmented when their labels are asked for; the last 64 are kept. The capture's own
    labels, if it has any, are hidden. Reading labels raises `OptionError` where the segmenter's answer
    is not what it said.
    """
    size = segmenter.size(capture.camera.width, capture.camera.height)
    cameras = [frame.camera.resized(*size) for frame in capture.frames]  # some refocus
    names = dict(segmenter.names)
    wanted = size[1], size[0]

    def answer(rgb: NDArray[np.uint8]) -> NDArray[np.int32]:
        said = np.asarray(segmenter.labels(rgb))
        if said.shape != wanted or said.dtype.kind not in "iu":
            raise OptionError(
                f"segmenter: labels are {said.dtype} {said.shape}; it promised whole numbers "
                f"{wanted}."
            )
        return said.astype(np.int32)

    frames = tuple(
        replace(
            frame,
            label_camera=camera,
            label_kind="labels",
            label_names=names,
            images=images,
        )
        for frame, camera, images in zip(
            capture.frames, cameras, answered(capture, "labels", answer), strict=True
        )
    )
    return replace(
        capture, frames=frames, label_camera=cameras[0], label_kind="labels", label_names=names
    )


def segmenter(
    weights: str | PathLike[str],
    names: str | PathLike[str] | None = None,
    *,
    threads: int | None = None,
) -> TfliteSegmenter:
    """Segmenter of a .tflite file: one image (1, h, w, 3) in, one label or score a class and pixel out.

    Parameters
    ----------
    weights
        The model: its input's size and quantisation stand in it. Colours reach it as -1 to 1.
    names
        JSON file of names by label, `{"1": "chair", "0": null}`; null: says nothing. The 21
        classes of Pascal VOC if not given.
    threads
        Of the processor; as many as it has if not given.

    Raises
    ------
    InputError
        A file is missing or not what it should be, or the model has another form.
    MissingExtraError
        ai-edge-litert is not installed.

    """
    return TfliteSegmenter(Path(weights), _names(names), threads)


class TfliteSegmenter:
    """A segmenter whose model is held in memory; made by `segmenter`. For one thread at a time."""

    def __init__(self, weights: Path, meant: dict[int, str | None], threads: int | None) -> None:
        self.weights = weights
        self.names = {i: name for i, name in meant.items() if name}
        """Names of the labels it gives."""
        self._network = ImageNetwork(weights, threads)
        shape = self._network.shape
        self._scored = len(shape) == 4 and shape[3] > 1
        highest = shape[3] if self._scored else max(meant, default=0) + 1
        self._rows = np.full(max(highest, 1), -1, np.int32)
        for i in self.names:
            if i < len(self._rows):
                self._rows[i] = i
        if self._scored and max(meant, default=0) >= highest:
            raise InputError(
                f"{weights} has {highest} classes, but label {max(meant)} has a name; give the "
                "names of this model's classes."
            )

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Width and height [px] of the labels of images of this width and height [px]."""
        return self._network.size(width, height)

    def labels(self, rgb: NDArray[np.uint8]) -> NDArray[np.int32]:
        """Labels (h, w) int32 of an image (H, W, 3) uint8 sRGB, `size` large; -1: nothing."""
        out = self._network(rgb)
        classes = out.argmax(axis=2) if self._scored else out[..., 0]
        found = np.clip(classes.astype(np.int64), 0, None)
        known = found < len(self._rows)
        labels: NDArray[np.int32] = np.where(known, self._rows[np.where(known, found, 0)], -1)
        return labels.astype(np.int32)


def _names(path: str | PathLike[str] | None) -> dict[int, str | None]:
    """Names of labels by number; None: says nothing."""
    if path is None:
        return {i: name or None for i, name in enumerate(PASCAL)}
    path = Path(path)
    content = read_json(path)
    if not isinstance(content, dict) or not content:
        raise InputError(f'{path} must be a JSON object from labels to names: {{"3": "chair"}}.')
    names: dict[int, str | None] = {}
    for key, name in content.items():
        number = key.strip()
        if not (number.isascii() and number.isdigit() and len(number) < 6):
            raise InputError(f"{path}: {key[:40]!r} is no label; labels are 0 to 99999.")
        if not (name is None or isinstance(name, str)):
            raise InputError(f"{path}: the name of label {key} is {str(name)[:40]!r}, not text.")
        names[int(number)] = name or None
    return names
