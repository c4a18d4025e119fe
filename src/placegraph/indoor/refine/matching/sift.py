"""SIFT from OpenCV: needs no weights and no network, so it is what works anywhere.

Lowe 2004; square roots of the descriptors after Arandjelovic and Zisserman 2012 (RootSIFT).
Renderings of the map are albedo without light, photographs have light; what helps there is said
with the options of `SiftMatcher`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import MissingExtraError
from placegraph.indoor.refine.matching.matches import (
    Features,
    Matches,
    ViewByView,
    check_range,
    is_blank,
    to_grey,
)

_SMALLEST = 8
"""OpenCV finds no feature in smaller images, and its pyramid may fail there [px]."""


@dataclass(eq=False, kw_only=True)
class SiftMatcher(ViewByView):
    """RootSIFT features, nearest to each other both ways and clearly so.

    Raises
    ------
    MissingExtraError
        OpenCV is not installed.
    OptionError
        An option is out of its range.

    """

    name = "sift"
    features: int = 3000
    """Most features of an image, the strongest first."""
    contrast: float = 0.01
    """Least contrast of a feature (OpenCV's `contrastThreshold`; its own default is 0.04)."""
    ratio: float = 0.95
    """Largest ratio of the distances to the nearest and to the second nearest descriptor, both ways;
    1 switches the test off."""
    upright: bool = True
    """Features are taken not to be turned: query and view know where down is."""
    equalise: float = 0.0
    """Clip limit of contrast-limited adaptive histogram equalisation, on 8 x 8 tiles; 0: none."""
    margin: int = 4
    """Features nearer than this to where the map ends in a view are edges of nothing [px]."""
    apart: float = 3.0
    """Features nearer to each other than this are no rivals in the ratio test [px]."""

    def __post_init__(self) -> None:
        check_range(features=(self.features, 1, 1e6), contrast=(self.contrast, 0, 1))
        check_range(ratio=(self.ratio, 0, 1), equalise=(self.equalise, 0, 100))
        check_range(margin=(self.margin, 0, 1e4), apart=(self.apart, 0, 1e4))
        cv2 = _opencv()
        # without the precise upscale all points lie a quarter of a pixel off
        self._sift = cv2.SIFT_create(
            nfeatures=self.features, contrastThreshold=self.contrast, enable_precise_upscale=True
        )
        self._clahe = cv2.createCLAHE(self.equalise, (8, 8)) if self.equalise else None

    def prepare_query(self, query: NDArray[np.uint8]) -> Features:
        """Return features of the query."""
        return self._features(query)

    def match_view(
        self, ours: Features, view: NDArray[np.uint8], mask: NDArray[np.bool_] | None
    ) -> Matches:
        """Return matches of the query's features with one view; see `Matcher.match`."""
        theirs = self._features(view).within(mask, self.margin)
        return ours.match(theirs, ratio=self.ratio, apart=self.apart)

    def _features(self, image: NDArray[np.uint8]) -> Features:
        """Return RootSIFT features of an image (H, W, 3) uint8."""
        return self.describe_image(image, 0.0 if self.upright else None)

    def describe_image(self, image: NDArray[np.uint8], turn: float | None) -> Features:
        """Return RootSIFT features of an image (H, W, 3) uint8, all taken to be turned clockwise by so much.

        `turn` in degrees; None: each as it looks.
        """
        if is_blank(image) or min(image.shape[:2]) < _SMALLEST:
            return Features.empty(128)
        lightness = to_grey(image)
        if self._clahe is not None:
            lightness = self._clahe.apply(lightness)
        found = self._sift.detect(lightness, None)
        if turn is not None:
            # keypoints turned alike; one that was found with several turns is kept once
            seen: dict[tuple[float, float, float], Any] = {}
            for point in found:
                point.angle = turn
                seen.setdefault((*point.pt, point.size), point)
            found = list(seen.values())
        found, vectors = self._sift.compute(lightness, found)
        if vectors is None or not len(found):
            return Features.empty(128)
        # OpenCV counts from the centre of the first pixel, we from its corner
        points = np.array([k.pt for k in found], np.float64) + 0.5
        return Features(points, _rooted(vectors))


def _rooted(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return unit vectors (N, 128): square roots of descriptors that sum to 1."""
    sums = vectors.sum(axis=1, keepdims=True)
    rooted: NDArray[np.float32] = np.sqrt(vectors / np.maximum(sums, 1e-6), dtype=np.float32)
    return rooted


def _opencv() -> Any:  # noqa: ANN401  # the module
    try:
        import cv2
    except ImportError as error:
        raise MissingExtraError(
            "The matcher 'sift' needs OpenCV: pip install 'placegraph[sift]'."
        ) from error
    return cv2
