"""Reader of OpenStreetMap files: `.osm.pbf`, `.osm`, `.osm.gz`, `.osm.bz2` (and what else libosmium reads).

Yields every element that carries one of the wanted keys, with its geometry in longitude and
latitude: nodes as points, open ways as lines, closed ways and multipolygon relations as areas.
"""

from __future__ import annotations

import struct
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping
    from os import PathLike

NODE, WAY, RELATION = 0, 1, 2
POINT, LINE, AREA = 0, 1, 2

SUFFIXES = (".osm.pbf", ".pbf", ".osm", ".osm.gz", ".osm.bz2", ".osm.xml", ".xml")
LINE_KEYS = frozenset({"highway", "barrier", "railway", "waterway", "power", "aerialway", "route"})
"""Keys whose closed ways are loops, not areas, unless `area=yes` or the value says otherwise."""
AREA_VALUES = frozenset({"riverbank", "dock", "boatyard", "substation", "plant", "platform", "station"})


class OsmElement(NamedTuple):
    """One tagged element."""

    osm_type: int
    """NODE, WAY or RELATION."""
    osm_id: int
    kind: int
    """POINT, LINE or AREA."""
    tags: dict[str, str]
    parts: list[NDArray[np.float64]]
    """Lines or rings, each (n, 2) longitude, latitude [deg]; rings are closed."""


@dataclass
class LeftOut:
    """What of a file could not be used, by reason; filled while reading."""

    counts: Counter[str] = field(default_factory=Counter)

    def __str__(self) -> str:
        return ", ".join(f"{n} {reason}" for reason, n in sorted(self.counts.items())) or "nothing"


def read_osm(
    path: str | PathLike[str], keys: Iterable[str], left_out: LeftOut | None = None
) -> Iterator[OsmElement]:
    """Yield the elements of an OpenStreetMap file that carry one of `keys`.

    Parameters
    ----------
    path
        File in a format of `SUFFIXES`.
    keys
        Keys worth reading; everything else is skipped in C++.
    left_out
        Is told what was left out, and why: clipped extracts lack members of ways and relations.

    Raises
    ------
    InputError
        The file is missing, empty, truncated, or not OpenStreetMap data.

    """
    import osmium

    path = _check(Path(path))
    left_out = LeftOut() if left_out is None else left_out
    wanted = osmium.filter.KeyFilter(*sorted(keys))
    factory = osmium.geom.WKBFactory()
    relations: set[int] = set()
    built: set[int] = set()  # an area may come before or after its relation
    try:
        for item in osmium.FileProcessor(path).with_areas(wanted).with_filter(wanted):
            if item.is_node():
                if item.location.valid():
                    point = np.array([[item.lon, item.lat]])
                    yield OsmElement(NODE, item.id, POINT, dict(item.tags), [point])
                else:
                    left_out.counts["nodes without a position"] += 1
            elif item.is_way():
                element = _way(item, factory, left_out)
                if element is not None:
                    yield element
            elif item.is_relation():
                if item.tags.get("type") == "multipolygon":
                    relations.add(item.id)
            elif not item.from_way():
                try:
                    rings = _rings(bytes.fromhex(factory.create_multipolygon(item)))
                except RuntimeError:
                    continue  # never built, and counted as such below
                built.add(item.orig_id())
                yield OsmElement(RELATION, item.orig_id(), AREA, dict(item.tags), rings)
    except (RuntimeError, OSError, ValueError, UnicodeDecodeError) as error:
        raise InputError(
            f"{path} cannot be read as OpenStreetMap data: {_one_line(error)}. "
            "It may be truncated or of another format; download or export it again."
        ) from error
    if relations - built:
        left_out.counts["multipolygons with missing or crossing members"] += len(relations - built)


def _check(path: Path) -> Path:
    if path.is_dir():
        raise InputError(f"{path} is a folder; name an OpenStreetMap file in it.")
    if not path.exists():
        raise InputError(f"{path} does not exist; check the path.")
    if not path.name.lower().endswith(SUFFIXES):
        raise InputError(
            f"{path} has an unknown ending; OpenStreetMap files end in {', '.join(SUFFIXES)}."
        )
    if path.stat().st_size == 0:
        raise InputError(f"{path} is empty; download or export it again.")
    return path


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__


def _way(way: Any, factory: Any, left_out: LeftOut) -> OsmElement | None:  # noqa: ANN401 - osmium is untyped
    import osmium

    try:
        wkb = bytes.fromhex(factory.create_linestring(way))
        line = np.frombuffer(wkb, "<f8", offset=9).reshape(-1, 2)
    except (RuntimeError, osmium.InvalidLocationError):  # a member is missing, or all nodes are one point
        known = [(n.location.lon, n.location.lat) for n in way.nodes if n.location.valid()]
        line = np.array(known).reshape(-1, 2)
        if len(line) < 2:  # noqa: PLR2004 - a line needs two points
            left_out.counts["ways without positions"] += 1
            return None
        left_out.counts["ways cut where members are missing"] += 1
    tags = dict(way.tags)
    closed = len(line) >= 4 and bool((line[0] == line[-1]).all())  # noqa: PLR2004 - a triangle, closed
    kind = AREA if closed and is_area(tags) else LINE
    return OsmElement(WAY, way.id, kind, tags, [line])


def is_area(tags: Mapping[str, str]) -> bool:
    """Whether a closed way with these tags encloses an area (False: it is a loop, as a roundabout)."""
    area = tags.get("area")
    if area in ("yes", "no"):
        return area == "yes"
    if "building" in tags or "landuse" in tags or "leisure" in tags and tags["leisure"] != "track":
        return True
    return not any(key in tags and tags[key] not in AREA_VALUES for key in LINE_KEYS)


def _rings(wkb: bytes) -> list[NDArray[np.float64]]:
    """Rings, outer and inner alike, of a little-endian WKB multipolygon."""
    rings, at = [], 9
    (polygons,) = struct.unpack_from("<I", wkb, 5)
    for _ in range(polygons):
        (n_rings,) = struct.unpack_from("<I", wkb, at + 5)
        at += 9
        for _ in range(n_rings):
            (n,) = struct.unpack_from("<I", wkb, at)
            rings.append(np.frombuffer(wkb, "<f8", 2 * n, at + 4).reshape(-1, 2))
            at += 4 + 16 * n
    return rings
