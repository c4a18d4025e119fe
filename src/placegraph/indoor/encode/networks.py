"""Networks of image files: segmenters and estimators of depth, and captures that they complete."""

from __future__ import annotations

import os
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import check_regular
from placegraph.errors import InputError, MissingExtraError, OptionError
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Images
from placegraph.io.capture.json_files import read_json

Answer = Callable[["NDArray[np.uint8]"], "NDArray[Any]"]
"""Network: maps an image (H, W, 3), sRGB, to its output (h, w)."""

_MAX_CACHED = 64  # Answers of a capture that are kept; what was used last stays
_HEAD = b"TFL3"  # at byte 4 of such a file


@dataclass(frozen=True, slots=True, eq=False)
class PredictedImages:
    """A frame's images, and a network for its depth or its labels, which hides its own."""

    images: Images
    kind: Literal["depth", "labels"]  # What the network answers
    answer: Answer
    row: int  # Of the frame, in the cache
    cache: OrderedDict[int, NDArray[Any]] = field(repr=False)  # Shared by the frames of a capture

    def rgb(self) -> NDArray[np.uint8]:
        """See `Frame.rgb`."""
        return self.images.rgb()

    def depth(self) -> NDArray[np.float32] | None:
        """See `Frame.depth`."""
        return self._predict() if self.kind == "depth" else self.images.depth()

    def labels(self) -> NDArray[np.int32] | None:
        """See `Frame.labels`."""
        return self._predict() if self.kind == "labels" else self.images.labels()

    def _predict(self) -> NDArray[Any]:
        known = self.cache.pop(self.row, None)
        if known is None:
            known = self.answer(self.images.rgb())
            known.flags.writeable = False
        self.cache[self.row] = known
        while len(self.cache) > _MAX_CACHED:
            self.cache.popitem(last=False)
        return known


def _complete(
    capture: Capture,
    kind: Literal["depth", "labels"],
    answer: Answer,
    **columns: Any,  # noqa: ANN401  # of the frames
) -> Capture:
    """Return a capture whose depth or labels a network predicts; `columns` are those of its frames."""
    cache: OrderedDict[int, NDArray[Any]] = OrderedDict()
    frames = tuple(
        replace(
            frame, images=PredictedImages(frame.images, kind, answer, i, cache),
            **{name: value[i] if isinstance(value, list) else value for name, value in columns.items()},
        )
        for i, frame in enumerate(capture.frames)
    )  # fmt: skip
    shared = {
        name: value[0] if isinstance(value, list) else value for name, value in columns.items()
    }
    return replace(capture, frames=frames, **shared)


