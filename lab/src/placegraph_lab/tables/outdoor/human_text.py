"""Descriptions that people wrote (RVS, Pittsburgh): the records, their map, and three baselines.

The map is the union of the landmarks of all records. It holds names only: that "two gardens" are
gardens is for the library to find out.
"""

from __future__ import annotations

import json
import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from placegraph.core.geometry import Floats, LocalPlane
from placegraph.errors import InputError
from placegraph_lab.tables.outdoor.raw import Ints

APART = (
    100.0  # points of one name that are nearer to each other are one landmark to the baselines [m]
)
WALK = 700.0  # how far the direction baseline walks from the start [m]

_COMPASS = {"north": (0.0, 1.0), "south": (0.0, -1.0), "east": (1.0, 0.0), "west": (-1.0, 0.0)}
_DIRECTION = re.compile(
    r"\b(?:(north|south)[\s-]?(east|west)|(north|south|east|west))(?:ern|erly|wards?)?\b",
    re.IGNORECASE,
)


@dataclass(frozen=True, slots=True)
class Record:
    """One description."""

    text: str
    goal: tuple[float, float]  # what is described: longitude, latitude [deg]
    start: tuple[float, float]  # where the reader stands ("you"): longitude, latitude [deg]
    landmarks: tuple[tuple[str, float, float], ...]  # name, longitude, latitude [deg]


def read_records(path: str | Path) -> list[Record]:
    """Read the records of a JSON-lines file; it lists points as latitude, longitude.

    Raises `InputError`: where the file is missing, or a line is not a record.
    """
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error}") from error
    records = []
    for number, line in enumerate(lines, 1):
        try:
            row = json.loads(line)
            latitude, longitude = row["rvs_goal_point"]
            you_latitude, you_longitude = row["rvs_start_point"]
            records.append(
                Record(
                    text=row["content"],
                    goal=(longitude, latitude),
                    start=(you_longitude, you_latitude),
                    landmarks=tuple(
                        (name, lon, lat) for (lat, lon), name in row["landmarks"].values()
                    ),
                )
            )
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise InputError(
                f"{path}, line {number}: not a record with content, rvs_goal_point, "
                f"rvs_start_point and landmarks ({error!r})."
            ) from error
    return records


def landmarks(records: Sequence[Record]) -> list[tuple[str, float, float]]:
    """Distinct landmarks of all records, sorted: name, longitude, latitude [deg]."""
    return sorted({place for record in records for place in record.landmarks})


def write_osm(places: Sequence[tuple[str, float, float]], path: str | Path) -> None:
    """Write an OpenStreetMap file with a node per landmark, whose only tag is its name."""
    import osmium
    from osmium.osm.mutable import Node

    with osmium.SimpleWriter(str(path), overwrite=True) as writer:
        for i, (name, longitude, latitude) in enumerate(places, 1):
            writer.add_node(
                Node(id=i, version=1, location=(longitude, latitude), tags={"name": name})
            )


def plain(text: str) -> str:
    """Lower-case words without punctuation and without a leading "the"."""
    words = re.sub(r"[^\w\s]", " ", text.lower().replace("&", " and ").replace("'", "")).split()
    return " ".join(words[1:] if words[:1] == ["the"] else words)


class Baselines:
    """Three guesses that use names, rarity and the start only."""

    def __init__(self, places: Sequence[tuple[str, float, float]]) -> None:
        lonlat = np.array([(longitude, latitude) for _, longitude, latitude in places])
        self.plane = LocalPlane(float(lonlat[:, 0].mean()), float(lonlat[:, 1].mean()))
        points: dict[str, list[int]] = defaultdict(list)
        for i, (name, _, _) in enumerate(places):
            if plain(name):
                points[plain(name)].append(i)
        east_north = self.plane.to_plane(lonlat)
        self._points = {name: east_north[rows] for name, rows in points.items()}
        self._rarity = {name: len(_apart(p)) for name, p in self._points.items()}

    def rarest(self, record: Record) -> Floats | None:
        """First place of the rarest landmark named in the text; longitude, latitude [deg]."""
        points = self._named(record.text)
        return None if points is None else self.plane.to_lonlat(points[0])

    def rarest_near(self, record: Record) -> Floats | None:
        """Of the places of the rarest landmark named, the one that is nearest to the start."""
        points = self._named(record.text)
        if points is None:
            return None
        off = np.hypot(*(points - self.plane.to_plane(record.start)).T)
        return self.plane.to_lonlat(points[np.argmin(off)])

    def walk(self, record: Record) -> Floats:
        """700 m from the start in the first direction that the text states, else the start."""
        here = self.plane.to_plane(record.start)
        stated = _DIRECTION.search(record.text)
        if stated:
            step = np.sum([_COMPASS[w.lower()] for w in stated.groups() if w], axis=0)
            here = here + WALK * step / np.hypot(*step)
        return self.plane.to_lonlat(here)

    def _named(self, text: str) -> Floats | None:
        """Places (n, 2) [m] of the rarest landmark named; of two as rare, the longer name."""
        spoken = f" {plain(text)} "
        named = [name for name in self._points if f" {name} " in spoken]
        if not named:
            return None
        return self._points[min(named, key=lambda name: (self._rarity[name], -len(name)))]


def _apart(points: Floats) -> Ints:
    """Rows of points (n, 2) that stand for all within `APART` of them, greedily."""
    left, kept = np.ones(len(points), bool), []
    while left.any():
        i = int(np.argmax(left))
        kept.append(i)
        left &= np.hypot(*(points - points[i]).T) >= APART
    return np.array(kept)
