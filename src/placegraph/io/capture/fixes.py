"""GPS fixes of a capture, from `fixes.txt` in its folder, else from the EXIF of its images."""

from __future__ import annotations

from contextlib import suppress
from math import isfinite, nan
from pathlib import Path
from typing import Any, NamedTuple

from placegraph.io.capture.frame import Capture, ColourFile, LazyImages
from placegraph.io.capture.images import open_image
from placegraph.io.capture.posed import match_stamps
from placegraph.io.capture.tum import read_table

FIXES_FILE = "fixes.txt"
"""File of rows `COLUMNS`, in the clock of the frames; heights and accuracies may be `nan`."""
COLUMNS = ("stamp", "longitude", "latitude", "height", "accuracy")
NEAR = 0.5
"""Largest distance in time between a fix and its frame [s]."""
_GPS = 0x8825
_SOUTH, _LAT, _WEST, _LON, _ABOVE, _HEIGHT, _ERROR = 1, 2, 3, 4, 5, 6, 31
_ELLIPSOID = {2: 1.0, 3: -1.0}  # EXIF 3.0: above it, below it; 0 and 1 are of the sea


class Fix(NamedTuple):
    """Position measured by a satellite receiver."""

    longitude: float
    latitude: float
    """[deg, WGS84]"""
    height: float = nan
    """Height above the ellipsoid [m], not above the sea; NaN: unknown."""
    accuracy: float = nan
    """Radius that holds the position with 68 % [m]; NaN: unknown."""


def read_fixes(capture: Capture) -> dict[int, Fix]:
    """Return fixes by the row of their frame, in order of time.

    Raises `InputError` where `fixes.txt` or an image is broken.
    """
    path = capture.path / FIXES_FILE if capture.path is not None and capture.path.is_dir() else None
    if path is not None and path.exists():
        return _read_file(path, capture)
    fixes = {}
    for row, frame in enumerate(capture):
        images = frame.images
        if isinstance(images, LazyImages) and isinstance(images.colours, ColourFile):
            with open_image(images.colours.path, images.colours.path) as image:
                fixes[row] = parse_exif(image.getexif())
    return {row: fix for row, fix in fixes.items() if fix is not None}


def _read_file(path: Path, capture: Capture) -> dict[int, Fix]:
    table = read_table(path, COLUMNS, unknown=COLUMNS[3:])
    for row, (_, lon, lat, _, accuracy) in enumerate(table.values.tolist()):
        if not (abs(lon) <= 180 and abs(lat) <= 90) or accuracy <= 0:
            raise table.error(
                row, "longitude must be -180 to 180, latitude -90 to 90, and accuracy above 0 [m]."
            )
    stamps = [frame.stamp for frame in capture]
    rows = match_stamps(stamps, table.values[:, 0], NEAR).tolist()
    fixes = [Fix(*values) for values in table.values[:, 1:].tolist()]
    return {row: fix for row, fix in zip(rows, fixes, strict=True) if row >= 0}


def parse_exif(exif: Any) -> Fix | None:  # noqa: ANN401  # Pillow's
    """Return the fix in EXIF; None without one, or at (0, 0), which cameras without a fix write."""
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
