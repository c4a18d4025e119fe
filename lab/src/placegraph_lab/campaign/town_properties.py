"""Metamorphic properties outdoors: towns moved, mirrored, renumbered or beside another town."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from placegraph.core.estimate import CityEstimate, Status
from placegraph.core.geometry import Floats, LocalPlane
from placegraph.demo.town import TOWN, unpack
from placegraph.outdoor.city import CityMap, build_city
from placegraph.outdoor.language.description import (
    SPEAKER,
    Description,
    Mention,
    Relation,
    Sense,
    Statement,
)
from placegraph.outdoor.likelihood.match_kernels import BOUND_SLACK, score_views
from placegraph.outdoor.map.index import REACH, STRIDE
from placegraph.outdoor.search.posterior import PRIOR_COHERENT, Candidates
from placegraph.outdoor.search.request import Hints, Matching, make_request

KINDS = ("node", "way", "relation")
_SEEN = 24.0  # farthest object of a description [m]


@dataclass(frozen=True, eq=False)
class Motion:
    """Motion of an extract: about its centre by `matrix` (2, 2), then to `there`."""

    matrix: Floats
    here: LocalPlane
    there: LocalPlane

    def positions(self, lonlat: Floats) -> Floats:
        """Return the moved positions (..., 2) [deg]."""
        return self.there.to_lonlat(self.here.to_plane(lonlat) @ self.matrix.T)

    def bearing(self, angle: float) -> float:
        """Return the moved bearing [rad]."""
        east, north = self.matrix @ (np.sin(angle), np.cos(angle))
        return float(np.arctan2(east, north) % (2.0 * np.pi))

    def describe(self, description: Description) -> Description:
        """Return the description that is true after the motion."""
        statements = tuple(
            s if s.bearing is None else replace(s, bearing=self.bearing(s.bearing))
            for s in description.statements
        )
        return replace(description, statements=statements)


def turn_matrix(angle: float, *, mirrored: bool = False) -> Floats:
    """Return the matrix (2, 2) that mirrors west to east, if asked, then turns clockwise [rad]."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, s], [-s, c]]) @ np.diag([-1.0 if mirrored else 1.0, 1.0])


def read_extract(path: Path) -> ET.Element:
    """Read an extract without its bounds."""
    root = ET.parse(path).getroot()  # noqa: S314  # ships with placegraph, or was drawn here
    for bounds in root.findall("bounds"):
        root.remove(bounds)
    return root


def find_centre(extract: ET.Element) -> LocalPlane:
    """Return the local plane at the centre of an extract."""
    lonlat = np.array([_lonlat(node) for node in extract.iter("node")])
    return LocalPlane(*((lonlat.min(axis=0) + lonlat.max(axis=0)) / 2.0))


def carry_extract(extract: ET.Element, motion: Motion) -> ET.Element:
    """Return a moved copy of an extract."""
    copy = ET.fromstring(ET.tostring(extract))  # noqa: S314
    for node in copy.iter("node"):
        longitude, latitude = motion.positions(np.array(_lonlat(node)))
        node.set("lon", f"{longitude:.9f}")
        node.set("lat", f"{latitude:.9f}")
    return copy


def merge_extracts(extract: ET.Element, other: ET.Element) -> ET.Element:
    """Merge two extracts; ids of the second are shifted."""
    copy, more = (ET.fromstring(ET.tostring(e)) for e in (extract, other))  # noqa: S314
    for thing in more.iter():
        for name in ("id", "ref"):
            if name in thing.attrib:
                thing.set(name, str(1_000_000 + int(thing.attrib[name])))
    copy.extend(list(more))
    return _sorted(copy)


def build_extract(extract: ET.Element, folder: Path) -> CityMap:
    """Build the city of an extract in a new file of a folder."""
    stem = next(name for n in count() if not (folder / (name := f"town{n}.osm")).exists())
    ET.ElementTree(extract).write(folder / stem, encoding="utf-8")
    return build_city(folder / stem, (folder / stem).with_suffix(".city"))


