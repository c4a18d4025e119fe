"""Registration of two axis-aligned scans of a room, which ScanNet does not have.

Both stand along x and y with the floor at 0, so what is unknown is a quarter turn and a shift. Every
quarter turn is tried from shifts on a grid around the middles of both, the best are refined point to
plane, and the winner counts where it fits much of the room and clearly more than any other quarter
turn does.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.random import Generator

from placegraph.core.geometry import Floats
from placegraph.errors import InputError, OptionError
from placegraph.indoor.mapping.change.align import (
    SurfaceSamples,
    register,
    sample_surface,
    transform_points,
    turn_about,
)
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.capture import Capture, open_capture
from placegraph.io.mesh.nearest_kernels import find_nearest
from placegraph_io.dataset.scannet import axis_alignment, is_rigid, read_text
from placegraph_lab.tables.indoor.windows import sample_frames

WITHIN = 0.05  # surfaces fit where they are this near [m]: two reconstructions differ by as much
LEAST = 0.5  # least share of the query's surface that fits the map's
LEAD = 0.08  # least lead of the best quarter turn over the next, in that share
SHIFTS = (
    -1.0,
    -0.5,
    0.0,
    0.5,
    1.0,
)  # shifts along x and y that are tried, from middle to middle [m]
_REACH = 0.6
_FINE, _TARGET = 5_000, 20_000
_COARSE, _COARSE_TARGET, _COARSE_WITHIN = 300, 3_000, 0.15


def register_scans(map_: SceneMap, query: SceneMap, rng: Generator) -> Floats | None:
    """map_from_query (4, 4) [m] of two maps of a room whose walls lie along x and y.

    None where too little of the query fits, or another quarter turn fits nearly as well: an empty
    rectangular room does not say how it is turned.
    """
    everything = np.arange(len(map_.mesh)), np.arange(len(query.mesh))
    target, rough = (
        sample_surface(map_.mesh, everything[0], n, rng) for n in (_TARGET, _COARSE_TARGET)
    )
    source, few = (
        sample_surface(query.mesh, everything[1], n, rng).points for n in (_FINE, _COARSE)
    )
    middle, goal = _middle(source), _middle(target.points)
    fits: list[tuple[float, Floats]] = []
    for turn in range(4):
        starts = (
            turn_about(middle, turn * np.pi / 2, goal + np.array([x, y, 0.0]))
            for x in SHIFTS
            for y in SHIFTS
        )
        best = max(
            (register(few, rough, start, reach=_REACH, within=_COARSE_WITHIN) for start in starts),
            key=lambda motion: _measure_fit(few, rough, motion, _COARSE_WITHIN),
        )
        motion = register(source, target, best, reach=2 * _COARSE_WITHIN, within=WITHIN)
        fits.append((_measure_fit(source, target, motion, WITHIN), motion))
    (share, motion), (second, _) = sorted(fits, key=lambda fit: -fit[0])[:2]
    return None if share < LEAST or share - second < LEAD else motion


def _measure_fit(source: Floats, target: SurfaceSamples, motion: Floats, within: float) -> float:
    """Measure the share of the points (N, 3) that `motion` brings within `within` of the surface."""
    points = transform_points(motion, source)
    rows = find_nearest(points, target.points, 2.0 * within)
    off = np.einsum("nk,nk->n", points - target.points[rows], target.normals[rows])
    return float(np.mean((rows >= 0) & (np.abs(off) < within)))


def _middle(points: Floats) -> Floats:
    """Middle (3,) of the points' box, on the floor."""
    low, high = points.min(axis=0), points.max(axis=0)
    return np.array([*(low + high)[:2] / 2.0, 0.0])


EVERY = 25  # images from one query to the next (Sec. 5).
_SCAN = re.compile(r"(scene\d{4})_\d{2}")
_RIGID = 1e-2


@dataclass(frozen=True, eq=False)
class ScanPair:
    """Two scans of one room."""

    map: str  # scan the map is made of
    query: str  # scan whose images are asked about
    map_from_query: Floats | None = None
    """(4, 4) [m], from the axis-aligned query to the axis-aligned map; None: nobody knows."""

    @property
    def name(self) -> str:
        return f"{self.query} in {self.map}"


