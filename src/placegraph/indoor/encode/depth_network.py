"""Depth from single images: captures whose frames a network measures, and one of TensorFlow Lite."""

from __future__ import annotations

from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import InputError, OptionError
from placegraph.indoor.encode.network import ImageNetwork, answered
from placegraph.io.capture.camera import read_json
from placegraph.io.capture.capture import Capture

SLOPE = 0.1
"""`Likelihood.depth_slope` for networks: they err by a tenth of the depth, a frame's readings alike."""
_METRIC = ("metres", "log metres")
_RELATIVE = ("inverse", "relative")
_MEND = (
    "relative depth has no scale; take a network of metric depth, such as one trained for indoor "
    "metres, or make metres of it"
)


@runtime_checkable
class DepthEstimator(Protocol):
    """Anything that tells from one image how far off each pixel is."""

    @property
    def metric(self) -> bool:
        """Whether it gives metres, not depth up to a scale."""

    def depth(self, rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Depth (h, w) along the optical axis [m] of an image (H, W, 3) sRGB; NaN: not known."""

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Width and height of the depth of images of a width and height [px]."""


def measured(capture: Capture, estimator: DepthEstimator) -> Capture:
    """Capture without depth images whose depth is what an estimator says of its colours.

    Images are measured when their depth is asked for; the last 64 are kept. A network errs more than
    a sensor: localize with ``Likelihood(depth_slope=SLOPE)`` and ``RefineOptions(depth=False)``.
    Raises `OptionError` where the capture has depth of its own, or the estimator's is relative; reading
    depth does where its answer is not what it said.
    """
    if capture.depth_camera is not None:
        raise OptionError(
            "capture: its frames have depth of their own, which is truer; leave out the network."
        )
    if not estimator.metric:
        raise OptionError(f"estimator: its {_MEND}.")
    size = estimator.size(capture.camera.width, capture.camera.height)
    cameras = [frame.camera.resized(*size) for frame in capture.frames]  # some refocus
    wanted = size[1], size[0]

    def answer(rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
        said = np.asarray(estimator.depth(rgb))
        if said.shape != wanted or said.dtype.kind != "f":
            raise OptionError(
                f"estimator: depth is {said.dtype} {said.shape}; it promised fractions {wanted}."
            )
        metres = said.astype(np.float32)
        return np.where(np.isfinite(metres) & (metres > 0), metres, np.float32(np.nan))

    frames = tuple(
        replace(frame, depth_camera=camera, images=images)
        for frame, camera, images in zip(
            capture.frames, cameras, answered(capture, "depth", answer), strict=True
        )
    )
    return replace(capture, frames=frames, depth_camera=cameras[0])


def depth_network(
    weights: str | PathLike[str],
    form: str | PathLike[str] | None = None,
    *,
    threads: int | None = None,
) -> TfliteDepth:
    """Estimator of a .tflite file: one image (1, h, w, 3) in, one depth a pixel out.

    Parameters
    ----------
    weights
        The model: its input's size and quantisation stand in it.
    form
        JSON file of what does not stand in it: `{"gives": "metres", "mean": [0.485, 0.456, 0.406],
        "deviation": [0.229, 0.224, 0.225]}`. `gives` is "metres" or "log metres" (natural); `mean`
        and `deviation` are of colours from 0 to 1, and 0.5 if left out. The model's name with
        `.json` if not given.
    threads
        Of the processor; as many as it has if not given.

    Raises
    ------
    InputError
        A file is missing or not what it should be, the model has another form, or gives relative
        depth.
    MissingExtraError
        ai-edge-litert is not installed.

    """
    weights = Path(weights)
    gives, mean, deviation = _form(weights.with_suffix(".json") if form is None else Path(form))
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
                f"{network.weights} gives {channels[0]} numbers a pixel; a depth network gives one."
            )

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Width and height [px] of the depth of images of this width and height [px]."""
        return self._network.size(width, height)

    def depth(self, rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Depth (h, w) float32 [m] of an image (H, W, 3) uint8 sRGB, `size` large."""
        values = self._network.values(self._network(rgb)[..., 0])
        with np.errstate(over="ignore"):  # too far to be a number: not known
            metres: NDArray[np.float32] = np.exp(values) if self._log else values
        return np.where(np.isfinite(metres) & (metres > 0), metres, np.float32(np.nan))


def _form(path: Path) -> tuple[str, tuple[float, ...], tuple[float, ...]]:
    """What a network gives, and mean and deviation (3,) of the colours that it takes."""
    example = '{"gives": "metres", "mean": [0.5, 0.5, 0.5], "deviation": [0.5, 0.5, 0.5]}'
    if not path.exists():
        raise InputError(f"{path} does not exist; say there what the network gives: {example}.")
    content = read_json(path)
    if not isinstance(content, dict) or set(content) - {"gives", "mean", "deviation"}:
        raise InputError(f"{path} must be a JSON object like {example}.")
    gives = content.get("gives")
    if gives in _RELATIVE:
        raise InputError(f"{path}: gives is {gives!r}; {_MEND}.")
    if gives not in _METRIC:
        raise InputError(f"{path}: gives is {gives!r}; it is 'metres' or 'log metres'.")
    mean, deviation = (
        _three(path, name, content.get(name, [0.5] * 3)) for name in ("mean", "deviation")
    )
    if min(deviation) <= 0:
        raise InputError(f"{path}: deviation is {list(deviation)}; it must be greater than 0.")
    return str(gives), mean, deviation


def _three(path: Path, name: str, given: Any) -> tuple[float, ...]:  # noqa: ANN401  # of JSON
    numbers = given if isinstance(given, list) else []
    true = [isinstance(n, int | float) and np.isfinite(n) for n in numbers]
    if len(true) != 3 or not all(true):
        raise InputError(f"{path}: {name} is {str(given)[:40]}; it is three numbers, red first.")
    return tuple(float(n) for n in numbers)
