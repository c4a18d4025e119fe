"""Reader of Overture Maps: GeoParquet of places, buildings, segments and the base theme.

A row becomes the element that OpenStreetMap would have of it, so that all that stands on elements stands
on Overture, too. Only row groups that meet the box are read, a few thousand rows at a time. Columns
become tags by the table `data/overture.tsv`.
"""

from __future__ import annotations

import hashlib
import math
import re
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import InputError, MissingExtraError, OptionError
from placegraph.io.osm.osm import (
    AREA,
    LINE,
    NODE,
    POINT,
    RELATION,
    WAY,
    LeftOut,
    OsmElement,
    one_line,
)
from placegraph.io.osm.urls import is_osm_url

Tags = dict[str, str]

TABLE = "data/overture.tsv"
BASE = frozenset({"infrastructure", "land", "land_use", "water"})
"""Types of the base theme, which bring tags of OpenStreetMap along."""
NO_TAG = "whose class has no matching tag"
BY_NAME = "stored by name only, because no tag matches their category"
_VARIANTS = {"official": "official_name", "alternate": "alt_name", "short": "short_name"}
_LANGUAGE = re.compile(r"[a-z]{2,3}(-[A-Za-z]+)?")
_NUMBER_FIRST = re.compile(r"(\d+\w?)\s+(\D[^,]*)")
_NUMBER_LAST = re.compile(r"(\D[^,\d]*)\s+(\d+\w?)(?:,|$)")


@lru_cache(maxsize=1)
def tag_table() -> dict[tuple[str, str, str], str]:
    """Return the tags by type, field and value, as written in the table; patterns with a star last."""
    text = files("placegraph_io").joinpath(TABLE).read_text("utf-8")
    lines = [line.split("\t") for line in text.splitlines() if line and not line.startswith("#")]
    rows = [
        (kind, field, value, tags)
        for kind, field, values, tags in lines[1:]
        for value in values.split()
    ]
    rows.sort(key=lambda row: "*" in row[2])
    return {(kind, field, value): tags for kind, field, value, tags in rows}


@lru_cache(maxsize=1 << 14)
def _find_tags(kind: str, field: str, value: str, of: str = "") -> tuple[tuple[str, str], ...]:
    """Return the tags of a value, empty where it is unknown."""
    tags, star = tag_table().get((kind, field, value)), ""
    if tags is None:
        for (its_kind, its_field, pattern), its_tags in _stars():
            tail = pattern.removeprefix("*")
            if (its_kind, its_field) == (kind, field) and value.endswith(tail):
                tags, star = its_tags, value.removesuffix(tail)
                break
    filled = (tags or "").replace("{}", value).replace("{*}", star).replace("{class}", of)
    return tuple((key, its) for key, _, its in (tag.partition("=") for tag in filled.split()))


@lru_cache(maxsize=1)
def _stars() -> tuple[tuple[tuple[str, str, str], str], ...]:
    return tuple((row, tags) for row, tags in tag_table().items() if row[2].startswith("*"))


def tags_of(kind: str, row: Mapping[str, Any]) -> tuple[Tags, str]:
    """Return the tags of a row of a feature type, and the reason to count, if any.

    Without tags the row is not used. A place of an unknown category keeps its names.
    """
    named = _name_tags(row)
    if kind in BASE:
        tags = {str(k): str(v) for k, v in _pairs(row.get("source_tags"))}
        return (tags | named, "") if tags else ({}, NO_TAG)
    if kind == "place":
        tags = _place_tags(row)
        if not tags:
            return named, BY_NAME if "name" in named else NO_TAG
        return tags | named, ""
    tags, known = _building_tags(row) if kind == "building" else _segment_tags(row)
    return (tags | named, "" if known else NO_TAG) if tags else ({}, NO_TAG)


