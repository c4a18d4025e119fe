"""What a matcher is, what it returns, and what it refuses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.core.geometry import Floats
from placegraph.errors import OptionError

BLANK = 2.0
"""An image whose grey values deviate less from their mean shows nothing: black, or burnt out."""


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Points of the query and of one rendered view that show the same spot, surest first."""

    query: Floats
    """(N, 2) float64, x y [px], pixel centres at +0.5."""
    rendered: Floats
    """(N, 2) float64, x y [px] in the rendered view, pixel centres at +0.5."""
    confidence: Floats
    """(N,) float64 in [0, 1]; it ranks the matches of one matcher, and is no probability."""

    def __post_init__(self) -> None:
        n = len(self.confidence)
        shapes = (self.query.shape, self.rendered.shape, self.confidence.shape)
        if shapes != ((n, 2), (n, 2), (n,)):
            raise OptionError(f"matches: shapes {shapes}; (N, 2), (N, 2) and (N,) belong.")

    def __len__(self) -> int:
        return len(self.confidence)

    @classmethod
    def of(cls, query: ArrayLike, rendered: ArrayLike, confidence: ArrayLike) -> Matches:
        """Matches of any numbers, put in order: the surest first."""
        sure = np.clip(np.asarray(confidence, np.float64), 0.0, 1.0)
        order = np.argsort(-sure, kind="stable")
        return cls(
            np.asarray(query, np.float64).reshape(-1, 2)[order],
            np.asarray(rendered, np.float64).reshape(-1, 2)[order],
            sure[order],
        )

    @classmethod
    def none(cls) -> Matches:
        """No match."""
        return cls(np.empty((0, 2)), np.empty((0, 2)), np.empty(0))


@runtime_checkable
class Matcher(Protocol):
    """Anything that finds what a photograph and renderings of the map show alike."""

    name: str

    def match(
        self,
        query: NDArray[np.uint8],
        views: Sequence[NDArray[np.uint8]],
        *,
        masks: Sequence[NDArray[np.bool_]] | None = None,
    ) -> list[Matches]:
        """Matches of the query with each view.

        Parameters
        ----------
        query
            (H, W, 3) uint8, sRGB; (H, W) is taken for grey.
        views
            Rendered views, as the query; they may be of another size.
        masks
            (H, W) bool of each view: where it shows the map at all. No match lies elsewhere.

        Raises
        ------
        OptionError
            An image or a mask is of another type or shape, or there is not one mask a view.

        """


class ViewByView:
    """Matcher that compares a query with one view after the other.

    What it needs of the query is found once.
    """

    def match(
        self,
        query: NDArray[np.uint8],
        views: Sequence[NDArray[np.uint8]],
        *,
        masks: Sequence[NDArray[np.bool_]] | None = None,
    ) -> list[Matches]:
        """Matches of the query with each view; see `Matcher.match`."""
        shown = pairs(views, masks)
        ours = self.prepared(colours(query, "query"))
        return [self.matched(ours, view, mask) for view, mask in shown]

    def prepared(self, query: NDArray[np.uint8]) -> Any:  # noqa: ANN401  # the matcher's own
        """What `matched` needs of the query (H, W, 3) uint8: features, or the image itself."""
        return query

    def matched(
        self,
        ours: Any,  # noqa: ANN401  # the matcher's own
        view: NDArray[np.uint8],
        mask: NDArray[np.bool_] | None,
    ) -> Matches:
        """Matches of the prepared query with one view."""
        raise NotImplementedError


def colours(image: ArrayLike, name: str) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 of a colour or grey image; `OptionError` where it is neither."""
    array = np.asarray(image)
    if array.dtype != np.uint8 or array.ndim not in {2, 3} or array.shape[2:] not in {(), (3,)}:
        raise OptionError(
            f"{name} is {array.dtype} of shape {array.shape}; an image is uint8 of shape "
            "(H, W, 3), or (H, W) for grey."
        )
    if 0 in array.shape:
        raise OptionError(f"{name} has no pixels: its shape is {array.shape}.")
    return np.repeat(array[:, :, None], 3, axis=2) if array.ndim == 2 else array


def pairs(
    views: Sequence[NDArray[np.uint8]], masks: Sequence[NDArray[np.bool_]] | None
) -> list[tuple[NDArray[np.uint8], NDArray[np.bool_] | None]]:
    """Each view with its mask, checked; raises as `Matcher.match` does."""
    checked = [colours(view, f"views[{i}]") for i, view in enumerate(views)]
    if masks is None:
        return [(view, None) for view in checked]
    if len(masks) != len(checked):
        raise OptionError(f"masks: {len(masks)} for {len(checked)} views; each view has one.")
    found: list[tuple[NDArray[np.uint8], NDArray[np.bool_] | None]] = []
    for i, (view, given) in enumerate(zip(checked, masks, strict=True)):
        mask = np.asarray(given)
        if mask.dtype != np.bool_ or mask.shape != view.shape[:2]:
            raise OptionError(
                f"masks[{i}] is {mask.dtype} of shape {mask.shape}; views[{i}] needs bool of shape "
                f"{view.shape[:2]}."
            )
        found.append((view, mask))
    return found


def grey(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(H, W) uint8, lightness by the weights of Rec. 601."""
    weighted = image.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)
    return np.rint(weighted).astype(np.uint8)


def blank(image: NDArray[np.uint8]) -> bool:
    """Whether an image shows nothing: unlit, burnt out, or of one colour."""
    return float(image.std(axis=(0, 1)).max()) < BLANK


def inside(mask: NDArray[np.bool_] | None, points: Floats, margin: int = 0) -> NDArray[np.bool_]:
    """Which points (N, 2) [px] lie in the mask, and `margin` pixels from where it ends.

    The edge of the image is no edge of the mask.
    """
    if mask is None or not len(points):
        return np.ones(len(points), np.bool_)
    h, w = mask.shape
    sums = np.zeros((h + 1, w + 1), np.int64)
    np.cumsum(np.cumsum(~mask, axis=0), axis=1, out=sums[1:, 1:])
    x, y = np.floor(points).astype(np.int64).T
    left, right = np.clip(x - margin, 0, w - 1), np.clip(x + margin, 0, w - 1) + 1
    top, bottom = np.clip(y - margin, 0, h - 1), np.clip(y + margin, 0, h - 1) + 1
    holes = sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]
    return holes == 0


def check_range(**options: tuple[float, float, float]) -> None:
    """`OptionError` where a named value is not between its least and its largest."""
    for name, (value, low, high) in options.items():
        if not low <= value <= high:
            raise OptionError(f"{name} is {value}; it must lie between {low:g} and {high:g}.")