def find_visible(city: CityMap, view: int) -> list[tuple[int, float]]:
    """Return the objects visible from a viewpoint, and their bearings [rad]."""
    seen = city.in_sight(np.array([view]))
    away = np.hypot(*seen.offsets.T)
    near = np.flatnonzero((away < _SEEN) & (away > 2.0))
    return [
        (int(i), float(np.arctan2(*delta) % (2.0 * np.pi)))
        for i, delta in zip(seen.objects[near], seen.offsets[near], strict=True)
    ]


def describe(city: CityMap, objects: list[tuple[int, float]]) -> Description:
    """Describe objects by their direction from the speaker."""
    o = city.objects
    mentions = [Mention(0, "me"), Mention(1, "you")]
    statements = []
    for row, bearing in objects:
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
    """Sort elements by kind and id, as in files of OpenStreetMap."""
    root = ET.Element(extract.tag, extract.attrib)
    for kind in KINDS:
        root.extend(sorted(extract.iter(kind), key=lambda thing: int(thing.attrib["id"])))
    return root


OTHER = "marktstadt"
ASKED = 12  # descriptions a trial
_WINDS = ("north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west")


@dataclass(frozen=True)
class Within:
    """Allowed difference of two answers."""

    metres: float  # of the best places, where both are `OK`
    probability: float  # of the best place


SAME = Within(0.01, 1e-6)
GRAIN = Within(5.0, 0.15)  # Coordinates are rounded again, and viewpoints with them
RASTER = Within(25.0, 0.4)
"""The 20 m grid of viewpoints starts at the map's south-west corner, so viewpoints move."""
MAX_GAIN = 0.1  # of probability beside another town, where words become rarer


@dataclass(frozen=True, eq=False)
class Town:
    """The shipped town as an extract and as a city, and another one."""

    extract: ET.Element
    plane: LocalPlane
    city: CityMap
    other: ET.Element
    folder: Path


def draw_towns(folder: Path) -> Town:
    """Draw both towns, the first with trees at its corners that align the grid of viewpoints."""
    world = unpack(folder / "raw")
    extract, other = (read_extract(world / f"{name}.osm") for name in (TOWN, OTHER))
    plane = find_centre(extract)
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
    return Town(extract, plane, build_extract(extract, folder), other, folder)


def descriptions(city: CityMap, rng: np.random.Generator) -> list[Description]:
    """Draw true descriptions of places, of two to five statements."""
    found: list[Description] = []
    while len(found) < ASKED:
        every = np.arange(len(city.views.positions))
        rich = np.flatnonzero(np.diff(city.in_sight(every).starts) >= 4)
        objects = find_visible(city, int(rng.choice(rich)))
        if len(objects) > 1:
            some = rng.permutation(len(objects))[: rng.integers(2, 6)]
            found.append(describe(city, [objects[i] for i in some]))
    return found


def _moved(town: Town, motion: Motion, rng: np.random.Generator, within: Within) -> str:
    city = build_extract(carry_extract(town.extract, motion), town.folder)
    for description in descriptions(town.city, rng):
        here, there = town.city.locate(description), city.locate(motion.describe(description))
        if broken := compare_estimates(city, here, there, within, motion):
            return broken
    return ""


def move_elsewhere(town: Town, rng: np.random.Generator) -> str:
    """Move the town anywhere on Earth: the place moves along."""
    there = LocalPlane(float(rng.uniform(-180.0, 180.0)), float(rng.uniform(-75.0, 75.0)))
    return _moved(town, Motion(np.eye(2), town.plane, there), rng, GRAIN)


def turn_by_quarters(town: Town, rng: np.random.Generator) -> str:
    """Turn by right angles or mirror, so that the grid of viewpoints stays aligned."""
    matrix = turn_matrix(rng.integers(4) * np.pi / 2, mirrored=bool(rng.integers(2)))
    return _moved(town, Motion(matrix, town.plane, town.plane), rng, GRAIN)


def turn_freely(town: Town, rng: np.random.Generator) -> str:
    """Turn by any angle or mirror."""
    matrix = turn_matrix(rng.uniform(0.0, 2.0 * np.pi), mirrored=bool(rng.integers(2)))
    return _moved(town, Motion(matrix, town.plane, town.plane), rng, RASTER)


