"""`3RScan.json`: which scans show the same room, how they are aligned, and what moved between them.

Matrices stand there column by column and in metres, as 3RScan's own tools read them. A room's scans
are aligned to its `reference`; `rigid` says for each moved object where the rescan has what the
reference shows: `scan_from_reference`, each in its own scan's axes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import InputError
from placegraph.io.capture.camera import read_json
from placegraph_io.dataset.scannet_files import is_rigid

NAME = "3RScan.json"
_RIGID = 1e-2  # matrices are written with few digits
_FARTHEST = 100.0
"""Two scans of a room whose origins lie farther apart [m] are told in another unit."""


@dataclass(frozen=True, slots=True, eq=False)
class Move:
    """An object that stands elsewhere in a rescan."""

    reference_id: str
    """Its id in the reference."""
    scan_id: str
    """Its id in the rescan."""
    scan_from_reference: NDArray[np.float64]
    """(4, 4) of the object's points [m], from the reference's axes to the rescan's."""
    symmetry: int
    """0: none; else 3RScan's code of the rotations that look alike."""


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """One scan of a room."""

    id: str
    reference_from_scan: NDArray[np.float64] | None
    """(4, 4) [m]; None where the file keeps it back, as of the hidden test scans."""
    moves: tuple[Move, ...] = ()
    nonrigid: tuple[str, ...] = ()
    """Ids, in the reference, of objects that changed their form."""
    removed: tuple[str, ...] = ()
    """Ids, in the reference, of objects that are gone."""


@dataclass(frozen=True, slots=True, eq=False)
class Room:
    """Scans of the same room at different times, the reference first."""

    reference: str
    kind: str
    """3RScan's `type`: train, validation or test."""
    scans: tuple[Scan, ...]


@dataclass(frozen=True)
class Rooms:
    """What a `3RScan.json` says."""

    path: Path
    rooms: tuple[Room, ...]

    @cached_property
    def _places(self) -> dict[str, tuple[Room, Scan]]:
        return {scan.id: (room, scan) for room in self.rooms for scan in room.scans}

    def room_of(self, scan: str) -> Room:
        """Room that a scan shows; `InputError` where the file does not know the scan."""
        return self._place(scan)[0]

    def scan(self, scan: str) -> Scan:
        """Scan by its id; `InputError` where the file does not know it."""
        return self._place(scan)[1]

    def reference_from(self, scan: str) -> NDArray[np.float64]:
        """(4, 4) reference_from_scan [m]; `InputError` where the file does not say it."""
        found = self.scan(scan).reference_from_scan
        if found is None:
            raise InputError(
                f"{self.path} gives no transform for the rescan {scan} (those of hidden test scans are "
                "kept back); use it in its own axes."
            )
        return found

    def _place(self, scan: str) -> tuple[Room, Scan]:
        if scan not in self._places:
            raise InputError(
                f"{self.path} knows no scan {scan!r}; name the scan's folder as 3RScan does, by its id."
            )
        return self._places[scan]


def read_rooms(path: str | PathLike[str]) -> Rooms:
    """Read a `3RScan.json`; `InputError` where it is missing, or is not what this module says."""
    path = Path(path)
    content = read_json(path)
    if not isinstance(content, list):
        raise InputError(f"{path} is no 3RScan.json: it must be a list of rooms.")
    rooms = Rooms(path, tuple(_room(path, entry) for entry in content))
    seen: set[str] = set()
    for room in rooms.rooms:
        for scan in room.scans:
            if scan.id in seen:
                raise InputError(f"{path} lists the scan {scan.id} twice; keep one of them.")
            seen.add(scan.id)
    return rooms


def _room(path: Path, entry: object) -> Room:
    reference = _text(path, entry, "reference")
    scans = entry.get("scans", []) if isinstance(entry, dict) else []
    kind = entry.get("type", "") if isinstance(entry, dict) else ""
    if not isinstance(scans, list) or not isinstance(kind, str):
        raise InputError(f"{path}: `scans` of {reference} is no list, or `type` no text.")
    first = Scan(reference, np.eye(4))
    return Room(reference, kind, (first, *(_scan(path, rescan) for rescan in scans)))


def _scan(path: Path, entry: Any) -> Scan:  # noqa: ANN401  # of a JSON list
    name = _text(path, entry, "reference")
    matrix = entry.get("transform")
    moves = entry.get("rigid") or []
    if not isinstance(moves, list):
        raise InputError(f"{path}: `rigid` of {name} is no list.")
    return Scan(
        name,
        None if matrix is None else _matrix(path, matrix, name),
        tuple(_move(path, move, name) for move in moves),
        _ids(entry.get("nonrigid")),
        _ids(entry.get("removed")),
    )


def _move(path: Path, entry: Any, scan: str) -> Move:  # noqa: ANN401  # of a JSON list
    if not isinstance(entry, dict) or "transform" not in entry:
        raise InputError(f"{path}: an entry of `rigid` of {scan} lacks its transform.")
    reference, own = (entry.get(key) for key in ("instance_reference", "instance_rescan"))
    if not all(isinstance(v, int | str) for v in (reference, own)):
        raise InputError(f"{path}: an entry of `rigid` of {scan} lacks its instances.")
    where = f"{scan}, instance {reference}"
    symmetry = entry.get("symmetry")
    return Move(
        str(reference),
        str(own),
        _matrix(path, entry["transform"], where),
        symmetry if isinstance(symmetry, int) else 0,
    )


def _matrix(path: Path, numbers: object, where: str) -> NDArray[np.float64]:
    good = isinstance(numbers, list) and len(numbers) == 16
    if not good or not all(type(v) in {int, float} for v in numbers):  # type: ignore[attr-defined]
        raise InputError(f"{path}: the transform of {where} is not 16 numbers; download it again.")
    with np.errstate(over="ignore"):
        matrix = np.array([float(min(max(v, -1e300), 1e300)) for v in numbers])  # type: ignore[attr-defined]
    matrix = matrix.reshape(4, 4).T
    if not is_rigid(matrix, _RIGID):
        raise InputError(
            f"{path}: the transform of {where} is no rigid one; it must stand column by column, as "
            "3RScan has it. Download it again."
        )
    if np.abs(matrix[:3, 3]).max() > _FARTHEST:
        raise InputError(
            f"{path}: the transform of {where} shifts by {np.abs(matrix[:3, 3]).max():.0f} m; is it in "
            "millimetres? Divide its translation by 1000."
        )
    u, _, vt = np.linalg.svd(matrix[:3, :3])
    matrix[:3, :3] = u @ vt
    matrix[3] = (0, 0, 0, 1)
    matrix.flags.writeable = False
    return matrix


def _ids(listed: object) -> tuple[str, ...]:
    """Ids of a list of numbers, or of objects with `instance_reference`."""
    ids = [
        entry.get("instance_reference") if isinstance(entry, dict) else entry
        for entry in (listed if isinstance(listed, list) else [])
    ]
    return tuple(str(i) for i in ids if isinstance(i, int | str))


def _text(path: Path, entry: object, key: str) -> str:
    value = entry.get(key) if isinstance(entry, dict) else None
    if not isinstance(value, str) or not value:
        raise InputError(f"{path}: an entry lacks {key!r}, the id of its scan; download it again.")
    return value
