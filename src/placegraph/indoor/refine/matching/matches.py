"""Matches of images: results of matchers, mutual nearest features, and thinned dense warps."""

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
            raise OptionError(f"matches: shapes are {shapes}, expected (N, 2), (N, 2) and (N,).")

    def __len__(self) -> int:
        return len(self.confidence)

    @classmethod
    def of(cls, query: ArrayLike, rendered: ArrayLike, confidence: ArrayLike) -> Matches:
        """Make matches of numbers in any order, and sort them, the surest first."""
        sure = np.clip(np.asarray(confidence, np.float64), 0.0, 1.0)
        order = np.argsort(-sure, kind="stable")
        return cls(
            np.asarray(query, np.float64).reshape(-1, 2)[order],
            np.asarray(rendered, np.float64).reshape(-1, 2)[order],
            sure[order],
        )

    @classmethod
    def empty(cls) -> Matches:
        """Make an empty set of matches."""
        return cls(np.empty((0, 2)), np.empty((0, 2)), np.empty(0))


@runtime_checkable
class Matcher(Protocol):
    """Interface of matchers of a photograph with renderings of the map."""

    name: str

    def match(
        self,
        query: NDArray[np.uint8],
        views: Sequence[NDArray[np.uint8]],
        *,
        masks: Sequence[NDArray[np.bool_]] | None = None,
    ) -> list[Matches]:
        """Return matches of the query with each view.

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
    """Base of matchers that compare a query with one view after the other."""

    def match(
        self,
        query: NDArray[np.uint8],
        views: Sequence[NDArray[np.uint8]],
        *,
        masks: Sequence[NDArray[np.bool_]] | None = None,
    ) -> list[Matches]:
        """Return matches of the query with each view; see `Matcher.match`."""
        shown = pair_masks(views, masks)
        ours = self.prepare_query(to_colours(query, "query"))
        return [self.match_view(ours, view, mask) for view, mask in shown]

    def prepare_query(self, query: NDArray[np.uint8]) -> Any:  # noqa: ANN401  # the matcher's own
        """Return the input of `match_view` from a query (H, W, 3) uint8: features, or the image itself."""
        return query

    def match_view(
        self,
        ours: Any,  # noqa: ANN401  # the matcher's own
        view: NDArray[np.uint8],
        mask: NDArray[np.bool_] | None,
    ) -> Matches:
        """Return matches of the prepared query with one view."""
        raise NotImplementedError


def to_colours(image: ArrayLike, name: str) -> NDArray[np.uint8]:
    """Return (H, W, 3) uint8 of a colour or grey image; `OptionError` where it is neither."""
    array = np.asarray(image)
    if array.dtype != np.uint8 or array.ndim not in {2, 3} or array.shape[2:] not in {(), (3,)}:
        raise OptionError(
            f"{name} is {array.dtype} of shape {array.shape}, expected uint8 of shape (H, "
            "W, 3), or (H, W) for grey."
        )
    if 0 in array.shape:
        raise OptionError(f"{name} has no pixels: its shape is {array.shape}.")
    return np.repeat(array[:, :, None], 3, axis=2) if array.ndim == 2 else array


def pair_masks(
    views: Sequence[NDArray[np.uint8]], masks: Sequence[NDArray[np.bool_]] | None
) -> list[tuple[NDArray[np.uint8], NDArray[np.bool_] | None]]:
    """Return each view with its mask, checked; raises as `Matcher.match` does."""
    checked = [to_colours(view, f"views[{i}]") for i, view in enumerate(views)]
    if masks is None:
        return [(view, None) for view in checked]
    if len(masks) != len(checked):
        raise OptionError(f"masks: {len(masks)} masks for {len(checked)} views; give one per view.")
    found: list[tuple[NDArray[np.uint8], NDArray[np.bool_] | None]] = []
    for i, (view, given) in enumerate(zip(checked, masks, strict=True)):
        mask = np.asarray(given)
        if mask.dtype != np.bool_ or mask.shape != view.shape[:2]:
            raise OptionError(
                f"masks[{i}] is {mask.dtype} of shape {mask.shape}, but views[{i}] needs "
                f"bool of shape {view.shape[:2]}."
            )
        found.append((view, mask))
    return found


def to_grey(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return (H, W) uint8, lightness by the weights of Rec. 601."""
    weighted = image.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)
    return np.rint(weighted).astype(np.uint8)