def _place_tags(row: Mapping[str, Any]) -> Tags:
    """Return the tags of the most specific category that has some, and of other categories beside it."""
    taxonomy, categories = row.get("taxonomy") or {}, row.get("categories") or {}
    ways = (
        [categories.get("primary")],
        [taxonomy.get("primary"), *reversed(taxonomy.get("hierarchy") or ())],
        [row.get("basic_category")],
    )
    tags: Tags = {}
    for value in (value for way in ways for value in way if value):
        if tags := dict(_find_tags("place", "category", str(value))):
            break
    others = [*(categories.get("alternate") or ()), *(taxonomy.get("alternates") or ())]
    for value in others:
        found = dict(_find_tags("place", "category", str(value)))
        if tags.keys().isdisjoint(found):
            tags |= found
    return tags


def _building_tags(row: Mapping[str, Any]) -> tuple[Tags, bool]:
    """Return the tags of a building, which is one whatever it is for; and whether its class is known."""
    given = [(field, str(row[field])) for field in ("subtype", "class") if row.get(field)]
    found = [_find_tags("building", field, value) for field, value in given]
    tags = {"building": "yes"}
    for pairs in found:
        tags |= dict(pairs)
    return tags, all(found)


def _segment_tags(row: Mapping[str, Any]) -> tuple[Tags, bool]:
    """Return the tags of a segment by subtype and class, then by what it is of its class."""
    subtype, its_class = str(row.get("subtype")), str(row.get("class") or "unknown")
    tags = dict(_find_tags("segment", subtype, its_class))
    rules = row.get("subclass_rules") or ()
    subclass = row.get("subclass") or next((r["value"] for r in rules if r.get("value")), None)
    if not tags or subclass is None:
        return tags, bool(tags)
    more = dict(_find_tags("segment", "subclass", str(subclass), its_class))
    return tags | more, bool(more)


def _name_tags(row: Mapping[str, Any]) -> Tags:
    """Return the names, brand and address, under the keys of OpenStreetMap."""
    names, out = row.get("names") or {}, {}
    if names.get("primary"):
        out["name"] = str(names["primary"])
    for language, name in _pairs(names.get("common")):
        if name and _LANGUAGE.fullmatch(str(language)):
            out[f"name:{language}"] = str(name)
    for rule in names.get("rules") or ():
        key = _VARIANTS.get(str(rule.get("variant")))
        if key and rule.get("value"):
            out[key] = ";".join(filter(None, (out.get(key), str(rule["value"]))))
    brand = ((row.get("brand") or {}).get("names") or {}).get("primary")
    if brand:
        out["brand"] = str(brand)
    addresses = row.get("addresses") or ()
    return out | (_address(str(addresses[0].get("freeform") or "")) if addresses else {})


def _address(freeform: str) -> Tags:
    """Return the house number and street of an address in free form, where it has both."""
    if first := _NUMBER_FIRST.match(freeform):
        number, street = first.groups()
    elif last := _NUMBER_LAST.match(freeform):
        street, number = last.groups()
    else:
        return {}
    return {"addr:housenumber": number, "addr:street": street.strip()}


def _pairs(
    mapping: Mapping[str, Any] | Iterable[tuple[str, Any]] | None,
) -> Iterable[tuple[str, Any]]:
    """Return the pairs of a map: Arrow hands a list of them out."""
    if mapping is None:
        return ()
    return mapping.items() if isinstance(mapping, dict) else mapping  # type: ignore[return-value]


TYPE_COLUMNS = {
    "place": ("categories", "taxonomy", "basic_category"),
    "segment": ("subclass_rules", "subclass", "connectors", "road_surface"),
    "building": ("class", "has_parts", "is_underground", "num_floors"),
}
"""Columns that identify a type without its folder, in this order."""
REQUIRED_COLUMNS = {
    "place": ("names",),
    "segment": ("subtype", "class"),
    "building": ("subtype", "class"),
}
"""Columns that a type must have."""
COLUMNS = frozenset(
    (
        "id", "geometry", "names", "categories", "taxonomy", "basic_category", "confidence",
        "operating_status", "brand", "addresses", "subtype", "class", "subclass", "subclass_rules",
        "source_tags",
    )
)  # fmt: skip
"""Columns that are read, where a file has them."""
EDGES = ("xmin", "ymin", "xmax", "ymax")
READ_ERRORS = (ValueError, TypeError, LookupError, ArithmeticError, AttributeError, MemoryError)
"""Errors that damaged columns raise, beside PyArrow's own."""
_TYPE = re.compile(r"[/\\]type=([a-z_]+)[/\\]")
_MAGIC = b"PAR1"
_STATISTICS_CHECK = """
import sys
from io import BytesIO
from pyarrow.parquet import read_metadata
try:
    found = read_metadata(BytesIO(sys.stdin.buffer.read()))
    groups = [found.row_group(i) for i in range(found.num_row_groups)]
    given = [group.column(i).statistics for group in groups for i in range(group.num_columns)]
except Exception:
    pass
"""
"""Program that reads all statistics of a footer."""
_BUFFER = 1 << 20  # Bytes of a column that are read at once