def renumber(town: Town, rng: np.random.Generator) -> str:
    """Give the objects other ids: the answer stays."""
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
    city = build_extract(_sorted(copy), town.folder)
    for description in descriptions(town.city, rng):
        if broken := compare_estimates(
            city, town.city.locate(description), city.locate(description), SAME
        ):
            return broken
    return ""


def reorder_statements(town: Town, rng: np.random.Generator) -> str:
    """Reorder statements and sentences: the answer stays."""
    for description in descriptions(town.city, rng):
        order = rng.permutation(len(description.statements))
        mixed = replace(description, statements=tuple(description.statements[i] for i in order))
        sentences = _sentences(description)
        texts = " ".join(sentences), " ".join(sentences[i] for i in rng.permutation(len(sentences)))
        for a, b in ((description, mixed), texts):
            if broken := compare_estimates(
                town.city, town.city.locate(a), town.city.locate(b), SAME
            ):
                return f"{broken}: {texts}"
    return ""


def add_other_town(town: Town, rng: np.random.Generator) -> str:
    """Add another town to the north-east: no answer becomes more confident."""
    away = town.plane.to_lonlat(rng.uniform(1500.0, 30_000.0, 2))
    motion = Motion(np.eye(2), find_centre(town.other), LocalPlane(*away))
    both = merge_extracts(town.extract, carry_extract(town.other, motion))
    city = build_extract(both, town.folder)
    for description in descriptions(town.city, rng):
        here, there = town.city.locate(description), city.locate(description)
        before, after = (e.best.probability if e.best else 0.0 for e in (here, there))
        if after > before + MAX_GAIN:
            return f"{before:.3f} became {after:.3f}"
    return ""


def add_true_statement(town: Town, rng: np.random.Generator) -> str:
    """Add a true statement: every viewpoint's score changes by the statement's own log-likelihood."""
    for description in descriptions(town.city, rng):
        *before, last = description.statements
        alone, some, every = (
            scores(town.city, replace(description, statements=tuple(s)))
            for s in ((last,), before, description.statements)
        )
        off = float(np.abs(every - some - alone).max())
        if off > 2.0 * BOUND_SLACK:
            return f"{last.text} moved a viewpoint by {off:.2f} more than its log-likelihood"
    return ""


def scores(city: CityMap, description: Description) -> Floats:
    """Return the log-likelihood ratios (W,) of a description at every viewpoint."""
    asked = make_request(city, description, Hints(), Matching())
    rows = np.arange(len(city.views.positions))
    chosen = Candidates.of_views(asked, rows)
    return score_views(
        asked.query.statements, city.columns, city.views.columns, asked.token_weights, chosen.rows,
        chosen.bounds, np.zeros(len(rows)), chosen.distant, PRIOR_COHERENT, 1e6,
    )[0].astype(np.float64)  # fmt: skip


def compare_estimates(
    city: CityMap,
    here: CityEstimate,
    there: CityEstimate,
    within: Within,
    motion: Motion | None = None,
) -> str:
    """Describe how two estimates differ; empty where the difference is allowed."""
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


def _sentences(description: Description) -> list[str]:
    """Return one sentence for each label of a description."""
    sentences = {}
    for s in description.statements:
        key, _, value = description.mentions[s.source].senses[0].label.partition("=")
        word = (key if value == "yes" else value).replace("_", " ")
        wind = _WINDS[round((s.bearing or 0.0) / (np.pi / 4)) % 8]
        sentences[word] = f"A {word} is {wind} of me."
    return list(sentences.values())


TOWNS = (draw_towns, 1.0, {
    "a town elsewhere on Earth": move_elsewhere,
    "a town turned by right angles, mirrored": turn_by_quarters,
    "a town turned by any angle, mirrored": turn_freely,
    "objects of a town in another order": renumber,
    "statements in another order": reorder_statements,
    "an unrelated town makes no answer surer": add_other_town,
    "a true statement weighs what the model says": add_true_statement,
})  # fmt: skip
