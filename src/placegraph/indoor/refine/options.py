"""Options of the refinement: plain structs with units; defaults are what measured best."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import Literal

from placegraph.core.options import check_options, option
from placegraph.errors import OptionError
from placegraph.indoor.options import MotionNoise

_LEAST = 1e-4  # m, rad: less would make one source silence all others


@dataclass(frozen=True, slots=True)
class DepthNoise:
    """Noise of depth readings about the map's surface."""

    floor: float = option(0.004, "Standard deviation of a reading at 0 m.", unit="m")
    slope: float = option(0.003, "Increase of the standard deviation per square metre.", unit="1/m")
    surface: float = option(
        0.008, "Standard deviation of the surface of the map.", unit="m", minimum=_LEAST
    )
    facing: tuple[float, float] = option(
        (0.5, 0.85),
        "Cosines of the angle between the normals of reading and map: below the first a reading has "
        "no weight, from the second on its full weight.",
        minimum=-1,
        maximum=1,
    )

    def __post_init__(self) -> None:
        check_options(self)
        if not self.facing[0] < self.facing[1]:
            raise OptionError(f"facing is {self.facing}; give two ascending cosines.")


@dataclass(frozen=True, slots=True)
class RefineOptions:
    """Options of the refinement of a pose (Sec. 3.6)."""

    depth: bool = option(True, "Align depth images with the mesh of the map.")
    images: bool | Literal["auto"] = option(
        "auto", "Match images with renderings; `auto`: if depth alone does not fix the pose."
    )
    joint: bool = option(
        True,
        "Refine all frames together in one robust fit, of a pose that is not `LOST`, and keep it near "
        "that pose; otherwise the frame with most inliers decides, as in the paper, wherever it is.",
    )
    views: int = option(
        1,
        "Rendered views per frame for matchers without a neighbourhood; with several, `auto` takes RoMa "
        "or SIFT. More than one gain nothing from starts within 10 degrees (benchmark; paper: 6).",
        minimum=1,
        maximum=72,
    )
    spread: float = option(
        pi / 4, "Half width of these views in yaw (paper: 45 degrees).", unit="rad", maximum=pi
    )
    frames: int | None = option(
        None,
        "Most frames with matched images, spread over the sequence; none: 12 with the guided matcher, "
        "5 with slower ones.",
        minimum=1,
    )
    readings: int = option(1500, "Depth readings per frame.", minimum=1)
    reach: tuple[float, float] = option(
        (0.15, 0.12),
        "Standard deviations of a given start (`scene.refine`) in the plane [m] and in yaw [rad]; "
        "`localize` knows those of its own poses.",
        maximum=5,
    )
    inlier: float = option(
        8.0, "Reprojection error of an inlier of RANSAC.", unit="px of an image 640 wide", above=0
    )
    least: int = option(12, "Fewest inliers of a pose, in a frame or a sequence.", minimum=1)
    noise: DepthNoise = option(DepthNoise(), "Noise of depth readings.")
    motion: MotionNoise = option(
        MotionNoise(0.0025, 0.01, 0.00125, 0.005), "Noise of the odometry from frame to frame."
    )
    tilt: float = option(
        0.005, "Standard deviation of the direction of gravity.", unit="rad", minimum=_LEAST
    )
    check: bool = option(
        True, "Keep the coarse pose if held-back pixels do not confirm the refined one."
    )

    def __post_init__(self) -> None:
        check_options(self)
        if not (self.depth or self.images):
            raise OptionError("depth and images are both off; leave one on, or refine=False.")
        if self.reach[1] > pi:
            raise OptionError(f"reach is {self.reach}; a turn is at most pi.")

    @classmethod
    def preset(cls, name: str) -> RefineOptions | None:
        """Return the refinement of the preset of that name (`FilterOptions.preset`).

        None after ``published``: that is a filter only, whose code ends in another refinement.
        """
        paper = cls.paper()
        follows = {"default": cls(), "paper": paper, "published": None, "coarse": paper}
        if name not in follows:
            raise OptionError(f"preset is {name!r}; there are {', '.join(follows)}.")
        return follows[name]

    @classmethod
    def paper(cls) -> RefineOptions:
        """Return the paper's recipe: six views of every frame, PnP frame by frame, most inliers decide.

        Its matcher is RoMa; ``auto`` takes SIFT where RoMa is not at hand. The guided one, if named,
        knows where to look, and gets one view.
        """
        return cls(depth=False, images=True, joint=False, check=False, views=6, frames=1000)
