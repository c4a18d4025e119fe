"""Properties of answers outdoors: a town goes elsewhere or gets company, and true things are said in it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from placegraph.core.estimate import CityEstimate, Status
from placegraph.core.geometry import LocalPlane
from placegraph.demo.world import TOWN, unpack
from placegraph.outdoor.city import CityMap
from placegraph.outdoor.language.description import Description
from placegraph.outdoor.likelihood.match_kernels import SLACK, score_views
from placegraph.outdoor.search.candidates import Candidates
from placegraph.outdoor.search.posterior import TOGETHER
from placegraph.outdoor.search.request import Hints, Matching, make_request
from placegraph_lab.campaign import towns
from placegraph_lab.campaign.towns import Motion

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element


Floats = NDArray[np.float64]


OTHER = "marktstadt"
ASKED = 12  # descriptions a trial
_WINDS = ("north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west")


@dataclass(frozen=True)
class Within:
    """How far two answers to one question may lie apart."""

    metres: float  # of the best places, where both are `OK`
    probability: float  # of the best place


SAME = Within(0.01, 1e-6)
GRAIN = Within(5.0, 0.15)
"""Coordinates are rounded anew, to the grain of the map's file, and viewpoints with them."""
RASTER = Within(25.0, 0.4)
"""Viewpoints stand 20 m apart from the map's south-west corner on: they stand elsewhere in the town."""
SURER = 0.1
"""So much surer an answer may become beside another town: a word is rarer among the things of both."""


@dataclass(frozen=True, eq=False)
class Town:
    """The shipped town as an extract and as a city, and another one."""

    extract: Element
    plane: LocalPlane
    city: CityMap
    other: Element
    folder: Path


def drawn(folder: Path) -> Town:
    """Both towns, the first with posts at its corners that fit the raster of viewpoints."""
    world = unpack(folder / "raw")
    extract, other = (towns.read(world / f"{name}.osm") for name in (TOWN, OTHER))
    plane = towns.middle(extract)
    extract = towns.fenced(extract, plane)
    return Town(extract, plane, towns.built(extract, folder), other, folder)


def descriptions(city: CityMap, rng: np.random.Generator) -> list[Description]:
    """True descriptions of places in a city, of two to five statements."""
    found: list[Description] = []
    while len(found) < ASKED:
        things = towns.true_things(city, towns.standing(city, rng))
        if len(things) > 1:
            some = rng.permutation(len(things))[: rng.integers(2, 6)]
            found.append(towns.told(city, [things[i] for i in some]))
    return found


def _moved(town: Town, motion: Motion, rng: np.random.Generator, within: Within) -> str:
    city = towns.built(towns.carried(town.extract, motion), town.folder)
    for told in descriptions(town.city, rng):
        here, there = town.city.locate(told), city.locate(motion.said(told))
        if broken := apart(city, here, there, within, motion):
            return broken
    return ""


def carried(town: Town, rng: np.random.Generator) -> str:
    """A town anywhere on Earth is asked the same."""
    there = LocalPlane(float(rng.uniform(-180.0, 180.0)), float(rng.uniform(-75.0, 75.0)))
    return _moved(town, Motion(np.eye(2), town.plane, there), rng, GRAIN)


def turned_by_quarters(town: Town, rng: np.random.Generator) -> str:
    """Turned by right angles, or mirrored, so that the raster of viewpoints comes upon itself."""
    matrix = towns.turn(rng.integers(4) * np.pi / 2, mirrored=bool(rng.integers(2)))
    return _moved(town, Motion(matrix, town.plane, town.plane), rng, GRAIN)


def turned(town: Town, rng: np.random.Generator) -> str:
    """Turned by any angle, or mirrored, too."""
    matrix = towns.turn(rng.uniform(0.0, 2.0 * np.pi), mirrored=bool(rng.integers(2)))
    return _moved(town, Motion(matrix, town.plane, town.plane), rng, RASTER)


def renumbered(town: Town, rng: np.random.Generator) -> str:
    """The same objects under other numbers, in another order."""
    city = towns.built(towns.renumbered(town.extract, rng), town.folder)
    for told in descriptions(town.city, rng):
        if broken := apart(city, town.city.locate(told), city.locate(told), SAME):
            return broken
    return ""