@dataclass(frozen=True)
class OvertureFile:
    """One Parquet file of one feature type."""

    path: str
    filesystem: Any
    type: str

    def batches(self, box: Box | None, rows: int) -> Iterator[dict[str, list[Any]]]:
        """Yield the columns, by name, of the rows that meet a box, at most so many at a time.

        Row groups whose statistics lie beside the box are not read.
        """
        import pyarrow.parquet as pq

        with self.filesystem.open_input_file(self.path) as stream:
            if box is not None:
                _check_statistics(stream, self.path)
            file = pq.ParquetFile(stream, buffer_size=_BUFFER, pre_buffer=False)
            groups = [
                i for i in range(file.num_row_groups) if _may_meet(file.metadata.row_group(i), box)
            ]
            names = [name for name in file.schema_arrow.names if name in COLUMNS or name == "bbox"]
            for batch in file.iter_batches(rows, groups, names, use_threads=False):
                inside = batch if box is None else batch.filter(_inside(batch.column("bbox"), box))
                wanted = [name for name in inside.schema.names if name in COLUMNS]
                yield {name: inside.column(name).to_pylist() for name in wanted}


def find_files(
    paths: Sequence[str], suffixes: tuple[str, ...], counts: Counter[str]
) -> Iterator[OvertureFile]:
    """Yield the files of all paths that are of a known type and whole in their columns, in order.

    Those of other types that lie in a folder are counted. Raises `InputError` where a path holds
    none, or a file is no Parquet, or lacks a column.
    """
    for path in paths:
        filesystem, root = _filesystem(path)
        found = list(_list_files(filesystem, root, suffixes, path))
        alone = found == [root]
        for name in found:
            kind = _type(filesystem, name, path)
            if kind in REQUIRED_COLUMNS or kind in BASE:
                yield OvertureFile(name, filesystem, kind)
            elif alone:
                raise InputError(
                    f"{path} contains {kind or 'rows of no known type'}, but only Overture's "
                    "places, buildings, segments and base theme are supported."
                )
            else:
                counts[f"files of {kind or 'no known type'}"] += 1


def _filesystem(path: str) -> tuple[Any, str]:
    """Return PyArrow's file system of a path or URL, and the path in it; by fsspec where it has none."""
    from pyarrow import fs

    if "://" not in path:
        return fs.LocalFileSystem(), path
    try:
        return fs.FileSystem.from_uri(path)
    except (ValueError, OSError, NotImplementedError) as error:
        try:
            import fsspec

            found, root = fsspec.core.url_to_fs(path)
        except (ImportError, ValueError) as other:
            raise OptionError(
                f"{path}: this kind of URL is not supported ({one_line(error)}; {one_line(other)})."
            ) from other
        return fs.PyFileSystem(fs.FSSpecHandler(found)), str(root)


def _list_files(filesystem: Any, root: str, suffixes: tuple[str, ...], given: str) -> Iterator[str]:  # noqa: ANN401
    """Yield the parquet files of a folder, by name, or the one file that a path is."""
    from pyarrow import fs

    try:
        (info,) = filesystem.get_file_info([root])
        if info.type == fs.FileType.NotFound:
            raise InputError(f"{given} does not exist; check the path.")
        if info.type == fs.FileType.File:
            yield root
            return
        inside = filesystem.get_file_info(fs.FileSelector(root, recursive=True))
    except OSError as error:
        raise InputError(f"{given} cannot be reached: {one_line(error)}.") from error
    names = sorted(i.path for i in inside if i.is_file and i.path.lower().endswith(suffixes))
    if not names:
        raise InputError(
            f"{given} contains no Parquet file ({', '.join(suffixes)}); give an Overture folder, "
            "such as theme=places."
        )
    yield from names


