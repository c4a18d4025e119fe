"""From an OpenStreetMap extract to the objects of a city (Eq. 1-2): read, label, simplify, sort.

`ElementTable` are the labelled elements as columns, small enough to hold many and to spill to disk; `clip`
cuts their lines and areas at a box.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import islice, pairwise
from os import PathLike
from typing import TYPE_CHECKING, NamedTuple, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geo import Box
from placegraph.core.geometry import LocalPlane
from placegraph.core.mapfile import gather_spans, offsets_of
from placegraph.core.plugins import load_module
from placegraph.errors import InputError
from placegraph.io.osm.osm import LINE, POINT, LeftOut, OsmColumns, OsmElement, read_columns
from placegraph.outdoor.language.vocabulary import Vocabulary
from placegraph.outdoor.map.cells import EACH, MOST
from placegraph.outdoor.map.geometry_kernels import along_curve
from placegraph.outdoor.map.index import STRIDE
from placegraph.outdoor.map.objects import AREA, GRAIN, CityObjects, simplify

if TYPE_CHECKING:
    from collections.abc import Generator, Iterator, Mapping

STEPS = 1e7
"""Steps in a degree, in which OpenStreetMap has its coordinates."""
WORD, LIST, THING = "\x1f", "\x1e", "\x1d"
"""Between labels, and between names; between the two; between things. No text holds them."""
_CLEAN = str.maketrans({WORD: " ", LIST: " ", THING: " "})


class LabelledElement(NamedTuple):
    """An element of OpenStreetMap with what it is called."""

    osm_type: int
    osm_id: int
    kind: int
    """POINT, LINE or AREA."""
    text: str
    """Its labels and its names, see `join_words`."""
    parts: Sequence[NDArray[np.float64]]
    """Lines or rings, each (n, 2) longitude, latitude [deg]."""


def join_words(labels: Iterable[str], names: Iterable[str]) -> str:
    """Join labels and names to one string, which `split_words` takes apart."""
    said = WORD.join([n if n.isprintable() else n.translate(_CLEAN) for n in names])
    return WORD.join(labels) + LIST + said if said else WORD.join(labels)


def split_words(text: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Split a string of `join_words` into labels and names."""
    labels, _, names = text.partition(LIST)
    return tuple(labels.split(WORD)), tuple(names.split(WORD)) if names else ()


