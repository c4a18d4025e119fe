"""The benchmark's noise model of labels: what a real encoder gets wrong, in one documented way.

Each patch that says something is, independently of all others and with probability `share`, made to
say something else: with instance labels another object of the map, with class labels another class
of the map, each of the others equally likely. `NoisyLabels` does that where there is no map: its
other labels are those of a vocabulary. Patches that say nothing go on saying nothing.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar
from zlib import crc32

import numpy as np
import typer
from numpy.typing import NDArray

from placegraph.errors import OptionError
from placegraph.indoor.encode import MapEncoder, Patches
from placegraph.indoor.encode.labels import ClassesOfInstances, InstancesEncoder, LabelsEncoder
from placegraph.indoor.options import PoseSearchOptions
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.frame import Frame
from placegraph_lab.tables.indoor import maps as indoor_maps
from placegraph_lab.tables.indoor.metrics import Answer, measure
from placegraph_lab.tables.indoor.windows import (
    HALVES,
    Window,
    house_windows,
    measure_coverage,
    office_windows,
)

SHARE = 0.3
_SAME = 1e-5  # cosines nearer to 1 are of one label


class NoisyEncoder:
    """An encoder that mislabels patches of another one with a probability `share`.

    The noise of a frame depends on `seed`, the `name` of the sequence and the frame's row alone: it
    is the same in every pass and in every window that holds the frame.
    """

    def __init__(
        self, encoder: MapEncoder, share: float = SHARE, *, seed: int = 0, name: str = ""
    ) -> None:
        self.encoder, self.share = encoder, share
        self._seed = (seed, crc32(name.encode()))

    def encode(self, frame: Frame) -> Patches | None:
        """Patches of a frame, some of them wrong; None where the encoder has none."""
        patches = self.encoder.encode(frame)
        if patches is None:
            return None
        rng = np.random.default_rng([*self._seed, frame.index])
        return mislabel(patches, self.share, rng)


def mislabel(patches: Patches, share: float, rng: np.random.Generator) -> Patches:
    """Replace a share of the patches' rows by others of the table, each equally likely."""
    count = len(patches.table)
    wrong = rng.random(len(patches.rows)) < share
    step = rng.integers(1, max(count, 2), len(patches.rows))
    wrong &= (patches.rows >= 0) & (count > 1)
    rows = np.where(wrong, (patches.rows + step) % max(count, 1), patches.rows)
    return replace(patches, rows=rows.astype(np.int32))


class NoisyLabels:
    """An encoder of labels that mislabels patches, each as another label of a vocabulary.

    Which label a patch gets does not depend on any map. Synonyms are one label; labels without a
    vector are left out. `share`, `seed` and `name` are those of `NoisyEncoder`.
    """

    def __init__(
        self,
        encoder: LabelsEncoder,
        vocabulary: Iterable[str],
        share: float = SHARE,
        *,
        seed: int = 0,
        name: str = "",
    ) -> None:
        self.encoder, self.share = encoder, share
        self._seed = (seed, crc32(name.encode()))
        known = {v.tobytes(): v for v in map(encoder.vector, vocabulary) if v.any()}
        if len(known) < 2:
            raise OptionError("vocabulary: noise needs two labels at least that have a vector.")
        self.vectors = np.stack(list(known.values()))
        """(L, d) of the labels that a patch can be taken for."""
        self.name, self.key = encoder.name, encoder.key
        self.dimension, self.temperature = encoder.dimension, encoder.temperature
        self.camera, self.objects = encoder.camera, encoder.objects

    def patches(self, image: Frame) -> NDArray[np.float32] | None:
        """Vectors (rows, columns, d) of a frame's patches, some of them wrong."""
        clean = self.encoder.patches(image)
        if clean is None:
            return None
        rng = np.random.default_rng([*self._seed, image.index])
        flat = clean.reshape(-1, self.dimension)
        wrong = (rng.random(len(flat)) < self.share) & flat.any(axis=1)
        cosines = flat @ self.vectors.T
        count = len(self.vectors)
        # counted on from its own label, or from any where that is not in the vocabulary
        known = cosines.max(axis=1) > 1 - _SAME
        own = np.where(known, cosines.argmax(axis=1), rng.integers(count, size=len(flat)))
        step = rng.integers(1, count, len(flat))
        other = self.vectors[(own + step) % count]
        return np.where(wrong[:, None], other, flat).reshape(clean.shape)


