"""Options of searching a library: plain structs; defaults are what measured best."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from placegraph.errors import OptionError
from placegraph.indoor.options import check_numbers, check_positive, check_whole


@dataclass(frozen=True, slots=True)
class SearchOptions:
    """How a capture is compared with the scenes of a library."""

    method: Literal["likelihood", "cosines"] = "likelihood"
    """``likelihood``: a log-likelihood ratio against the library and the homes beside it; ``cosines``: the
    paper's sum over frames of the mean over patches of the best cosine (Sec. 4)."""
    rarity: bool = True
    """Weigh what is said against how common it is in the library."""
    geometry: bool = True
    """Compare with panoramas: what is seen together, and in which direction."""
    odometry: bool = True
    """Frames lie on one way; without, each frame may lie anywhere in the scene."""
    wrong: float = 0.4
    """Share of patches taken to say something wrong."""
    focus: float = 0.75
    """Share of what is seen in a direction that is the object which fills most of it."""
    witnesses: float = 24.0
    """Patches of a frame that speak independently of each other."""
    thing: float = 6.0
    """Patches that say the same, in all frames together, that speak independently of each other."""
    heat: float = 3.3
    """Nats of log-likelihood that count as one, for a single frame; T frames of one way see much
    the same, and T^0.45 times as many count as one; of two encoders, sqrt(2) times."""
    looks: int = 12
    """Frames compared, spread over the capture: those between show much the same."""
    finalists: int = 16
    """Scenes compared with panoramas: the best by what they hold."""
    shortlist: int = 1000
    """Scenes looked at in a larger library: those whose vectors are nearest."""

    def __post_init__(self) -> None:
        if self.method not in {"likelihood", "cosines"}:
            raise OptionError(f"method is {self.method!r}; it is 'likelihood' or 'cosines'.")
        if not 0 < self.wrong < 1:
            raise OptionError(f"wrong is {self.wrong}; a share lies between 0 and 1.")
        check_numbers(self)
        check_positive(self, "witnesses", "thing", "heat")
        check_whole(self, "looks", "finalists", "shortlist")