def reordered(town: Town, rng: np.random.Generator) -> str:
    """The same statements in another order, understood and in words."""
    for told in descriptions(town.city, rng):
        order = rng.permutation(len(told.statements))
        mixed = replace(told, statements=tuple(told.statements[i] for i in order))
        said = _sentences(told)
        texts = " ".join(said), " ".join(said[i] for i in rng.permutation(len(said)))
        for a, b in ((told, mixed), texts):
            if broken := apart(town.city, town.city.locate(a), town.city.locate(b), SAME):
                return f"{broken}: {texts}"
    return ""


def accompanied(town: Town, rng: np.random.Generator) -> str:
    """Another town to the north-east, where nothing was said, makes no answer surer."""
    away = town.plane.to_lonlat(rng.uniform(1500.0, 30_000.0, 2))
    motion = Motion(np.eye(2), towns.middle(town.other), LocalPlane(*away))
    both = towns.beside(town.extract, towns.carried(town.other, motion))
    city = towns.built(both, town.folder)
    for told in descriptions(town.city, rng):
        here, there = town.city.locate(told), city.locate(told)
        before, after = (e.best.probability if e.best else 0.0 for e in (here, there))
        if after > before + SURER:
            return f"{before:.3f} became {after:.3f}"
    return ""


def said_truly(town: Town, rng: np.random.Generator) -> str:
    """One true statement more moves every viewpoint by its own likelihood, and the truth by no less.

    So the rank of the truth falls behind those alone that the statement fits better.
    """
    for told in descriptions(town.city, rng):
        *before, last = told.statements
        alone, some, every = (
            scores(town.city, replace(told, statements=tuple(s)))
            for s in ((last,), before, told.statements)
        )
        off = float(np.abs(every - some - alone).max())
        if off > 2.0 * SLACK:
            return f"{last.text} moved a viewpoint by {off:.2f} nat more than it says"
    return ""


def scores(city: CityMap, told: Description) -> Floats:
    """Log-likelihood ratios (W,) of a description at every viewpoint."""
    asked = make_request(city, told, Hints(), Matching())
    rows = np.arange(len(city.views.positions))
    chosen = Candidates.given(asked, rows)
    return score_views(
        asked.query.statements, city.columns, city.views.columns, asked.words, chosen.rows,
        chosen.bounds, np.zeros(len(rows)), chosen.far, TOGETHER, 1e6,
    )[0].astype(np.float64)  # fmt: skip


def apart(
    city: CityMap,
    here: CityEstimate,
    there: CityEstimate,
    within: Within,
    motion: Motion | None = None,
) -> str:
    """How two answers differ, in words, where they differ by more than they may."""
    if (here.best is None) != (there.best is None):
        return f"{here.status} became {there.status}"
    if here.best is None or there.best is None:
        return ""
    change = there.best.probability - here.best.probability
    if abs(change) > within.probability:
        return f"{here.best.probability:.4f} became {there.best.probability:.4f}"
    if {here.status, there.status} != {Status.OK}:
        return ""
    wanted = np.array((here.best.longitude, here.best.latitude))
    found = np.array((there.best.longitude, there.best.latitude))
    delta = city.plane.to_plane(found) - city.plane.to_plane(
        wanted if motion is None else motion.positions(wanted)
    )
    far = float(np.hypot(*delta))
    return f"{far:.2f} m apart, both OK" if far > within.metres else ""


def _sentences(told: Description) -> list[str]:
    """What is understood, in words; one sentence a kind of thing."""
    said = {}
    for s in told.statements:
        key, _, value = told.mentions[s.source].senses[0].label.partition("=")
        word = (key if value == "yes" else value).replace("_", " ")
        wind = _WINDS[round((s.bearing or 0.0) / (np.pi / 4)) % 8]
        said[word] = f"A {word} is {wind} of me."
    return list(said.values())


TOWNS = (drawn, 1.0, {
    "a town elsewhere on Earth": carried,
    "a town turned by right angles, mirrored": turned_by_quarters,
    "a town turned by any angle, mirrored": turned,
    "objects of a town in another order": renumbered,
    "statements in another order": reordered,
    "an unrelated town makes no answer surer": accompanied,
    "a true statement weighs what the model says": said_truly,
})  # fmt: skip
