"""A walk without end: whether memory stays flat, and what the worst frame takes."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from placegraph.indoor.scene_map import SceneMap
from placegraph_lab.tables.indoor.perturb import Recording
from placegraph_lab.tables.live.paced import quantiles
from placegraph_lab.tables.live.walks import SENSES, Row, Seen, looked_at, looped

DRIFT = 0.5
"""Of odometry [deg a frame]."""
LOOKS = 20
"""Times at which memory is looked at."""


@dataclass(frozen=True)
class Life:
    """A long run."""

    row: Row
    wall: dict[str, float]
    """Milliseconds a frame, odometry of its time included."""
    memory: list[tuple[int, float]]
    """Frames, and what the process holds then [MB], resident."""
    kidnapped: int

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers."""
        own = {"wall_ms": self.wall, "memory": self.memory, "kidnapped": self.kidnapped}
        return self.row.to_dict() | own


def lived(
    scene: SceneMap,
    recordings: Sequence[Recording],
    frames: int,
    seed: int,
    say: Callable[[str], None],
) -> Life:
    """So many frames to and fro along recordings, kidnapped from one to the next, in one tracker."""
    live = scene.live(seed=seed, background=False, options=SENSES)
    seen: list[Seen] = []
    memory, wall = [], []
    endless = looped(recordings, DRIFT, np.random.default_rng(seed))
    for number, (frame, truth, kidnapped) in enumerate(islice(endless, frames)):
        if number % max(1, frames // LOOKS) == 0:
            memory.append((number, resident()))
            say(f"{number} frames, {memory[-1][1]:.0f} MB")
        start = perf_counter()
        samples = [(frame.stamp, frame.odometry)]
        seen.append(looked_at(live, frame, truth, samples, kidnapped=kidnapped and number > 0))
        wall.append(perf_counter() - start)
    memory.append((frames, resident()))
    row = Row.of("house, without end", DRIFT, [seen])
    return Life(row, quantiles(wall), memory, sum(s.kidnapped for s in seen))


def resident() -> float:
    """What this process holds [MB]; NaN where the system does not say."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return float("nan")
    return pages * os.sysconf("SC_PAGE_SIZE") * 1e-6
