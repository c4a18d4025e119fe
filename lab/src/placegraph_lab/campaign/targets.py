"""All that is fuzzed: of each format its seeds, how it is made wrong, and what is done with it."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.random import Generator

from placegraph_lab.campaign import asked, serving, uses
from placegraph_lab.campaign.mutate import spoil, spoil_world
from placegraph_lab.campaign.seeds import CAPTURES
from placegraph_lab.campaign.seeds_maps import MAPS
from placegraph_lab.campaign.seeds_stores import STORES
from placegraph_lab.campaign.uses import Bench


@dataclass(frozen=True)
class Target:
    """A format, and what becomes of its files."""

    name: str
    seeds: dict[str, Any]  # what draws each, by its name
    use: Callable[[Bench, Path, Generator], object]
    spoil: Callable[[Path, Generator], None] = spoil
    slow: bool = False
    """Whether an input takes a process or a film: it comes last, and has the time that is left."""

    def drawn(self, folder: Path, bench: Bench) -> list[Path]:
        """Seeds in a folder of their own, drawn where they are not yet."""
        if not folder.exists():
            making = folder.with_name(f"{folder.name}.making")
            shutil.rmtree(making, ignore_errors=True)
            making.mkdir(parents=True)
            for name, draw in self.seeds.items():
                draw(making / name, bench)
            making.rename(folder)
        return [folder / name for name in self.seeds]


USES = {
    "OSM .osm": uses.osm, "OSM .osm.pbf": uses.osm, "OSM .osm.gz, .osm.bz2": uses.osm,
    "OSM of Overpass": uses.osm, "Overpass answers": uses.overpass,
    "Nominatim answers": uses.nominatim, "OSM rooms": uses.rooms, "GLB": uses.mesh,
    "glTF": uses.folder_mesh, "OBJ and MTL": uses.folder_mesh, "PLY": uses.mesh,
    "Spark-DSG": uses.mesh, "ConceptGraphs": uses.mesh, "3RScan scan": uses.folder_mesh,
    "ScanNet scan": uses.folder_mesh, "SceneGraphFusion": uses.folder_mesh, ".city": uses.anything,
    ".scene": uses.anything, ".library": uses.library, "worlds": uses.world,
    ".vectors": uses.vectors, ".weights": uses.weights, ".run": uses.run, ".track": uses.track,
    "changes": uses.changes, "Overture": uses.overture, ".city with an index": uses.anything,
    "worlds in shards": uses.world, "libraries in shards": uses.shards,
}  # fmt: skip
SPOILED = {"worlds in shards": spoil_world}
SLOW = {"OSM .osm", "OSM .osm.pbf", "OSM .osm.gz, .osm.bz2", "OSM of Overpass", "worlds", "changes",
        "MultiScan", "COLMAP"}  # fmt: skip
TARGETS = {
    target.name: target
    for target in (
        *(
            Target(n, seeds, USES[n], SPOILED.get(n, spoil), n in SLOW)
            for n, seeds in {**MAPS, **STORES}.items()
        ),
        *(Target(n, seeds, uses.capture, slow=n in SLOW) for n, seeds in CAPTURES.items()),
        Target("bags as streams", CAPTURES["bags MCAP"], uses.stream),
        Target("descriptions", {"all.words": asked.texts}, asked.describe, asked.reworded),
        Target("requests", {"requests": asked.requests}, serving.request, asked.one, slow=True),
        Target("HTTP messages", {"messages": asked.messages}, serving.message, asked.one),
        Target("command lines", {"commands": asked.commands}, asked.command, asked.misspoken),
    )
}
"""By name, in the order of the table."""
