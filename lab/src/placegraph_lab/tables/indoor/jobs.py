"""The rows of the indoor benchmark: which map, which labels, which options; and asking for them."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, TypeVar

import typer

from placegraph.indoor.encode import MapEncoder
from placegraph.indoor.encode.labels import ClassesOfInstances, InstancesEncoder
from placegraph.indoor.options import FilterOptions
from placegraph.indoor.scene_map import SceneMap
from placegraph_lab.tables.indoor.label_noise import NoisyEncoder
from placegraph_lab.tables.indoor.metrics import Answer, measure
from placegraph_lab.tables.indoor.windows import HALVES, Window
from placegraph_lab.tables.runner import INDOOR

Labels = Literal["instances", "classes", "none"]

ANSWERING = (*INDOOR, "placegraph_lab/tables/indoor/*.py")
"""Code that decides what the answers are."""
QUICK_EVERY = 13
"""Frames between windows of the house for a first impression."""

SEMANTIC = {
    "semantic": {"semantic": True},
    "semantic + depth": {"semantic": True, "depth": True},
    "semantic + colour": {"semantic": True, "colour": True},
    "all": {"semantic": True, "depth": True, "colour": True},
}
BARE = {
    "depth": {"depth": True},
    "colour": {"colour": True},
    "depth + colour": {"depth": True, "colour": True},
}
TITLES = {
    "instances": "House, instance labels, 30 % of the patches wrong",
    "classes": "House, class labels, 30 % of the patches wrong",
    "none": "House, no labels",
    "b in a": "Office, map of frames 0-185, asked about 186-372",
    "a in b": "Office, map of frames 186-372, asked about 0-185",
}


@dataclass(frozen=True)
class Job:
    """One row of a table, for windows of any length."""

    table: str
    """Key of `TITLES`."""
    row: str
    options: FilterOptions
    map: str
    """`house`, `coarse` or a key of `HALVES`."""
    labels: Labels

    @property
    def name(self) -> str:
        """`instances: semantic + depth`."""
        return f"{self.table}: {self.row}"

    def key(self, window: Window, seed: int, code: str) -> str:
        """What an answer depends on."""
        options = hashlib.sha256(repr(self.options).encode()).hexdigest()[:12]
        return f"{code} {self.map} {self.labels} {options} seed {seed} {window.name}"


def house_jobs() -> list[Job]:
    """Terms and pairs, with all labels and none, and the coarse map."""
    jobs = []
    for labels in ("instances", "classes"):
        jobs += [
            Job(labels, row, FilterOptions().only(**terms), "house", labels)
            for row, terms in SEMANTIC.items()
        ]
    jobs += [
        Job("none", row, FilterOptions().only(**terms), "house", "none")
        for row, terms in BARE.items()
    ]
    for row in ("semantic", "semantic + depth", "all"):
        options = FilterOptions().only(**SEMANTIC[row])
        jobs.append(Job("instances", f"{row}, 20k triangles", options, "coarse", "instances"))
    for row in ("depth + colour", "colour"):
        options = FilterOptions().only(**BARE[row])
        jobs.append(Job("none", f"{row}, 20k triangles", options, "coarse", "none"))
    return jobs


def office_jobs() -> list[Job]:
    """No labels: depth and colour, and each alone."""
    return [
        Job(half, row, FilterOptions().only(**terms), half, "none")
        for half in HALVES
        for row, terms in BARE.items()
    ]


QUICK = (
    "instances: semantic", "instances: semantic + depth", "instances: all", "classes: all",
    "none: depth + colour", "b in a: depth + colour", "a in b: depth + colour",
)  # fmt: skip
"""Rows of a first impression."""


class Named(Protocol):
    """What has a name that rows can be chosen by."""

    @property
    def name(self) -> str:
        """`instances: all`."""


Row = TypeVar("Row", bound=Named)


def chosen(jobs: Iterable[Row], only: Sequence[str]) -> list[Row]:
    """Jobs whose name is, or with a trailing `*` begins with, one of those given; all if none is.

    Refused where no name is.
    """
    there = list(jobs)
    found = [
        j
        for j in there
        if not only
        or any(j.name == o or (o.endswith("*") and j.name.startswith(o[:-1])) for o in only)
    ]
    if not found:
        names = "; ".join(j.name for j in there)
        raise typer.BadParameter(f"no row is named {'; '.join(only)!r}; there are {names}")
    return found


def encoder_of(job: Job, scene: SceneMap, window: Window, seed: int) -> MapEncoder | None:
    """Encoder with the noise model; None without labels."""
    if job.labels == "none":
        return None
    clean = InstancesEncoder(scene) if job.labels == "instances" else ClassesOfInstances(scene)
    return NoisyEncoder(clean, seed=seed, name=window.place)


def ask(
    job: Job, scene: SceneMap, window: Window, *, seed: int = 0, device: str = "auto"
) -> Answer:
    """Localize a window, without refining, and measure the answer."""
    encoder = encoder_of(job, scene, window, seed)
    return answered(scene, window, encoder, job.options, seed=seed, device=device)


def answered(
    scene: SceneMap,
    window: Window,
    encoder: MapEncoder | None,
    options: FilterOptions,
    *,
    seed: int = 0,
    device: str = "auto",
) -> Answer:
    """Localize a window with an encoder of the map, without refining, and measure the answer."""
    start = time.perf_counter()
    estimate = scene.localize(
        window.capture, encoder=encoder, options=options, refine=False, seed=seed, device=device
    )
    seconds = time.perf_counter() - start
    return measure(
        estimate,
        window.truth,
        seconds=seconds,
        frames=len(window.capture),
        window=window.name,
        place=window.place,
        changed=window.changed,
        coverage=window.coverage,
    )