def is_blank(image: NDArray[np.uint8]) -> bool:
    """Return whether an image shows nothing: unlit, burnt out, or of one colour."""
    return float(image.std(axis=(0, 1)).max()) < BLANK


def is_inside_mask(
    mask: NDArray[np.bool_] | None, points: Floats, margin: int = 0
) -> NDArray[np.bool_]:
    """Return which points (N, 2) [px] lie in the mask, and `margin` pixels from where it ends.

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


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """Points of one image with what they look like."""

    points: Floats
    """(N, 2) float64, x y [px], pixel centres at +0.5."""
    vectors: NDArray[np.float32]
    """(N, D) float32, unit vectors."""

    def __len__(self) -> int:
        return len(self.points)

    @classmethod
    def empty(cls, dimension: int = 1) -> Features:
        """Make an empty set of features."""
        return cls(np.empty((0, 2)), np.empty((0, dimension), np.float32))

    def within(self, mask: NDArray[np.bool_] | None, margin: int) -> Features:
        """Select features in a mask (H, W), `margin` px from its edge."""
        keep = is_inside_mask(mask, self.points, margin)
        return self if keep.all() else Features(self.points[keep], self.vectors[keep])

    def match(
        self, view: Features, *, ratio: float = 1.0, least: float = -1.0, apart: float = 0.0
    ) -> Matches:
        """Match with the features of a view; parameters: see `mutual`."""
        rows, columns, sure = match_mutually(self, view, ratio=ratio, least=least, apart=apart)
        return Matches.of(self.points[rows], view.points[columns], sure)


def match_mutually(
    query: Features, view: Features, *, ratio: float = 1.0, least: float = -1.0, apart: float = 0.0
) -> tuple[NDArray[np.intp], NDArray[np.intp], Floats]:
    """Pair features that are each other's nearest, and clearly so (Lowe's ratio, both ways).

    Parameters
    ----------
    query, view
        Features with vectors of the same length.
    ratio
        Largest ratio of the distance to the nearest vector and to the second nearest; 1: any.
    least
        Smallest cosine of two vectors that match.
    apart
        Features nearer than this to the match [px] are no rivals of it: one spot may have several
        features, at several scales.

    Returns
    -------
    tuple
        Rows (K,) of the query, rows (K,) of the view, and how sure each pair is (K,), in [0, 1]: 1
        less the ratio, or the cosine where every ratio will do.

    """
    if not len(query) or not len(view):
        return np.empty(0, np.intp), np.empty(0, np.intp), np.empty(0)
    cosine = query.vectors @ view.vectors.T
    nearest = cosine.argmax(axis=1)
    rows = np.flatnonzero(cosine.argmax(axis=0)[nearest] == np.arange(len(query)))
    rows = rows[cosine[rows, nearest[rows]] >= least]
    columns = nearest[rows]
    best = cosine[rows, columns].astype(np.float64)
    if ratio >= 1.0:
        return rows, columns, np.maximum(best, 0.0)
    rival = np.maximum(
        _second(cosine[rows], view.points, columns, apart),
        _second(cosine.T[columns], query.points, rows, apart),
    )
    # distances of unit vectors: |a - b|^2 = 2 - 2 a.b
    ratios = np.sqrt(np.maximum(1.0 - best, 0.0) / np.maximum(1.0 - rival, 1e-9))
    keep = ratios <= ratio
    return rows[keep], columns[keep], 1.0 - ratios[keep]


def _second(
    cosine: NDArray[np.float32], points: Floats, best: NDArray[np.intp], apart: float
) -> NDArray[np.float32]:
    """Return largest cosine (K,) of rows (K, N) elsewhere than near the best feature of each."""
    spots = points.astype(np.float32)
    dx = spots[:, 0] - spots[best, :1]
    dy = spots[:, 1] - spots[best, 1:]
    away: NDArray[np.float32] = np.where(
        dx * dx + dy * dy > apart * apart, cosine, np.float32(-1.0)
    ).max(axis=1, initial=-1.0)
    return away


@dataclass(frozen=True, slots=True, eq=False)
class Warp:
    """Dense warp: position of each pixel of a grid in both images.

    Normalised coordinates run from -1 to 1 between the images' edges, so that pixel i of n has
    its centre at (2 i + 1) / n - 1.
    """

    query: NDArray[np.float32]
    """(h, w, 2) normalised x y in the query."""
    view: NDArray[np.float32]
    """(h, w, 2) normalised x y in the rendered view."""
    certainty: NDArray[np.float32]
    """(h, w) in [0, 1]."""


def to_pixels(normalised: NDArray[np.floating], size: tuple[int, int]) -> Floats:
    """Return pixels (..., 2), centres at +0.5, of normalised coordinates (..., 2); size: height, width."""
    height, width = size
    return (np.asarray(normalised, np.float64) + 1.0) / 2.0 * (width, height)


def to_normalised(pixels: Floats, size: tuple[int, int]) -> Floats:
    """Return normalised coordinates (..., 2) of pixels (..., 2); inverse of `to_pixels`."""
    height, width = size
    return np.asarray(pixels, np.float64) * 2.0 / (width, height) - 1.0


def thin_matches(
    warps: Sequence[Warp],
    query: tuple[int, int],
    view: tuple[int, int],
    *,
    count: int,
    least: float,
    mask: NDArray[np.bool_] | None = None,
    margin: int = 0,
) -> Matches:
    """Return about `count` matches, spread over the images: the surest of each block of pixels.

    The authors draw theirs at random by certainty and density; this gives the same ones again.

    Parameters
    ----------
    warps
        One, or one for each direction.
    query, view
        Height and width of the images [px].
    count
        Most matches.
    least
        Smallest certainty of a match.
    mask
        (H, W) bool of the view; matches lie in it, and `margin` px from its edge.
    margin
        [px]

    """
    parts = [_blocks(warp, max(1, count // len(warps)), least) for warp in warps]
    ours = to_pixels(np.concatenate([p[0] for p in parts]), query)
    theirs = to_pixels(np.concatenate([p[1] for p in parts]), view)
    sure = np.concatenate([p[2] for p in parts])
    keep = _in_image(ours, query) & _in_image(theirs, view)
    keep[keep] = is_inside_mask(mask, theirs[keep], margin)
    return Matches.of(ours[keep], theirs[keep], sure[keep])


def _blocks(
    warp: Warp, count: int, least: float
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Return the surest pixel of each of at most `count` blocks: in the query, in the view, certainty."""
    height, width = warp.certainty.shape
    side = int(np.ceil(np.sqrt(height * width / count)))
    while -(-height // side) * -(-width // side) > count and side < max(height, width):
        side += 1
    rows, columns = -(-height // side), -(-width // side)
    sure = np.full((rows * side, columns * side), -1.0, np.float32)
    sure[:height, :width] = np.nan_to_num(warp.certainty, nan=-1.0)
    tiles = sure.reshape(rows, side, columns, side).swapaxes(1, 2).reshape(rows * columns, -1)
    best = tiles.argmax(axis=1)
    block = np.arange(rows * columns)
    keep = tiles[block, best] >= max(least, 0.0)
    y = (block // columns * side + best // side)[keep]
    x = (block % columns * side + best % side)[keep]
    return warp.query[y, x], warp.view[y, x], warp.certainty[y, x]


def _in_image(points: Floats, size: tuple[int, int]) -> NDArray[np.bool_]:
    height, width = size
    x, y = points.T
    found: NDArray[np.bool_] = (x > 0) & (x < width) & (y > 0) & (y < height)
    return found
