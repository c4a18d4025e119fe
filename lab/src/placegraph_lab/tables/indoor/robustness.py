"""Sets, cases and answers of `indoor_robustness`: what is window, in which map, spoiled in which way."""

from __future__ import annotations

import math
import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path

import numpy as np
from numpy.random import Generator

from placegraph.core.geometry import Floats
from placegraph.errors import PlacegraphError
from placegraph.indoor.build import build_scene
from placegraph.indoor.mapping.from_capture import FromCapture
from placegraph.indoor.options import PoseSearchOptions
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.capture import open_capture
from placegraph_lab.tables.indoor import perturb
from placegraph_lab.tables.indoor.maps import place
from placegraph_lab.tables.indoor.metrics import NEAR, position_error, rotation_error
from placegraph_lab.tables.indoor.perturb import Clip, Recording, half_elsewhere, only
from placegraph_lab.tables.indoor.sg2loc import RPY
from placegraph_lab.tables.indoor.windows import HALVES, OFFICE_STRIDE, TILT, true_poses
from placegraph_lab.worlds.flat.walks import add_drift

THRESHOLDS = ((0.05, 5.0), (0.10, 5.0), (0.25, 2.0), (0.25, 10.0))
"""Position [m] and rotation [deg] that a recall allows."""
SETS = ("house", "office", "freiburg1_rpy")
EVERY = {"house": 5, "office": 9, "freiburg1_rpy": 4}
"""Frames of the recording from the start of a window to the next."""
_RPY_SEED = 5


@dataclass(frozen=True, eq=False)
class MapWindow:
    """One window of a set."""

    map: str  # name of its own map, of `Places.scene`
    clip: Clip
    number: int  # among all windows of the set: even ones may be tuned on, odd ones are held out


@dataclass(frozen=True)
class Outcome:
    """Result of one window."""

    window: str
    number: int
    position: float  # error of the best pose [m]; infinite of none, or where none can be right
    rotation: float  # the same [deg]; infinite
    status: str  # `OK`, `AMBIGUOUS`, `LOST`, or the name of an error
    reason: str
    milliseconds: float  # CPU time a frame; NaN of an error
    agreement: dict[str, float | None] = field(default_factory=dict)
    """Diagnostics of the status (`PoseEstimate.stats`); None for a missing sense."""
    rival: dict[str, float | None] = field(default_factory=dict)
    """The same of the second best pose, where that is wrong."""

    @property
    def right(self) -> bool:
        return self.within(*NEAR)

    def within(self, metres: float, degrees: float) -> bool:
        return self.position <= metres and self.rotation <= degrees


class Places:
    """Maps as users make them, and windows of every set; of the maps only a few are kept open."""

    def __init__(self, data: Path, cache: Path) -> None:
        self.data = data
        self.cache = cache
        self._maps: dict[str, SceneMap] = {}

    def scene(self, name: str) -> SceneMap:
        if name not in self._maps:
            if len(self._maps) > 2:
                self._maps.pop(next(iter(self._maps)))
            self._maps[name] = self._made(name)
        return self._maps[name]

    def _made(self, name: str, detail: str = "default") -> SceneMap:
        what, _, rows = name.partition(" ")
        path = place(self.cache, f"{name}_{detail}".translate(_PLAIN))
        if not path.exists():
            if what == "house":
                build_scene(self.data / "house/map/house.glb", path, detail=detail)
            else:
                low, _, high = rows.partition(":")
                how = FromCapture(frames=slice(int(low), int(high)))
                build_scene(self.data / what, path, capture=how, detail=detail)
        return SceneMap.open(path)

    def recordings(self, name: str) -> dict[str, list[Recording]]:
        if name == "house":
            world = cache(partial(self._made, "house", "full"))
            folders = sorted((self.data / "house").glob("seq[0-9]*"))
            return {
                "house": [
                    Recording(f.name, open_capture(f).frames, true_poses(f), 0.2, world)
                    for f in folders
                ]
            }
        if name == "office":
            return self._office()
        return self._turning()

    def _office(self) -> dict[str, list[Recording]]:
        folder = self.data / "office"
        capture, truth = open_capture(folder), true_poses(folder)
        world = cache(partial(self._made, f"office 0:{len(capture)}", "fine"))
        found = {}
        for half, ((low, high), (first, last)) in HALVES.items():
            rows = slice(first, last)
            of = Recording(f"office {half}", capture.frames[rows], truth[rows], 0.2, world)
            found[f"office {low}:{high}"] = [of]
        return found

    def _turning(self) -> dict[str, list[Recording]]:
        capture = open_capture(self.data / "freiburg1_rpy")
        rng = np.random.default_rng(_RPY_SEED)
        found = {}
        for half, (made, first, last) in RPY.items():
            frames, truth = capture.frames[first:last], capture.odometry[first:last]
            odometry = add_drift(truth, rng)
            gravity = [f.gravity + TILT * rng.standard_normal(3) for f in frames]
            told = [
                replace(f, odometry=pose, gravity=down / np.linalg.norm(down))
                for f, pose, down in zip(frames, odometry, gravity, strict=True)
            ]
            name = f"freiburg1_rpy {made}:{made + 52}"
            found[name] = [Recording(f"rpy, {half}", tuple(told), truth, 7 / 30)]
        return found

    def windows(self, name: str, frames: int) -> list[MapWindow]:
        """All windows of a set."""
        stride = OFFICE_STRIDE if name == "office" else 1
        span = (frames - 1) * stride + 1
        whole = [
            (where, Clip.of(of, range(start, start + span, stride)))
            for where, parts in self.recordings(name).items()
            for of in parts
            for start in range(0, len(of.frames) - span + 1, EVERY[name])
        ]
        return [MapWindow(where, clip, i) for i, (where, clip) in enumerate(whole)]


