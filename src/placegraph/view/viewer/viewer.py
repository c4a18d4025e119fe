"""A scene map in the browser, by viser: objects, relations, camera paths, a recorded run."""

from __future__ import annotations

import socket
import threading
from collections.abc import Mapping
from contextlib import redirect_stdout
from io import StringIO
from time import sleep
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from placegraph.core.estimate import PoseEstimate
from placegraph.core.geometry import quaternion_from_rotation
from placegraph.errors import MissingExtraError, OptionError
from placegraph.view.draw.painter import likely
from placegraph.view.scene.pose_items import OPENING, levels
from placegraph.view.viewer.viewer_scene import SceneView

if TYPE_CHECKING:
    import viser

    from placegraph.indoor.scene_map import SceneMap

HOST, PORT = "127.0.0.1", 8080


class Viewer:
    """A running server; whoever opens its address sees the map. Close it, or use it in `with`."""

    def __init__(
        self,
        server: viser.ViserServer,
        scene: SceneMap,
        camera_paths: Mapping[str, NDArray[Any]],
        run: PoseEstimate | None,
    ) -> None:
        self.server = server
        self.map = SceneView(server, scene)
        paths = dict(camera_paths)
        if run is not None and len(run.trajectory):
            paths["run"] = run.trajectory
        if paths:
            self.map.add_paths(paths)
        self.run = None if run is None else RunView(server, run)

    @property
    def address(self) -> str:
        """What to open in a browser."""
        host = self.server.get_host()
        shown = socket.gethostname() if host in {"0.0.0.0", "::"} else host  # noqa: S104
        return f"http://{shown}:{self.server.get_port()}"

    def close(self) -> None:
        """Stop the server."""
        self.server.stop()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def open_viewer(
    scene: SceneMap,
    *,
    camera_paths: Mapping[str, NDArray[Any]] | None = None,
    run: PoseEstimate | None = None,
    host: str = HOST,
    port: int = PORT,
) -> Viewer:
    """Serve a map to browsers.

    Parameters
    ----------
    camera_paths
        Names and (T, 4, 4) map_from_camera.
    run
        An estimate with its particles: made with `FilterOptions(record=True)`, or read by
        `placegraph.indoor.pose.record.read_run`.
    host
        Address to listen at: 127.0.0.1 serves this computer alone, 0.0.0.0 all that can reach it.
    port
        Port; the next free one where it is taken.

    Raises
    ------
    MissingExtraError
        viser is not installed.
    OptionError
        The host is none of this computer's, or the port is out of range.

    """
    try:
        import viser
    except ImportError as error:
        raise MissingExtraError(
            "The viewer needs viser; `pip install 'placegraph[view]'` brings it."
        ) from error
    if not 1 <= port <= 65535:
        raise OptionError(f"port is {port}; it must be 1 to 65535.")
    _check_host(host)
    with redirect_stdout(StringIO()):  # the caller says where to look, once
        server = viser.ViserServer(host=host, port=port, label=scene.source or None, verbose=False)
    return Viewer(server, scene, camera_paths or {}, run)


def _check_host(host: str) -> None:
    """Raise `OptionError` where nothing can listen at `host`."""
    try:
        family, kind, *_, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind) as probe:
            probe.bind(address)
    except (OSError, UnicodeError) as error:
        raise OptionError(
            f"host is {host!r}, where this computer cannot listen ({error}); use 127.0.0.1, or "
            "0.0.0.0 for all that can reach it."
        ) from error


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
