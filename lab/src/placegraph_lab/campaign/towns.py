"""Extracts turned, mirrored, carried elsewhere, renumbered or in company, and what is said in them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import LocalPlane
from placegraph.outdoor.city import CityMap, build_city
from placegraph.outdoor.language.description import (
    SPEAKER,
    Description,
    Mention,
    Relation,
    Sense,
    Statement,
)
from placegraph.outdoor.map.index import REACH, STRIDE

Floats = NDArray[np.float64]


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


def carried(extract: ET.Element, motion: Motion) -> ET.Element:
    """A copy of an extract that was moved."""
    copy = ET.fromstring(ET.tostring(extract))  # noqa: S314
    for node in copy.iter("node"):
        longitude, latitude = motion.positions(np.array(_lonlat(node)))
        node.set("lon", f"{longitude:.9f}")
        node.set("lat", f"{latitude:.9f}")
    return copy


def fenced(extract: ET.Element, plane: LocalPlane) -> ET.Element:
    """An extract with two trees at its corners, as wide and as long as viewpoints fit into.

    The raster of viewpoints begins `REACH` before the first object; with these it ends as far behind
    the last, and comes upon itself where the extract is turned by right angles or mirrored.
    """
    lonlat = np.array([_lonlat(node) for node in extract.iter("node")])
    half = np.abs(plane.to_plane(lonlat)).max(axis=0) + STRIDE
    half = np.ceil((half.max() + REACH) / STRIDE) * STRIDE - REACH - 0.01
    corners = plane.to_lonlat(np.array([(-half, -half), (half, half)]))
    for k, (longitude, latitude) in enumerate(corners):
        node = ET.Element("node", id=str(900_000 + k), version="1")
        node.attrib |= {"lon": f"{longitude:.9f}", "lat": f"{latitude:.9f}"}
        ET.SubElement(node, "tag", k="natural", v="tree")
        extract.append(node)
    return _sorted(extract)


def renumbered(extract: ET.Element, rng: np.random.Generator) -> ET.Element:
    """A copy whose objects have each other's numbers, in another order."""
    copy = ET.fromstring(ET.tostring(extract))  # noqa: S314
    for kind in KINDS:
        old = [thing.attrib["id"] for thing in copy.iter(kind)]
        new = dict(zip(old, (str(i) for i in rng.permutation(old)), strict=True))
        for thing in copy.iter(kind):
            thing.set("id", new[thing.attrib["id"]])
        inside = copy.iter("nd") if kind == "node" else copy.iter("member")
        for part in inside:
            if part.get("type", "node") == kind:
                part.set("ref", new[part.attrib["ref"]])
    return _sorted(copy)


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


def standing(city: CityMap, rng: np.random.Generator) -> int:
    """A viewpoint (row of `city.views`) from which some things can be told."""
    every = np.arange(len(city.views.positions))
    rich = np.flatnonzero(np.diff(city.in_sight(every).starts) >= 4)
    return int(rng.choice(rich))


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