_PLAIN = str.maketrans({" ": "_", ":": "_"})


def thin_windows(window: list[MapWindow], count: int, family: str) -> list[MapWindow]:
    """At most `count` windows, spread over all, as many even as odd ones.

    Families begin at windows of their own, so that few windows a row are many of a table; what a row
    is compared with, other strengths of its family, asks the same.
    """
    turn = zlib.crc32(family.encode())
    return [a for half in (window[::2], window[1::2]) for a in _spread(half, -(-count // 2), turn)]


def _spread(window: list[MapWindow], most: int, turn: int) -> list[MapWindow]:
    if len(window) <= most:
        return window
    rows = np.linspace(0, len(window), most, endpoint=False).astype(int) + turn % len(window)
    return [window[i] for i in rows % len(window)]


def spoil_window(window: MapWindow, case: Case, other: Recording | None, seed: int) -> Clip:
    """The window as a case has it; the same seed, the same noise."""
    rng = np.random.default_rng([seed, window.number])
    clip = only(window.clip, case.senses) if "labels" in case.senses else window.clip
    if other is not None:
        clip = half_elsewhere(clip, other)
    elif case.make is not None:
        clip = case.make(clip, case.strength, rng)
    return only(clip, case.senses)


def ask(
    scene: SceneMap, window: MapWindow, clip: Clip, case: Case, *, seed: int, device: str
) -> Outcome:
    """Localize as users do, refined, and measure the answer; in a foreign map none is right."""
    options = PoseSearchOptions().only(**{_TERMS[sense]: True for sense in case.senses})
    start = time.process_time()
    try:
        estimate = scene.localize(clip.frames, options=options, seed=seed, device=device)
    except PlacegraphError as error:
        name = type(error).__name__
        return Outcome(clip.name, window.number, math.inf, math.inf, name, str(error), math.nan)
    took = time.process_time() - start
    best, truth = estimate.best, clip.truth[-1]
    known = best is not None and not case.map
    misses = [_off(mode.map_from_camera, truth) for mode in estimate.modes[1:2]]
    return Outcome(
        window=clip.name,
        number=window.number,
        position=position_error(best.map_from_camera, truth) if best and known else math.inf,
        rotation=rotation_error(best.map_from_camera, truth) if best and known else math.inf,
        status=estimate.status.name,
        reason=estimate.reason,
        milliseconds=1000.0 * took / len(clip.frames),
        agreement=dict(estimate.stats.get("trust", {})),
        rival=dict(estimate.stats.get("rival", {})) if case.map or all(misses) else {},
    )


def _off(pose: Floats, truth: Floats) -> bool:
    near = position_error(pose, truth) <= NEAR[0] and rotation_error(pose, truth) <= NEAR[1]
    return not near


_TERMS = {"labels": "semantic", "depth": "depth", "colour": "colour"}
Make = Callable[[Clip, float, Generator], Clip]
FRAMES = 10
BOTH = ("depth", "colour")


@dataclass(frozen=True)
class Case:
    """One row: a set, spoiled in one way by one strength."""

    set: str  # one of `SETS`
    family: str
    strength: float = 0.0
    label: str = ""  # the strength, as it is printed
    make: Make | None = None
    frames: int = FRAMES
    senses: tuple[str, ...] = BOTH
    map: str = ""  # foreign map that is window; empty: its own
    other: str = ""  # set of which half of the images are
    part: str = "spoiled"  # which of the tables: `spoiled`, `senses`, `bad` or `absent`

    @property
    def name(self) -> str:
        return f"{self.set}: {self.family} {self.label}".rstrip()


@dataclass(frozen=True)
class Family:
    """A perturbation, and its three strengths."""

    name: str
    make: Make
    strengths: tuple[float, float, float]
    unit: str = ""
    sets: tuple[str, ...] = SETS

    def cases(self) -> list[Case]:
        return [
            Case(of, self.name, strength, f"{strength:+g}{self.unit}".lstrip("+"), self.make)
            for of in self.sets
            for strength in self.strengths
        ]


RENDERED = ("house", "office")
"""Sets that can be rendered from elsewhere: all that is known of the other stands in one spot."""
SPOILED = (
    Family("camera's height", perturb.height, (0.15, 0.9, 2.3), " m", RENDERED),
    Family("drift", perturb.drift, (0.3, 1.0, 2.0), "° a frame"),
    Family("steady drift", perturb.steady_drift, (0.3, 1.0, 2.0), "° a frame"),
    Family("tilt", perturb.tilt, (1.0, 2.0, 4.0), "°"),
    Family("shaken tilt", perturb.shake_gravity, (1.0, 2.0, 4.0), "°"),
    Family("frames dropped", perturb.drop_frames, (10.0, 30.0, 50.0), " %"),
    Family("rolling stamps", perturb.shift_odometry, (50.0, 100.0, 200.0), " ms"),
    Family("focal length", perturb.focal, (-10.0, 5.0, 10.0), " %"),
    Family("depth scale", perturb.depth_scale, (-10.0, 5.0, 10.0), " %"),
    Family("depth late", perturb.depth_late, (1.0, 2.0, 3.0), " frames"),
    Family("depth aside", perturb.depth_aside, (3.0, 6.0, 12.0), " px"),
    Family("width to height", perturb.crop, (9 / 16, 1.0, 4 / 3)),
    Family("turned", perturb.turn_images, (90.0, 180.0, 270.0), "°"),
    Family("light", perturb.dark, (60.0, 40.0, 20.0), " %"),
    Family("noise", perturb.noise, (10.0, 20.0, 40.0), " of 255"),
    Family("blur", perturb.blur, (1.0, 2.0, 4.0), " px"),
)
BAD: dict[str, Make] = {
    "lens cap": perturb.lens_cap,
    "frozen image": perturb.freeze_images,
    "mirrored": perturb.mirror_images,
    "gravity up": perturb.gravity_up,
    "no odometry": perturb.without_odometry,
    "time backwards": perturb.backwards,
}
OUTSIDE = {"below the floor": -0.6, "above the ceiling": 3.4}
"""Heights of cameras where none can be [m]."""
SENSES = (BOTH, ("depth",), ("colour",))
LENGTHS = (1, 5, 25)
ABSENT = {
    "house": ("office 0:186", "freiburg1_rpy 0:52"),
    "office": ("house", "freiburg1_rpy 0:52"),
    "freiburg1_rpy": ("house", "office 0:186"),
}
"""Maps of places that a set was not taken in."""


def all_cases() -> list[Case]:
    """Return rows of all tables, as they are printed."""
    plain = [Case(of, "as recorded") for of in SETS]
    spoiled = [case for family in SPOILED for case in family.cases()]
    fewer = [
        Case(of, _named(senses), label=f"{n} frame{'s' * (n > 1)}", frames=n, senses=senses,
             part="senses")
        for senses in SENSES for of in SETS for n in (*LENGTHS, FRAMES)
    ]  # fmt: skip
    bad = [Case(of, what, make=make, part="bad") for what, make in BAD.items() for of in SETS]
    others = {of: "office" if of == "house" else "house" for of in SETS}
    bad += [Case(of, "half elsewhere", other=other, part="bad") for of, other in others.items()]
    bad += [
        Case(of, what, metres, make=perturb.height, part="bad")
        for what, metres in OUTSIDE.items() for of in RENDERED
    ]  # fmt: skip
    absent = [
        Case(of, f"in {where}", label=f"{_named(senses)}, {n} frames", frames=n, senses=senses,
             map=where, part="absent")
        for of, places in ABSENT.items() for where in places for senses in SENSES for n in (1, FRAMES)
    ]  # fmt: skip
    return [*plain, *spoiled, *fewer, *bad, *absent]


def _named(senses: tuple[str, ...]) -> str:
    return " and ".join(senses) if len(senses) > 1 else f"{senses[0]} alone"


def quick(cases: list[Case]) -> list[Case]:
    """One strength of each, the middle one; bad input, and absent scenes with both senses."""
    middle = {family.name: family.strengths[1] for family in SPOILED}
    return [
        c
        for c in cases
        if c.strength == middle.get(c.family, c.strength)
        and (c.part != "senses" or c.frames == FRAMES)
        and (c.part != "absent" or (c.frames == FRAMES and c.senses == BOTH))
    ]
