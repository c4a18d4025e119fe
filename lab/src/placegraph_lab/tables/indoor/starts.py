"""Where a refinement starts in the benchmark, and captures from which something was taken away."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING
from zlib import crc32

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from placegraph.core.geometry import Floats, rotation_from_vector
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Images

if TYPE_CHECKING:
    from placegraph_lab.tables.indoor.windows import Window

SHIFT = 0.2
"""Length of the step from the true position [m]."""
TURN = 10.0
"""Angle between the true rotation and the start's [deg]."""
RISE = 0.3
"""Most that the step climbs or falls, as a share of its horizontal way."""
LEAN = 10.0
"""Most that the axis of the turn is away from the vertical [deg]."""


def disturbed(
    truth: Floats, rng: Generator, metres: float = SHIFT, degrees: float = TURN
) -> Floats:
    """A pose (4, 4) that is exactly so far off, and turned by exactly so much.

    The direction of the step is even in azimuth and climbs or falls by up to `RISE`; the axis of
    the turn lies within `LEAN` of the vertical, even in angle, and either way round is as likely.
    So are the errors of a pose whose tilt is known from gravity.
    """
    azimuth, rise = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(-RISE, RISE)
    step = np.array([np.cos(azimuth), np.sin(azimuth), rise])
    lean, towards = np.radians(rng.uniform(0.0, LEAN)), rng.uniform(0.0, 2.0 * np.pi)
    axis = np.array([np.sin(lean) * np.cos(towards), np.sin(lean) * np.sin(towards), np.cos(lean)])
    turn = np.radians(degrees) * rng.choice([-1.0, 1.0]) * axis
    start = truth.copy()
    start[:3, 3] += metres * step / np.linalg.norm(step)
    start[:3, :3] = rotation_from_vector(turn) @ truth[:3, :3]
    return start


def start_of(window: Window, seed: int) -> Floats:
    """The disturbed start (4, 4) of a window's last frame: the same for all who start there."""
    return disturbed(window.truth, np.random.default_rng([seed, crc32(window.name.encode())]))


def without_depth(capture: Capture) -> Capture:
    """The same frames as a camera sees them that measures no depth."""
    frames = tuple(replace(f, depth_camera=None, images=_Flat(f.images)) for f in capture)
    return replace(capture, frames=frames, depth_camera=None)


@dataclass(frozen=True, slots=True, eq=False)
class _Flat:
    """Images of a frame without the depth."""

    images: Images

    def rgb(self) -> NDArray[np.uint8]:
        return self.images.rgb()

    def depth(self) -> None:
        return None

    def labels(self) -> NDArray[np.int32] | None:
        return self.images.labels()