class ImageNetwork:
    """A model in memory that takes one image and gives another. For one thread at a time.

    Images fill its input on one side, as they are shaped; the rest is of the mean colour. `mean` and
    `deviation` (3,) are those of the colours from 0 to 1 that it was trained with. Raises
    `InputError` where there is no such model, `MissingExtraError` without ai-edge-litert.
    """

    def __init__(
        self,
        weights: Path,
        threads: int | None = None,
        mean: tuple[float, ...] = (0.5,) * 3,
        deviation: tuple[float, ...] = (0.5,) * 3,
    ) -> None:
        self.weights = weights
        self._mean, self._deviation = np.array(mean, np.float32), np.array(deviation, np.float32)
        self._model = _load_model(weights, threads or os.cpu_count() or 1)
        # input and output of a model from image to image
        inputs, outputs = self._model.get_input_details(), self._model.get_output_details()
        into, out = inputs[0]["shape"], outputs[0]["shape"]
        if len(inputs) != 1 or len(into) != 4 or into[0] != 1 or into[3] != 3:
            raise InputError(
                f"{weights} expects input {[i['shape'].tolist() for i in inputs]}; it must "
                "accept one image [1, height, width, 3]."
            )
        if len(outputs) != 1 or len(out) not in {3, 4} or out[0] != 1:
            raise InputError(
                f"{weights} returns {[o['shape'].tolist() for o in outputs]}; it must "
                "return one image [1, height, width] or [1, height, width, channels]."
            )
        self._input, self._output = inputs[0], outputs[0]
        self.shape = tuple(int(n) for n in self._output["shape"])
        """Shape of the output: (1, h, w) or (1, h, w, channels)."""

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Return width and height [px] of the answers to images of this width and height [px]."""
        inner = self._fit_size(width, height)
        net_high, net_wide = (int(n) for n in self._input["shape"][1:3])
        return (
            max(round(inner[0] * self.shape[2] / net_wide), 1),
            max(round(inner[1] * self.shape[1] / net_high), 1),
        )

    def __call__(self, rgb: NDArray[np.uint8]) -> NDArray[Any]:
        """Return answer (h, w, channels) to an image (H, W, 3) uint8 sRGB, as the model stores numbers."""
        wide, high = self.size(rgb.shape[1], rgb.shape[0])
        self._model.set_tensor(self._input["index"], self._prepare_input(rgb))
        self._model.invoke()
        out = self._model.get_tensor(self._output["index"])
        answer: NDArray[Any] = out.reshape(*out.shape[1:3], -1)[:high, :wide]
        return answer

    def values(self, answer: NDArray[Any]) -> NDArray[np.float32]:
        """Dequantize stored numbers."""
        scale, zero = self._output["quantization"]
        numbers: NDArray[np.float32] = answer.astype(np.float32)
        return (numbers - np.float32(zero)) * np.float32(scale) if scale else numbers

    def _fit_size(self, width: int, height: int) -> tuple[int, int]:
        """Return width and height of an image that fills the model's input on one side."""
        high, wide = (int(n) for n in self._input["shape"][1:3])
        scale = min(wide / width, high / height)
        return max(min(round(width * scale), wide), 1), max(min(round(height * scale), high), 1)

    def _prepare_input(self, rgb: NDArray[np.uint8]) -> NDArray[Any]:
        """Return the model's input (1, h, w, 3): the image in its upper left corner."""
        from PIL import Image

        size = self._fit_size(rgb.shape[1], rgb.shape[0])
        small = Image.fromarray(rgb).resize(size, Image.Resampling.BILINEAR)
        values = np.zeros(self._input["shape"][1:], np.float32)
        colours = np.asarray(small, np.float32) / np.float32(255.0)
        values[: size[1], : size[0]] = (colours - self._mean) / self._deviation
        dtype = np.dtype(self._input["dtype"])
        scale, zero = self._input["quantization"]
        if dtype.kind in "iu":
            limits = np.iinfo(dtype)
            values = np.clip(np.rint(values / scale + zero), limits.min, limits.max)
        return values.astype(dtype)[None]


