"""`placegraph live`: follow a recording, a folder that fills, or a pipe, as a robot's camera."""

from __future__ import annotations

import json
import os
import select
import signal
import sys
import threading
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click

from placegraph.cli.command import Argument, Option
from placegraph.cli.common import AsJson, Quiet
from placegraph.cli.scene_options import Device, Seed
from placegraph.errors import InputError
from placegraph_ros.cli.following import RerunFile, RoomsFile, carriers, show_summary

if TYPE_CHECKING:
    from collections.abc import Iterator

    from placegraph.indoor.track.live_pose import LivePose
    from placegraph_ros.localizer import Localizer
    from placegraph_ros.pace import Pace
    from placegraph_ros.sources import Patience

_EVERY = 1.0  # seconds between two lines where nothing but the pose has changed


def live(
    map_file: RoomsFile,
    source: Annotated[
        Path,
        Argument(
            help="Bag, whole or still being recorded (.mcap); folder of images that fills; or - for "
            "an MCAP on standard input."
        ),
    ],
    foxglove: Annotated[
        str | None,
        Option(help="Serve the messages to Foxglove, at ws://127.0.0.1:8765; extra `foxglove`."),
    ] = None,
    out: Annotated[
        Path | None, Option("--out", "-o", help="Write a bag, as `bag localize` does.")
    ] = None,
    rerun: RerunFile = None,
    mode: Annotated[
        str,
        Option(help="continuous, or once: images are looked at until the pose is known."),
    ] = "continuous",
    speed: Annotated[float, Option(help="1: as it was recorded; inf: as fast as it comes.")] = 1.0,
    wait: Annotated[
        float,
        Option(help="End when nothing has come for so long [s], where more may come: 0 at once."),
    ] = 10.0,
    seed: Seed = 0,
    device: Device = "auto",
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Localize as if live: messages and images are taken as they come, and dropped where they come too fast.

    A line tells the pose of the camera when the status changes, and every second. In a terminal the
    space bar pauses, + and - change the speed, and q, or Ctrl-C, ends it; Foxglove's buttons do the same.
    What a stream does not say stands in a file beside it, SOURCE.json, as of bags (stdin.json).

    Example: placegraph live house.scene walk.mcap --foxglove ws://127.0.0.1:8765
    """
    from placegraph.maps import open_rooms
    from placegraph_ros.localizer import Localizer
    from placegraph_ros.loop import run
    from placegraph_ros.options import LiveOptions, mode_of
    from placegraph_ros.pace import Pace
    from placegraph_ros.sources import Patience, open_source, time_of

    pace, patience = Pace(speed), Patience(wait)
    from_where = open_source(source, patience)
    with ExitStack() as stack:
        sinks = carriers(stack, out, rerun)
        if foxglove is not None:
            from placegraph_ros.foxglove import FoxgloveServer

            server = FoxgloveServer(foxglove, pace, from_where.span)
            sinks.append(stack.enter_context(server))
            click.echo(f"Foxglove: open a connection to {server.address}", err=True)
        options = LiveOptions(mode=mode_of(mode), whole=bool(sinks), seed=seed)
        localizer = Localizer(
            open_rooms(map_file), options, plan=from_where.plan, name=str(from_where.path),
            wishes=from_where.wishes, device=device,
        )  # fmt: skip
        stack.enter_context(keys(pace, patience))
        stack.enter_context(ending(pace, patience))
        lines = _Lines(as_json=as_json, quiet=quiet)
        paced = pace.paced(from_where.happenings, time_of)
        with suppress(KeyboardInterrupt):  # a second Ctrl-C
            summary = run(paced, localizer, sinks, lines)
            if not summary.frames and not pace.stopped:
                why = (*summary.lacks, *summary.left_out, f"{source} holds no frame.")
                raise InputError(why[0])
        written = {name: str(file) for name, file in (("out", out), ("rerun", rerun)) if file}
    if as_json or not quiet:
        show_summary(localizer.summary, written, as_json=as_json)


class _Lines:
    """Prints the pose when its status changes, and every second; as JSON whenever an image has told it."""

    def __init__(self, *, as_json: bool, quiet: bool) -> None:
        self._as_json, self._quiet = as_json, quiet
        self._last: LivePose | None = None

    def __call__(self, localizer: Localizer) -> None:
        pose, last = localizer.tracker.pose(), self._last
        if pose.estimate is None or self._quiet:
            return
        if last is not None and (pose.estimate is last.estimate or not self._is_due(pose, last)):
            return
        self._last = pose
        click.echo(json.dumps(pose.to_dict()) if self._as_json else _line(pose))

    def _is_due(self, pose: LivePose, last: LivePose) -> bool:
        changed = pose.status is not last.status
        return self._as_json or changed or abs(pose.stamp - last.stamp) >= _EVERY


def _line(pose: LivePose) -> str:
    """Stamp, status, pose and reason in one line."""
    import numpy as np

    said = f"{pose.stamp:.2f}  {pose.status.name:9}"
    if pose.map_from_camera is None or pose.covariance is None:
        return f"{said}  {pose.reason}"
    x, y, z = pose.map_from_camera[:3, 3]
    ahead = pose.map_from_camera[:3, 2]
    yaw = np.degrees(np.arctan2(ahead[1], ahead[0]))
    spread = float(np.sqrt(np.linalg.eigvalsh(pose.covariance[:3, :3])[-1]))
    return f"{said}  {x:.2f}, {y:.2f}, {z:.2f} m  {yaw:.0f} deg  ±{spread:.2f} m  {pose.reason}"


_FASTEST, _SLOWEST = 64.0, 1 / 64


@contextmanager
def ending(pace: Pace, patience: Patience) -> Iterator[None]:
    """The first Ctrl-C ends what plays as `q` does, between two messages: what is written of it is whole.

    The second is a `KeyboardInterrupt`, wherever it falls.
    """
    before = signal.getsignal(signal.SIGINT)
    main = threading.current_thread() is threading.main_thread()
    if not main or before is signal.SIG_IGN:  # a shell has started it in the background
        yield
        return

    def interrupted(*_: object) -> None:
        signal.signal(signal.SIGINT, before)
        # whoever was interrupted may hold the locks that this needs
        threading.Thread(target=pressed, args=("q", pace, patience)).start()

    signal.signal(signal.SIGINT, interrupted)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def keys(pace: Pace, patience: Patience) -> Iterator[None]:
    """Space pauses, + and - change the speed by two, q ends; without a terminal, nothing does."""
    if not (sys.stdin.isatty() and threading.current_thread() is threading.main_thread()):
        yield
        return
    import termios
    import tty

    terminal = sys.stdin.fileno()
    before = termios.tcgetattr(terminal)
    read, write = os.pipe()

    def listen() -> None:
        while read not in select.select([terminal, read], [], [])[0]:
            pressed(os.read(terminal, 1).decode("ascii", "replace"), pace, patience)

    listener = threading.Thread(target=listen, daemon=True)
    tty.setcbreak(terminal)
    try:
        listener.start()
        yield
    finally:
        os.write(write, b".")
        listener.join()
        os.close(read)
        os.close(write)
        termios.tcsetattr(terminal, termios.TCSADRAIN, before)


def pressed(key: str, pace: Pace, patience: Patience) -> None:
    """Do what a key stands for."""
    if key == " ":
        pace.set(paused=not pace.paused)
    elif key in "+=":
        pace.set(speed=min(pace.speed * 2.0, _FASTEST))
    elif key in "-_":
        pace.set(speed=max(pace.speed / 2.0, _SLOWEST))
    elif key in "qQ":
        patience.over.set()
        pace.stop()