def _type(filesystem: Any, name: str, given: str) -> str:  # noqa: ANN401
    """Feature type of a file: by its folder, else by its columns; "" where it is none of Overture's.

    Raises `InputError` where the file is no Parquet, or lacks what its type needs.
    """
    named = _TYPE.search(name)
    if named and named[1] not in REQUIRED_COLUMNS and named[1] not in BASE:
        return named[1]  # not opened
    columns = _columns(filesystem, name)
    kind = (
        named[1]
        if named
        else next((k for k, tells in TYPE_COLUMNS.items() if columns & set(tells)), "")
    )
    if not named and "source_tags" in columns and kind != "segment":
        kind = "land_use"  # or another of the base theme: all are read alike
    if not kind:
        return ""
    lacks = [
        c
        for c in ("id", "geometry", *REQUIRED_COLUMNS.get(kind, ("source_tags",)))
        if c not in columns
    ]
    if kind == "place" and not columns & set(TYPE_COLUMNS["place"]):
        lacks.append(TYPE_COLUMNS["place"][0])
    lacks += [f"bbox.{edge}" for edge in EDGES if f"bbox.{edge}" not in columns]
    if lacks:
        raise InputError(
            f"{name if name != given else given} lacks the column {', '.join(lacks)} of Overture's "
            f"{kind}s; download it again, with all columns of a release since 2024-07."
        )
    return kind


def _columns(filesystem: Any, name: str) -> set[str]:  # noqa: ANN401
    """Return the names of columns, with those of the edges in ``bbox``; checks how shapes are written."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with filesystem.open_input_file(name) as stream:
            schema = pq.read_schema(stream)
    except (pa.ArrowException, OSError, *READ_ERRORS) as error:
        raise InputError(
            f"{name} cannot be read as Parquet: {one_line(error)}. Download it again."
        ) from error
    out = set(schema.names)
    if "geometry" in out:
        kind = schema.field("geometry").type
        kind = getattr(kind, "storage_type", kind)
        if not (pa.types.is_binary(kind) or pa.types.is_large_binary(kind)):
            raise InputError(
                f"{name}: geometry is {kind}, not WKB; export it as GeoParquet with WKB."
            )
    if "bbox" in out and pa.types.is_struct(schema.field("bbox").type):
        out |= {f"bbox.{field.name}" for field in schema.field("bbox").type}
    return out


def _check_statistics(stream: Any, name: str) -> None:  # noqa: ANN401
    """Raise `InputError` where reading a file's statistics crashes PyArrow."""
    tail = min(
        stream.size(), 8 + int.from_bytes(stream.read_at(4, max(0, stream.size() - 8)), "little")
    )
    footer = _MAGIC + stream.read_at(tail, stream.size() - tail)
    with suppress(OSError):  # no process can be started, as in a sandbox
        look = [sys.executable, "-P", "-c", _STATISTICS_CHECK]
        died = subprocess.run(look, input=footer, capture_output=True, check=False)  # noqa: S603
        if died.returncode < 0:
            raise InputError(
                f"{name} is damaged: PyArrow crashes while reading its statistics, with "
                f"{signal.strsignal(-died.returncode)}. Download it again."
            )


def _may_meet(group: Any, box: Box | None) -> bool:  # noqa: ANN401
    """Return whether a row group may hold rows that meet a box, by its statistics."""
    if box is None:
        return True
    low, high = {}, {}
    for i in range(group.num_columns):
        column = group.column(i)
        if column.path_in_schema.startswith("bbox.") and column.statistics is not None:
            if not column.statistics.has_min_max:
                continue
            edge = column.path_in_schema.removeprefix("bbox.")
            low[edge], high[edge] = column.statistics.min, column.statistics.max
    return not (
        low.get("xmin", -180.0) > box.east
        or high.get("xmax", 180.0) < box.west
        or low.get("ymin", -90.0) > box.north
        or high.get("ymax", 90.0) < box.south
    )


