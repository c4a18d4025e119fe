"""Extracts turned, mirrored, carried elsewhere, renumbered or in company, and what is said in them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree as ET

import numpy as np

from placegraph.core.estimate import CityEstimate, Status
from placegraph.core.geometry import Floats, LocalPlane
from placegraph.demo.world import TOWN, unpack
from placegraph.outdoor.city import CityMap, build_city
from placegraph.outdoor.language.description import (
    SPEAKER,
    Description,
    Mention,
    Relation,
    Sense,
    Statement,
)
from placegraph.outdoor.likelihood.match_kernels import SLACK, score_views
from placegraph.outdoor.map.index import REACH, STRIDE
from placegraph.outdoor.search.candidates import Candidates
from placegraph.outdoor.search.posterior import TOGETHER
from placegraph.outdoor.search.request import Hints, Matching, make_request

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

KINDS = ("node", "way", "relation")
_SEEN = 24.0  # what is said of lies within so far of who says it [m]


@dataclass(frozen=True, eq=False)
class Motion:
    """An extract's way to elsewhere: about its centre by `matrix` (2, 2), then to `there`."""

    matrix: Floats
    here: LocalPlane
    there: LocalPlane

    def positions(self, lonlat: Floats) -> Floats:
        """Where positions (..., 2) [deg] come to lie [deg]."""
        return self.there.to_lonlat(self.here.to_plane(lonlat) @ self.matrix.T)

    def bearing(self, angle: float) -> float:
        """Where a bearing [rad] comes to point [rad]."""
        east, north = self.matrix @ (np.sin(angle), np.cos(angle))
        return float(np.arctan2(east, north) % (2.0 * np.pi))

    def said(self, told: Description) -> Description:
        """What was said here, as it is true there."""
        statements = tuple(
            s if s.bearing is None else replace(s, bearing=self.bearing(s.bearing))
            for s in told.statements
        )
        return replace(told, statements=statements)


