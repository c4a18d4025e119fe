"""Segmenters of images, captures whose frames they label, and one that runs TensorFlow Lite models."""

from __future__ import annotations

import os
from collections import OrderedDict
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np

from placegraph.errors import InputError, MissingExtraError, OptionError
from placegraph.formats.capture.camera import read_json

if TYPE_CHECKING:
    from os import PathLike

    from numpy.typing import NDArray

    from placegraph.formats.capture.capture import Capture
    from placegraph.formats.capture.frame import Images
    from placegraph.geometry import Camera

_KEPT = 64
"""Label images of a capture that are kept; what was used last stays."""
PASCAL = (
    "", "aeroplane", "bicycle", "bird", "boat", "bottle", "bus", "car", "cat", "chair", "cow",
    "table", "dog", "horse", "motorbike", "person", "potted plant", "sheep", "sofa", "train", "tv",
)  # fmt: skip
"""Classes of Pascal VOC 2012 by number; the first, background, says nothing."""
_HEAD = b"TFL3"  # at byte 4 of such a file
_GREY = 127.5  # what fills the rest of the model's square; 0 to the model


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
    labels, if it has any, are hidden.
    """
    size = segmenter.size(capture.camera.width, capture.camera.height)
    cameras = [frame.camera.resized(*size) for frame in capture.frames]  # some refocus
    names = dict(segmenter.names)
    cache: OrderedDict[int, NDArray[np.int32]] = OrderedDict()
    frames = tuple(
        replace(
            frame,
            label_camera=cameras[i],
            label_kind="labels",
            label_names=names,
            images=SegmentedImages(frame.images, segmenter, cameras[i], i, cache),
        )
        for i, frame in enumerate(capture.frames)
    )
    return replace(
        capture, frames=frames, label_camera=cameras[0], label_kind="labels", label_names=names
    )


@dataclass(frozen=True, slots=True, eq=False)
class SegmentedImages:
    """A frame's images, and a segmenter for its labels."""

    images: Images
    segmenter: Segmenter
    camera: Camera
    """Of the labels."""
    row: int
    """Of the frame, in the cache."""
    cache: OrderedDict[int, NDArray[np.int32]] = field(repr=False)
    """Shared by the frames of a capture."""

    def rgb(self) -> NDArray[np.uint8]:
        """As `Frame.rgb`."""
        return self.images.rgb()

    def depth(self) -> NDArray[np.float32] | None:
        """As `Frame.depth`."""
        return self.images.depth()

    def labels(self) -> NDArray[np.int32]:
        """As `Frame.labels`; `OptionError` where the segmenter's answer is not what it said."""
        known = self.cache.pop(self.row, None)
        if known is None:
            known = np.asarray(self.segmenter.labels(self.images.rgb()))
            wanted = self.camera.height, self.camera.width
            if known.shape != wanted or known.dtype.kind not in "iu":
                raise OptionError(
                    f"segmenter: labels are {known.dtype} {known.shape}; it promised whole numbers "
                    f"{wanted}."
                )
            known = known.astype(np.int32)
            known.flags.writeable = False
        self.cache[self.row] = known
        while len(self.cache) > _KEPT:
            self.cache.popitem(last=False)
        return known


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
    return TfliteSegmenter(Path(weights), _names(names), threads or os.cpu_count() or 1)