def _inside(bbox: Any, box: Box) -> Any:  # noqa: ANN401
    """Return which rows of a column of boxes meet a box; those without one do."""
    import pyarrow.compute as pc

    west, south, east, north = (pc.struct_field(bbox, edge) for edge in EDGES)
    beside = [
        pc.greater(west, box.east),
        pc.less(east, box.west),
        pc.greater(south, box.north),
        pc.less(north, box.south),
    ]
    out = beside[0]
    for also in beside[1:]:
        out = pc.or_kleene(out, also)
    return pc.invert(pc.fill_null(out, False))


SUFFIXES = (".parquet", ".geoparquet")
CONFIDENCE = 0.5  # Least of a place
BATCH = 4096  # Rows read at a time
_POINTS, _LINES, _AREAS = (0, 4), (1, 2, 5), (3, 6)  # shapely's numbers of geometries
_HEX = re.compile(r"[0-9a-f]{16,}")


class Box(NamedTuple):
    """Part of the Earth [deg]."""

    west: float
    south: float
    east: float
    north: float

    @classmethod
    def of(cls, numbers: Sequence[float]) -> Box:
        """Return the box of west, south, east, north [deg]; raises `OptionError` where they make none."""
        if len(numbers) != 4 or not all(map(math.isfinite, numbers)):
            raise OptionError(
                "bbox must be four numbers: west, south, east, north in degrees, such as "
                "7.41,43.72,7.44,43.75."
            )
        west, south, east, north = map(float, numbers)
        if not (
            -180 <= west <= 180
            and -180 <= east <= 180
            and -90 <= south <= 90
            and -90 <= north <= 90
        ):
            raise OptionError(
                f"bbox {_format_box(numbers)} is out of range; give west, south, east, north in "
                "degrees: longitude, latitude, longitude, latitude."
            )
        if west >= east or south >= north:
            raise OptionError(
                f"bbox {_format_box(numbers)} is empty: west must be less than east ({west:g}, "
                f"{east:g}), and south less than north ({south:g}, {north:g}). Exchange them; "
                "across the date line, build two maps."
            )
        return cls(west, south, east, north)

    def __str__(self) -> str:
        return _format_box(self)


def _format_box(numbers: Sequence[float]) -> str:
    return ",".join(f"{n:g}" for n in numbers)


@dataclass(frozen=True)
class Overture:
    """Selection of Overture's data: paths, box and least confidence."""

    paths: tuple[str, ...]
    """Files, folders of such, or URLs of either (``s3://...``, or any that fsspec knows)."""
    box: Box | None = None  # Only features that touch it are read; None: all
    confidence: float = CONFIDENCE  # Places of a smaller confidence are left out

    def __post_init__(self) -> None:
        if not self.paths:
            raise OptionError("Give at least one Overture file or folder.")
        if not 0.0 <= self.confidence <= 1.0:
            raise OptionError(f"confidence is {self.confidence}; choose between 0 and 1.")

    def __str__(self) -> str:
        return ", ".join(self.paths)


def is_overture(path: str) -> bool:
    """Return whether a path or URL looks like one of Overture, and not like an OpenStreetMap file."""
    if path.lower().endswith(SUFFIXES) or ("://" in path and not is_osm_url(path)):
        return True
    return Path(path).is_dir() and any(next(Path(path).rglob(f"*{end}"), None) for end in SUFFIXES)


