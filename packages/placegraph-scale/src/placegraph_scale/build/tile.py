"""One tile of a split extract becomes a city: its core, and what lies within a margin of it.

What is in sight of its grid is worked out once: for the index of viewpoints, and for the words that
the world counts.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from placegraph.core.geo import bounds
from placegraph.core.geometry import LocalPlane
from placegraph.core.mapfile import DIGEST
from placegraph.io.osm.osm import LeftOut
from placegraph.outdoor.map.city import City
from placegraph.outdoor.map.extract import Things, clip, objects_of, once, without_largest
from placegraph_scale.build.spill import things_of
from placegraph_scale.shards.table import counted, keep

if TYPE_CHECKING:
    from placegraph.core.geo import Box

SPARE = 0.01
"""What sticks out of a tile by less than this stays whole [deg]: squares, parks, long buildings."""


@dataclass(frozen=True)
class TileJob:
    """What is to be made of a tile; it can be sent to other processes, and done again."""

    key: str
    things: tuple[tuple[str, int], ...]
    """Files of things, and their sizes [bytes]."""
    out: str
    """City to write."""
    margin: float
    """How far around the tile things are taken [m]."""
    sizes: tuple[float, float, float]
    """Cells, their distance, and how far edges reach [m]."""
    source: str
    """What the city says it was made from."""
    counts: str = ""
    """File for the words that were counted in it; none where it is empty."""

    @property
    def lies_there(self) -> bool:
        """Whether its things were put aside, and are there still."""
        try:
            return all(Path(path).stat().st_size >= size for path, size in self.things)
        except OSError:
            return False


@dataclass(frozen=True)
class TileDone:
    """What became of a tile."""

    key: str
    digest: str
    """SHA-256 that the map file ends with; empty where there is nothing, and no file."""
    bytes: int = 0
    objects: int = 0
    cells: int = 0

    def stands(self, path: Path) -> bool:
        """Whether the file is there that was written then."""
        if not self.digest:
            return True
        try:
            return path.stat().st_size == self.bytes and _digest(path) == self.digest
        except OSError:
            return False


def build_tile(job: TileJob) -> TileDone:
    """Build the city of a tile, in one step, whoever built it before.

    Raises `MapError` where things are damaged, or the city cannot be written.
    """
    tables = [table for path, size in job.things for table in things_of(Path(path), size)]
    core = bounds(job.key)
    plane = LocalPlane(*(round(x, 4) for x in core.center))
    left_out, things = LeftOut(), None
    if tables:
        things = _within(once(Things.joined(tables)), core.widened(job.margin))
        del tables
    if things:
        things = without_largest(things, left_out, plane)
    out = Path(job.out)
    if not things:
        return TileDone(job.key, "")
    cell_size, stride, edge_distance = job.sizes
    city = City.create(
        plane, objects_of(things, plane), cell_size=cell_size, stride=stride,
        edge_distance=edge_distance, source=job.source, left_out=dict(left_out.counts),
    )  # fmt: skip
    words = counted(city, job.key)
    city.save(out, quick=True)
    made = TileDone(job.key, _digest(out), out.stat().st_size, len(city.objects), len(city.cells))
    if job.counts:
        keep(words, Path(job.counts), made.digest)
    return made


def _within(things: Things, box: Box) -> Things | None:
    """What of things lies in a box [deg], which may reach across the date line; None for nothing."""
    low, high = things.ends()
    turn = 360.0 * np.round((low[:, 0] - box.center[0]) / 360.0)
    low[:, 0] -= turn
    high[:, 0] -= turn
    west, south, east, north = box
    there = (low <= (east, north)).all(axis=1) & (high >= (west, south)).all(axis=1)
    whole = (low >= (west - SPARE, south - SPARE)) & (high <= (east + SPARE, north + SPARE))
    found = [things.take(np.flatnonzero(there & whole.all(axis=1)))]
    cut = []
    for row in np.flatnonzero(there & ~whole.all(axis=1)).tolist():
        thing = things.thing(row)
        parts = [part - (turn[row], 0.0) for part in thing.parts]
        if parts := clip(thing.kind, parts, box):
            cut.append(thing._replace(parts=parts))
    if cut:
        found.append(Things.of(cut))
    made = Things.joined([table for table in found if len(table)] or found)
    return made if len(made) else None


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        file.seek(-DIGEST, 2)
        return file.read(DIGEST).hex()
