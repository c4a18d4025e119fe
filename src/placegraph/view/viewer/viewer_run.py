"""A recorded run in the viewer: particles frame by frame and pass by pass, and the modes."""

from __future__ import annotations

import threading
from time import sleep
from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph.geometry import quaternion_from_rotation
from placegraph.view.draw.painter import likely
from placegraph.view.scene.pose_items import OPENING, levels

if TYPE_CHECKING:
    import viser
    from numpy.typing import NDArray

    from placegraph.estimate import PoseEstimate

LEAST = 0.01
"""Probability of a mode that is shown."""
MOST = 4000
"""Particles shown of one frame."""
TAIL = 0.15
"""Length of the line that says which way a particle looks [m]."""
PAUSE = 0.25
"""Between two steps that are played [s]."""
MODES = ((30, 136, 229), (255, 179, 0), (120, 120, 120))
"""Colours of the first mode, the second, and others."""


class RunView:
    """Particles of an estimate's history, with a slider over its steps."""

    def __init__(self, server: viser.ViserServer, run: PoseEstimate) -> None:
        self.server, self.run = server, run
        self.steps = [
            (k, step) for k, record in enumerate(run.history) for step in range(len(record.steps))
        ]
        """Pass and row of each step."""
        self.modes = self._modes()
        self.cloud: viser.PointCloudHandle | None = None
        self.tails: viser.LineSegmentsHandle | None = None
        self._playing = threading.Lock()
        with server.gui.add_folder("Run"):
            server.gui.add_markdown(f"**{run.status.name}**: {run.reason}")
            self._controls()

    def show(self, number: int) -> None:
        """Show the particles of a step."""
        k, step = self.steps[number]
        record = self.run.history[k]
        frame, poses, weights = record.steps[step]
        self.said.content = (
            f"pass {k + 1} of {len(self.run.history)}, stride {record.stride:g}, frame {frame}: "
            f"{len(poses):,} particles"
        )
        rows = np.linspace(0, len(poses) - 1, min(len(poses), MOST)).round().astype(np.int64)
        colours = likely(levels(poses, weights))[rows, :3].astype(np.uint8)
        with self.server.atomic():
            self._draw(poses[rows], colours)

    def play(self) -> None:
        """Go through all steps, once; a second call while it goes does nothing."""
        if not self._playing.acquire(blocking=False):
            return
        try:
            for number in range(len(self.steps)):
                self.slider.value = number
                sleep(PAUSE)
        finally:
            self._playing.release()

    def _controls(self) -> None:
        gui = self.server.gui
        self.said = gui.add_markdown("No particles were recorded.")
        if not self.steps:
            return
        last = len(self.steps) - 1
        # viser's types forbid to set a value, which it allows
        self.slider: Any = gui.add_slider("Step", 0, max(last, 1), 1, 0, disabled=last == 0)
        self.slider.on_update(lambda _: self.show(min(int(self.slider.value), last)))
        gui.add_button("Play").on_click(lambda _: self.play())
        self.show(0)

    def _draw(self, poses: NDArray[np.float64], colours: NDArray[np.uint8]) -> None:
        heading = np.stack([np.cos(poses[:, 3]), np.sin(poses[:, 3]), np.zeros(len(poses))], axis=1)
        ends = np.stack([poses[:, :3], poses[:, :3] + TAIL * heading], axis=1)
        both = np.repeat(colours[:, None], 2, axis=1)
        for handle in (self.cloud, self.tails):
            if handle is not None:
                handle.remove()
        self.cloud = self.server.scene.add_point_cloud(
            "/run/particles",
            points=poses[:, :3].astype(np.float32),
            colors=colours,
            point_size=0.04,
            point_shape="circle",
            precision="float32",
        )
        self.tails = self.server.scene.add_line_segments(
            "/run/headings", points=ends.astype(np.float32), colors=both, thickness=0.008
        )

    def _modes(self) -> list[viser.CameraFrustumHandle]:
        """A camera for each likely mode."""
        handles = []
        for k, mode in enumerate(self.run.modes):
            if k and mode.probability < LEAST:
                continue
            x, y, z, w = quaternion_from_rotation(mode.map_from_camera[:3, :3]).tolist()
            handles.append(
                self.server.scene.add_camera_frustum(
                    f"/run/modes/{k + 1}",
                    fov=OPENING * 0.75,
                    aspect=4 / 3,
                    scale=0.25,
                    color=MODES[min(k, 2)],
                    wxyz=(w, x, y, z),
                    position=mode.map_from_camera[:3, 3],
                )
            )
        return handles
