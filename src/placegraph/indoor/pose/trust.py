"""How far a pose is to be believed: the log odds that frames fit there, by what each sense says.

Senses err apart from each other, so that their log odds add up; a sense that is silent adds less than
nothing. A pose is right where frames fit, and no other place fits better: both shares are multiplied.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from placegraph.indoor.pose.evidence import Agreement

SURE = 0.75
"""Probability of being right from which on a pose is `OK`."""
LOST = -1.0
"""Log odds below which nothing on the map fits."""
SPEAK = 0.02
"""What colours tell from which on they speak, so that depth is not alone [nat a sample] ..."""
CLEAR = 0.035
"""... from which on they speak clearly enough to be believed alone ..."""
_MOST = 0.12
"""... and what counts at most."""
_MOST_TONE = 0.2
"""The same of tones: a wall and a floor have those of any room."""
TELLING = 1.0
"""Log-likelihood ratio below which an object says nothing [nat]."""
WITNESSES = 4
"""Objects whose labels speak for a pose as firmly as a surface."""
_SLIM = 0.01
"""Added to how firmly surfaces hold a pose, before its logarithm is taken."""


@dataclass(frozen=True, slots=True)
class Trust:
    """Coefficients of the log odds that frames fit, of a pose without a rival.

    By logistic regression over even windows of house and office, asked in their own maps and in those of
    other places, as `placegraph-lab table indoor_robustness --fit` does it. Those of tones were fitted
    later, to windows with depth and colours and their wrong rivals; the others stayed as they were, so
    that what one sense alone says is what it was.
    """

    level: float
    depth: tuple[float, float, float]
    """That depth is there; log odds of its share that agrees; the log of how firmly surfaces hold the
    pose, as far as depth speaks alone."""
    colour: tuple[float, float]
    """That colours are there; what their steps tell [1 / nat]."""
    tone: tuple[float, float]
    """That they stand beside depth; what they tell themselves [1 / nat]."""

    @property
    def coefficients(self) -> tuple[float, ...]:
        """(8,) what stands before `features`."""
        return (self.level, *self.depth, *self.colour, *self.tone)

    def toned(self, tone: float) -> float:
        """Log odds that tones add which tell so much [nat]."""
        return self.tone[0] + self.tone[1] * min(max(tone, 0.0), _MOST_TONE)

    def odds(self, agreed: Agreement) -> float:
        """Log odds; minus infinity where there is neither depth nor colour."""
        if np.isnan(agreed.depth) and np.isnan(agreed.colour):
            return -np.inf
        return float(np.dot(self.coefficients, features(agreed)))

    def of(self, agreed: Agreement, probability: float) -> float:
        """Probability that a pose is right which is the best with a probability."""
        return probability / (1.0 + float(np.exp(-self.odds(agreed))))


def features(agreed: Agreement) -> list[float]:
    """(8,) what the coefficients of `Trust` stand before."""
    depth = [0.0, 0.0, 0.0]
    if not np.isnan(agreed.depth):
        bare = _alone(agreed) * float(np.log(agreed.held + _SLIM))
        depth = [1.0, log_odds(agreed.depth, 0.01), bare]
    colour = [0.0, 0.0]
    if not np.isnan(agreed.colour):
        colour = [1.0, float(np.clip(agreed.colour, 0.0, _MOST))]
    tone = [0.0, 0.0]
    if not np.isnan(agreed.tone):
        tone = [1.0, float(np.clip(agreed.tone, 0.0, _MOST_TONE))]
    return [1.0, *depth, *colour, *tone]


def _alone(agreed: Agreement) -> float:
    """How far depth speaks alone, 0 to 1: clear colours lift it, and several objects that tell."""
    colour = 0.0 if np.isnan(agreed.colour) else (agreed.colour - SPEAK) / (CLEAR - SPEAK)
    named = 0.0 if np.isnan(agreed.semantic) else np.clip(agreed.weights / TELLING, 0.0, 1.0).sum()
    lifted = np.clip([colour, named / WITNESSES], 0.0, 1.0)
    return float(np.prod(1.0 - lifted))


def log_odds(share: float, least: float) -> float:
    """Log odds of a share, no nearer to 0 and 1 than `least`."""
    share = min(max(share, least), 1.0 - least)
    return float(np.log(share / (1.0 - share)))


TRUST = Trust(level=6.44, depth=(-3.0, 1.77, 2.26), colour=(-5.54, 31.36), tone=(2.12, 21.28))
