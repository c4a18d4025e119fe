"""Floor, ceiling and walls as label images have them: what covers a plane of the building is it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from placegraph.indoor.mapping.segment.votes import NOTHING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from placegraph.indoor.mapping.segment.options import SegmentOptions
    from placegraph.indoor.mapping.segment.patches import Patches

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

_MOST = 0.5  # of its area lies on planes of one kind, or
_SOME, _VAST = 0.3, 4.0  # so much, and so many m2: walls have niches, and no cupboard is as large
_PART = 0.35  # of a plane that what is the plane covers; pictures and rugs cover less ...
_LARGE = 8.0  # ... and none is as large as this [m2]: a floor of many rooms has many parts


def cover(
    group: Ints,
    pieces: Patches,
    label: Ints,
    plane: Ints,
    words: Sequence[str],
    planes: Sequence[str],
    options: SegmentOptions,
) -> tuple[Ints, dict[int, str]]:
    """Groups (N,) of pieces, and the words of the planes that groups without one cover.

    What no label speaks of on a plane joins what covers that plane and lies beside it, unless this
    has a word of its own: then crumbs alone do. So do they where crumbs are all that is left.
    `label` and `plane` (N,) are rows of `words`, empty where they say nothing, and of `planes`.
    """
    kinds = sorted(set(planes))
    kind = np.array([kinds.index(word) for word in planes], np.int64)
    said = label != NOTHING
    on = np.flatnonzero(said & (plane >= 0))
    count = len(pieces)
    whole = np.bincount(group[said], pieces.areas[said], count)
    of_kind = np.bincount(
        group[on] * len(kinds) + kind[plane[on]], pieces.areas[on], count * len(kinds)
    ).reshape(count, len(kinds))
    keys, row = np.unique(group[on] * len(planes) + plane[on], return_inverse=True)
    area = np.bincount(row, pieces.areas[on], len(keys))
    size = np.bincount(plane[plane >= 0], pieces.areas[plane >= 0], len(planes))
    g, p = keys // max(len(planes), 1), keys % max(len(planes), 1)
    on_kind = of_kind[g, kind[p]]
    good = (on_kind >= _MOST * whole[g]) | ((on_kind >= _SOME * whole[g]) & (on_kind >= _VAST))
    good &= area >= np.minimum(_PART * size[p], _LARGE)
    bare = size - np.bincount(p, area, len(planes)) < options.carpet  # crumbs are all that is left
    meant: dict[int, str] = {}
    covers: dict[int, list[tuple[int, float, bool]]] = {}
    for i in np.flatnonzero(good | bare[p]).tolist():
        one, own = int(g[i]), int(p[i])
        word = words[int(label[one])]
        if good[i] and not word:
            meant[one] = planes[own]
        same = bool(good[i]) and (word or planes[own]) == planes[own]
        covers.setdefault(own, []).append((one, float(area[i]), same))
    open_ = np.flatnonzero(~said & (plane >= 0))
    return _joined(group, pieces, open_, plane, covers, options), meant


def _joined(
    group: Ints,
    pieces: Patches,
    open_: Ints,
    plane: Ints,
    covers: dict[int, list[tuple[int, float, bool]]],
    options: SegmentOptions,
) -> Ints:
    """Groups (N,), pieces `open_` (K,) put into the covers of their planes they touch most.

    Covers of a plane are groups, their area on it [m2], and whether it is what they are.
    """
    a, b = pieces.ends.T
    order = np.argsort(a, kind="stable")
    starts = np.searchsorted(a[order], np.arange(len(pieces) + 1))
    out = group.copy()
    for piece in open_.tolist():
        area = float(pieces.areas[piece])
        near = order[starts[piece] : starts[piece + 1]]
        beside = np.bincount(group[b[near]], pieces.lengths[near], len(pieces))
        fit = [
            (float(beside[one]), much, -one)
            for one, much, same in covers.get(int(plane[piece]), [])
            if area < (much if same else options.carpet)
        ]
        best = max(fit, default=(0.0, 0.0, 0))
        if best[0] > 0 or (fit and area < options.carpet):
            out[piece] = -best[2]
    return out
