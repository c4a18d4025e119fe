"""Reader of OpenStreetMap files: `.osm.pbf`, `.osm`, `.osm.gz`, `.osm.bz2`.

Yields every element that carries one of the wanted keys, with its geometry in longitude and
latitude: nodes as points, open ways as lines, closed ways and multipolygon relations as areas.
"""

from __future__ import annotations

import errno
import re
import struct
from collections import Counter
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from placegraph.errors import InputError
from placegraph.files import cannot_write
from placegraph.formats.place import osm_pass

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping
    from os import PathLike

    from numpy.typing import NDArray
    from osmium.osm import Area, Node, Way

NODE, WAY, RELATION = 0, 1, 2
POINT, LINE, AREA = 0, 1, 2

SUFFIXES = (".osm.pbf", ".pbf", ".osm", ".osm.gz", ".osm.bz2", ".osm.xml", ".xml", ".osmag")
LINE_KEYS = frozenset({"highway", "barrier", "railway", "waterway", "power", "aerialway", "route"})
"""Keys whose closed ways are loops, not areas, unless `area=yes` or the value says otherwise."""
AREA_VALUES = frozenset(
    {"riverbank", "dock", "boatyard", "substation", "plant", "platform", "station"}
)

_FULL = re.compile("No space left|File too large|quota", re.IGNORECASE)
"""What osmium says of an index of nodes that has no room."""


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
    read: int = 0
    """Objects of the file that were looked at so far, or before."""

    def __str__(self) -> str:
        return ", ".join(f"{n} {reason}" for reason, n in sorted(self.counts.items())) or "nothing"


def read_osm(
    path: str | PathLike[str],
    keys: Iterable[str],
    left_out: LeftOut | None = None,
    index: Path | None = None,
) -> Iterator[OsmElement]:
    """Yield the elements of an OpenStreetMap file that carry one of `keys`.

    Parameters
    ----------
    path
        File in a format of `SUFFIXES`.
    keys
        Keys worth reading; everything else is skipped in C++.
    left_out
        Is told what was left out, and why: clipped extracts lack members of ways and relations. Of
        one that was told of `read` objects before, these are passed over: an eighth of the time.
    index
        File for the positions of nodes, 16 bytes each, made and left for the caller to remove;
        they are held in memory where none is named.

    Raises
    ------
    InputError
        The file is missing, empty, truncated, not OpenStreetMap data, holds history, has its nodes
        behind the ways that need them, or is damaged such that its reader crashes: another
        process has read it through before.
    MapError
        There is no room for `index`.

    """
    import osmium

    path, keys = checked_osm(Path(path)), sorted(keys)
    storage = f"sparse_file_array,{index}" if index else "flex_mem"
    with _emptied(index):
        osm_pass.survived(path, _ending(path), storage, keys)
    wanted = osmium.filter.KeyFilter(*keys)
    left_out = LeftOut() if left_out is None else left_out
    reader, passed = _Reader(path, left_out), left_out.read
    try:
        file = osmium.FileProcessor(osm_file(path)).with_locations(storage)
        reader.several_times(declared=file.header.has_multiple_object_versions)
        items = iter(file.with_areas(wanted).with_filter(wanted))
        for item in islice(items, passed):
            reader.passed(item)
        for left_out.read, item in enumerate(items, passed + 1):  # as it goes on
            element = reader.read(item)
            if element is not None:
                yield element
    except (RuntimeError, OSError, ValueError, osmium.InvalidLocationError) as error:
        if index is not None and _FULL.search(str(error)):
            raise cannot_write(index, OSError(errno.ENOSPC, one_line(error))) from error
        raise InputError(
            f"{path} cannot be read as OpenStreetMap data: {one_line(error)}. "
            "It may be truncated or of another format; download or export it again."
        ) from error
    if reader.late and reader.counts["ways without positions"]:
        raise InputError(
            f"{path} lists nodes behind the ways that need them; bring it into order by "
            "`osmium sort`."
        )
    reader.finish()


@contextmanager
def _emptied(index: Path | None) -> Iterator[None]:
    """Without an index of an earlier pass, before and after: osmium would add to it."""
    if index is not None:
        index.unlink(missing_ok=True)
    yield
    if index is not None:
        index.unlink(missing_ok=True)


