"""By the clock: images and odometry at a rate each, as a robot has them, on two cores."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from time import perf_counter, process_time
from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph.core.geometry import Floats
from placegraph.indoor.scene_map import SceneMap
from placegraph.indoor.track.odometry import Odometry
from placegraph.io.capture.frame import ArrayImages, Frame
from placegraph_lab.tables.indoor.robustness import Places
from placegraph_lab.tables.live.walks import SENSES, looped

if TYPE_CHECKING:
    from placegraph.indoor.track.live import LiveTracker

ODOMETRY = 100.0
"""Samples a second."""


@dataclass(frozen=True)
class Clock:
    """Tells and waits; a fake one makes tests quick."""

    start: float

    def now(self) -> float:
        """Seconds since the start."""
        return time.perf_counter() - self.start

    def until(self, when: float) -> None:
        """Wait until so many seconds after the start."""
        time.sleep(max(0.0, when - self.now()))


def paced(data: Path, cache: Path, path: Path, rate: float, seconds: float) -> dict[str, Any]:
    """Play walks of the house with images at a rate [Hz], and odometry at 100 Hz, in a fresh process."""
    recordings = Places(data, cache).recordings("house")["house"]
    endless = looped(recordings, 0.0, np.random.default_rng(0))
    every = islice(endless, int(rate * seconds))
    frames = [_read(replace(f, stamp=i / rate)) for i, (f, _, _) in enumerate(every)]
    with SceneMap.open(path).live(options=SENSES) as live:
        for frame in frames[:8]:  # compiled code, and the table
            live.step(frame)
        live.lose()
        spent = process_time()
        told = play(live, frames, frames[7].stamp + 100.0, Clock(perf_counter()))
        spent = process_time() - spent
        live.wait()
        return {"rate": rate, "cores": spent / told["seconds"], "dropped": live.dropped} | told


def _read(frame: Frame) -> Frame:
    """The frame with its images in memory: a camera needs no files."""
    return replace(frame, images=ArrayImages(frame.rgb(), frame.depth(), frame.labels()))


def play(live: LiveTracker, frames: list[Frame], base: float, clock: Clock) -> dict[str, Any]:
    """Give images and odometry when their time has come; what each call took, and how old poses were."""
    calls, ages, behind = [], [], []
    coming = iter(frames)
    image = next(coming)
    for stamp, pose in wheels(frames):
        clock.until(stamp)
        start = clock.now()
        told = live.move(base + stamp, pose)
        calls.append(clock.now() - start)
        behind.append(start - stamp)
        if told.map_from_camera is not None:
            ages.append(told.age)
        if image.stamp <= stamp:
            live.see(replace(image, stamp=base + image.stamp))
            image = next(coming, replace(image, stamp=np.inf))
    return {
        "seconds": frames[-1].stamp, "images": len(frames), "moves": len(calls),
        "with_pose": len(ages), "move_ms": quantiles(calls), "age_ms": quantiles(ages),
        "behind_ms": quantiles(behind),
    }  # fmt: skip


def wheels(frames: list[Frame]) -> Iterator[tuple[float, Floats]]:
    """Odometry of frames at 100 Hz."""
    odometry = Odometry()
    odometry.tell(frames[0].stamp, frames[0].odometry)
    count = 0
    for frame in frames[1:]:
        odometry.tell(frame.stamp, frame.odometry)
        while (stamp := count / ODOMETRY) <= frame.stamp:
            sample = odometry.at(stamp)
            assert sample is not None  # noqa: S101  of the last step
            yield stamp, sample.pose
            count += 1


def quantiles(seconds: list[float]) -> dict[str, float]:
    """Median, 95 and 99 % and the most, in milliseconds; nothing of nothing."""
    if not seconds:
        return {}
    found = 1e3 * np.percentile(seconds, [50, 95, 99, 100])
    return dict(zip(("p50", "p95", "p99", "most"), found.round(3).tolist(), strict=True))
