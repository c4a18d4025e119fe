"""Patches of a rendering found again near where they should be: for views that are nearly right.

A feature matcher may look anywhere and needs features that survive a change of light and of
material. Where the pose is known to a hand's breadth, it is enough to look for a rendered patch in a
small window around its own place, by zero-mean normalised correlation, which no change of
brightness or contrast alters.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from placegraph.indoor.refine.matching.matches import Matches, ViewByView, check_range, is_blank
from placegraph.indoor.refine.refine_kernels import corners, search
from placegraph.io.capture.images import lightness, resize_image

_PEAK = 3  # pixels around the best place that are no rivals of it


class GuidedMatcher(ViewByView):
    """Corners of the rendering, sought in the query within `radius` of the same place.

    Query and views show nearly the same from nearly the same place; the query is brought to a
    view's size. Needs no extra and no weights.

    Parameters
    ----------
    radius
        How far from its place in the view a patch is sought [px of the view].
    half
        Half the side of a patch [px of the view].
    cell
        One corner is taken from each square of this side [px of the view].
    least
        Least correlation of a match.
    lead
        Least lead of the best place over any other.

    Raises
    ------
    OptionError
        An option is out of its range.

    """

    name = "guided"
    local = True

    def __init__(
        self,
        *,
        radius: int = 28,
        half: int = 5,
        cell: int = 8,
        least: float = 0.6,
        lead: float = 0.0,
    ) -> None:
        check_range(radius=(radius, 1, 1000), half=(half, 2, 50), cell=(cell, 2, 1000))
        check_range(least=(least, -1, 1), lead=(lead, 0, 2))
        self.radius, self.half, self.cell = int(radius), int(half), int(cell)
        self.least, self.lead = least, lead

    def match_view(
        self, ours: NDArray[np.uint8], view: NDArray[np.uint8], mask: NDArray[np.bool_] | None
    ) -> Matches:
        """Return matches of the query (H, W, 3) with one view; see `Matcher.match`."""
        height, width = view.shape[:2]
        side = 2 * self.half + 3
        if is_blank(ours) or is_blank(view) or min(height, width) < side + 2:
            return Matches.empty()
        sought = lightness(resize_image(ours, width, height))
        drawn = lightness(view)
        seen = np.ones(drawn.shape, bool) if mask is None else mask
        at = corners(drawn, seen, self.half + 1, self.cell)
        found = search(drawn, seen, sought, at, self.half, self.radius, _PEAK)
        good = (found[:, 2] >= self.least) & (found[:, 2] - found[:, 3] >= self.lead)
        scale = np.array(ours.shape[1::-1]) / (width, height)
        # rows and columns count from the centre of the first pixel, points from its corner
        return Matches.of((found[good, 1::-1] + 0.5) * scale, at[good, ::-1] + 0.5, found[good, 2])