class TfliteSegmenter:
    """A segmenter whose model is held in memory; made by `segmenter`. For one thread at a time."""

    def __init__(self, weights: Path, meant: dict[int, str | None], threads: int) -> None:
        self.weights = weights
        self.names = {i: name for i, name in meant.items() if name}
        """Names of the labels it gives."""
        self._model = _loaded(weights, threads)
        self._input, self._output = _ends(self._model, weights)
        shape = self._output["shape"]
        self._scored = len(shape) == 4 and shape[3] > 1
        highest = int(shape[3]) if self._scored else max(meant, default=0) + 1
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
        inner = self._fitted(width, height)
        high, wide = (int(n) for n in self._output["shape"][1:3])
        net_high, net_wide = (int(n) for n in self._input["shape"][1:3])
        return (
            max(round(inner[0] * wide / net_wide), 1),
            max(round(inner[1] * high / net_high), 1),
        )

    def labels(self, rgb: NDArray[np.uint8]) -> NDArray[np.int32]:
        """Labels (h, w) int32 of an image (H, W, 3) uint8 sRGB, `size` large; -1: nothing."""
        height, width = rgb.shape[:2]
        wide, high = self.size(width, height)
        self._model.set_tensor(self._input["index"], self._prepared(rgb))
        self._model.invoke()
        out = self._model.get_tensor(self._output["index"])[0]
        classes = out.argmax(axis=2) if self._scored else out.reshape(out.shape[:2])
        found = np.clip(classes[:high, :wide].astype(np.int64), 0, None)
        known = found < len(self._rows)
        labels: NDArray[np.int32] = np.where(known, self._rows[np.where(known, found, 0)], -1)
        return labels.astype(np.int32)

    def _fitted(self, width: int, height: int) -> tuple[int, int]:
        """Width and height of an image that fills the model's input on one side."""
        high, wide = (int(n) for n in self._input["shape"][1:3])
        scale = min(wide / width, high / height)
        return max(min(round(width * scale), wide), 1), max(min(round(height * scale), high), 1)

    def _prepared(self, rgb: NDArray[np.uint8]) -> NDArray[Any]:
        """The model's input (1, h, w, 3): the image in its upper left corner, grey beyond."""
        from PIL import Image

        size = self._fitted(rgb.shape[1], rgb.shape[0])
        small = Image.fromarray(rgb).resize(size, Image.Resampling.BILINEAR)
        canvas = np.full(self._input["shape"][1:], _GREY, np.float32)
        canvas[: size[1], : size[0]] = np.asarray(small)
        values = canvas / np.float32(127.5) - np.float32(1.0)
        dtype = np.dtype(self._input["dtype"])
        scale, zero = self._input["quantization"]
        if dtype.kind in "iu":
            limits = np.iinfo(dtype)
            values = np.clip(np.rint(values / scale + zero), limits.min, limits.max)
        return values.astype(dtype)[None]


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


def _loaded(path: Path, threads: int) -> Any:  # noqa: ANN401  # an interpreter
    try:
        content = path.read_bytes()
    except FileNotFoundError as error:
        raise InputError(f"{path} does not exist; name a .tflite file.") from error
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error
    if content[4:8] != _HEAD:
        raise InputError(f"{path} is no TensorFlow Lite model; name a .tflite file.")
    try:
        from ai_edge_litert.interpreter import Interpreter
    except ImportError as error:
        raise MissingExtraError(
            "Segmenting images needs ai-edge-litert: pip install 'placegraph[segment]'."
        ) from error
    try:
        model = Interpreter(model_content=content, num_threads=threads)
        model.allocate_tensors()
    except (ValueError, RuntimeError) as error:
        why = " ".join(str(error).split())
        raise InputError(f"{path} cannot be loaded ({why[:200]}); copy it again.") from error
    return model


def _ends(model: Any, path: Path) -> tuple[dict[str, Any], dict[str, Any]]:  # noqa: ANN401
    """Input and output of a model that segments images."""
    inputs, outputs = model.get_input_details(), model.get_output_details()
    into, out = inputs[0]["shape"], outputs[0]["shape"]
    if len(inputs) != 1 or len(into) != 4 or into[0] != 1 or into[3] != 3:
        raise InputError(
            f"{path} takes {[i['shape'].tolist() for i in inputs]}; a segmenter takes one image "
            "[1, height, width, 3]."
        )
    if len(outputs) != 1 or len(out) not in {3, 4} or out[0] != 1:
        raise InputError(
            f"{path} gives {[o['shape'].tolist() for o in outputs]}; a segmenter gives labels "
            "[1, height, width] or scores [1, height, width, classes]."
        )
    return inputs[0], outputs[0]
