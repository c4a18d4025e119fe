"""Commands `live`, `bag localize` and `bag layout`."""

from __future__ import annotations

import json
import os
import select
import signal
import sys
import threading
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from placegraph.cli.command import Argument, Option
from placegraph.cli.common import AsJson, Quiet, console, echo_json, progress_of
from placegraph.cli.scene_options import Device, Seed
from placegraph.errors import InputError
from placegraph_io.cli import BagFile

if TYPE_CHECKING:
    from collections.abc import Iterator

    from placegraph.indoor.track.belief import LivePose
    from placegraph_ros.localizer import Localizer, Sink
    from placegraph_ros.options import Summary
    from placegraph_ros.sources import PlaybackClock, WaitPolicy

RoomsFile = Annotated[
    Path, Argument(help="Scene map (.scene), or library of several.", metavar="MAP")
]
RerunFile = Annotated[
    Path | None, Option(help="Write a recording for Rerun (.rrd) as well; extra `rerun`.")
]


def open_sinks(stack: ExitStack, out: Path | None, rerun: Path | None) -> list[Sink]:
    """Open the writers of a bag and of a recording for Rerun."""
    sinks: list[Sink] = []
    if out is not None:
        from placegraph_ros.bag import BagWriter

        sinks.append(stack.enter_context(BagWriter(out)))
    if rerun is not None:
        from placegraph_ros.rerun import RerunWriter

        sinks.append(stack.enter_context(RerunWriter(rerun)))
    return sinks


def show_summary(summary: Summary, written: dict[str, Any], *, as_json: bool) -> None:
    """Print the counts of frames, what is missing, and the files written."""
    if as_json:
        echo_json(summary.to_dict() | written)
        return
    out = console()
    total = sum(summary.told.values())
    shares = ", ".join(f"{n:,} {name} ({n / total:.0%})" for name, n in summary.told.most_common())
    out.print(f"{summary.frames:,} frames: {shares or 'no status'}; {summary.dropped:,} dropped")
    for sentence in summary.notes:
        out.print(f"Note: {sentence}")
    for sentence in summary.lacks:
        out.print(f"Missing: {sentence}")
    for reason, count in summary.left_out.items():
        out.print(f"Left out: {count:,}: {reason}")
    for name, value in written.items():
        out.print(f"{name}: {value}")


_EVERY = 1.0  # seconds between two lines where nothing but the pose has changed


