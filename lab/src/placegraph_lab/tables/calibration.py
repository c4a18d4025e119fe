"""Calibration: whether things said to be 80 % sure are true 80 % of the time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from placegraph.core.geometry import Floats
from placegraph.errors import OptionError

ROUNDING = 1e-6
"""How far a sum of probabilities may stray from 0 to 1."""


@dataclass(frozen=True)
class Reliability:
    """Bins of equal mass, from the least to the most confident."""

    count: Floats
    """(B,) answers in a bin."""
    confidence: Floats
    """(B,) mean confidence."""
    accuracy: Floats
    """(B,) share that is right."""

    @property
    def error(self) -> float:
        """Expected calibration error: mean of |accuracy - confidence|, weighted by count."""
        gap = np.abs(self.accuracy - self.confidence)
        return float(np.average(gap, weights=self.count))

    @property
    def floor(self) -> float:
        """Error that answers with these confidences would show if perfectly calibrated.

        The mean of a bin of n answers scatters by sqrt(p (1 - p) / n); the mean absolute value
        of a normal deviate is sqrt(2 / pi).
        """
        sure = np.clip(self.confidence, 0.0, 1.0)
        spread = np.sqrt(sure * (1.0 - sure) / self.count)
        return float(np.average(np.sqrt(2.0 / np.pi) * spread, weights=self.count))


def reliability(confidence: ArrayLike, right: ArrayLike, bins: int = 10) -> Reliability:
    """Sort answers by confidence (N,) in [0, 1] into bins of equal mass; `right` (N,) is bool.

    Raises
    ------
    OptionError
        Where there is nothing to sort, a confidence is not in [0, 1], or lengths differ.
    """
    sure, true = np.asarray(confidence, np.float64), np.asarray(right, np.float64)
    if sure.ndim != 1 or sure.shape != true.shape or not len(sure) or bins < 1:
        raise OptionError("Calibration needs at least one answer, a confidence each, and a bin.")
    if not ((sure >= -ROUNDING) & (sure <= 1.0 + ROUNDING)).all():
        raise OptionError("A confidence lies outside 0 to 1; give probabilities.")
    order = np.argsort(sure, kind="stable")
    parts = [part for part in np.array_split(order, bins) if len(part)]
    return Reliability(
        count=np.array([len(part) for part in parts], np.float64),
        confidence=np.array([sure[part].mean() for part in parts]),
        accuracy=np.array([true[part].mean() for part in parts]),
    )
