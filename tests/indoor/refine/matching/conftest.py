"""Pictures whose true matches are known."""

import numpy as np
import pytest

cv2 = pytest.importorskip("cv2", reason="needs OpenCV: pip install 'placegraph[sift]'")


def draw_texture(rng, height=240, width=320):
    """Blobs and edges of all sizes, in colour, smooth enough to be resampled."""
    image = np.zeros((height, width, 3), np.float32)
    for cells in (4, 9, 20, 45):
        noise = rng.normal(size=(cells, cells * 4 // 3, 3)).astype(np.float32)
        image += cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)
    for _ in range(60):
        x, y = rng.integers(0, width), rng.integers(0, height)
        w, h = rng.integers(6, 40, 2)
        image[y : y + h, x : x + w] += rng.normal(size=3) * 1.5
    image = cv2.GaussianBlur(image, (0, 0), 0.8)
    return np.clip(image * 28 + 128, 0, 255).astype(np.uint8)


def warp(image, homography, size=None):
    """The image under a homography of points with pixel centres at +0.5."""
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    moved = np.linalg.inv(half) @ homography @ half
    size = size or (image.shape[1], image.shape[0])
    return cv2.warpPerspective(
        image, moved, size, flags=cv2.INTER_AREA, borderMode=cv2.BORDER_REFLECT
    )


def measure_errors(matches, homography):
    """Distance (N,) [px] of matches from where a homography puts the query's points."""
    points = np.column_stack([matches.query, np.ones(len(matches))]) @ homography.T
    return np.linalg.norm(points[:, :2] / points[:, 2:] - matches.rendered, axis=1)


@pytest.fixture(scope="session")
def picture():
    """(240, 320, 3) uint8, full of texture."""
    return draw_texture(np.random.default_rng(5))
