"""Writes videos of test images."""

import numpy as np
import pytest

cv2 = pytest.importorskip("cv2", reason="needs OpenCV")


def write_video(path, images, rate=60):
    """A video of images (T, H, W, 3) uint8, in MPEG-4; `.m4v` under another name, which OpenCV asks for."""
    height, width = images[0].shape[:2]
    written = path.with_suffix(".mp4")
    stream = cv2.VideoWriter(str(written), cv2.VideoWriter_fourcc(*"mp4v"), rate, (width, height))
    for image in images:
        stream.write(np.ascontiguousarray(image[..., ::-1]))
    stream.release()
    return written.rename(path)
