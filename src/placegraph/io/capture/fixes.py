"""GPS fixes of a capture: of `fixes.txt` in its folder, else of the EXIF of its images."""

from __future__ import annotations

from contextlib import suppress
from math import isfinite, nan
from pathlib import Path
from typing import Any, NamedTuple

from placegraph.io.capture.frame import Capture, ColourFile, LazyImages
from placegraph.io.capture.images import opened
from placegraph.io.capture.posed import nearest_stamps
from placegraph.io.capture.tum import read_table

FILE = "fixes.txt"
"""Rows `COLUMNS`, in the clock of the frames; `nan` where a height or an accuracy is not known."""
COLUMNS = ("stamp", "longitude", "latitude", "height", "accuracy")
NEAR = 0.5
"""A fix belongs to the frame nearest in time, if that is so near [s]."""
_GPS = 0x8825
_SOUTH, _LAT, _WEST, _LON, _ABOVE, _HEIGHT, _ERROR = 1, 2, 3, 4, 5, 6, 31
_ELLIPSOID = {2: 1.0, 3: -1.0}  # EXIF 3.0: above it, below it; 0 and 1 are of the sea


class Fix(NamedTuple):
    """A place that a receiver told."""

    longitude: float
    latitude: float
    """[deg, WGS84]"""
    height: float = nan
    """Above the ellipsoid [m]; NaN: not known. Above the sea is something else."""
    accuracy: float = nan
    """Radius that holds the place with 68 % [m]; NaN: not known."""


def fixes_of(capture: Capture) -> dict[int, Fix]:
    """Return the fixes by the row of the frame that they belong to, in the order of time.

    Raises `InputError` where `fixes.txt` or an image is broken.
    """
    path = capture.path / FILE if capture.path is not None and capture.path.is_dir() else None
    if path is not None and path.exists():
        return _of_file(path, capture)
    found = {
        row: exif_fix_of(images.colours.path)
        for row, frame in enumerate(capture)
        if isinstance(images := frame.images, LazyImages) and isinstance(images.colours, ColourFile)
    }
    return {row: fix for row, fix in found.items() if fix is not None}


def _of_file(path: Path, capture: Capture) -> dict[int, Fix]:
    table = read_table(path, COLUMNS, unknown=COLUMNS[3:])
    for row, (_, lon, lat, _, accuracy) in enumerate(table.values.tolist()):
        if not (abs(lon) <= 180 and abs(lat) <= 90) or accuracy <= 0:
            raise table.error(
                row, "longitude is -180 to 180, latitude -90 to 90, accuracy above 0 [m]."
            )
    stamps = [frame.stamp for frame in capture]
    rows = nearest_stamps(stamps, table.values[:, 0], NEAR).tolist()
    fixes = [Fix(*values) for values in table.values[:, 1:].tolist()]
    return {row: fix for row, fix in zip(rows, fixes, strict=True) if row >= 0}


def exif_fix_of(path: Path) -> Fix | None:
    """Return the fix of an image file; None: it tells none."""
    with opened(path, path) as image:
        return exif_fix(image.getexif())


def exif_fix(exif: Any) -> Fix | None:  # noqa: ANN401  # Pillow's
    """Return the fix that EXIF tells; None: it tells none, or (0, 0), as cameras without a fix write."""
    with suppress(TypeError, ValueError, ZeroDivisionError, KeyError):
        gps = exif.get_ifd(_GPS)
        lat, lon = (sum(float(v) / 60.0**k for k, v in enumerate(gps[tag])) for tag in (_LAT, _LON))
        lat *= -1 if gps.get(_SOUTH) == "S" else 1
        lon *= -1 if gps.get(_WEST) == "W" else 1
        if abs(lat) <= 90 and abs(lon) <= 180 and (lat or lon):
            above = gps.get(_ABOVE, 0)
            sign = _ELLIPSOID.get(above[0] if isinstance(above, bytes) and above else above, nan)
            return Fix(lon, lat, sign * _number(gps.get(_HEIGHT)), _number(gps.get(_ERROR)) or nan)
    return None


def _number(value: Any) -> float:  # noqa: ANN401  # Pillow's
    with suppress(TypeError, ValueError, ZeroDivisionError):
        number = float(value)
        return number if isfinite(number) else nan
    return nan
