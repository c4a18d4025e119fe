"""Objects of an extract, read without the package's own reader, vocabulary or cells.

The evaluation must not share the map's mistakes: this reader goes from osmium straight to arrays,
with its own choice of keys (`KEYS`) and its own rule for what is a line and what an area.
"""

from __future__ import annotations

import json
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats, LocalPlane
from placegraph.errors import InputError

Ints = NDArray[np.int64]

Bounds = tuple[float, float, float, float]  # west, south, east, north [deg]

POINT, LINE, AREA = 0, 1, 2

KEYS = (
    "amenity", "shop", "tourism", "leisure", "historic", "office", "craft", "healthcare",
    "emergency", "man_made", "railway", "aeroway", "natural", "waterway", "barrier", "highway",
    "public_transport", "power", "building", "landuse",
)  # fmt: skip
"""Keys that make an element an object. The first one it carries gives its label."""

_LINEAR = {
    "barrier": frozenset[str](),
    "highway": frozenset({"rest_area", "services", "platform", "pedestrian_area"}),
    "railway": frozenset({"station", "platform", "roundhouse", "turntable"}),
    "waterway": frozenset({"riverbank", "dock", "boatyard", "dam"}),
    "aeroway": frozenset({"aerodrome", "apron", "helipad", "terminal", "hangar"}),
    "power": frozenset({"substation", "plant", "generator", "station"}),
}
"""Keys whose closed ways are lines, with the values that are areas all the same."""

_LINEAR_VALUES = {
    "natural": frozenset({"coastline", "cliff", "tree_row", "ridge"}),
    "man_made": frozenset({"embankment", "pipeline", "cutline", "breakwater"}),
}


@dataclass(frozen=True)
class RawCity:
    """Tagged objects of an extract; row i of every column is one object."""

    plane: LocalPlane
    osm: tuple[str, ...]  # openStreetMap's own ids: ``node/1``, ``way/2``, ``relation/3``
    kind: NDArray[np.uint8]  # (N,) POINT, LINE or AREA
    key: NDArray[np.int16]  # (N,) index into `KEYS`
    label: NDArray[np.int32]  # (N,) index into `labels`: tag values
    named: NDArray[
        np.int32
    ]  # (N,) index into `labels`: the name where there is one, else the tag value
    labels: tuple[str, ...]  # tag values and names, sorted
    center: Floats  # (N, 2) east, north [m]: the point, the middle of the line, the centroid of the area
    segment_starts: Ints  # (N + 1,) segments of an object; a point is one segment without length
    segments: Floats  # (S, 4) east, north of both ends [m]

    def __len__(self) -> int:
        return len(self.osm)

    @cached_property
    def rows(self) -> dict[str, int]:
        return {osm: i for i, osm in enumerate(self.osm)}


def tag_label(tags: Mapping[str, str]) -> tuple[int, str] | None:
    """Index into `KEYS` and label of an element, or None where it has none of the keys.

    The label is the value of the first key, its first part where it lists several
    (``cafe;bar``), and the key itself where the value says no more than ``yes``.
    """
    for index, key in enumerate(KEYS):
        value = tags.get(key, "").split(";")[0].strip().replace(" ", "_")
        if value and value != "no":
            return index, key if value == "yes" else value
    return None


def is_area(tags: Mapping[str, str]) -> bool:
    """Whether a closed way with these tags is an area (else it is a ring-shaped line)."""
    if "area" in tags:
        return tags["area"] != "no"
    found = tag_label(tags)
    if found is None:
        return False
    key, value = KEYS[found[0]], found[1]
    if key in _LINEAR:
        return value in _LINEAR[key]
    return value not in _LINEAR_VALUES.get(key, ())


