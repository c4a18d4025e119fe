"""XFeat (Potje et al., CVPR 2024) from kornia: features at points, by a small network.

Code and weights are under Apache-2.0.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.errors import MissingExtraError, ServiceError
from placegraph.indoor.refine.matching.matches import (
    Features,
    Matches,
    ViewByView,
    check_range,
    is_blank,
)
from placegraph_learn.torch_files import check_weights, read_state, select_device


@dataclass(eq=False, kw_only=True)
class XFeatMatcher(ViewByView):
    """XFeat features, nearest to each other both ways.

    Raises `MissingExtraError`: kornia is not installed; `InputError`: the weights are missing, no
    weights, or another network's; `ServiceError`: no file is given and the hub cannot be reached;
    `OptionError`: an option is out of its range, or there is no such device.
    """

    name = "xfeat"
    weights: Path | str | None = None
    """File with the weights (`xfeat.pt` of the authors); None: from their own hub, kept in PyTorch's
    cache."""
    device: str = "cpu"
    """`cpu`, `cuda` or `auto`."""
    features: int = 4096
    """Most features of an image, the strongest first."""
    threshold: float = 0.05
    """Least value of a point in the network's map of points."""
    least: float = 0.7
    """Smallest cosine of two descriptors that match."""
    ratio: float = 1.0
    """Largest ratio of the distances to the nearest and to the second nearest, both ways; 1: any."""
    scale: float = 1.0
    """The images are brought to so many times their size first: the network finds points to the whole
    pixel, so that larger is more exact, and slower."""
    margin: int = 4
    """Features nearer than this to where the map ends in a view are edges of nothing [px]."""

    def __post_init__(self) -> None:
        check_range(features=(self.features, 1, 1e6), threshold=(self.threshold, 0, 1))
        check_range(least=(self.least, -1, 1), ratio=(self.ratio, 0, 1))
        check_range(scale=(self.scale, 0.1, 8), margin=(self.margin, 0, 1e4))
        self._device = select_device(torch, self.device)
        self._xfeat = _network(self.weights).to(self._device).eval()

    def prepare_query(self, query: NDArray[np.uint8]) -> Features:
        """Return features of the query."""
        return self._points(query)

    def match_view(
        self,
        ours: Features,
        view: NDArray[np.uint8],
        mask: NDArray[np.bool_] | None,
    ) -> Matches:
        """Return matches of the query's features with one view; see `Matcher.match`."""
        theirs = self._points(view).within(mask, self.margin)
        matches: Matches = ours.match(theirs, ratio=self.ratio, least=self.least)
        return matches

    def _points(self, image: NDArray[np.uint8]) -> Features:
        """Return features at points of an image (H, W, 3) uint8."""
        if is_blank(image):
            return Features.empty(64)
        tensor, step = self._tensor(image)
        found = self._xfeat.detectAndCompute(
            tensor, top_k=self.features, detection_threshold=self.threshold
        )[0]
        # keypoint i is pixel i of what the network sees; its centre lies at i + 0.5
        points = (_numpy(found["keypoints"]).astype(np.float64) + 0.5) * step
        return Features(points, _numpy(found["descriptors"]))

    def _tensor(self, image: NDArray[np.uint8]) -> tuple[Any, Floats]:
        """Return the network's input (1, 3, h, w), and px of the image in a px of it (2,)."""
        height, width = image.shape[:2]
        size = [max(32, round(self.scale * n / 32) * 32) for n in (height, width)]
        whole = torch.from_numpy(image.astype(np.float32) / 255.0).to(self._device)
        tensor = whole.permute(2, 0, 1)[None]
        if size != [height, width]:
            resize = torch.nn.functional.interpolate
            tensor = resize(tensor, size, mode="bilinear", align_corners=False, antialias=True)
        return tensor, np.array([width / size[1], height / size[0]])


def _numpy(tensor: Any) -> NDArray[Any]:  # noqa: ANN401
    array: NDArray[Any] = tensor.detach().cpu().numpy()
    return array


def _network(weights: Path | str | None) -> Any:  # noqa: ANN401
    """Return XFeat with its weights."""
    try:
        from kornia.feature import XFeat
    except ImportError as error:
        raise MissingExtraError(
            "The matcher 'xfeat' needs kornia 0.9 or newer: pip install 'placegraph[xfeat]'."
        ) from error
    if weights is not None:
        xfeat = XFeat()
        state = read_state(torch, Path(weights), "xfeat")
        with check_weights(weights, "xfeat"):
            xfeat.net.load_state_dict(state)
        return xfeat
    try:
        return XFeat.from_pretrained()
    except OSError as error:  # urllib's errors are such
        raise ServiceError(
            f"{XFeat.weights_url} cannot be reached ({error}); download it elsewhere and give the "
            "file: weights='xfeat.pt'."
        ) from error
