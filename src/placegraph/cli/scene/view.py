"""`placegraph scene view`: a scene map in the browser."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click

from placegraph.cli.command import Option
from placegraph.cli.common import progress_of
from placegraph.cli.scene.export import CameraPaths, camera_paths
from placegraph.cli.scene.query import (
    Device,
    Frames,
    MapFile,
    NoProgress,
    Seed,
    chosen_frames,
)
from placegraph.errors import OptionError

if TYPE_CHECKING:
    from placegraph.core.estimate import PoseEstimate
    from placegraph.indoor.scene_map import SceneMap


def view(
    map_file: MapFile,
    capture: Annotated[
        Path | None,
        Option(help="Capture to localize first; its way and particles are shown."),
    ] = None,
    frames: Frames = None,
    run: Annotated[
        Path | None,
        Option(help="Recorded run to show: `scene localize --record FILE` writes it."),
    ] = None,
    camera_path: CameraPaths = None,
    host: Annotated[
        str, Option(help="Address to listen at; 0.0.0.0 lets other computers look, too.")
    ] = "127.0.0.1",
    port: Annotated[int, Option(help="Port, or the next free one.")] = 8080,
    seed: Seed = 0,
    device: Device = "auto",
    quiet: NoProgress = False,
) -> None:
    """Look at a scene map in the browser; needs `pip install 'placegraph[view]'`.

    Objects can be clicked, listed and hidden, each with its label, attributes and relations;
    relations are drawn by kind. With --capture, or --run of an earlier localization, a slider goes
    through the particles of every frame and pass. The map is only read. Ctrl-C ends it.

    Example: placegraph scene view house.scene --capture walk/ --frames 0:10
    """
    from placegraph.maps import open_scene
    from placegraph.view.viewer.viewer import open_viewer

    if capture is not None and run is not None:
        raise OptionError("--capture and --run both bring particles; give one of them.")
    if frames is not None and capture is None:
        raise OptionError("--frames belongs to --capture; give both.")
    paths = camera_paths(camera_path)
    scene = open_scene(map_file)
    estimate = None
    if run is not None:
        from placegraph.indoor.pose.record import read_run

        estimate = read_run(run)
    elif capture is not None:
        estimate = _localized(scene, capture, frames, seed=seed, device=device, quiet=quiet)
    with open_viewer(scene, camera_paths=paths, run=estimate, host=host, port=port) as viewer:
        click.echo(f"{map_file} at {viewer.address} (Ctrl-C ends it)")
        wait()


def wait() -> None:
    """Return when the user presses Ctrl-C."""
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        return


def _localized(
    scene: SceneMap, folder: Path, frames: str | None, *, seed: int, device: str, quiet: bool
) -> PoseEstimate:
    from placegraph.indoor.options import FilterOptions
    from placegraph.io.capture.capture import open_capture

    chosen = chosen_frames(open_capture(folder), frames)
    with progress_of(hidden=quiet) as tell:
        return scene.localize(
            chosen, options=FilterOptions(record=True), seed=seed, device=device, progress=tell
        )
