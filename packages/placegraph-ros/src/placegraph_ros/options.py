"""How a localizer works, and what became of a stream's frames."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from math import inf
from typing import Any, Literal

from placegraph.core.estimate import Status
from placegraph.errors import OptionError

Mode = Literal["continuous", "once"]


@dataclass(frozen=True, slots=True)
class LiveOptions:
    """How a `Localizer` works, and what it tells."""

    mode: Mode = "continuous"
    """`once`: images are looked at until the pose is known, and again when somebody asks."""
    map_frame: str = "map"
    base_frame: str = ""
    """Of the robot; base_link, base_footprint or what odometry carries, if not given."""
    tolerance: float = 0.1
    """The transform map -> odom is stamped so far ahead [s], for those who ask for it till then."""
    whole: bool = True
    """Tell also what a robot knows already: images, where its camera sits, its odometry."""
    background: bool = True
    """Images are looked at while others come, and dropped where they come too fast; else one by one."""
    seed: int = 0

    def __post_init__(self) -> None:
        mode_of(self.mode)
        if not 0.0 <= self.tolerance < inf:
            raise OptionError(f"tolerance is {self.tolerance}; it is seconds, 0 or more.")


def mode_of(name: str) -> Mode:
    """Mode of a name; `OptionError` where it is none."""
    modes: dict[str, Mode] = {"continuous": "continuous", "once": "once"}
    if name in modes:
        return modes[name]
    raise OptionError(f"mode is {name!r}; it is 'continuous' or 'once'.")


@dataclass(slots=True)
class Summary:
    """What became of a stream's frames."""

    frames: int = 0
    """Images that could be looked at."""
    told: Counter[str] = field(default_factory=Counter)
    """Images that were looked at, by the status after each."""
    dropped: int = 0
    """Images that came too fast."""
    left_out: Counter[str] = field(default_factory=Counter)
    """Images and messages that could not be used, by reason."""
    lacks: tuple[str, ...] = ()
    """What is missing still for any frame, in sentences."""
    notes: tuple[str, ...] = ()
    """What was chosen, and found out, in sentences."""

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings."""
        looked = sum(self.told.values())
        return {
            "frames": self.frames, "told": dict(self.told), "dropped": self.dropped,
            "share_ok": self.told[Status.OK.name] / looked if looked else None,
            "left_out": dict(self.left_out), "lacks": list(self.lacks), "notes": list(self.notes),
        }  # fmt: skip
