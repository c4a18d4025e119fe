"""What is known, before any map is looked at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from placegraph.errors import OptionError
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame
from placegraph.outdoor.search.request import is_count, number

if TYPE_CHECKING:
    from placegraph.indoor.pose.query import Progress
    from placegraph.outdoor.search.ask import Answer


@dataclass(frozen=True, eq=False)
class Known:
    """One question; fields as of `World.locate`. Raises `OptionError` where one is out of its range."""

    text: str | None = None
    capture: Capture | Sequence[Frame] | None = None
    frames: slice | Sequence[int] | None = None
    near: Sequence[float] | None = None
    radius: float = 1000.0
    heading: float | None = None
    seed: int = 0
    top: int = 5
    most: int = 8
    refine: bool = True
    device: str = "auto"
    answers: Sequence[Answer] = ()
    language: str | None = None
    progress: Progress | None = None
    budget: float | None = None
    """Of worlds in shards [s]."""

    def __post_init__(self) -> None:
        if self.text is None and self.capture is None and self.near is None:
            raise OptionError(
                "Nothing is known: give a text, a capture, or `near`, or several of them."
            )
        if self.frames is not None and self.capture is None:
            raise OptionError("frames: they are of a capture, and there is none.")
        for name in ("top", "most"):
            if not is_count(getattr(self, name)):
                raise OptionError(f"{name} is {getattr(self, name)!r}; it is a number from 1 on.")
        if self.budget is not None and not 0.0 < number(self.budget) < np.inf:
            raise OptionError(f"budget is {self.budget!r} s; give a time greater than 0.")
        if self.heading is not None and not abs(number(self.heading)) < 1e6:
            raise OptionError(f"heading is {self.heading!r}; give a finite angle.")
        if not 1.0 <= number(self.radius) <= 1e7:
            raise OptionError(f"radius is {self.radius!r} m; choose between 1 and 10,000,000 m.")
        if self.near is not None:
            given = [number(x) for x in self.near]
            if len(given) != 2 or not (abs(given[0]) <= 180.0 and abs(given[1]) <= 90.0):
                raise OptionError(
                    f"near is {self.near!r}; give longitude and latitude in degrees, in this order."
                )