def scans_in(path: str | PathLike[str]) -> list[str]:
    """Names of scans, ascending: subfolders `scene0000_00` of a folder, or words of a text file.

    Raises `InputError` where there is none.
    """
    path = Path(path)
    if path.is_dir():
        words = [entry.name for entry in path.iterdir() if entry.is_dir()]
    else:
        words = read_text(path).split()
    found = sorted({word for word in words if _SCAN.fullmatch(word)})
    if not found:
        raise InputError(
            f"{path} contains no scan with a name such as scene0000_00; give ScanNet's scans/."
        )
    return found


def derive_pairs(scans: Iterable[str]) -> list[ScanPair]:
    """Pairs of scans of the same room, in order of their names: the first is the map of all others.

    `scans`: names such as `scene0011_00`; the room is what stands before the underscore.

    Raises `OptionError`: a name is none of ScanNet's.
    """
    pairs: list[ScanPair] = []
    for _, (first, *others) in itertools.groupby(sorted(set(scans)), _room):
        pairs += [ScanPair(first, other) for other in others]
    return pairs


def _room(scan: str) -> str:
    match = _SCAN.fullmatch(scan)
    if match is None:
        raise OptionError(
            f"scans: {scan!r} is not a scan of ScanNet; give names such as scene0000_00."
        )
    return match[1]


def read_pairs(path: str | PathLike[str]) -> list[ScanPair]:
    """Pairs of a text file: `map query` a line, and optionally 16 numbers, map_from_query by rows.

    `#` begins a comment. Raises `InputError`, which names the line, where a line is not that, or the
    scans are the same or of different rooms.
    """
    path = Path(path)
    pairs = []
    for number, line in enumerate(read_text(path).splitlines(), 1):
        words = line.partition("#")[0].split()
        if words:
            try:
                pairs.append(_pair(words))
            except (OptionError, ValueError) as error:
                raise InputError(f"{path}, line {number}: {error}") from error
    if not pairs:
        raise InputError(f"{path} contains no pair; a line must be `scene0011_00 scene0011_01`.")
    return pairs


def _pair(words: list[str]) -> ScanPair:
    if len(words) not in {2, 18}:
        raise OptionError(
            f"{len(words)} words, where map, query and perhaps 16 numbers of map_from_query belong."
        )
    one, other = words[:2]
    if one == other or _room(one) != _room(other):
        raise OptionError(f"{one} and {other} are not two scans of one room.")
    if len(words) == 2:
        return ScanPair(one, other)
    matrix = np.array([float(word) for word in words[2:]]).reshape(4, 4)
    if not is_rigid(matrix, _RIGID):
        raise OptionError(
            "map_from_query is not a rigid transform; write its 4 x 4 numbers by rows."
        )
    return ScanPair(one, other, matrix)


# ---------------------------------------------------------------------------------------- queries


def true_poses(capture: Capture, folder: Path, pair: ScanPair) -> Floats:
    """True map_from_camera (T, 4, 4) [m] of frames of the query's recording, in `folder`.

    The map is the axis-aligned `pair.map`. Raises `OptionError` where the pair's scans are not
    registered, `InputError` where the alignment of the query is broken.
    """
    if pair.map_from_query is None:
        raise OptionError(
            f"{pair.name}: ScanNet does not register scans to each other; find map_from_query by "
            "scannet_register, write it beside the pair, or ask only which room it is."
        )
    poses: Floats = pair.map_from_query @ axis_alignment(folder) @ capture.odometry
    return poses


def read_query(folder: Path, pair: ScanPair, *, every: int = EVERY) -> tuple[Capture, Floats]:
    """A pair's query, one image in `every`, and its true map_from_camera (T, 4, 4) [m].

    Raises as `pair_windows` does.
    """
    scan = folder / pair.query
    capture = sample_frames(open_capture(scan), every)
    return capture, true_poses(capture, scan, pair)
