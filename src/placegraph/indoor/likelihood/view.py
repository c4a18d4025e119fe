"""What compiled loops compare with the map: a frame at one stride, and the numbers of the model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.indoor.options import Likelihood


@dataclass(frozen=True, slots=True, eq=False)
class Background:
    """What a camera sees in a map when nothing is known of where it is.

    Every likelihood is a ratio against this: a floor seen at the depth where all floors are seen
    says nothing, and a ray that leaves the map counts as much as it knows: nothing.
    """

    objects: Floats
    """(N,) share of each object among all rays of the visibility table that hit."""
    ranges: Floats
    """(bands of elevation, bins) share of each range among the rays of a band that hit."""
    distances: Floats
    """(bins,) range of each bin [m]."""
    highest: float
    """Elevation at which the bands end, above and below the horizon [rad]."""


class View(NamedTuple):
    """One frame at one stride: R = 16 * tiles samples, what they see, and what it would mean.

    Samples stand in tiles of 4 x 4; a sample outside the image has patch -1.
    """

    directions: NDArray[np.float32]
    """(R, 3) rays in the level frame, of length 1 along the optical axis: distances are depths."""
    patch: NDArray[np.int32]
    """(R,) patch of each sample."""
    semantic: NDArray[np.float32]
    """(P + 1, N + 1) likelihood ratio of what a patch says if it sees object n, against anywhere;
    column N: the map ends there. Under ``gaussian``: cosine + 1 where they agree."""
    weight: NDArray[np.float32]
    """(P + 1,) weight of each patch; 0: it says nothing. The last patch is for samples in none."""
    depth: NDArray[np.float32]
    """(R,) along the optical axis [m]; 0: no reading."""
    usual_depth: NDArray[np.float32]
    """(R,) log-likelihood of the reading if nothing is known of where the camera is."""
    colour: NDArray[np.float32]
    """(R, 3) `surface.opponent` of the image, averaged over what each sample stands for."""
    footprint: float
    """Angle between neighbouring samples [rad]."""
    terms: NDArray[np.bool_]
    """(3,) which terms are there and wanted: semantic, depth, colour."""


class Noise(NamedTuple):
    """Numbers of a likelihood, as compiled loops read them (`options.Likelihood`)."""

    gaussian: bool
    """Eq. 2's scores in [0, 2] instead of log-likelihoods."""
    depth_floor: float
    """Standard deviation of depth at 0 m [m] ..."""
    depth_slope: float
    """... and what it gains a metre."""
    depth_gain: float
    """Log-likelihood of a perfect reading above one that fits nothing."""
    near_cost: float
    """Log-likelihood lost by a reading nearer than the map: something stands in front."""
    far_cost: float
    """... and by one beyond the map's surface: something is gone."""
    depth_weight: float
    """Independent readings that a full image of depth is worth."""
    colour_weight: float
    """Independent samples that a full image is worth by its steps of colour ..."""
    tone_weight: float
    """... and by tones, where they count."""
    depth_clip: float
    """Eq. of Sec. 3.4: depth errors are clipped here [m], and count as shares of it; 0: nowhere."""

    @classmethod
    def of(cls, options: Likelihood, *, gaussian: bool) -> Self:
        """The options' own numbers."""
        return cls(gaussian, *(getattr(options, name) for name in cls._fields[1:]))
