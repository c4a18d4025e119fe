"""Table `bag_read`: what does reading a bag cost, beside `rosbags` and `mcap` alone? MB/s of each.

A walk through the house, repeated until the bag is large enough, is written in every container and read
by each reader: colour and depth of all frames, opening included.

Times are CPU seconds, the median of interleaved rounds; the page cache is warm.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from statistics import median
from time import process_time
from typing import Any

import numpy as np

from placegraph.io.capture.capture import open_capture
from placegraph.io.capture.frame import Capture
from placegraph_io.ros.decode import decode_message
from placegraph_lab.tables.runner import Column as Col
from placegraph_lab.tables.runner import Quick, Run, render, table
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


def _speed(reader: str) -> Col:
    return Col(reader, lambda r: r[reader] and r["megabytes"] / r[reader], 0)


def _ratio(reader: str) -> Col:
    return Col(f"{reader}/rosbags", lambda r: r[reader] / r["rosbags"], 2)


COLUMNS = (
    Col("", "container"), Col("MB", "megabytes", 0), Col("open", "open", 0, "ms", 1e3),
    *map(_speed, ("messages", "arrays", "rosbags", "mcap")), *map(_ratio, ("messages", "arrays")),
)  # fmt: skip


@table()
def bag_read(
    run: Run,
    *,
    quick: Quick = False,
) -> None:
    """Read rates of bags [MB/s], beside `rosbags` and `mcap` alone."""
    # Size of each bag, and rounds of which the median counts
    megabytes, rounds = (40, 3) if quick else (300, 5)
    walk = open_capture(run.data / "house/seq00", labels=None)
    with tempfile.TemporaryDirectory() as name:
        rows = [
            time_container(repeat(walk, megabytes), kind, Path(name), rounds)
            for kind in run.track(KINDS, "reading")
        ]
    print(f"MB/s of CPU time; aim: messages/rosbags at most {AIM}\n\n{render(COLUMNS, rows)}")
    run.save({"rows": rows})


def repeat(walk: Capture, megabytes: float) -> Capture:
    """Frames of a walk, over and over, until their pixels have that many megabytes."""
    count = max(2, round(megabytes / frame_megabytes(walk)))
    frames = (replace(walk[i % len(walk)], stamp=i / 10) for i in range(count))
    return Capture.from_frames(frames)


def frame_megabytes(walk: Capture) -> float:
    depth = walk[0].depth()
    return (walk[0].rgb().nbytes + (0 if depth is None else depth.size * 2)) / 1e6


def time_container(
    capture: Capture, kind: tuple[str, Container, bool], folder: Path, rounds: int
) -> dict[str, Any]:
    """Write a bag and read it by every reader; CPU seconds, None of `mcap` where it is no MCAP."""
    name, container, packed = kind
    path = folder / name.replace(", ", "_").lower()
    path = path.with_suffix(".bag") if container == "rosbag1" else path
    with BagWriter(path, container, packed=packed) as writer:
        write_capture(writer, capture, Layout())
    readers: dict[str, Callable[[], Any]] = {
        "open": lambda: open_capture(path),
        "messages": lambda: read_messages(path),
        "arrays": lambda: [
            np.asarray(a).nbytes for f in open_capture(path) for a in (f.rgb(), f.depth())
        ],
        "rosbags": lambda: read_by_rosbags(path),
    }
    if container == "mcap":
        readers["mcap"] = lambda: read_by_mcap(next(path.glob("*.mcap")))
    seconds: dict[str, list[float]] = {reader: [] for reader in readers}
    for done in range(rounds + 1):
        for reader, read in readers.items():
            start = process_time()
            read()
            if done:  # the first warms the cache, and what is compiled
                seconds[reader].append(process_time() - start)
    row = {"container": name, "megabytes": len(capture) * frame_megabytes(capture)}
    row |= {"frames": len(capture), "mcap": None}
    return row | {reader: median(times) for reader, times in seconds.items()}


def read_messages(path: Path) -> int:
    """Open a bag as a capture, and decode the messages of its images; their bytes."""
    total = 0
    for frame in open_capture(path):
        images: Any = frame.images
        for read in (images.colours, images.metres):
            message, source = read.args[:2]
            total += len(decode_message(message, *source).data)
    return total


def read_by_rosbags(path: Path) -> int:
    from rosbags.highlevel import AnyReader

    with AnyReader([path]) as reader:
        wanted = [c for c in reader.connections if c.topic in IMAGES]
        messages: Any = (
            reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages(wanted)
        )
        return sum(len(message.data) for message in messages)


def read_by_mcap(path: Path) -> int:
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        messages = reader.iter_decoded_messages(topics=list(IMAGES))
        return sum(len(message.data) for *_, message in messages)