def live(
    map_file: RoomsFile,
    source: Annotated[
        Path,
        Argument(
            help="Bag, complete or still being recorded (.mcap); growing folder of images; or - "
            "for MCAP on standard input."
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
        Option(help="continuous, or once (stop when the pose is known)."),
    ] = "continuous",
    speed: Annotated[
        float, Option(help="Playback speed: 1 is real time, inf is without pauses.")
    ] = 1.0,
    wait: Annotated[
        float,
        Option(help="Stop after this time without new data [s]; 0 stops at once."),
    ] = 10.0,
    seed: Seed = 0,
    device: Device = "auto",
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Localize live: use messages and images as they arrive, and drop images that arrive too fast.

    Prints the camera's pose when the status changes, and every second, from the first one found. In a
    terminal the space bar pauses, + and - change the speed, and q or Ctrl-C ends; Foxglove's buttons
    do the same. A file SOURCE.json (stdin.json) adds what the stream lacks, as for bags.

    Example: placegraph live house.scene walk.mcap --foxglove ws://127.0.0.1:8765
    """
    from placegraph.maps import open_scenes
    from placegraph_ros.localizer import Localizer, run
    from placegraph_ros.options import LiveOptions, mode_of
    from placegraph_ros.sources import PlaybackClock, WaitPolicy, open_source, time_of

    clock, wait_policy = PlaybackClock(speed), WaitPolicy(wait)
    stream = open_source(source, wait_policy)
    with ExitStack() as stack:
        sinks = open_sinks(stack, out, rerun)
        if foxglove is not None:
            from placegraph_ros.foxglove import FoxgloveServer

            server = FoxgloveServer(foxglove, clock, stream.span)
            sinks.append(stack.enter_context(server))
            click.echo(f"Foxglove: open a connection to {server.address}", err=True)
        options = LiveOptions(mode=mode_of(mode), with_inputs=bool(sinks), seed=seed)
        localizer = Localizer(
            open_scenes(map_file), options, plan=stream.plan, name=str(stream.path),
            choice=stream.choice, device=device,
        )  # fmt: skip
        stack.enter_context(listen_to_keys(clock, wait_policy))
        stack.enter_context(stop_on_interrupt(clock, wait_policy))
        lines = _PosePrinter(as_json=as_json, quiet=quiet)
        events = clock.play(stream.events, time_of)
        with suppress(KeyboardInterrupt):  # a second Ctrl-C
            summary = run(events, localizer, sinks, lines)
            if not summary.frames and not clock.stopped:
                why = (*summary.lacks, *summary.left_out, f"{source} contains no frame.")
                raise InputError(why[0])
        written = {name: str(file) for name, file in (("out", out), ("rerun", rerun)) if file}
    if as_json or not quiet:
        show_summary(localizer.summary, written, as_json=as_json)


class _PosePrinter:
    """Printer of the pose when its status changes and every second; as JSON after every image."""

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
        click.echo(json.dumps(pose.to_dict()) if self._as_json else _format_pose(pose))

    def _is_due(self, pose: LivePose, last: LivePose) -> bool:
        changed = pose.status is not last.status
        return self._as_json or changed or abs(pose.stamp - last.stamp) >= _EVERY


def _format_pose(pose: LivePose) -> str:
    """Return the stamp, status, pose and reason in one line."""
    import numpy as np

    head = f"{pose.stamp:.2f}  {pose.status.name:9}"
    if pose.map_from_camera is None or pose.covariance is None:
        return f"{head}  {pose.reason}"
    x, y, z = pose.map_from_camera[:3, 3]
    ahead = pose.map_from_camera[:3, 2]
    yaw = np.degrees(np.arctan2(ahead[1], ahead[0]))
    spread = float(np.sqrt(np.linalg.eigvalsh(pose.covariance[:3, :3])[-1]))
    return f"{head}  {x:.2f}, {y:.2f}, {z:.2f} m  {yaw:.0f} deg  ±{spread:.2f} m  {pose.reason}"


_FASTEST, _SLOWEST = 64.0, 1 / 64


@contextmanager
def stop_on_interrupt(clock: PlaybackClock, wait_policy: WaitPolicy) -> Iterator[None]:
    """End playback between two messages at the first Ctrl-C; raise `KeyboardInterrupt` at the second."""
    before = signal.getsignal(signal.SIGINT)
    main = threading.current_thread() is threading.main_thread()
    if not main or before is signal.SIG_IGN:  # a shell has started it in the background
        yield
        return

    def interrupted(*_: object) -> None:
        signal.signal(signal.SIGINT, before)
        # in a thread: the interrupted code may hold the locks
        threading.Thread(target=handle_key, args=("q", clock, wait_policy)).start()

    signal.signal(signal.SIGINT, interrupted)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def listen_to_keys(clock: PlaybackClock, wait_policy: WaitPolicy) -> Iterator[None]:
    """Listen to keys of a terminal: space pauses, + and - change the speed by two, q ends."""
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
            handle_key(os.read(terminal, 1).decode("ascii", "replace"), clock, wait_policy)

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


def handle_key(key: str, clock: PlaybackClock, wait_policy: WaitPolicy) -> None:
    """Run the action of a key."""
    if key == " ":
        clock.set(paused=not clock.paused)
    elif key in "+=":
        clock.set(speed=min(clock.speed * 2.0, _FASTEST))
    elif key in "-_":
        clock.set(speed=max(clock.speed / 2.0, _SLOWEST))
    elif key in "qQ":
        wait_policy.over.set()
        clock.stop()


def localize(
    bag: BagFile,
    map_file: RoomsFile,
    out: Annotated[
        Path,
        Option("--out", "-o", help="Bag to write: .mcap, .db3, .bag, or a folder for rosbag2."),
    ],
    rerun: RerunFile = None,
    seed: Seed = 0,
    device: Device = "auto",
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Localize all frames of a bag in order, and write the results as a bag.

    The bag holds the pose of the robot's base with covariance, odometry in the map, transforms, a
    particle cloud, the modes, the status with reason and evidence, the objects that agree and
    disagree, the map and the images. `placegraph bag layout OUT` makes a layout for Foxglove.

    Example: placegraph bag localize walk.mcap house.scene -o out.mcap
    """
    from placegraph.maps import open_scenes
    from placegraph_ros.localizer import Localizer, run
    from placegraph_ros.options import LiveOptions
    from placegraph_ros.sources import bag_source

    source = bag_source(bag)
    options = LiveOptions(background=False, seed=seed)
    with ExitStack() as stack:
        sinks = open_sinks(stack, out, rerun)
        localizer = Localizer(open_scenes(map_file), options, plan=source.plan, device=device)
        tell = stack.enter_context(progress_of(hidden=quiet or as_json))

        def report(localizer: Localizer) -> None:
            tell("localizing", localizer.frames, source.frames)

        summary = run(source.events, localizer, sinks, report)
    written = {"out": str(out)} | ({"rerun": str(rerun)} if rerun else {})
    if as_json or not quiet:
        show_summary(summary, written, as_json=as_json)


def layout(bag: BagFile) -> None:
    """Write BAG.layout.json: a layout for Foxglove or Lichtblick, to import there.

    It shows the map, the pose with its covariance, the modes, the objects that agree and disagree, the
    camera's images if BAG holds them, and the status with reason and evidence.

    Example: placegraph bag layout out.mcap
    """
    from placegraph_ros.foxglove import write_layout

    click.echo(f"wrote {write_layout(bag)}")
