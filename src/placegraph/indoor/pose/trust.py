"""How far a pose is to be believed: the log odds that it is right, by what each sense says of it.

Senses err apart from each other, so that their log odds add up; a sense that is silent adds less than
nothing. What speaks for a pose speaks less where another place fits nearly as well.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from placegraph.indoor.pose.evidence import Agreement

SURE = 1.7
"""Log odds from which on a pose is `OK`: 85 %."""
LOST = -0.5
"""Log odds below which, were there no rival, nothing on the map fits."""
_SLIM, _DIM = 0.01, 0.01
"""What is added before a logarithm is taken: to how firmly surfaces hold a pose, and to what colours
tell [nat]."""


@dataclass(frozen=True, slots=True)
class Trust:
    """Coefficients of the log odds of being right: what each sense that is there adds, and rivals.

    Coefficients by `placegraph-lab table indoor_robustness --fit`: logistic regression over windows of
    house and office, asked in their own maps and in those of other places; even windows are fitted.
    """

    level: float
    rivals: float
    depth: tuple[float, float, float]
    """That depth is there; log odds of its share that agrees; log of how firmly surfaces hold."""
    colour: tuple[float, float]
    """That colours are there; log of what they tell."""

    def of(self, agreed: Agreement, probability: float = 1.0) -> float:
        """Log odds of a pose that is the best mode with a probability; 1: it has no rival."""
        weights = (self.level, self.rivals, *self.depth, *self.colour)
        return float(np.dot(weights, features(agreed, probability)))


def features(agreed: Agreement, probability: float) -> list[float]:
    """(7,) what the coefficients of `Trust` stand before."""
    depth = [0.0, 0.0, 0.0]
    if not np.isnan(agreed.depth):
        depth = [1.0, log_odds(agreed.depth, 0.01), float(np.log(agreed.held + _SLIM))]
    colour = [0.0, 0.0]
    if not np.isnan(agreed.colour):
        colour = [1.0, float(np.log(max(agreed.colour, 0.0) + _DIM))]
    return [1.0, log_odds(probability, 0.001), *depth, *colour]


def log_odds(share: float, least: float) -> float:
    """Log odds of a share, no nearer to 0 and 1 than `least`."""
    share = min(max(share, least), 1.0 - least)
    return float(np.log(share / (1.0 - share)))


TRUST = Trust(level=0.81, rivals=0.32, depth=(0.53, 1.25, 1.7), colour=(4.72, 1.31))