class _Columns:
    """Grows the columns of a `RawCity`."""

    def __init__(self, bounds: Bounds | None) -> None:
        self.bounds = bounds
        self.osm: list[str] = []
        self.kind: list[int] = []
        self.key: list[int] = []
        self.label: list[str] = []
        self.named: list[str] = []
        self.parts: list[list[Floats]] = []

    def add(self, osm: str, kind: int, tags: Mapping[str, str], parts: list[Floats]) -> None:
        found = tag_label(tags)
        if found is None or not parts or not self.within(parts):
            return
        key, label = found
        name = " ".join(tags.get("name", "").split()).replace(" ", "_")
        self.osm.append(osm)
        self.kind.append(kind)
        self.key.append(key)
        self.label.append(label)
        self.named.append(name or label)
        self.parts.append(parts)

    def within(self, parts: list[Floats]) -> bool:
        """Whether the box of an element touches the bounds."""
        if self.bounds is None:
            return True
        west, south, east, north = self.bounds
        low = np.min([p.min(axis=0) for p in parts], axis=0)
        high = np.max([p.max(axis=0) for p in parts], axis=0)
        return bool((low <= (east, north)).all() and (high >= (west, south)).all())

    def to_city(self, origin: str) -> RawCity:
        if not self.osm:
            where = " there" if self.bounds else ""
            raise InputError(
                f"{origin} contains no tagged object{where}; give an extract with some."
            )
        points = np.concatenate([p for parts in self.parts for p in parts])
        low, high = points.min(0), points.max(0)
        plane = LocalPlane(*(0.5 * (low + high)).tolist())
        segments, counts, centers = [], [], []
        for kind, lonlat in zip(self.kind, self.parts, strict=True):
            parts = [plane.to_plane(p) for p in lonlat]
            pieces = [_segments(p) for p in parts]
            segments.extend(pieces)
            counts.append(sum(map(len, pieces)))
            centers.append(_center(kind, np.concatenate(pieces)))
        labels = sorted({*self.label, *self.named})
        number = {label: i for i, label in enumerate(labels)}
        return RawCity(
            plane=plane,
            osm=tuple(self.osm),
            kind=np.array(self.kind, np.uint8),
            key=np.array(self.key, np.int16),
            label=np.array([number[x] for x in self.label], np.int32),
            named=np.array([number[x] for x in self.named], np.int32),
            labels=tuple(labels),
            center=np.array(centers),
            segment_starts=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
            segments=np.concatenate(segments),
        )


def _segments(points: Floats) -> Floats:
    if len(points) == 1:
        return np.hstack([points, points])
    return np.hstack([points[:-1], points[1:]])


def _center(kind: int, segments: Floats) -> Floats:
    a, b = segments[:, :2], segments[:, 2:]
    if kind == AREA:
        origin = a[0]
        p, q = a - origin, b - origin
        cross = p[:, 0] * q[:, 1] - q[:, 0] * p[:, 1]
        if abs(cross.sum()) > 1e-6:
            # osmium winds outer rings one way and inner rings the other: holes are subtracted
            return np.asarray(origin + ((p + q) * cross[:, None]).sum(0) / (3.0 * cross.sum()))
    length = np.hypot(*(b - a).T)
    total = length.sum()
    if total == 0.0:
        return np.asarray(a[0])
    along = np.concatenate([[0.0], np.cumsum(length)])
    i = int(np.searchsorted(along, 0.5 * total, side="right")) - 1
    i = min(i, len(length) - 1)
    return np.asarray(a[i] + (b[i] - a[i]) * (0.5 * total - along[i]) / max(length[i], 1e-9))


def _lonlat(nodes: Iterable[Any]) -> Floats:
    """Coordinates (n, 2) [deg] of the nodes whose location the extract holds."""
    found = [(n.lon, n.lat) for n in nodes if n.location.valid()]
    return np.array(found, np.float64).reshape(-1, 2)


