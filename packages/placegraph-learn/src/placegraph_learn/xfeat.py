"""XFeat (Potje et al., CVPR 2024) from kornia: a small network, quick on a processor.

Features at points (the default), or semi-dense ("XFeat*", `dense=True`): features of cells of
8 px, whose matches a second network brings to the pixel. Code and weights are under Apache-2.0.
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
    is_inside_mask,
    match_mutually,
)
from placegraph_learn.torch_files import check_weights, read_state, select_device

_CENTRE = 4.0
"""A cell of 8 px is said to lie at its corner; it stands for its centre [px]."""
_LEFT = 1.0
"""The second network's offsets come out so much too small, in x and in y [px], measured."""


@dataclass(frozen=True, slots=True, eq=False)
class _Cells:
    """Features of cells, as the second network wants them."""

    features: Features
    raw: Any
    """(N, 64) tensor, vectors before they are normalised."""
    scales: Floats
    """(N,) px of the image in a px of the scale at which each was found."""

    def at(self, rows: NDArray[np.intp] | NDArray[np.bool_]) -> _Cells:
        """Return those of these rows."""
        features = Features(self.features.points[rows], self.features.vectors[rows])
        return _Cells(features, self.raw[rows], self.scales[rows])


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
    dense: bool = False
    """Cells (XFeat*) instead of points."""
    features: int = 4096
    """Most features of an image, the strongest first."""
    threshold: float = 0.05
    """Least value of a point in the network's map of points; dense features have none."""
    least: float = 0.7
    """Smallest cosine of two descriptors that match."""
    ratio: float = 1.0
    """Largest ratio of the distances to the nearest and to the second nearest, both ways; 1: any."""
    scale: float = 1.0
    """The images are brought to so many times their size first: the network finds points to the whole
    pixel, so that larger is more exact, and slower."""
    sure: float = 0.25
    """Least certainty of the second network about where in the cell; for dense features."""
    margin: int = 4
    """Features nearer than this to where the map ends in a view are edges of nothing [px]."""

    def __post_init__(self) -> None:
        check_range(features=(self.features, 1, 1e6), threshold=(self.threshold, 0, 1))
        check_range(least=(self.least, -1, 1), ratio=(self.ratio, 0, 1), sure=(self.sure, 0, 1))
        check_range(scale=(self.scale, 0.1, 8), margin=(self.margin, 0, 1e4))
        self._device = select_device(torch, self.device)
        self._xfeat = _network(self.weights).to(self._device).eval()

    def prepare_query(self, query: NDArray[np.uint8]) -> Any:  # noqa: ANN401  # points, or cells
        """Return features of the query: at points, or of its cells."""
        return self._cells(query) if self.dense else self._points(query)

    def match_view(
        self,
        ours: Any,  # noqa: ANN401  # of `prepare_query`
        view: NDArray[np.uint8],
        mask: NDArray[np.bool_] | None,
    ) -> Matches:
        """Return matches of the query's features with one view; see `Matcher.match`."""
        if self.dense:
            return self._match_cells(ours, view, mask)
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

    def _cells(self, image: NDArray[np.uint8]) -> _Cells:
        """Return features of cells of an image; their points are the cells' centres."""
        if is_blank(image):
            return _Cells(Features.empty(64), None, np.empty((0, 2)))
        tensor, step = self._tensor(image)
        found = self._xfeat.detectAndComputeDense(tensor, top_k=self.features)
        raw = found["descriptors"][0]
        scales = _numpy(found["scales"][0]).astype(np.float64)[:, None] * step
        points = _numpy(found["keypoints"][0]).astype(np.float64) * step + _CENTRE * scales
        vectors = torch.nn.functional.normalize(raw, dim=-1)
        return _Cells(Features(points, _numpy(vectors)), raw, scales)

    def _match_cells(
        self, ours: _Cells, view: NDArray[np.uint8], mask: NDArray[np.bool_] | None
    ) -> Matches:
        theirs = self._cells(view)
        if not len(ours.features) or not len(theirs.features):
            return Matches.empty()
        theirs = theirs.at(
            np.flatnonzero(is_inside_mask(mask, theirs.features.points, self.margin))
        )
        rows, columns, _ = match_mutually(
            ours.features, theirs.features, ratio=self.ratio, least=self.least
        )
        if not len(rows):
            return Matches.empty()
        offsets, sure = self._offsets(ours.raw[rows], theirs.raw[columns])
        query = ours.features.points[rows] + (offsets + _LEFT) * ours.scales[rows]
        keep = sure > self.sure
        return Matches.of(query[keep], theirs.features.points[columns[keep]], sure[keep])

    def _offsets(self, ours: Any, theirs: Any) -> tuple[Floats, Floats]:  # noqa: ANN401
        """Return each match's place (K, 2) [px] in the query's cell of 8 x 8 px, and its certainty (K,)."""
        with torch.inference_mode():
            logits = self._xfeat.net.fine_matcher(torch.cat([ours, theirs], dim=-1))
            sure = torch.softmax(3.0 * logits, dim=-1).amax(dim=-1)
            shares = torch.softmax(3.0 * logits, dim=-1).reshape(-1, 8, 8)
            along = torch.arange(8, device=logits.device, dtype=logits.dtype) - 4.0
            x, y = shares.sum(dim=1) @ along, shares.sum(dim=2) @ along
        return _numpy(torch.stack([x, y], dim=-1)).astype(np.float64), _numpy(sure)


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
