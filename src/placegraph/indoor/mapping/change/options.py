"""Options of comparing a map with a later look at the same place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from placegraph.core.geometry import Floats
from placegraph.errors import OptionError
from placegraph.indoor.options import check_numbers, check_positive, check_whole


@dataclass(frozen=True, slots=True)
class DiffOptions:
    """When something counts as changed.

    The defaults were set by hand, from the errors of poses and depth that the shared house and
    office show, and by looking at what was found there; no sweep was made over them.
    """

    least_shift: float = 0.08
    """What moved less than this [m] and turned less than `least_turn` stayed."""
    least_turn: float = 10.0
    """[deg]"""
    reach: float = 4.0
    """How far a moved object is looked for [m]."""
    depth_floor: float = 0.04
    """A reading agrees with the map within this at 0 m [m], map and pose included ..."""
    depth_slope: float = 0.015
    """... and this much more a metre."""
    frames: int = 60
    """Frames of a longer capture that are used, evenly spread."""
    least_pixels: int = 100
    """Pixels, of pictures at most 320 wide, that have to speak of an object in all frames."""
    least_frames: int = 3
    """Frames in which they have to, with at least `least_pixels` / 10 each (all, of fewer)."""
    voxel: float = 0.05
    """Edge of the cells in which what appeared is gathered [m]."""
    least_box: float = 0.08
    """What appeared is this large at least, along its longest side [m]."""
    depth: bool = True
    """Use depth images, where there are any."""
    colour: bool = True
    """Use colours, where depth cannot tell."""
    b_from_a: Floats | None = None
    """(4, 4) rigid [m], from the first map's axes to the second's; estimated if not given."""
    within: float = 0.05
    """Surfaces of two maps this near are the same [m]."""
    points: int = 400
    """Points on each object that are compared between maps."""
    seed: int = 0
    """Of the points drawn on surfaces."""

    def __post_init__(self) -> None:
        check_numbers(self)
        check_whole(self, "frames", "least_pixels", "least_frames", "points")
        check_positive(self, "reach", "depth_floor", "voxel", "within", "least_shift", "least_turn")
        if not (self.depth or self.colour):
            raise OptionError("depth and colour are both off; leave one on.")
        if self.b_from_a is not None:
            from placegraph.indoor.render import checked_pose

            object.__setattr__(self, "b_from_a", checked_pose(np.asarray(self.b_from_a)))