def _load_model(path: Path, threads: int) -> Any:  # noqa: ANN401  # an interpreter
    try:
        content = check_regular(path).read_bytes()
    except FileNotFoundError as error:
        raise InputError(f"{path} does not exist; name a .tflite file.") from error
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error
    if content[4:8] != _HEAD:
        raise InputError(f"{path} is not a TensorFlow Lite model; give a .tflite file.")
    try:
        from ai_edge_litert.interpreter import Interpreter
    except ImportError as error:
        raise MissingExtraError(
            "Networks of images need ai-edge-litert: pip install 'placegraph[segment]'."
        ) from error
    try:
        model = Interpreter(model_content=content, num_threads=threads)
        model.allocate_tensors()
    except (ValueError, RuntimeError) as error:
        why = " ".join(str(error).split())
        raise InputError(f"{path} cannot be loaded ({why[:200]}); copy it again.") from error
    return model


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
        """Return labels (h, w) of an image (H, W, 3) sRGB, as large or smaller; -1: nothing."""

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Return width and height of the labels of images of a width and height [px]."""


def label_capture(capture: Capture, segmenter: Segmenter) -> Capture:
    """Return capture whose frames' labels are what a segmenter says of their colours.

    Images are segmented when their labels are asked for; the last 64 are kept. The capture's own
    labels, if it has any, are hidden. Reading labels raises `OptionError` where the segmenter's answer
    is not what it said.
    """
    size = segmenter.size(capture.camera.width, capture.camera.height)
    cameras = [frame.camera.resize(*size) for frame in capture.frames]  # some refocus
    wanted = size[1], size[0]

    def answer(rgb: NDArray[np.uint8]) -> NDArray[np.int32]:
        answered = np.asarray(segmenter.labels(rgb))
        if answered.shape != wanted or answered.dtype.kind not in "iu":
            raise OptionError(
                f"segmenter: labels are {answered.dtype} {answered.shape}, expected "
                f"integers of shape {wanted}."
            )
        return answered.astype(np.int32)

    return _complete(
        capture, "labels", answer, label_camera=cameras, label_kind="labels",
        label_names=dict(segmenter.names),
    )  # fmt: skip


def segmenter(
    weights: str | PathLike[str],
    names: str | PathLike[str] | None = None,
    *,
    threads: int | None = None,
) -> TfliteSegmenter:
    """Load a segmenter from a .tflite file: one image (1, h, w, 3) in, a label or scores a pixel out.

    Raises `InputError`: a file is missing or not what it should be, or the model has another form;
    `MissingExtraError`: ai-edge-litert is not installed.

    `weights`: the model: its input's size and quantisation stand in it. Colours reach it as -1 to
        1.
    `names`: JSON file of names by label, `{"1": "chair", "0": null}`; null: says nothing. The 21
        classes of Pascal VOC if not given.
    `threads`: of the processor; as many as it has if not given.
    """
    return TfliteSegmenter(Path(weights), _read_names(names), threads)


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
                f"{weights} has {highest} classes, but a name is given for label "
                f"{max(meant)}; give names of this model's classes."
            )

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Return width and height [px] of the labels of images of this width and height [px]."""
        return self._network.size(width, height)

    def labels(self, rgb: NDArray[np.uint8]) -> NDArray[np.int32]:
        """Return labels (h, w) int32 of an image (H, W, 3) uint8 sRGB, `size` large; -1: nothing."""
        out = self._network(rgb)
        classes = out.argmax(axis=2) if self._scored else out[..., 0]
        found = np.clip(classes.astype(np.int64), 0, None)
        known = found < len(self._rows)
        labels: NDArray[np.int32] = np.where(known, self._rows[np.where(known, found, 0)], -1)
        return labels.astype(np.int32)


def _read_names(path: str | PathLike[str] | None) -> dict[int, str | None]:
    """Return names of labels by number; None: says nothing."""
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
            raise InputError(
                f"{path}: {key[:40]!r} is not a label; labels are integers from 0 to 99999."
            )
        if not (name is None or isinstance(name, str)):
            raise InputError(f"{path}: the name of label {key} is {str(name)[:40]!r}, not text.")
        names[int(number)] = name or None
    return names


SLOPE = 0.1
"""`Likelihood.depth_slope` for networks: they err by a tenth of the depth, a frame's readings alike."""
_METRIC = ("metres", "log metres")
_RELATIVE = ("inverse", "relative")
_MEND = (
    "relative depth has no scale; use a network for metric depth, such as one trained "
    "indoors, or convert its output to metres"
)


