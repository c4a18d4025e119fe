"""Frames of a video, decoded by OpenCV where it is installed."""

from __future__ import annotations

from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera
from placegraph.errors import InputError, MissingExtraError
from placegraph.io.capture.frame_files import check_shape

ENDINGS = (".mp4", ".mov", ".m4v", ".mkv", ".avi")
"""Endings of videos, in lower case."""
_NEAR = 60  # frames that are passed faster than another place is sought


class Video:
    """A video whose frames are read by number; in order is fastest.

    `size` is the width and height [px] of the frames as they are stored, without the rotation that
    a player would show; `rate` is how many stand for a second. Raises `InputError` where the file is
    missing or no video, `MissingExtraError` where OpenCV is not installed.
    """

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise InputError(f"{path} does not exist; copy the whole recording.")
        self.path = path
        self._lock = Lock()
        self._next = 0
        self._stream = self._open()
        count, width, height = (int(self._stream.get(code)) for code in (7, 3, 4))
        if not (count > 0 and width > 0 and height > 0):
            raise InputError(f"{path} cannot be read as a video; copy it again.")
        self._count = count
        rate = float(self._stream.get(5))
        self.rate = rate if 0 < rate < 1e4 else 30.0
        self.size = width, height

    def __reduce__(self) -> tuple[type[Video], tuple[Path]]:
        return Video, (self.path,)  # opened again where it is sent to

    def __len__(self) -> int:
        return self._count

    def read(self, number: int) -> NDArray[np.uint8]:
        """Frame (H, W, 3) uint8, sRGB; `InputError` where the video ends before it or is damaged."""
        with self._lock:
            if not self._next <= number <= self._next + _NEAR:
                self._stream.set(1, number)  # CAP_PROP_POS_FRAMES
                self._next = number
            while self._next < number and self._stream.grab():
                self._next += 1
            found, image = self._stream.read() if self._next == number else (False, None)
            if image is None or not found:
                self._stream, self._next = self._open(), 0
                raise InputError(
                    f"{self.path}: frame {number} cannot be read; copy the file again."
                )
            self._next += 1
        return np.ascontiguousarray(image[..., ::-1])

    def picture(self, number: int, camera: Camera) -> NDArray[np.uint8]:
        """As `read`; `InputError` where it has not the camera's size."""
        image = self.read(number)
        check_shape(image, camera, f"{self.path}, frame {number},")
        return image

    def _open(self) -> Any:  # noqa: ANN401  # OpenCV has no types
        try:
            import cv2
        except ImportError as error:
            raise MissingExtraError(
                f"{self.path} is a video, and no decoder is installed: "
                'pip install "placegraph[video]".'
            ) from error
        stream = cv2.VideoCapture(str(self.path))
        stream.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        return stream
