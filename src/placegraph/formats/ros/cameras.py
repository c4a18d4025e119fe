"""`sensor_msgs/CameraInfo` as a camera, and what stands of one in the file beside a bag."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph.errors import InputError
from placegraph.formats.capture.posed import camera_of

if TYPE_CHECKING:
    from collections.abc import Mapping

    from placegraph.geometry import Camera

_MODELS = {"": "opencv", "none": "opencv", "plumb_bob": "opencv", "rational_polynomial": "opencv",
           "radtan": "opencv", "equidistant": "fisheye", "fisheye": "fisheye"}  # fmt: skip


def camera_of_info(info: Any, size: tuple[int, int], name: str, *, rectified: bool) -> Camera:  # noqa: ANN401
    """Camera of images of this width and height [px]; `rectified`: they were freed of the lens.

    ROS counts pixels from their centres, placegraph from their corners: half a pixel is added.
    Raises `InputError`, which begins with `name`, where the message is none of such images.
    """
    get = {field: _field(info, field) for field in ("k", "p", "d")}
    matrix = np.asarray(get["p"] if rectified else get["k"], np.float64)
    if not matrix.any():
        raise InputError(
            f"{name}: {'P' if rectified else 'K'} is all zeros: the camera was not calibrated; give its "
            'intrinsics as "camera" in the file beside the bag.'
        )
    matrix = matrix.reshape(3, -1)
    fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2] + 0.5, matrix[1, 2] + 0.5
    said = str(info.distortion_model).lower()
    if said not in _MODELS:
        raise InputError(
            f"{name}: distortion_model is {said[:40]!r}; plumb_bob, rational_polynomial and equidistant "
            'are known. Rectify the images, or give "camera" in the file beside the bag.'
        )
    bent = () if rectified else _distortion(get["d"], _MODELS[said], name)
    whole = int(info.width), int(info.height)
    roi = info.roi
    if roi.width and roi.height and (roi.width, roi.height) != whole:
        cx, cy, whole = cx - roi.x_offset, cy - roi.y_offset, (int(roi.width), int(roi.height))
    if whole == (0, 0):  # drivers that leave it out
        whole = size
    model = "opencv" if rectified else _MODELS[said]
    camera = camera_of(name, whole, (fx, fy, cx, cy), bent, model)
    if abs(size[0] * whole[1] - size[1] * whole[0]) > max(*size, *whole):
        raise InputError(
            f"{name} is of {whole[0]} x {whole[1]} pixels, but the images have {size[0]} x {size[1]}, "
            'which is not the same view; give their intrinsics as "camera" in the file beside the bag.'
        )
    return camera if size == whole else camera.resized(*size)


def camera_of_dict(content: Mapping[str, Any], size: tuple[int, int], name: str) -> Camera:
    """Camera of intrinsics as `camera.json` has them, but for the size, which is the images'."""
    try:
        numbers = [float(content[field]) for field in ("fx", "fy", "cx", "cy")]
        bent = [float(v) for v in content.get("distortion") or ()]
        whole = int(content.get("width", size[0])), int(content.get("height", size[1]))
        model = str(content.get("model", "opencv"))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f"{name} must have fx, fy, cx, cy as numbers, as camera.json has them ({error!r})."
        ) from error
    if whole != size:
        raise InputError(
            f"{name} is of {whole[0]} x {whole[1]} pixels, but the images have {size[0]} x {size[1]}."
        )
    return camera_of(name, size, numbers, bent, model)


def _field(info: Any, name: str) -> Any:  # noqa: ANN401  # capital letters in ROS 1
    return getattr(info, name) if hasattr(info, name) else getattr(info, name.upper())


def _distortion(given: Any, model: str, name: str) -> tuple[float, ...]:  # noqa: ANN401
    numbers = [float(v) for v in given]
    if not any(numbers):
        return (0.0,) * 4 if model == "fisheye" else ()
    most = 4 if model == "fisheye" else 8
    if any(numbers[most:]):
        raise InputError(
            f"{name}: D has {len(numbers)} coefficients; the first {most} are known. Rectify the "
            'images, or give "camera" in the file beside the bag.'
        )
    numbers = numbers[:most]
    wanted = next(n for n in ((4,) if model == "fisheye" else (4, 5, 8)) if n >= len(numbers))
    return tuple(numbers + [0.0] * (wanted - len(numbers)))
