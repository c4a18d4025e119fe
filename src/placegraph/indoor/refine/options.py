"""Options of the refinement: plain structs with units; defaults are what measured best."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from placegraph.errors import OptionError
from placegraph.indoor.options import MotionNoise, check_numbers, check_positive, check_whole

_LEAST = 1e-4  # m, rad: less would make one witness silence all others
_FAR = 5.0
_MOST = 72


def _two(name: str, pair: object) -> tuple[float, float]:
    """Return two numbers, or `OptionError`."""
    if not (isinstance(pair, tuple | list) and len(pair) == 2):
        raise OptionError(f"{name} is {pair!r}; it is two numbers.")
    return float(pair[0]), float(pair[1])


@dataclass(frozen=True, slots=True)
class DepthNoise:
    """Noise of depth readings about the map's surface."""

    floor: float = 0.004
    """Standard deviation of a reading at 0 m [m] ..."""
    slope: float = 0.003
    """... and what it gains a square metre [1/m]."""
    surface: float = 0.008
    """Standard deviation of the map's own surface [m]."""
    facing: tuple[float, float] = (0.5, 0.85)
    """Cosine of the angle between the seen and the map's normal: below the first a reading has no
    say, from the second on all of it."""

    def __post_init__(self) -> None:
        check_numbers(self)
        if self.surface < _LEAST:
            raise OptionError(f"surface is {self.surface} m; no map is truer than {_LEAST} m.")
        low, high = _two("facing", self.facing)
        if not -1.0 <= low < high <= 1.0:
            raise OptionError(f"facing is {self.facing}; give two ascending cosines.")


@dataclass(frozen=True, slots=True)
class RefineOptions:
    """Everything that can be set about refining a pose (Sec. 3.6)."""

    depth: bool = True
    """Align depth images to the map's mesh, where there are any."""
    images: bool | Literal["auto"] = "auto"
    """Match images with renderings; ``auto``: where depth alone does not fix the pose."""
    joint: bool = True
    """All frames in one robust optimisation, of a pose that is not `LOST`, and which must stay near
    it; else the frame with most inliers decides, as in the paper, wherever that is."""
    views: int = 1
    """Rendered views a frame is matched with, by matchers that know no neighbourhood: of several,
    ``auto`` takes RoMa or SIFT. From starts within 10 degrees more than one cost time and gain
    nothing (benchmark; paper: 6)."""
    spread: float = 0.7853981633974483
    """Half width in yaw of these views [rad] (paper: 45 degrees)."""
    frames: int | None = None
    """Most frames whose images are matched, spread over the sequence; None: 12 for the guided
    matcher, 5 for those that are slower."""
    readings: int = 1500
    """Depth readings of a frame that are aligned."""
    reach: tuple[float, float] = (0.15, 0.12)
    """How far off the start may be: standard deviations in the plane [m] and in yaw [rad]. Only of a
    start that is given (`scene.refine`); `localize` knows what its own poses are worth."""
    inlier: float = 8.0
    """Reprojection error of an inlier of RANSAC [px of an image 640 wide]."""
    least: int = 12
    """Fewest inliers of a frame, or of a sequence, that count as a pose."""
    noise: DepthNoise = field(default_factory=DepthNoise)
    motion: MotionNoise = field(default_factory=lambda: MotionNoise(0.0025, 0.01, 0.00125, 0.005))
    """Standard deviations of odometry from frame to frame."""
    tilt: float = 0.005
    """Standard deviation of the direction of gravity [rad]."""
    check: bool = True
    """Keep the coarse pose where held-back pixels do not speak for the refined one."""

    def __post_init__(self) -> None:
        check_numbers(self)
        check_whole(self, "views", "readings", "least")
        if self.frames is not None:
            check_whole(self, "frames")
        check_positive(self, "inlier")
        if self.tilt < _LEAST or self.spread > np.pi or self.views > _MOST:
            raise OptionError(
                f"tilt, spread, views are {self.tilt}, {self.spread}, {self.views}; they must be at "
                f"least {_LEAST} rad, at most pi, and at most {_MOST}."
            )
        for name in ("depth", "joint", "check"):
            if not isinstance(getattr(self, name), bool):
                raise OptionError(f"{name} is {getattr(self, name)!r}; it is True or False.")
        if not (isinstance(self.images, bool) or self.images == "auto"):
            raise OptionError(f"images is {self.images!r}; it is True, False or 'auto'.")
        if not (isinstance(self.noise, DepthNoise) and isinstance(self.motion, MotionNoise)):
            raise OptionError("noise and motion: give a DepthNoise and a MotionNoise.")
        if not (self.depth or self.images):
            raise OptionError("depth and images are both off; leave one on, or refine=False.")
        way, turn = _two("reach", self.reach)
        if not (0 <= way <= _FAR and 0 <= turn <= np.pi):
            raise OptionError(f"reach is {self.reach}; a way to {_FAR:g} m and a turn to pi.")

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