def turn(angle: float, *, mirrored: bool = False) -> Floats:
    """Matrix (2, 2) of a turn by an angle [rad] clockwise, of what was mirrored west to east before."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, s], [-s, c]]) @ np.diag([-1.0 if mirrored else 1.0, 1.0])


def read(path: Path) -> ET.Element:
    """The extract of a file of our own."""
    root = ET.parse(path).getroot()  # noqa: S314  # ships with placegraph, or was drawn here
    for bounds in root.findall("bounds"):
        root.remove(bounds)
    return root


def middle(extract: ET.Element) -> LocalPlane:
    """Plane that touches the Earth at the middle of an extract."""
    lonlat = np.array([_lonlat(node) for node in extract.iter("node")])
    return LocalPlane(*((lonlat.min(axis=0) + lonlat.max(axis=0)) / 2.0))


def carry_extract(extract: ET.Element, motion: Motion) -> ET.Element:
    """A copy of an extract that was moved."""
    copy = ET.fromstring(ET.tostring(extract))  # noqa: S314
    for node in copy.iter("node"):
        longitude, latitude = motion.positions(np.array(_lonlat(node)))
        node.set("lon", f"{longitude:.9f}")
        node.set("lat", f"{latitude:.9f}")
    return copy


def beside(extract: ET.Element, other: ET.Element) -> ET.Element:
    """One extract of two, whose numbers are kept apart."""
    copy, more = (ET.fromstring(ET.tostring(e)) for e in (extract, other))  # noqa: S314
    for thing in more.iter():
        for name in ("id", "ref"):
            if name in thing.attrib:
                thing.set(name, str(1_000_000 + int(thing.attrib[name])))
    copy.extend(list(more))
    return _sorted(copy)


def built(extract: ET.Element, folder: Path) -> CityMap:
    """City of an extract, in an empty file of a folder."""
    stem = next(name for n in count() if not (folder / (name := f"town{n}.osm")).exists())
    ET.ElementTree(extract).write(folder / stem, encoding="utf-8")
    return build_city(folder / stem, (folder / stem).with_suffix(".city"))


def true_things(city: CityMap, view: int) -> list[tuple[int, float]]:
    """Things in sight of a viewpoint, and their bearings [rad]: what could be said there."""
    seen = city.in_sight(np.array([view]))
    away = np.hypot(*seen.offsets.T)
    near = np.flatnonzero((away < _SEEN) & (away > 2.0))
    return [
        (int(i), float(np.arctan2(*delta) % (2.0 * np.pi)))
        for i, delta in zip(seen.objects[near], seen.offsets[near], strict=True)
    ]


def told(city: CityMap, things: list[tuple[int, float]]) -> Description:
    """That each of these things lies in its direction of who speaks."""
    o = city.objects
    mentions = [Mention(0, "me"), Mention(1, "you")]
    statements = []
    for row, bearing in things:
        label = o.label(row)
        word = label.partition("=")[2]
        mentions.append(Mention(len(mentions), word, (Sense(label, 1.0),), definite=False))
        statements.append(
            Statement(
                Relation.DIRECTION,
                len(mentions) - 1,
                SPEAKER,
                bearing=bearing,
                text=f"{word} {row}",
            )
        )
    return Description("", tuple(mentions), tuple(statements))


def _lonlat(node: ET.Element) -> tuple[float, float]:
    return float(node.attrib["lon"]), float(node.attrib["lat"])


def _sorted(extract: ET.Element) -> ET.Element:
    """By kind and number, as files of OpenStreetMap are."""
    root = ET.Element(extract.tag, extract.attrib)
    for kind in KINDS:
        root.extend(sorted(extract.iter(kind), key=lambda thing: int(thing.attrib["id"])))
    return root


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
    extract, other = (read(world / f"{name}.osm") for name in (TOWN, OTHER))
    plane = middle(extract)
    lonlat = np.array([_lonlat(node) for node in extract.iter("node")])
    half = np.abs(plane.to_plane(lonlat)).max(axis=0) + STRIDE
    half = np.ceil((half.max() + REACH) / STRIDE) * STRIDE - REACH - 0.01
    corners = plane.to_lonlat(np.array([(-half, -half), (half, half)]))
    for k, (longitude, latitude) in enumerate(corners):
        node = ET.Element("node", id=str(900_000 + k), version="1")
        node.attrib |= {"lon": f"{longitude:.9f}", "lat": f"{latitude:.9f}"}
        ET.SubElement(node, "tag", k="natural", v="tree")
        extract.append(node)
    extract = _sorted(extract)
    return Town(extract, plane, built(extract, folder), other, folder)


def descriptions(city: CityMap, rng: np.random.Generator) -> list[Description]:
    """True descriptions of places in a city, of two to five statements."""
    found: list[Description] = []
    while len(found) < ASKED:
        every = np.arange(len(city.views.positions))
        rich = np.flatnonzero(np.diff(city.in_sight(every).starts) >= 4)
        things = true_things(city, int(rng.choice(rich)))
        if len(things) > 1:
            some = rng.permutation(len(things))[: rng.integers(2, 6)]
            found.append(told(city, [things[i] for i in some]))
    return found


def _moved(town: Town, motion: Motion, rng: np.random.Generator, within: Within) -> str:
    city = built(carry_extract(town.extract, motion), town.folder)
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
    matrix = turn(rng.integers(4) * np.pi / 2, mirrored=bool(rng.integers(2)))
    return _moved(town, Motion(matrix, town.plane, town.plane), rng, GRAIN)


def turned(town: Town, rng: np.random.Generator) -> str:
    """Turned by any angle, or mirrored, too."""
    matrix = turn(rng.uniform(0.0, 2.0 * np.pi), mirrored=bool(rng.integers(2)))
    return _moved(town, Motion(matrix, town.plane, town.plane), rng, RASTER)


def renumbered(town: Town, rng: np.random.Generator) -> str:
    """The same objects under other numbers, in another order."""
    copy = ET.fromstring(ET.tostring(town.extract))  # noqa: S314
    for kind in KINDS:
        old = [thing.attrib["id"] for thing in copy.iter(kind)]
        new = dict(zip(old, (str(i) for i in rng.permutation(old)), strict=True))
        for thing in copy.iter(kind):
            thing.set("id", new[thing.attrib["id"]])
        inside = copy.iter("nd") if kind == "node" else copy.iter("member")
        for part in inside:
            if part.get("type", "node") == kind:
                part.set("ref", new[part.attrib["ref"]])
    city = built(_sorted(copy), town.folder)
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
    motion = Motion(np.eye(2), middle(town.other), LocalPlane(*away))
    both = beside(town.extract, carry_extract(town.other, motion))
    city = built(both, town.folder)
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