QUICK_EVERY = 13  # frames between windows of the house for a first impression

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
OFFICE = {
    "b in a": "Office, map of frames 0-185, asked about 186-372",
    "a in b": "Office, map of frames 186-372, asked about 0-185",
}
TITLES = {
    "instances": "House, instance labels, 30 % of the patches wrong",
    "classes": "House, class labels, 30 % of the patches wrong",
    "none": "House, no labels",
    **OFFICE,
}


@dataclass(frozen=True)
class Job:
    """One row of a table, for windows of any length."""

    table: str  # key of `TITLES`
    row: str
    options: PoseSearchOptions
    map: str  # `house` or a key of `HALVES`
    labels: (
        str  # how patches are encoded: `instances`, `classes`, `none`; `indoor_semantics` has more
    )

    @property
    def name(self) -> str:
        return f"{self.table}: {self.row}"

    @property
    def place(self) -> str:
        return self.table

    def key(self, window: Window, seed: int, code: str) -> str:
        """Name all that an answer depends on."""
        options = hashlib.sha256(repr(self.options).encode()).hexdigest()[:12]
        return f"{code} {self.map} {self.labels} {options} seed {seed} {window.name}"


def house_jobs() -> list[Job]:
    """Return rows of terms and pairs, with all labels and none."""

    def jobs(labels: str, rows: Iterable[str]) -> list[Job]:
        terms = SEMANTIC | BARE
        return [
            Job(labels, row, PoseSearchOptions().only(**terms[row]), "house", labels)
            for row in rows
        ]

    return [*jobs("instances", SEMANTIC), *jobs("classes", SEMANTIC), *jobs("none", BARE)]


def office_jobs() -> list[Job]:
    return [
        Job(half, row, PoseSearchOptions().only(**terms), half, "none")
        for half in HALVES
        for row, terms in BARE.items()
    ]


QUICK = (
    "instances: semantic", "instances: semantic + depth", "instances: all", "classes: all",
    "none: depth + colour", "b in a: depth + colour", "a in b: depth + colour",
)  # fmt: skip
"""Rows of a first impression."""
Row = TypeVar("Row", bound=Any)  # has a `name`


def choose_jobs(jobs: Iterable[Row], only: Sequence[str]) -> list[Row]:
    """Jobs whose name is, or with a trailing `*` begins with, one of those given; all if none is.

    Refused where no name is.
    """
    there = list(jobs)
    found = [
        j for j in there
        if not only or any(j.name == o or (o[-1:] == "*" and j.name.startswith(o[:-1])) for o in only)
    ]  # fmt: skip
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
    return localize(scene, window, encoder, job.options, seed=seed, device=device)


def localize(
    scene: SceneMap,
    window: Window,
    encoder: MapEncoder | None,
    options: PoseSearchOptions,
    *,
    seed: int = 0,
    device: str = "auto",
) -> Answer:
    """Localize a window with an encoder of the map, without refining, and measure the answer."""
    start = time.perf_counter()
    estimate = scene.localize(
        window.capture, encoder=encoder, options=options, refine=False, seed=seed, device=device
    )
    return measure(estimate, window.truth, seconds=time.perf_counter() - start, **window.fields)


class Bench:
    """Maps and windows by name; of the maps only the last is kept.

    `data` has `house` and `office`, maps go to `cache`; `every` and `office_every` frames lie between
    the starts of two windows.
    """

    def __init__(self, data: Path, cache: Path, every: int, office_every: int) -> None:
        self.data, self.cache = data, cache
        self.every, self.office_every = every, office_every
        self._maps: dict[str, SceneMap] = {}
        self._windows: dict[tuple[str, int], list[Window]] = {}

    def scene(self, name: str) -> SceneMap:
        """Map `house`, or one of a key of `HALVES`."""
        if name not in self._maps:
            self._maps.clear()
            if name in HALVES:
                made = indoor_maps.office(self.data, self.cache, name)
            else:
                made = indoor_maps.house(self.data, self.cache)
            self._maps[name] = made
        return self._maps[name]

    def windows(self, place: str, length: int) -> list[Window]:
        """Windows of a length of the house, or of the half of the office that a key of `HALVES` asks.

        Of the office it is measured how much of them the map covers.
        """
        place = place if place in HALVES else "house"
        if (place, length) not in self._windows:
            if place in HALVES:
                folder = self.data / "office"
                made = office_windows(folder, place, length=length, every=self.office_every)
                made = [measure_coverage(self.scene(place), w) for w in made]
            else:
                made = house_windows(self.data / "house", length, every=self.every)
            self._windows[place, length] = made
        return self._windows[place, length]
