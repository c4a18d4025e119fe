"""A scene map in the browser, by viser: objects, relations, camera paths, a recorded run."""

from __future__ import annotations

import socket
from contextlib import redirect_stdout
from io import StringIO
from typing import TYPE_CHECKING, Any, Self

from placegraph.errors import MissingExtraError, OptionError
from placegraph.view.viewer.viewer_run import RunView
from placegraph.view.viewer.viewer_scene import SceneView

if TYPE_CHECKING:
    from collections.abc import Mapping

    import viser
    from numpy.typing import NDArray

    from placegraph.estimate import PoseEstimate
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
    scene
        What to show.
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
