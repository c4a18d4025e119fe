"""Reader of OpenStreetMap files: `.osm.pbf`, `.osm`, `.osm.gz`, `.osm.bz2`.

Yields every element that carries one of the wanted keys, with its geometry in longitude and
latitude: nodes as points, open ways as lines, closed ways and multipolygon relations as areas.
"""

from __future__ import annotations

import errno
import re
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from os import PathLike
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import write_error
from placegraph.errors import InputError
from placegraph.io.osm import osm_process

NODE, WAY, RELATION = 0, 1, 2
POINT, LINE, AREA = 0, 1, 2

SUFFIXES = (".osm.pbf", ".pbf", ".osm", ".osm.gz", ".osm.bz2", ".osm.xml", ".xml", ".osmag")
LINE_KEYS = frozenset({"highway", "barrier", "railway", "waterway", "power", "aerialway", "route"})
"""Keys whose closed ways are loops, not areas, unless `area=yes` or the value says otherwise."""
AREA_VALUES = frozenset(
    {"riverbank", "dock", "boatyard", "substation", "plant", "platform", "station"}
)

_FULL = re.compile("No space left|File too large|quota", re.IGNORECASE)
"""Error of osmium when the disk is full."""
STEPS = 1e7
"""Steps in a degree, in which OpenStreetMap has its coordinates."""


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


class OsmColumns(NamedTuple):
    """Tagged elements as columns; row i of every column is one."""

    osm_type: NDArray[np.uint8]
    osm_id: NDArray[np.int64]
    kind: NDArray[np.uint8]
    part_starts: NDArray[np.int64]
    """(N + 1,) parts of an element."""
    point_starts: NDArray[np.int64]
    """(P + 1,) points of a part."""
    steps: NDArray[np.int32]
    """(V, 2) longitude, latitude in steps of 1e-7 degrees."""
    tags: list[dict[str, str]]
    """Tags of each element; elements with equal tags share one dictionary."""


@dataclass
class LeftOut:
    """Numbers of unusable elements by reason, filled while reading."""

    counts: Counter[str] = field(default_factory=Counter)
    read: int = 0
    """Blocks of the file that were looked at so far, or before."""

    def __str__(self) -> str:
        return ", ".join(f"{n} {reason}" for reason, n in sorted(self.counts.items())) or "nothing"


def read_osm(
    path: str | PathLike[str],
    keys: Iterable[str],
    left_out: LeftOut | None = None,
    index: Path | None = None,
) -> Iterator[OsmElement]:
    """Yield the elements of an OpenStreetMap file that carry one of `keys`; see `read_columns`."""
    for columns in read_columns(path, keys, left_out, index):
        lonlat, points = columns.steps / STEPS, columns.point_starts
        heads = (columns.osm_type.tolist(), columns.osm_id.tolist(), columns.kind.tolist())
        bounds = pairwise(columns.part_starts.tolist())
        for osm_type, osm_id, kind, tags, (a, b) in zip(*heads, columns.tags, bounds, strict=True):
            parts = [lonlat[i:j] for i, j in pairwise(points[a : b + 1].tolist())]
            yield OsmElement(osm_type, osm_id, kind, tags, parts)


def read_columns(
    path: str | PathLike[str],
    keys: Iterable[str],
    left_out: LeftOut | None = None,
    index: Path | None = None,
) -> Iterator[OsmColumns]:
    """Yield the elements of an OpenStreetMap file that carry one of `keys`, block after block.

    Parameters
    ----------
    path
        File in a format of `SUFFIXES`; what is no PBF is made one first, beside other temporary files.
    keys
        Keys worth reading; everything else is skipped by compiled code.
    left_out
        Is told what was left out, and why: clipped extracts lack members of ways and relations. Of
        one that was told of `read` blocks before, these are passed over.
    index
        File for the positions of nodes, 12 bytes each, made and removed; they are held in memory
        where none is named.

    Raises
    ------
    InputError
        The file is missing, empty, truncated, not OpenStreetMap data, holds history, has its nodes
        behind the ways that need them, or is damaged such that assembling its areas crashes.
    MapError
        There is no room for `index`, or for a PBF of what is none.

    """
    from placegraph.io.osm.reader import Reader  # which makes what is described here

    path, left_out = check_osm(Path(path)), LeftOut() if left_out is None else left_out
    try:
        with _open_as_pbf(path) as pbf, pbf.open("rb") as file:
            yield from Reader(file, path, keys, left_out).columns(index)
    except (RuntimeError, OSError, ValueError) as error:
        raise InputError(
            f"{path} cannot be read as OpenStreetMap data: {one_line(error)}. "
            "It may be truncated or of another format; download or export it again."
        ) from error


@contextmanager
def _open_as_pbf(path: Path) -> Iterator[Path]:
    """Yield a file as PBF, converted by osmium if necessary."""
    ending = _ending(path)
    if ending.endswith("pbf"):
        yield path
        return
    with TemporaryDirectory() as folder:
        made = Path(folder) / "made.osm.pbf"
        try:
            _convert(path, made)
        except RuntimeError as error:
            if _FULL.search(str(error)):
                raise write_error(made, OSError(errno.ENOSPC, one_line(error))) from error
            raise
        yield made


def _convert(path: Path, made: Path) -> None:
    """Let a process of its own write a file as PBF; where none can be, as in a sandbox, this one does."""
    given = [str(path), _ending(path), str(made)]
    command = [sys.executable, "-P", osm_process.__file__, "convert", *given]
    try:
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, check=False)  # noqa: S603  # our own interpreter and file
    except OSError:
        osm_process.convert(*given)
        return
    if done.returncode < 0:
        raise InputError(
            f"{path} is damaged: osmium crashed while reading it, with "
            f"{signal.strsignal(-done.returncode)}. Download or export it again."
        )
    if done.returncode:
        raise RuntimeError(done.stderr.decode(errors="replace"))


def osm_file(path: Path) -> Any:  # noqa: ANN401  # osmium has no types
    """Return the file for osmium, which knows endings in lower case only."""
    import osmium

    return osmium.io.File(path, _ending(path))


def _ending(path: Path) -> str:
    ending = next(s for s in SUFFIXES if path.name.lower().endswith(s))
    return ending.removeprefix(".").replace("osmag", "osm")


def check_osm(path: Path) -> Path:
    """Return the path of a file that may be read; raises `InputError` where it is none."""
    try:
        size = -1 if path.is_dir() else path.stat().st_size
    except (OSError, ValueError) as error:
        missing = isinstance(error, FileNotFoundError)
        why = "does not exist" if missing else f"cannot be read ({error})"
        raise InputError(f"{path} {why}; check the path.") from error
    if size < 0:
        raise InputError(f"{path} is a folder; name an OpenStreetMap file in it.")
    if not path.name.lower().endswith(SUFFIXES):
        raise InputError(
            f"{path} has an unknown ending; OpenStreetMap files end in {', '.join(SUFFIXES)}."
        )
    if size == 0:
        raise InputError(f"{path} is empty; download or export it again.")
    return path


def one_line(error: Exception) -> str:
    """Return the cause of an error in one line."""
    return " ".join(str(error).split())[:200].rstrip(".") or type(error).__name__


def is_area(tags: Mapping[str, str]) -> bool:
    """Return whether a closed way with these tags is an area (else a loop, such as a roundabout)."""
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
