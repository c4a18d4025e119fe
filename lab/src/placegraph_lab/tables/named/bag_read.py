"""What does reading a bag cost, beside `rosbags` and `mcap` alone? MB/s of each.

A walk through the house, repeated until the bag is large enough, is written in every container and read
by each reader: colour and depth of all frames, opening included.

    placegraph-lab table bag_read
    placegraph-lab table bag_read --quick

Prints Markdown, writes JSON. Times are CPU seconds, the median of interleaved rounds; the page cache is warm.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import median
from time import process_time
from typing import Annotated, Any

import numpy as np

from placegraph.core.geometry import Camera
from placegraph.io.capture.capture import open_capture
from placegraph.io.capture.frame import Capture, Frame
from placegraph_lab.tables.runner import Quick, Run, markdown, number, option, table
from placegraph_lab.worlds.bags import BagWriter, Layout, write_capture
from placegraph_ros.bag import Container

IMAGES = ("/camera/color/image_raw", "/camera/aligned_depth_to_color/image_raw")
AIM = 1.3  # of the CPU time of `rosbags` alone
KINDS: tuple[tuple[str, Container, bool], ...] = (
    ("MCAP", "mcap", False),
    ("MCAP, zstd", "mcap", True),
    ("sqlite", "sqlite3", False),
    ("rosbag1", "rosbag1", False),
)


@dataclass(frozen=True)
class Row:
    """Figures of one container; seconds of CPU."""

    container: str
    megabytes: float  # of the pixels that are read
    frames: int
    open: float  # until there is a capture
    messages: float  # opening, and colour and depth as messages, as `rosbags` gives them
    arrays: float  # opening, and colour and depth as arrays: RGB and metres
    rosbags: float  # `rosbags` alone: opening, and the same messages
    mcap: float | None  # `mcap` with `mcap-ros2-support`; None where it is no MCAP

    @property
    def ratio(self) -> float:
        return self.messages / self.rosbags


@table()
def bag_read(
    run: Run,
    megabytes: Annotated[int, option("Size of each bag.")] = 300,
    rounds: Annotated[int, option("Of which the median counts.")] = 5,
    frames: Annotated[int, option("Of a bag of tiny images, which is opened alone.")] = 13_000,
    *,
    quick: Quick = False,
) -> None:
    """What does reading a bag cost, beside `rosbags` and `mcap` alone? MB/s of each."""
    if quick:
        megabytes, rounds, frames = 40, 3, 1000
    walk = open_capture(run.data / "house/seq00", labels=None)
    with tempfile.TemporaryDirectory() as name:
        rows = [
            measured(repeated(walk, megabytes), kind, Path(name), rounds)
            for kind in run.track(KINDS, "reading")
        ]
        seconds = opened(frames, Path(name), rounds)
    print(report(rows))
    print(f"\nOpening {frames:,} frames, as of 20 GB of VGA: {seconds:.2f} s of CPU time")
    run.save({"rows": [asdict(row) for row in rows], "opened": seconds})


def repeated(walk: Capture, megabytes: float) -> Capture:
    """Frames of a walk, over and over, until their pixels have that many megabytes."""
    frame = walk[0]
    depth = frame.depth()
    each = (frame.rgb().nbytes + (0 if depth is None else depth.size * 2)) / 1e6
    count = max(2, round(megabytes / each))
    frames = (replace(walk[i % len(walk)], stamp=i / 10) for i in range(count))
    return Capture.from_frames(frames)


def measured(capture: Capture, kind: tuple[str, Container, bool], folder: Path, rounds: int) -> Row:
    """Write a bag and read it by every reader."""
    name, container, packed = kind
    path = folder / name.replace(", ", "_").lower()
    path = path.with_suffix(".bag") if container == "rosbag1" else path
    with BagWriter(path, container, packed=packed) as writer:
        write_capture(writer, capture, Layout())
    readers: dict[str, Callable[[], Any]] = {
        "open": lambda: open_capture(path),
        "messages": lambda: ours(path),
        "arrays": lambda: [
            np.asarray(a).nbytes for f in open_capture(path) for a in (f.rgb(), f.depth())
        ],
        "rosbags": lambda: by_rosbags(path),
    }
    if container == "mcap":
        readers["mcap"] = lambda: by_mcap(next(path.glob("*.mcap")))
    seconds: dict[str, list[float]] = {reader: [] for reader in readers}
    for done in range(rounds + 1):
        for reader, read in readers.items():
            start = process_time()
            read()
            if done:  # the first warms the cache, and what is compiled
                seconds[reader].append(process_time() - start)
    taken: dict[str, Any] = {reader: median(times) for reader, times in seconds.items()}
    depth = capture[0].depth()
    each = capture[0].rgb().nbytes + (0 if depth is None else depth.size * 2)
    return Row(name, each * len(capture) / 1e6, len(capture), **{"mcap": None} | taken)


def opened(frames: int, folder: Path, rounds: int) -> float:
    """CPU seconds to open an MCAP of many frames: what counts is their number, not their size."""
    rgb, depth, camera = np.zeros((6, 8, 3), np.uint8), np.ones((6, 8)), Camera(8, 6, 8, 8, 4, 3)
    with BagWriter(folder / "many") as writer:
        held = (Frame.from_arrays(rgb, camera, depth=depth, stamp=i / 30) for i in range(frames))
        write_capture(writer, Capture.from_frames(held), Layout())
    seconds = []
    for _ in range(rounds):
        start = process_time()
        open_capture(folder / "many")
        seconds.append(process_time() - start)
    return median(seconds)


def ours(path: Path) -> int:
    """Open a bag as a capture, and decode the messages of its images; their bytes."""
    from placegraph_io.ros.decode import decoded

    total = 0
    for frame in open_capture(path):
        images: Any = frame.images
        for read in (images.colours, images.metres):
            message, source = read.args[:2]
            total += len(decoded(message, *source).data)
    return total


def by_rosbags(path: Path) -> int:
    """The same by `rosbags` alone."""
    from rosbags.highlevel import AnyReader

    total = 0
    with AnyReader([path]) as reader:
        wanted = [c for c in reader.connections if c.topic in IMAGES]
        for connection, _, raw in reader.messages(wanted):
            message: Any = reader.deserialize(raw, connection.msgtype)
            total += len(message.data)
    return total


def by_mcap(path: Path) -> int:
    """The same by `mcap` and its decoder for ROS 2."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        held = reader.iter_decoded_messages(topics=list(IMAGES))
        return sum(len(message.data) for *_, message in held)


def report(rows: list[Row]) -> str:
    cells = []
    for row in rows:
        speeds = [
            None if taken is None else row.megabytes / taken
            for taken in (row.messages, row.arrays, row.rosbags, row.mcap)
        ]
        cells.append([
            row.container, number(row.megabytes), number(1000 * row.open, 0, "ms"),
            *(number(speed) for speed in speeds), number(row.ratio, 2),
            number(row.arrays / row.rosbags, 2),
        ])  # fmt: skip
    head = [
        "",
        "MB",
        "open",
        "messages",
        "arrays",
        "rosbags",
        "mcap",
        "messages/rosbags",
        "arrays/rosbags",
    ]
    return f"MB/s of CPU time; aim: messages/rosbags at most {AIM}\n\n{markdown(head, cells)}"
