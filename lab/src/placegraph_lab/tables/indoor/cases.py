"""Rows of `indoor_robustness`: every perturbation at three strengths, bad input, absent scenes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from numpy.random import Generator

from placegraph_lab.tables.indoor import perturb, perturb_images
from placegraph_lab.tables.indoor.perturb import Shot
from placegraph_lab.tables.indoor.robustness import SETS

Make = Callable[[Shot, float, Generator], Shot]


FRAMES = 10
BOTH = ("depth", "colour")


@dataclass(frozen=True)
class Case:
    """One row: a set, spoiled in one way by one strength."""

    set: str
    """One of `SETS`."""
    family: str
    strength: float = 0.0
    told: str = ""
    """The strength, as it is printed."""
    make: Make | None = None
    frames: int = FRAMES
    senses: tuple[str, ...] = BOTH
    map: str = ""
    """Foreign map that is asked; empty: its own."""
    other: str = ""
    """Set of which half of the images are."""
    part: str = "spoiled"
    """Which of the tables: `spoiled`, `senses`, `bad` or `absent`."""

    @property
    def name(self) -> str:
        """`house: drift 1° a frame`."""
        return f"{self.set}: {self.family} {self.told}".rstrip()


@dataclass(frozen=True)
class Family:
    """A perturbation, and its three strengths."""

    name: str
    make: Make
    strengths: tuple[float, float, float]
    unit: str = ""
    sets: tuple[str, ...] = SETS

    def cases(self) -> list[Case]:
        """Rows of all sets."""
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
    Family("shaken tilt", perturb.shaken, (1.0, 2.0, 4.0), "°"),
    Family("frames dropped", perturb.dropped, (10.0, 30.0, 50.0), " %"),
    Family("rolling stamps", perturb.rolling, (50.0, 100.0, 200.0), " ms"),
    Family("focal length", perturb.focal, (-10.0, 5.0, 10.0), " %"),
    Family("depth scale", perturb.depth_scale, (-10.0, 5.0, 10.0), " %"),
    Family("depth late", perturb.depth_late, (1.0, 2.0, 3.0), " frames"),
    Family("depth aside", perturb.depth_aside, (3.0, 6.0, 12.0), " px"),
    Family("width to height", perturb.crop, (9 / 16, 1.0, 4 / 3)),
    Family("turned", perturb.turned, (90.0, 180.0, 270.0), "°"),
    Family("light", perturb_images.dark, (60.0, 40.0, 20.0), " %"),
    Family("noise", perturb_images.noise, (10.0, 20.0, 40.0), " of 255"),
    Family("blur", perturb_images.blur, (1.0, 2.0, 4.0), " px"),
)
BAD: dict[str, Make] = {
    "lens cap": perturb_images.lens_cap,
    "frozen image": perturb_images.frozen,
    "mirrored": perturb_images.mirrored,
    "gravity up": perturb_images.gravity_up,
    "time backwards": perturb_images.backwards,
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
    """Rows of all tables, as they are printed."""
    plain = [Case(of, "as recorded") for of in SETS]
    spoiled = [case for family in SPOILED for case in family.cases()]
    return [*plain, *spoiled, *_senses(), *_bad(), *_absent()]


def _senses() -> list[Case]:
    return [
        Case(of, _named(senses), told=f"{n} frame{'s' * (n > 1)}", frames=n, senses=senses,
             part="senses")
        for senses in SENSES
        for of in SETS
        for n in (*LENGTHS, FRAMES)
    ]  # fmt: skip


def _bad() -> list[Case]:
    found = [Case(of, what, make=make, part="bad") for what, make in BAD.items() for of in SETS]
    found += [
        Case(of, "half elsewhere", other="office" if of == "house" else "house", part="bad")
        for of in SETS
    ]
    return found + [
        Case(of, what, metres, make=perturb.height, part="bad")
        for what, metres in OUTSIDE.items()
        for of in RENDERED
    ]


def _absent() -> list[Case]:
    return [
        Case(of, f"in {where}", told=f"{_named(senses)}, {n} frames", frames=n, senses=senses,
             map=where, part="absent")
        for of, places in ABSENT.items()
        for where in places
        for senses in SENSES
        for n in (1, FRAMES)
    ]  # fmt: skip


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
