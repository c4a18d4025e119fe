"""Rounds of matching images with the map, from wide to fine."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from placegraph.indoor.refine.landmarks import SHARE, SIGMA
from placegraph.indoor.refine.matching.guided import GuidedMatcher

if TYPE_CHECKING:
    from placegraph.indoor.refine.matching import Matcher


@dataclass(frozen=True, slots=True)
class Stage:
    """One round of matching: at which size, how, and how well matches are placed."""

    matcher: Matcher | None
    """None: what matches are the map's landmarks, and renderings are not asked."""
    size: int
    """Longer side of renderings and queries [px]; images that are smaller stay so."""
    sigma: float
    """Standard deviation of a right match [px of an image `REFERENCE` wide]."""
    turned: bool = False
    """Views turned in yaw are matched too."""
    rigid: bool = True
    """Only matches count that agree on one pose of all frames, tied together by odometry; where all
    lie near already, the robust kernel tells better."""
    share: float = 0.0
    """Least share of the matches that must agree: features do so by chance if few do."""


LANDMARKS = Stage(None, 0, SIGMA, share=SHARE)
"""The round before all others, of a map that carries landmarks."""
LARGEST = 960
"""Longer side [px] to which larger images are brought for feature matchers."""


def stages_of(matcher: Matcher | None, *, near: bool) -> list[Stage]:
    """Rounds of matching by a matcher, the guided one if None; `near`: depth has been aligned."""
    if matcher is not None:
        first = Stage(matcher, LARGEST, 2.0, turned=True, share=SHARE)
        return [first, replace(first, turned=False)]
    fine = [Stage(GuidedMatcher(radius=10, half=7, cell=8), 160, 2.0)]
    if near:
        return fine
    wide = [Stage(GuidedMatcher(radius=34, half=5, cell=8), 160, 3.0)]
    return [*wide, *fine, Stage(GuidedMatcher(radius=8, half=7, cell=12), 320, 1.0, rigid=False)]