def read_overture(source: Overture, left_out: LeftOut | None = None) -> Iterator[OsmElement]:
    """Yield Overture's features as elements of OpenStreetMap.

    Places are points, segments lines, buildings areas. Ids are negative, since they are none of
    OpenStreetMap: their digits are the last 15 hexadecimal ones of Overture's id.

    `source`: files, box and least confidence; `left_out`: is told what was left out, and why.

    Raises `MissingExtraError`: pyArrow or Shapely is not installed; `InputError`: a file is missing, no
    Parquet, of another schema, or damaged; nothing lies in the box.
    """
    try:
        import pyarrow.parquet  # noqa: F401
        import shapely  # noqa: F401
    except ImportError as error:
        raise MissingExtraError(
            "Overture files need PyArrow and Shapely: pip install 'placegraph[overture]'."
        ) from error
    counts = (LeftOut() if left_out is None else left_out).counts
    found = 0
    for file in find_files(source.paths, SUFFIXES, counts):
        for element in _elements(file, source, counts):
            found += 1
            yield element
    if not found:
        where = f" in bbox {source.box}" if source.box else ""
        left = ", ".join(f"{n} {why}" for why, n in sorted(counts.items())) or "nothing"
        raise InputError(
            f"{source}: no usable objects{where}; ignored: {left}. Give west,south,east,north of "
            "an area that the files cover, or other files."
        )


def _elements(file: OvertureFile, source: Overture, counts: Counter[str]) -> Iterator[OsmElement]:
    """Yield the elements of one file; raises `InputError` where it cannot be read to its end."""
    import pyarrow as pa
    import shapely

    try:
        for rows in file.batches(source.box, BATCH):
            shapes = shapely.from_wkb(rows.pop("geometry"), on_invalid="ignore")
            for i, shape in enumerate(shapes):
                row = {name: column[i] for name, column in rows.items()}
                element = _element(file.type, row, shape, source.confidence, counts)
                if element is not None:
                    yield element
    except (pa.ArrowException, OSError, *READ_ERRORS) as error:
        raise InputError(
            f"{file.path} cannot be read as Parquet: {one_line(error)}. Download it again."
        ) from error


def _element(
    kind: str,
    row: dict[str, Any],
    shape: Any,  # noqa: ANN401
    confidence: float,
    counts: Counter[str],
) -> OsmElement | None:
    """Return the element of a row, or None and a count of why there is none."""
    if shape is None:
        counts[f"{kind}s whose geometry is not WKB"] += 1
        return None
    why = _why_closed(row, confidence)
    if why:
        counts[f"{kind}s {why}"] += 1
        return None
    geometry = _parts(shape)
    if isinstance(geometry, str):
        counts[f"{kind}s {geometry}"] += 1
        return None
    tags, why = tags_of(kind, row)
    if why:
        counts[f"{kind}s {why}"] += 1
    if not tags:
        return None
    geometry_kind, parts = geometry
    osm_type = (NODE, WAY, WAY if len(parts) == 1 else RELATION)[geometry_kind]
    return OsmElement(osm_type, make_id(str(row["id"])), geometry_kind, tags, parts)


def _why_closed(row: dict[str, Any], confidence: float) -> str:
    """Return why a place does not exist (any more), or an empty text."""
    if row.get("operating_status") == "permanently_closed":
        return "permanently closed"
    known = row.get("confidence")
    return "below the confidence limit" if known is not None and known < confidence else ""


def _parts(shape: Any) -> tuple[int, list[NDArray[np.float64]]] | str:  # noqa: ANN401
    """Return the kind and parts (n, 2) of a shape, longitude and latitude [deg]; or what is wrong with it."""
    import shapely

    number = shapely.get_type_id(shape)
    if number in _POINTS:
        kind, pieces = POINT, [shape]
    elif number in _LINES:
        kind, pieces = LINE, shapely.get_parts(shape)
    elif number in _AREAS:
        kind, pieces = AREA, shapely.get_rings(shape)
    else:
        return "with several kinds of geometry"
    parts = [part for part in map(shapely.get_coordinates, pieces) if len(part)]
    if not parts:
        return "without a position"
    if not all((np.abs(part) <= (180.0, 90.0)).all() for part in parts):  # NaN is not, either
        return "with coordinates out of range"
    return kind, [parts[0][:1]] if kind == POINT else parts


def make_id(overture_id: str) -> int:
    """Return a negative id for an id of Overture: of its last 15 hexadecimal digits, or of a digest."""
    digits = overture_id.replace("-", "").lower()
    if not _HEX.fullmatch(digits):
        digits = hashlib.sha256(overture_id.encode()).hexdigest()
    return -1 - int(digits[-15:], 16)
