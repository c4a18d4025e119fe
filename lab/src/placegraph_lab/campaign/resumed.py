"""A training that is killed again and again ends with the bits of one that was not."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from time import perf_counter

import numpy as np

from placegraph_lab.campaign.row import Effort, Row
from placegraph_lab.campaign.trial import Commands, Ended

OPTIONS = ("--epochs", "4", "--examples", "6", "--steps", "2", "--batch", "3", "--check", "3", "--device",
           "cpu", "--quiet")  # fmt: skip
"""Of a training that takes seconds."""


def resumed(
    inputs: Path, commands: Commands, effort: Effort, rng: np.random.Generator, seconds: float
) -> Iterator[Row]:
    """Kill a training at random moments until it ends, and compare its weights; again and again."""
    try:
        import torch  # noqa: F401
    except ImportError:
        effort.say("PyTorch is not installed: nothing is trained")
        return
    from placegraph.outdoor.network.weights import read_weights

    start, counts = perf_counter(), Counter[str]()
    room = effort.folder / "training"
    room.mkdir()
    first = _trained(inputs, commands, room, "whole", None)
    if first.code:
        effort.say(f"no training: {first.said[-300:]}")
        return
    wanted = read_weights(room / "whole.weights").fingerprint
    while not counts or perf_counter() - start < seconds:
        name = f"killed{counts.total()}"
        for _ in range(12):
            moment = first.seconds * (0.3 + rng.random())
            ended = _trained(inputs, commands, room, name, moment)
            if not ended.killed:
                break
        else:
            ended = _trained(inputs, commands, room, name, None)
        if ended.code:
            counts["untyped" if ended.outcome == "typed" else ended.outcome] += 1
            effort.say(f"a training ended with {ended.code}: {ended.said[-300:]}")
            continue
        same = read_weights(room / f"{name}.weights").fingerprint == wanted
        counts["accepted" if same else "untyped"] += 1
    seconds = perf_counter() - start
    yield Row.counted("faults", "kill -9 of a training, resumed", counts, effort.seed, seconds)


def _trained(
    inputs: Path, commands: Commands, room: Path, name: str, moment: float | None
) -> Ended:
    """Train, and go on where one of that name was killed; kill it after so many seconds."""
    words = (
        "city",
        "train",
        str(inputs / "town.city"),
        "-o",
        f"{name}.weights",
        "--work",
        f"{name}.work",
    )
    running = commands.start((*words, *OPTIONS), room, room)
    if moment is not None:
        running.process.join(moment)
        running.kill()
    return running.end()
