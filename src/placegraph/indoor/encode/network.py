"""Networks from image to image in TensorFlow Lite's format, and frames for which a network speaks."""

from __future__ import annotations

import os
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import regular
from placegraph.errors import InputError, MissingExtraError
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Images

Answer = Callable[["NDArray[np.uint8]"], "NDArray[Any]"]
"""What a network says (h, w) of an image (H, W, 3) sRGB."""

_KEPT = 64
"""Answers of a capture that are kept; what was used last stays."""
_HEAD = b"TFL3"  # at byte 4 of such a file


@dataclass(frozen=True, slots=True, eq=False)
class AnsweredImages:
    """A frame's images, and a network for its depth or its labels, which hides its own."""

    images: Images
    made: Literal["depth", "labels"]
    """What the network answers."""
    answer: Answer
    row: int
    """Of the frame, in the cache."""
    cache: OrderedDict[int, NDArray[Any]] = field(repr=False)
    """Shared by the frames of a capture."""

    def rgb(self) -> NDArray[np.uint8]:
        """As `Frame.rgb`."""
        return self.images.rgb()

    def depth(self) -> NDArray[np.float32] | None:
        """As `Frame.depth`."""
        return self._answered() if self.made == "depth" else self.images.depth()

    def labels(self) -> NDArray[np.int32] | None:
        """As `Frame.labels`."""
        return self._answered() if self.made == "labels" else self.images.labels()

    def _answered(self) -> NDArray[Any]:
        known = self.cache.pop(self.row, None)
        if known is None:
            known = self.answer(self.images.rgb())
            known.flags.writeable = False
        self.cache[self.row] = known
        while len(self.cache) > _KEPT:
            self.cache.popitem(last=False)
        return known


def answered(capture: Capture, made: Literal["depth", "labels"], answer: Answer) -> list[Images]:
    """Images of a capture's frames, with a network for their depth or labels; the last 64 are kept."""
    cache: OrderedDict[int, NDArray[Any]] = OrderedDict()
    return [
        AnsweredImages(frame.images, made, answer, i, cache)
        for i, frame in enumerate(capture.frames)
    ]


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
        self._model = _loaded(weights, threads or os.cpu_count() or 1)
        self._input, self._output = _ends(self._model, weights)
        self.shape = tuple(int(n) for n in self._output["shape"])
        """Of what it gives: (1, h, w) or (1, h, w, channels)."""

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Width and height [px] of the answers to images of this width and height [px]."""
        inner = self._fitted(width, height)
        net_high, net_wide = (int(n) for n in self._input["shape"][1:3])
        return (
            max(round(inner[0] * self.shape[2] / net_wide), 1),
            max(round(inner[1] * self.shape[1] / net_high), 1),
        )

    def __call__(self, rgb: NDArray[np.uint8]) -> NDArray[Any]:
        """Answer (h, w, channels) to an image (H, W, 3) uint8 sRGB, as the model stores numbers."""
        wide, high = self.size(rgb.shape[1], rgb.shape[0])
        self._model.set_tensor(self._input["index"], self._prepared(rgb))
        self._model.invoke()
        out = self._model.get_tensor(self._output["index"])
        answer: NDArray[Any] = out.reshape(*out.shape[1:3], -1)[:high, :wide]
        return answer

    def values(self, answer: NDArray[Any]) -> NDArray[np.float32]:
        """What stored numbers stand for."""
        scale, zero = self._output["quantization"]
        numbers: NDArray[np.float32] = answer.astype(np.float32)
        return (numbers - np.float32(zero)) * np.float32(scale) if scale else numbers

    def _fitted(self, width: int, height: int) -> tuple[int, int]:
        """Width and height of an image that fills the model's input on one side."""
        high, wide = (int(n) for n in self._input["shape"][1:3])
        scale = min(wide / width, high / height)
        return max(min(round(width * scale), wide), 1), max(min(round(height * scale), high), 1)

    def _prepared(self, rgb: NDArray[np.uint8]) -> NDArray[Any]:
        """The model's input (1, h, w, 3): the image in its upper left corner."""
        from PIL import Image

        size = self._fitted(rgb.shape[1], rgb.shape[0])
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


def _loaded(path: Path, threads: int) -> Any:  # noqa: ANN401  # an interpreter
    try:
        content = regular(path).read_bytes()
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
            "Networks of images need ai-edge-litert: pip install 'placegraph[segment]'."
        ) from error
    try:
        model = Interpreter(model_content=content, num_threads=threads)
        model.allocate_tensors()
    except (ValueError, RuntimeError) as error:
        why = " ".join(str(error).split())
        raise InputError(f"{path} cannot be loaded ({why[:200]}); copy it again.") from error
    return model


def _ends(model: Any, path: Path) -> tuple[dict[str, Any], dict[str, Any]]:  # noqa: ANN401
    """Input and output of a model from image to image."""
    inputs, outputs = model.get_input_details(), model.get_output_details()
    into, out = inputs[0]["shape"], outputs[0]["shape"]
    if len(inputs) != 1 or len(into) != 4 or into[0] != 1 or into[3] != 3:
        raise InputError(
            f"{path} takes {[i['shape'].tolist() for i in inputs]}; such a network takes one image "
            "[1, height, width, 3]."
        )
    if len(outputs) != 1 or len(out) not in {3, 4} or out[0] != 1:
        raise InputError(
            f"{path} gives {[o['shape'].tolist() for o in outputs]}; such a network gives one image "
            "[1, height, width] or [1, height, width, channels]."
        )
    return inputs[0], outputs[0]
