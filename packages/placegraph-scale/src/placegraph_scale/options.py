"""Options of the build of a world in shards."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from placegraph.core.geo import MAX_ZOOM
from placegraph.core.options import option
from placegraph.outdoor.options import LARGEST, CellOptions


@dataclass(frozen=True)
class BuildOptions(CellOptions):
    """Options of `build_world`: how a world is cut into shards, and by whom it is built."""

    zoom: int = option(
        12,
        "Quadtree level of the shards' tiles: 12 gives tiles of 10 km at the equator and 6 km at "
        "50 degrees, with 200,000 objects in the densest cities.",
        minimum=1,
        maximum=MAX_ZOOM,
        flag="--zoom",
    )
    overlap: float = option(
        500.0,
        "Overlap of shards beyond their tiles. Viewpoints are compared up to 400 m from a rare "
        "object, and objects are visible up to 38 m away, so with the default the answers do not "
        "depend on borders.",
        unit="m",
        maximum=LARGEST,
        flag="--overlap",
    )
    vocabulary: Path | None = option(
        None, "Folder with edited vocabulary tables.", flag="--vocabulary"
    )
    workers: int | None = option(
        None,
        "Processes on this machine; one per processor if not given.",
        minimum=1,
        flag="--workers",
    )
    scheduler: str | None = option(
        None,
        "Dask scheduler (tcp://host:port) whose workers see the same folders.",
        flag="--scheduler",
    )
    work: Path | None = option(
        None, "Local folder for the build of a world that is then copied to a URL.", flag="--work"
    )
