"""A place that was found by looking everywhere is believed when it is found again."""

from __future__ import annotations

import numpy as np

from placegraph.core.estimate import PoseEstimate, Status
from placegraph.core.geometry import Floats, vector_from_rotation
from placegraph.indoor.status import await_confirmation
from placegraph.io.capture.frame import Frame

NEAR, TURNED = 0.3, 0.17
"""Two poses are of one place where they are no further apart [m, rad]."""


class Again:
    """Judges what is found in a whole map: one image may fit an alias, such as wallpaper that repeats.

    A place counts when the next answer that is sure finds it where odometry has come to since.
    """

    def __init__(self) -> None:
        self._before: tuple[str, Floats] | None = None

    def judged(self, scene: str, frame: Frame, estimate: PoseEstimate) -> PoseEstimate:
        """The estimate of a frame's pose in a scene; where it was found first, `AMBIGUOUS`."""
        best = estimate.best
        if estimate.status is not Status.OK or best is None:
            return estimate
        found = best.map_from_camera
        before, self._before = self._before, (scene, found @ np.linalg.inv(frame.odometry))
        if before is not None and before[0] == scene and _one(before[1] @ frame.odometry, found):
            return estimate
        return await_confirmation(estimate)


def _one(pose: Floats, other: Floats) -> bool:
    """Whether two poses (4, 4) are of one place."""
    apart = np.linalg.norm(pose[:3, 3] - other[:3, 3])
    turned = np.linalg.norm(vector_from_rotation(pose[:3, :3].T @ other[:3, :3]))
    return bool(apart <= NEAR and turned <= TURNED)
