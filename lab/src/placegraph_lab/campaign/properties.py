"""What must not change an answer, or must change it in a known way, tried with drawn worlds."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np

from placegraph.errors import PlacegraphError
from placegraph_lab.campaign.processes import PROCESSES
from placegraph_lab.campaign.room_properties import ROOMS
from placegraph_lab.campaign.row import Effort, Row
from placegraph_lab.campaign.town_properties import TOWNS

PART = "properties"


@dataclass(frozen=True)
class Property:
    """A property, and how it is tried once."""

    name: str
    world: Callable[[Path], Any]  # makes what its trials are about, in a folder
    trial: Callable[[Any, np.random.Generator], str]  # in words how it is broken; empty: it holds
    share: float = 1.0  # of the time, against the others


_WORLDS: tuple[tuple[Callable[[Path], Any], float, dict[str, Callable[..., str]]], ...] = (
    TOWNS,
    ROOMS,
    PROCESSES,
)
PROPERTIES = tuple(
    Property(name, world, trial, share)
    for world, share, trials in _WORLDS
    for name, trial in trials.items()
)


def rows(effort: Effort) -> Iterator[Row]:
    """One row a property; each is tried once at least."""
    worlds: dict[object, object] = {}
    whole = sum(p.share for p in PROPERTIES)
    for number, known in enumerate(PROPERTIES):
        if known.world not in worlds:
            folder = effort.folder / f"world{len(worlds)}"
            folder.mkdir(parents=True)
            worlds[known.world] = known.world(folder)
        yield tried(
            known, worlds[known.world], (effort.seed, number), effort.seconds * known.share / whole,
            effort.say,
        )  # fmt: skip


def tried(
    known: Property,
    world: object,
    seed: tuple[int, int],
    seconds: float,
    say: Callable[[str], None] = lambda _: None,
) -> Row:
    """Try a property for so long; trial k draws from ``default_rng((*seed, k))``."""
    found = {"accepted": 0, "untyped": 0}
    start, k = monotonic(), 0
    while not k or monotonic() - start < seconds:
        rng = np.random.default_rng((*seed, k))
        try:
            broken = known.trial(world, rng)
        except PlacegraphError as error:
            broken = f"{type(error).__name__}: {error}"
        found["untyped" if broken else "accepted"] += 1
        if broken:
            say(f"{known.name}, seed {(*seed, k)}: {broken}")
        k += 1
    return Row.counted(PART, known.name, found, seed[0], monotonic() - start)
