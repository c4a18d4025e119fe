"""Reader of Overture Maps: GeoParquet of places, buildings, segments and the base theme.

A row becomes the element that OpenStreetMap would have of it, so that all that stands on elements
stands on Overture, too. Only row groups that meet the box are read, a few thousand rows at a time.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
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
from placegraph.io.osm.urls import of_osm
from placegraph_io.overture.overture_files import DAMAGED, OvertureFile, files_of
from placegraph_io.overture.overture_tags import tags_of

SUFFIXES = (".parquet", ".geoparquet")
CONFIDENCE = 0.5
"""Least of a place."""
BATCH = 4096
"""Rows read at a time."""
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
        """Box of west, south, east, north [deg]; raises `OptionError` where they make none."""
        if len(numbers) != 4 or not all(map(math.isfinite, numbers)):
            raise OptionError(
                "bbox has to be four numbers: west, south, east, north in degrees, such as "
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
                f"bbox {_said(numbers)} lies beyond the Earth; give west, south, east, north in "
                "degrees: longitude, latitude, longitude, latitude."
            )
        if west >= east or south >= north:
            raise OptionError(
                f"bbox {_said(numbers)} is empty: west has to be less than east ({west:g}, {east:g}), "
                f"and south less than north ({south:g}, {north:g}). Exchange them; across the date "
                "line, build two maps."
            )
        return cls(west, south, east, north)

    def __str__(self) -> str:
        return _said(self)


def _said(numbers: Sequence[float]) -> str:
    return ",".join(f"{n:g}" for n in numbers)


@dataclass(frozen=True)
class Overture:
    """What of Overture is read."""

    paths: tuple[str, ...]
    """Files, folders of such, or URLs of either (``s3://...``, or any that fsspec knows)."""
    box: Box | None = None
    """What touches it is read; everything where it is None."""
    confidence: float = CONFIDENCE
    """Places that exist with a smaller probability than this, by Overture's word, are left out."""

    def __post_init__(self) -> None:
        if not self.paths:
            raise OptionError("Name at least one file or folder of Overture.")
        if not 0.0 <= self.confidence <= 1.0:
            raise OptionError(f"confidence is {self.confidence}; choose between 0 and 1.")

    def __str__(self) -> str:
        return ", ".join(self.paths)


def is_overture(path: str) -> bool:
    """Whether a path or URL looks like one of Overture, and not like an OpenStreetMap file."""
    if path.lower().endswith(SUFFIXES) or ("://" in path and not of_osm(path)):
        return True
    return Path(path).is_dir() and any(next(Path(path).rglob(f"*{end}"), None) for end in SUFFIXES)


def read_overture(source: Overture, left_out: LeftOut | None = None) -> Iterator[OsmElement]:
    """Yield what Overture knows, as elements of OpenStreetMap.

    Places are points, segments lines, buildings areas. Ids are negative, since they are none of
    OpenStreetMap: their digits are the last 15 hexadecimal ones of Overture's id.

    Parameters
    ----------
    source
        Files, box and least confidence.
    left_out
        Is told what was left out, and why.

    Raises
    ------
    MissingExtraError
        PyArrow or Shapely is not installed.
    InputError
        A file is missing, no Parquet, of another schema, or damaged; nothing lies in the box.

    """
    _check_installed()
    counts = (LeftOut() if left_out is None else left_out).counts
    found = 0
    for file in files_of(source.paths, SUFFIXES, counts):
        for element in _elements(file, source, counts):
            found += 1
            yield element
    if not found:
        where = f" lies in bbox {source.box}" if source.box else ""
        left = ", ".join(f"{n} {why}" for why, n in sorted(counts.items())) or "nothing"
        raise InputError(
            f"{source}: nothing that can be told{where}; left out: {left}. Give west,south,east,north "
            "of a part that the files hold, or other files."
        )


def _check_installed() -> None:
    try:
        import pyarrow.parquet  # noqa: F401
        import shapely  # noqa: F401
    except ImportError as error:
        raise MissingExtraError(
            "Overture's files are read by PyArrow and Shapely: pip install 'placegraph[overture]'."
        ) from error


def _elements(file: OvertureFile, source: Overture, counts: Counter[str]) -> Iterator[OsmElement]:
    """Elements of one file; raises `InputError` where it cannot be read to its end."""
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
    except (pa.ArrowException, OSError, *DAMAGED) as error:
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
    """Element of a row, or None and a count of why there is none."""
    if shape is None:
        counts[f"{kind}s whose geometry is no WKB"] += 1
        return None
    why = _closed(row, confidence)
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
    return OsmElement(osm_type, identity(str(row["id"])), geometry_kind, tags, parts)


def _closed(row: dict[str, Any], confidence: float) -> str:
    """Why a place is none (any more), or nothing."""
    if row.get("operating_status") == "permanently_closed":
        return "closed for good"
    known = row.get("confidence")
    return "of less confidence" if known is not None and known < confidence else ""


def _parts(shape: Any) -> tuple[int, list[NDArray[np.float64]]] | str:  # noqa: ANN401
    """Kind and parts (n, 2) of a shape, longitude and latitude [deg]; or what is wrong with it."""
    import shapely

    number = shapely.get_type_id(shape)
    if number in _POINTS:
        kind, pieces = POINT, [shape]
    elif number in _LINES:
        kind, pieces = LINE, shapely.get_parts(shape)
    elif number in _AREAS:
        kind, pieces = AREA, shapely.get_rings(shape)
    else:
        return "of several kinds of geometry"
    parts = [part for part in map(shapely.get_coordinates, pieces) if len(part)]
    if not parts:
        return "without a position"
    if not all((np.abs(part) <= (180.0, 90.0)).all() for part in parts):  # NaN is not, either
        return "with coordinates out of range"
    return kind, [parts[0][:1]] if kind == POINT else parts


def identity(overture_id: str) -> int:
    """Negative number of an id of Overture: its last 15 hexadecimal digits, of others a digest."""
    digits = overture_id.replace("-", "").lower()
    if not _HEX.fullmatch(digits):
        digits = hashlib.sha256(overture_id.encode()).hexdigest()
    return -1 - int(digits[-15:], 16)