class _Reader:
    """Turns osmium's objects into elements and counts what cannot be turned."""

    def __init__(self, path: Path, left_out: LeftOut) -> None:
        import osmium

        self.path, self.osm = path, osmium.osm
        self.invalid = (RuntimeError, osmium.InvalidLocationError)
        self.factory: Any = osmium.geom.WKBFactory()
        self.counts = left_out.counts
        self.relations: set[int] = set()
        self.built: set[int] = set()  # an area may come before or after its relation
        self.ways = self.late = False  # whether there was a way, and a node behind one
        self.last = (-1, 0)  # id and version of the last node or way

    def read(self, item: object) -> OsmElement | None:
        """Element of one object, None where it has no geometry of its own or none that is known."""
        if isinstance(item, self.osm.Way):
            return self.way(item)
        if isinstance(item, self.osm.Node):
            return self.point(item)
        if isinstance(item, self.osm.Area) and not item.from_way():
            return self.area(item)
        if isinstance(item, self.osm.Relation) and item.tags.get("type") == "multipolygon":
            self.relations.add(item.id)
        return None

    def several_times(self, *, declared: bool) -> None:
        """Raise `InputError` where a file is of several times: it says so, or what it holds does."""
        if declared:
            raise InputError(
                f"{self.path} holds history, several versions of one thing; make an extract of one time "
                "of it, as by `osmium time-filter`."
            )

    def seen(self, item: Node | Way) -> int:
        """Id of a node or way; `InputError` where the one before was another version of it."""
        number: int = item.id
        if number == self.last[0]:
            self.several_times(declared=item.version != self.last[1])
        self.last = number, item.version
        return number

    def passed(self, item: object) -> None:
        """See an object that was read before."""
        if isinstance(item, self.osm.Way):
            self.ways = True
        elif isinstance(item, self.osm.Node):
            self.late |= self.ways
        else:
            self.read(item)

    def finish(self) -> None:
        """Count the relations that no area was built of."""
        if missing := len(self.relations - self.built):
            self.counts["multipolygons with missing or crossing members"] += missing

    def point(self, node: Node) -> OsmElement | None:
        self.late |= self.ways
        if not node.location.valid():
            self.counts["nodes without a position"] += 1
            return None
        return OsmElement(
            NODE, self.seen(node), POINT, dict(node.tags), [np.array([[node.lon, node.lat]])]
        )

    def way(self, way: Way) -> OsmElement | None:
        if not self.ways:
            self.ways, self.last = True, (-1, 0)
        number = self.seen(way)
        try:
            wkb = self.factory.create_linestring(way)  # in hexadecimal, behind 9 bytes of head
            line = np.frombuffer(bytes.fromhex(wkb), "<f8", offset=9).reshape(-1, 2)
            closed = wkb[18:50] == wkb[-32:]
        except self.invalid:  # a member is missing, or all nodes are one point
            known = [(n.location.lon, n.location.lat) for n in way.nodes if n.location.valid()]
            line = np.array(known).reshape(-1, 2)
            if len(line) < 2:  # a line needs two points
                self.counts["ways without positions"] += 1
                return None
            self.counts["ways cut where members are missing"] += 1
            closed = known[0] == known[-1]
        tags = dict(way.tags)
        ring = closed and len(line) >= 4  # a triangle, closed
        return OsmElement(WAY, number, AREA if ring and is_area(tags) else LINE, tags, [line])

    def area(self, area: Area) -> OsmElement | None:
        try:
            rings = _rings(bytes.fromhex(self.factory.create_multipolygon(area)))
        except self.invalid:
            return None  # never built, and counted so
        self.built.add(area.orig_id())
        return OsmElement(RELATION, area.orig_id(), AREA, dict(area.tags), rings)


def osm_file(path: Path) -> Any:  # noqa: ANN401  # osmium has no types
    """File for osmium, which knows endings in lower case only."""
    import osmium

    return osmium.io.File(path, _ending(path))


def _ending(path: Path) -> str:
    ending = next(s for s in SUFFIXES if path.name.lower().endswith(s))
    return ending.removeprefix(".").replace("osmag", "osm")


def checked_osm(path: Path) -> Path:
    """Path of a file that may be read; raises `InputError` where it is none."""
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


def one_line(error: Exception) -> str:
    """What went wrong, in one line."""
    return " ".join(str(error).split())[:200].rstrip(".") or type(error).__name__


def is_area(tags: Mapping[str, str]) -> bool:
    """Whether a closed way with these tags is an area (else a loop, such as a roundabout)."""
    area = tags.get("area")
    if area in ("yes", "no"):
        return area == "yes"
    if (
        "building" in tags
        or "landuse" in tags
        or ("leisure" in tags and tags["leisure"] != "track")
    ):
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