@dataclass(frozen=True)
class ElementTable:
    """Labelled elements as columns; row i of every column is one."""

    osm_type: NDArray[np.uint8]
    osm_id: NDArray[np.int64]
    kind: NDArray[np.uint8]
    part_starts: NDArray[np.int64]
    """(N + 1,) parts of a thing."""
    point_starts: NDArray[np.int64]
    """(P + 1,) points of a part."""
    steps: NDArray[np.int32]
    """(V, 2) longitude, latitude in steps of 1e-7 degrees."""
    texts: list[str]

    def __len__(self) -> int:
        return len(self.texts)

    @classmethod
    def of(cls, elements: Sequence[LabelledElement]) -> Self:
        """Return the columns of elements, of which there must be one."""
        flat = [part for thing in elements for part in thing.parts]
        return cls(
            np.array([thing.osm_type for thing in elements], np.uint8),
            np.array([thing.osm_id for thing in elements], np.int64),
            np.array([thing.kind for thing in elements], np.uint8),
            offsets_of([len(thing.parts) for thing in elements]),
            offsets_of([len(part) for part in flat]),
            np.rint(np.concatenate(flat) * STEPS).astype(np.int32),
            [thing.text for thing in elements],
        )

    @classmethod
    def concatenate(cls, tables: Sequence[ElementTable]) -> Self:
        """Concatenate tables, of which there must be one."""
        return cls(
            np.concatenate([t.osm_type for t in tables]),
            np.concatenate([t.osm_id for t in tables]),
            np.concatenate([t.kind for t in tables]),
            offsets_of(np.concatenate([np.diff(t.part_starts) for t in tables])),
            offsets_of(np.concatenate([np.diff(t.point_starts) for t in tables])),
            np.concatenate([t.steps for t in tables]),
            [text for t in tables for text in t.texts],
        )

    def take(self, rows: NDArray[np.int64]) -> Self:
        """Take the elements in some rows, in their order."""
        part_starts, parts = gather_spans(self.part_starts, rows)
        point_starts, points = gather_spans(self.point_starts, parts)
        texts = self.texts
        return type(self)(
            self.osm_type[rows], self.osm_id[rows], self.kind[rows], part_starts, point_starts,
            self.steps[points], [texts[row] for row in rows.tolist()],
        )  # fmt: skip

    @property
    def lonlat(self) -> NDArray[np.float64]:
        """Points (V, 2), longitude and latitude [deg]."""
        return self.steps / STEPS

    @property
    def first(self) -> NDArray[np.int64]:
        """(N + 1,) where the points of each thing begin."""
        return self.point_starts[self.part_starts]

    def ends(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the south-western and north-eastern corners (N, 2) of the elements [deg]."""
        first = self.first[:-1]
        low, high = np.minimum.reduceat(self.steps, first), np.maximum.reduceat(self.steps, first)
        return low / STEPS, high / STEPS

    def element(self, row: int) -> LabelledElement:
        """Return the element in a row."""
        first, last = self.part_starts[row : row + 2]
        bounds = self.point_starts[first : last + 1].tolist()
        parts = [self.steps[a:b] / STEPS for a, b in pairwise(bounds)]
        return LabelledElement(
            int(self.osm_type[row]),
            int(self.osm_id[row]),
            int(self.kind[row]),
            self.texts[row],
            parts,
        )


def drop_duplicates(elements: ElementTable) -> ElementTable:
    """Drop elements that extracts share; the version with the most points stays."""
    counts = np.diff(elements.first)
    order = np.lexsort((-counts, elements.osm_id, elements.osm_type))
    same = (np.diff(elements.osm_id[order]) == 0) & (np.diff(elements.osm_type[order]) == 0)
    if not same.any():
        return elements
    return elements.take(np.sort(order[np.concatenate(([True], ~same))]))


Points = NDArray[np.float64]


def clip(kind: int, parts: Sequence[Points], box: Box, spare: float = 0.0) -> list[Points]:
    """Clip the parts, lines or rings (n, 2), of an element at a box; none where it lies outside.

    What sticks out by at most `spare` (in the box's unit) stays whole. A ring that leaves the box
    goes on along its edge.
    """
    low, high = np.array(box[:2]), np.array(box[2:])
    points = np.concatenate(parts)
    lowest, highest = points.min(axis=0), points.max(axis=0)
    if (lowest > high).any() or (highest < low).any():
        return []
    if (lowest >= low - spare).all() and (highest <= high + spare).all():
        return list(parts)
    if kind == AREA:
        rings = (_ring(part, low, high) for part in parts)
        return [ring for ring in rings if len(ring) > 3]
    return [piece for part in parts for piece in _pieces(part, low, high)]


def _ring(ring: Points, low: Points, high: Points) -> Points:
    """Clip a ring at a box, edge after edge (Sutherland and Hodgman)."""
    for axis in (0, 1):
        for side, sign in ((low[axis], 1.0), (high[axis], -1.0)):
            if not len(ring):
                return ring
            depth = sign * (ring[:, axis] - side)
            inside, start, end = depth >= 0.0, ring[:-1], ring[1:]
            crosses = inside[:-1] != inside[1:]
            share = np.divide(
                depth[:-1], depth[:-1] - depth[1:], out=np.zeros(len(start)), where=crosses
            )
            met = start + share[:, None] * (end - start)
            ring = np.stack([met, end], 1)[np.stack([crosses, inside[1:]], 1)]
            ring = np.concatenate([ring, ring[:1]])
    return ring


def _pieces(line: Points, low: Points, high: Points) -> list[Points]:
    """Cut a line at the edges of a box, and return the pieces inside."""
    if len(line) == 1:
        return [line] if ((line >= low) & (line <= high)).all() else []
    start, step = line[:-1], np.diff(line, axis=0)
    segments, shares = [], []
    for axis in (0, 1):
        for side in (low[axis], high[axis]):
            share = np.divide(
                side - start[:, axis], step[:, axis],
                out=np.zeros(len(start)), where=step[:, axis] != 0.0,
            )  # fmt: skip
            rows = np.flatnonzero((share > 0.0) & (share < 1.0))
            segments.append(rows)
            shares.append(share[rows])
    segment, share = np.concatenate(segments), np.concatenate(shares)
    order = np.lexsort((share, segment))
    segment, share = segment[order], share[order]
    points = np.insert(line, segment + 1, start[segment] + share[:, None] * step[segment], axis=0)
    middle = (points[:-1] + points[1:]) / 2.0
    inside = ((middle >= low) & (middle <= high)).all(axis=1)
    turns = np.flatnonzero(np.diff(np.concatenate(([False], inside, [False])).astype(np.int8)))
    return [points[first : last + 1] for first, last in turns.reshape(-1, 2)]


Progress = Callable[[str, int], None]
"""Called with the step's name and how many elements are done."""

BATCH = 32_768
"""Things that are handed on at once, or a block more."""
TOLERANCE = 0.75
"""Outlines and lines are simplified to this error [m]: directions between things do not feel it."""
LONGEST = 50_000.0
"""Things longer than this are left out [m]: meridians, sea lanes, long-distance roads in one piece."""
UNKNOWN = "name=*"
"""Label of things that have a name and no tag the vocabulary knows."""
NOT_THINGS = frozenset({"boundary", "route", "type"})
"""Keys of lines on the map: an element with such a key and no known tag is no object."""
NAME_KEY = re.compile(
    r"(name|alt_name|official_name|short_name|loc_name|old_name|int_name|nat_name|reg_name|brand"
    r"|(name|brand|official_name):[a-z]{2,3}(-[A-Za-z]+)?)$"
)
ROAD_NUMBER = re.compile(r"[A-Za-z]+[ -]?\d")
"""Pattern of the number of a road that nothing else is called: "A1", "NY 9A", but not "99"."""
RUN = frozenset({"amenity", "shop", "office", "craft", "healthcare", "leisure", "tourism"})
"""Keys of objects that are called by their operator if they lack a name: a letter box of the post."""


class Overture(Protocol):
    """Files of Overture, as `placegraph_io.overture` names them."""

    @property
    def paths(self) -> tuple[str, ...]:
        """Files, folders or URLs."""


def read_extract(
    path: str | PathLike[str] | Overture,
    vocabulary: Vocabulary | None = None,
    progress: Progress | None = None,
) -> tuple[LocalPlane, CityObjects, dict[str, int]]:
    """Read the objects of an extract, or of Overture, and count the elements left out, by reason.

    Raises
    ------
    InputError
        The file cannot be read, or holds nothing worth naming.

    """
    vocabulary, left_out = vocabulary or Vocabulary.default(), LeftOut()
    if isinstance(path, str | PathLike):
        blocks = read_columns(path, keys_read(vocabulary), left_out)
    else:
        overture = load_module("placegraph_io.overture", "overture")
        blocks = _in_columns(overture.read_overture(path, left_out))
    tables = list(label_elements(blocks, vocabulary, progress or (lambda _step, _n: None)))
    things = drop_largest(ElementTable.concatenate(tables), left_out) if tables else ()
    if not things:
        raise make_empty_error(path, left_out)
    plane = _plane(things.lonlat)
    return plane, make_objects(things, plane), dict(sorted(left_out.counts.items()))


def make_empty_error(path: str | PathLike[str] | Overture, left_out: LeftOut) -> InputError:
    """Return the error of an extract without anything that people speak of."""
    return InputError(
        f"{path} contains no usable objects (roads, buildings, shops, ...); ignored: "
        f"{left_out}. Choose a larger extract, or extend the vocabulary."
    )


def keys_read(vocabulary: Vocabulary | None = None) -> frozenset[str]:
    """Return the keys of elements that become objects, by the shipped vocabulary if none is given."""
    return frozenset((*(vocabulary or Vocabulary.default()).keys, "name"))


def label_elements(
    blocks: Iterable[OsmColumns], vocabulary: Vocabulary, progress: Progress
) -> Generator[ElementTable]:
    """Yield blocks of the elements that the vocabulary has a word for, or that have a name."""
    waiting, seen = [], 0
    for columns in blocks:
        progress("reading", seen)
        seen += len(columns.tags)
        waiting.append(_label_block(columns, vocabulary))
        if sum(map(len, waiting)) >= BATCH:
            yield ElementTable.concatenate(waiting)
            waiting = []
    if any(map(len, waiting)):
        yield ElementTable.concatenate(waiting)


def _label_block(columns: OsmColumns, vocabulary: Vocabulary) -> ElementTable:
    """Label the elements of a block; elements that share their tags are labelled once."""
    known: dict[tuple[int, int], str] = {}
    texts = []
    for kind, tags in zip(columns.kind.tolist(), columns.tags, strict=True):
        text = known.get((id(tags), kind))
        if text is None:
            labels = vocabulary.labels_of(tags) or named_labels(kind, tags, vocabulary)
            text = join_words(labels, list_names(tags)) if labels else ""
            known[id(tags), kind] = text
        texts.append(text)
    things = ElementTable(*columns[:-1], texts)
    return things.take(np.flatnonzero(np.array(texts, np.object_) != ""))


def _in_columns(elements: Iterator[OsmElement]) -> Iterator[OsmColumns]:
    while batch := list(islice(elements, BATCH)):
        t = ElementTable.of(
            [LabelledElement(e.osm_type, e.osm_id, e.kind, "", e.parts) for e in batch]
        )
        head = (t.osm_type, t.osm_id, t.kind, t.part_starts, t.point_starts, t.steps)
        yield OsmColumns(*head, [element.tags for element in batch])


def list_names(tags: Mapping[str, str]) -> tuple[str, ...]:
    """List the names of an element, the name proper first, the address last, without repetitions."""
    found = [tags["name"]] if "name" in tags else []
    keys = [key for key in tags if "name" in key or "brand" in key]
    found += [tags[key] for key in sorted(keys) if NAME_KEY.match(key)]
    if not found and "operator" in tags and not RUN.isdisjoint(tags):
        found.append(tags["operator"])
    if "highway" in tags and ROAD_NUMBER.match(tags.get("ref", "")):
        found.append(tags["ref"])
    if "addr:housename" in tags:
        found.append(tags["addr:housename"])
    street = tags.get("addr:street") or tags.get("addr:place")
    if "addr:housenumber" in tags and street:
        found.append(f"{tags['addr:housenumber'].partition(',')[0]} {street}")
    if not found:
        return ()
    split = (part.strip() for value in found for part in value.split(";"))
    return tuple(dict.fromkeys(part for part in split if part))


def named_labels(kind: int, tags: Mapping[str, str], vocabulary: Vocabulary) -> tuple[str, ...]:
    """Return labels of an element that has a name alone; "parking lot" says what it is."""
    if "name" not in tags or kind == LINE or not tags.keys().isdisjoint(NOT_THINGS):
        return ()
    roads = {s.label for s in vocabulary.senses("road")} if kind == POINT else set()
    best = [
        sense.label
        for sense in vocabulary.senses(tags["name"])
        if sense.weight >= 0.9 and not sense.label.endswith("*")
        if sense.label not in roads  # a place called "Avenues" is no avenue
    ]
    return tuple(best[:3]) or (UNKNOWN,)


def drop_largest(
    elements: ElementTable, left_out: LeftOut, plane: LocalPlane | None = None
) -> ElementTable:
    """Leave out what would stretch the map far beyond a city, or fill it with grid points."""
    lonlat = elements.lonlat
    at = (plane or _plane(lonlat)).to_plane(lonlat)
    first = elements.first
    span = np.maximum.reduceat(at, first[:-1]) - np.minimum.reduceat(at, first[:-1])
    keep = span.max(axis=1) <= LONGEST
    points = span / STRIDE + 5.0  # of the grid of viewpoints
    cost = keep * (points.prod(axis=1) + points[:, 1] * np.diff(first))
    order = np.argsort(cost, kind="stable")
    keep[order] &= 2.0 * np.cumsum(cost[order]) <= MOST + EACH * len(keep)
    if keep.all():
        return elements
    left_out.counts["things larger than a city"] += int((~keep).sum())
    return elements.take(np.flatnonzero(keep))


def _plane(lonlat: NDArray[np.float64]) -> LocalPlane:
    """Return the plane at the median: one far-off member of a clipped relation must not tilt it."""
    median = np.percentile(lonlat, 50, axis=0, method="lower")  # of a point: dates have a line
    return LocalPlane(*(round(float(x), 4) for x in median))


def make_objects(elements: ElementTable, plane: LocalPlane) -> CityObjects:
    """Make objects on a plane of elements in any order: simplified, and sorted along a curve."""
    simple, point_starts = simplify(
        plane.to_plane(elements.lonlat), elements.point_starts, TOLERANCE
    )
    steps = np.round(simple / GRAIN).astype(np.int64)
    first = steps[point_starts[elements.part_starts[:-1]]]
    order = np.lexsort((elements.osm_id, elements.osm_type, along_curve(first - first.min(axis=0))))
    part_ends, part_rows = gather_spans(elements.part_starts, order)
    point_ends, point_rows = gather_spans(point_starts, part_rows)
    parts, ends = part_ends.astype(np.int32), point_ends.astype(np.int32)
    points = (steps[point_rows] * GRAIN).astype(np.float32)
    kind = elements.kind[order]
    texts: dict[str, int] = {}  # many things are called alike
    which = np.array([texts.setdefault(text, len(texts)) for text in elements.texts])[order]
    said = list(map(split_words, texts))
    label_starts, label_table, label_values = _table([labels for labels, _ in said], which)
    name_starts, name_table, name_values = _table([names for _, names in said], which)
    return CityObjects(
        osm_type=elements.osm_type[order],
        osm_id=elements.osm_id[order],
        kind=kind,
        label_starts=label_starts,
        label_values=label_values,
        name_starts=name_starts,
        name_values=name_values,
        part_starts=parts,
        point_starts=ends,
        points=points,
        labels=label_table,
        names=name_table,
    )


def _table(
    texts: list[tuple[str, ...]], which: NDArray[np.int64]
) -> tuple[NDArray[np.int32], tuple[str, ...], NDArray[np.int32]]:
    """Return the bounds of the words of each row, all words, sorted, and the indices of each row's words."""
    flat = [word for text in texts for word in text]
    table = tuple(sorted(set(flat)))
    index = {word: i for i, word in enumerate(table)}
    values = np.fromiter(map(index.__getitem__, flat), np.int32, len(flat))
    bounds, at = gather_spans(offsets_of(list(map(len, texts))), which)
    return bounds.astype(np.int32), table, values[at]