@runtime_checkable
class DepthEstimator(Protocol):
    """Anything that tells from one image how far off each pixel is."""

    @property
    def metric(self) -> bool:
        """Whether it gives metres, not depth up to a scale."""

    def depth(self, rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return depth (h, w) along the optical axis [m] of an image (H, W, 3) sRGB; NaN: not known."""

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Return width and height of the depth of images of a width and height [px]."""


def estimate_depth(capture: Capture, estimator: DepthEstimator) -> Capture:
    """Return capture without depth images whose depth is what an estimator says of its colours.

    Images are measured when their depth is asked for; the last 64 are kept. A network errs more than
    a sensor: localize with ``Likelihood(depth_slope=SLOPE)`` and ``RefineOptions(depth=False)``.
    Raises `OptionError` where the capture has depth of its own, or the estimator's is relative; reading
    depth does where its answer is not what it said.
    """
    if capture.depth_camera is not None:
        raise OptionError(
            "capture: its frames already have measured depth; remove the depth network."
        )
    if not estimator.metric:
        raise OptionError(f"estimator: its {_MEND}.")
    size = estimator.size(capture.camera.width, capture.camera.height)
    cameras = [frame.camera.resize(*size) for frame in capture.frames]  # some refocus
    wanted = size[1], size[0]

    def answer(rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
        answered = np.asarray(estimator.depth(rgb))
        if answered.shape != wanted or answered.dtype.kind != "f":
            raise OptionError(
                f"estimator: depth is {answered.dtype} {answered.shape}, expected "
                f"floating-point numbers of shape {wanted}."
            )
        metres = answered.astype(np.float32)
        return np.where(np.isfinite(metres) & (metres > 0), metres, np.float32(np.nan))

    return _complete(capture, "depth", answer, depth_camera=cameras)


def depth_network(
    weights: str | PathLike[str],
    form: str | PathLike[str] | None = None,
    *,
    threads: int | None = None,
) -> TfliteDepth:
    """Return estimator of a .tflite file: one image (1, h, w, 3) in, one depth a pixel out.

    Raises `InputError`: a file is missing or not what it should be, the model has another form, or
    gives relative depth; `MissingExtraError`: ai-edge-litert is not installed.

    `weights`: the model: its input's size and quantisation stand in it.
    `form`: JSON file of what does not stand in it: `{"gives": "metres", "mean": [0.485, 0.456,
        0.406], "deviation": [0.229, 0.224, 0.225]}`. `gives` is "metres" or "log metres" (natural);
        `mean` and `deviation` are of colours from 0 to 1, and 0.5 if left out. The model's name
        with `.json` if not given.
    `threads`: of the processor; as many as it has if not given.
    """
    weights = Path(weights)
    gives, mean, deviation = _read_form(
        weights.with_suffix(".json") if form is None else Path(form)
    )
    return TfliteDepth(ImageNetwork(weights, threads, mean, deviation), log=gives == "log metres")


class TfliteDepth:
    """Metric depth by a model that is held in memory; made by `depth_network`. For one thread at a time."""

    metric = True

    def __init__(self, network: ImageNetwork, *, log: bool) -> None:
        self._network = network
        self._log = log
        channels = network.shape[3:] or (1,)
        if channels != (1,):
            raise InputError(
                f"{network.weights} returns {channels[0]} numbers per pixel; a depth "
                "network must return one."
            )

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Return width and height [px] of the depth of images of this width and height [px]."""
        return self._network.size(width, height)

    def depth(self, rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return depth (h, w) float32 [m] of an image (H, W, 3) uint8 sRGB, `size` large."""
        values = self._network.values(self._network(rgb)[..., 0])
        with np.errstate(over="ignore"):  # too far to be a number: not known
            metres: NDArray[np.float32] = np.exp(values) if self._log else values
        return np.where(np.isfinite(metres) & (metres > 0), metres, np.float32(np.nan))


def _read_form(path: Path) -> tuple[str, tuple[float, ...], tuple[float, ...]]:
    """Read a network's output unit, and mean and deviation (3,) of its input colours."""
    example = '{"gives": "metres", "mean": [0.5, 0.5, 0.5], "deviation": [0.5, 0.5, 0.5]}'
    if not path.exists():
        raise InputError(
            f"{path} does not exist; create it to describe the output of the network: {example}."
        )
    content = read_json(path)
    if not isinstance(content, dict) or set(content) - {"gives", "mean", "deviation"}:
        raise InputError(f"{path} must be a JSON object like {example}.")
    gives = content.get("gives")
    if gives in _RELATIVE:
        raise InputError(f"{path}: gives is {gives!r}; {_MEND}.")
    if gives not in _METRIC:
        raise InputError(f"{path}: gives is {gives!r}; it must be 'metres' or 'log metres'.")
    mean, deviation = (
        _check_three(path, name, content.get(name, [0.5] * 3)) for name in ("mean", "deviation")
    )
    if min(deviation) <= 0:
        raise InputError(f"{path}: deviation is {list(deviation)}; it must be greater than 0.")
    return str(gives), mean, deviation


def _check_three(path: Path, name: str, given: Any) -> tuple[float, ...]:  # noqa: ANN401  # of JSON
    numbers = given if isinstance(given, list) else []
    true = [isinstance(n, int | float) and np.isfinite(n) for n in numbers]
    if len(true) != 3 or not all(true):
        raise InputError(
            f"{path}: {name} is {str(given)[:40]}; it must be three numbers (red, green, blue)."
        )
    return tuple(float(n) for n in numbers)