def read_raw(path: str | Path, bounds: Bounds | None = None) -> RawCity:
    """Read the tagged objects of an OpenStreetMap extract: all, or those whose box touches `bounds`.

    Closed ways become areas by `is_area`, multipolygon relations by osmium's assembler; nodes
    that a clipped extract lacks are left out of their lines.
    """
    import osmium

    columns = _Columns(bounds)
    objects = osmium.FileProcessor(str(path)).with_locations().with_areas()
    objects = objects.with_filter(osmium.filter.KeyFilter(*KEYS))
    try:
        for o in objects:
            tags = {t.k: t.v for t in o.tags}
            if isinstance(o, osmium.osm.Node):
                if o.location.valid():
                    columns.add(f"node/{o.id}", POINT, tags, [np.array([[o.lon, o.lat]])])
            elif isinstance(o, osmium.osm.Way):
                line = _lonlat(o.nodes)
                if len(line) > 1 and not (o.is_closed() and is_area(tags)):
                    columns.add(f"way/{o.id}", LINE, tags, [line])
            elif isinstance(o, osmium.osm.Area) and (not o.from_way() or is_area(tags)):
                rings = [_lonlat(r) for r in o.outer_rings()]
                rings += [_lonlat(r) for outer in o.outer_rings() for r in o.inner_rings(outer)]
                kind = "way" if o.from_way() else "relation"
                columns.add(f"{kind}/{o.orig_id()}", AREA, tags, [r for r in rings if len(r) > 3])
    except RuntimeError as error:
        raise InputError(f"{path} cannot be read as OpenStreetMap data: {error}") from error
    return columns.to_city(str(path))


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
    """Read the records of a JSON-lines file; it lists points as latitude, longitude."""
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


@dataclass(frozen=True, slots=True)
class Note:
    """A text about a place of a real map."""

    text: str
    goal: tuple[float, float]  # longitude, latitude [deg]


def read_notes(path: str | Path, kind: str, *, sentences: bool) -> list[Note]:
    """Read where a city's fountains or works of art (`kind`) stand: as notes, or in a person's words."""
    rows = [json.loads(line) for line in Path(path).read_text(encoding="utf-8").splitlines()]
    notes = []
    for row in rows:
        if row["set"] != kind:
            continue
        place = [row[key] for key in ("site", "address", "name") if row.get(key)]
        if not sentences:
            text = ". ".join(part.strip(" .") for part in (*place, row["location"])) + "."
        elif kind == "fountain":
            text = f"I'm at the drinking fountain in {place[0]}, {row['location']}."
        else:
            what, where = row["kind"].lower(), row["location"].rstrip(".")
            text = f"I'm at the {what} at {', '.join(place)}. It is {where}."
        notes.append(Note(text, (row["longitude"], row["latitude"])))
    return notes


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

    def rarest(self, record: Record | Note) -> Floats | None:
        """First place of the rarest landmark named in the text; longitude, latitude [deg]."""
        points = self._named(record.text)
        return None if points is None else self.plane.to_lonlat(points[0])

    def rarest_near(self, record: Record) -> Floats | None:
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

    def crossing(self, record: Record | Note, streets: Mapping[str, Floats]) -> Floats | None:
        """Crossing of two streets named in the text that is nearest to its rarest name, else that name.

        `streets` holds points (n, 2) [m] along each street, by its name and by its name without a type.
        """
        spoken = f" {plain(record.text)} "
        named = [points for name, points in streets.items() if f" {name} " in spoken]
        here = self._named(record.text)
        met = []
        for i, one in enumerate(named):
            for other in named[:i]:
                low, high = other.min(axis=0) - 20.0, other.max(axis=0) + 20.0
                inside = one[((one >= low) & (one <= high)).all(axis=1)]
                off = np.hypot(*(inside[:, None] - other[None]).transpose(2, 0, 1))
                met.append(inside[(off < 20.0).any(axis=1)])
        points = np.concatenate([np.zeros((0, 2)), *met])
        if not len(points):
            return None if here is None else self.plane.to_lonlat(here[0])
        at = points[0] if here is None else points[np.hypot(*(points - here[0]).T).argmin()]
        return self.plane.to_lonlat(at)

    def _named(self, text: str) -> Floats | None:
        """Places (n, 2) [m] of the rarest landmark named; of two as rare, the longer name."""
        spoken = f" {plain(text)} "
        named = [name for name in self._points if f" {name} " in spoken]
        if not named:
            return None
        return self._points[min(named, key=lambda name: (self._rarity[name], -len(name)))]


def _apart(points: Floats) -> Ints:
    left, kept = np.ones(len(points), bool), []
    while left.any():
        i = int(np.argmax(left))
        kept.append(i)
        left &= np.hypot(*(points - points[i]).T) >= APART
    return np.array(kept)
