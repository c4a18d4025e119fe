"""Depth in another unit than metres, told by what is usual in a map.

How far away things are at an elevation hardly depends on where in a map one stands. Millimetres
taken for metres, or a wrong `scale` in `camera.json`, move all readings by one factor, and on the
logarithmic scale of the visibility table a factor is a shift.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.errors import InputError, OptionError
from placegraph.indoor.likelihood.observe import Background, Sighting, View
from placegraph.io.capture.frame import Frame, LazyImages

FACTORS = (1000.0, 100.0, 39.37, 10.0, 5.0, 3.281)
"""What units are mistaken by: mm, cm, inches, 0.1 mm for mm, TUM's 1/5000 m for mm, feet."""
LONGEST = 30.0
"""No depth camera for rooms measures a median longer than this [m]; the map may say more ..."""
DIAGONALS = 3.0
"""... as many of its own diagonals."""
SHORTEST = 0.05
"""And none a shorter one than this [m]."""
TELLING = 0.75
"""Log-likelihood of a reading that a factor must gain, on average [nat]: true metres of every window
of the shared house, office and flats gain less, in the map of another place too (0.42 at most)."""
_FEWEST = 100  # readings that say anything
_A_FRAME = 1000  # readings of a frame that are looked at
_SMOOTH = 4.0  # standard deviation in bins of the table: cameras are held higher or lower
_FLOOR = 0.01  # density, in units of an even one, of readings that the map never shows
_USUAL = 2.0  # median of the depth in a room [m]


def check_unit(diagonal: float, sightings: Sequence[Sighting]) -> None:
    """Refuse depth that cannot be in metres; `diagonal` is the map's [m].

    Raises
    ------
    InputError
        The median of all frames is absurd; the message names `camera.json` and what would fit.
    OptionError
        The same for frames in memory.

    """
    found = [_some(s.depth) for s in sightings if s.depth is not None]
    readings = np.concatenate([np.zeros(0, np.float32), *found])
    if len(readings) < _FEWEST:
        return
    middle = float(np.median(readings))
    if SHORTEST <= middle <= max(LONGEST, DIAGONALS * diagonal):
        return
    factor = _nearest(middle / _USUAL)
    frame = next(s.frame for s in sightings if s.depth is not None)
    error = InputError if isinstance(frame.images, LazyImages) else OptionError
    raise error(f"The median of the depth is {middle:.3g} m. {mended(frame, factor)}")


def _some(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Some readings of an image (h, w), spread evenly."""
    step = max(1, int((depth.size / _A_FRAME) ** 0.5))
    some = depth[step // 2 :: step, step // 2 :: step]
    return some[np.isfinite(some)]


def _nearest(ratio: float) -> float:
    """The known factor, or its inverse, nearest to a ratio."""
    known = np.concatenate([FACTORS, 1.0 / np.array(FACTORS)])
    return float(known[np.abs(np.log(known / ratio)).argmin()])


def suspected_factor(
    views: Sequence[View], background: Background, telling: float = TELLING
) -> float | None:
    """By how much depth readings look too long (over 1) or too short; None: they do not.

    A factor must gain `telling` a reading [nat]. Compares the likelihood of all readings under what the
    map shows at their elevation, divided by each of `FACTORS` or its inverse, with that of the readings
    as they are.
    """
    aims = np.concatenate([v.directions[v.depth > 0] for v in views]).astype(np.float64)
    depth = np.concatenate([v.depth[v.depth > 0] for v in views]).astype(np.float64)
    reach = np.linalg.norm(aims, axis=1)
    elevation = np.arcsin(aims[:, 2] / reach)
    told = np.abs(elevation) < background.highest
    if np.count_nonzero(told) < _FEWEST:
        return None
    density = _density(background)
    bands, bins = density.shape
    band = ((elevation[told] / background.highest + 1.0) / 2.0 * bands).astype(int)
    low, high = np.log(background.distances[[0, bins - 1]])
    place = (np.log((depth * reach)[told]) - low) / (high - low) * (bins - 1)
    known = np.concatenate([[1.0], FACTORS, 1.0 / np.array(FACTORS)])
    shifts = np.log(known) / (high - low) * (bins - 1)
    at = np.rint(place - shifts[:, None]).astype(int)
    shown = np.where((at >= 0) & (at < bins), density[band, np.clip(at, 0, bins - 1)], 0.0)
    likelihood = np.log(shown + _FLOOR).mean(axis=1)
    best = int(likelihood.argmax())
    # what fits nowhere in this map with any factor says nothing of the unit
    if likelihood[best] < 0.0 or likelihood[best] - likelihood[0] < telling:
        return None
    return float(known[best])


def _density(background: Background) -> Floats:
    """Ranges (bands, bins) of each elevation, smoothed, in units of an even distribution."""
    ranges = background.ranges[:, :-1]  # the last bin: the map ends
    reach = np.arange(-12, 13)
    kernel = np.exp(-0.5 * (reach / _SMOOTH) ** 2)
    kernel /= kernel.sum()
    smooth = np.stack([np.convolve(row, kernel, "same") for row in ranges])
    return np.asarray(smooth * ranges.shape[1])


def hint(views: Sequence[View], background: Background, frame: Frame) -> str:
    """A sentence on the unit of the depth readings of frames like this one; empty: all is well."""
    factor = suspected_factor(views, background)
    return "" if factor is None else mended(frame, factor)


def mended(frame: Frame, factor: float) -> str:
    """What is wrong, where, and what would fit."""
    times, direction = (factor, "long") if factor > 1 else (1.0 / factor, "short")
    said = f"The depth readings look about {times:.{0 if times > 9 else 1}f} times too {direction}"
    if not isinstance(frame.images, LazyImages):
        return f"{said}; give depth in metres."
    unit = frame.images.unit
    if unit is None:
        return f"{said} for metres; check what the depth images were written in."
    return (
        f"{said}: check {unit.said}, which is {unit.per_metre:g} units a metre; "
        f"{unit.per_metre * factor:.4g} would fit."
    )
