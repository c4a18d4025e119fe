"""Table `outdoor_map_size` (Table V): bytes of 110 to 447 cells, and of whole cities.

The point cloud that a map replaces is the paper's, of 447 cells of 30 m that lie 10 m apart along
a drive; it is not here and was not measured.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

from placegraph.outdoor.city import CityMap
from placegraph_lab.tables.kitti.kitti360pose import POINT_CLOUD, SCENE_GRAPH
from placegraph_lab.tables.outdoor.extracts import CITIES, busiest_tile, crop, extracts_of
from placegraph_lab.tables.runner import Column as Col
from placegraph_lab.tables.runner import Quick, Run, option, render, table

MEGA = 1e-6


def measure(city: CityMap, folder: Path) -> dict[str, Any]:
    """Bytes of a city's file, of its graph embeddings, and the paper's for as many cells."""
    path = folder / "part.city"
    city.save(path)
    cells, size, vectors = len(city.cells), path.stat().st_size, int(city.embeddings.nbytes)
    return {
        "cells": cells,
        "objects": len(city.objects),
        "km2": cells * city.cells.grid.stride**2 * 1e-6,
        "bytes": size,
        "both": size + vectors,
        "cloud": POINT_CLOUD[cells] / MEGA if cells in POINT_CLOUD else None,
        "paper": SCENE_GRAPH[cells] / MEGA if cells in SCENE_GRAPH else None,
    }


def _per(size: str, other: str) -> Callable[[dict[str, Any]], float | None]:
    return lambda row: row[size] / row[other] if row[size] and row[other] else None


COLUMNS = (
    Col("", "city"), Col("cells", "cells", 0), Col("objects", "objects", 0), Col("km²", "km2", 2),
    Col("point cloud, paper [MB]", "cloud", 0, "", MEGA),
    Col("scene graph, paper [MB]", "paper", 2, "", MEGA),
    Col("map [MB]", "bytes", 3, "", MEGA), Col("with vectors [MB]", "both", 3, "", MEGA),
    Col("bytes/cell", _per("bytes", "cells"), 0), Col("with vectors", _per("both", "cells"), 0),
    Col("cloud/map", _per("cloud", "bytes"), 0), Col("cloud/graph, paper", _per("cloud", "paper"), 0),
)  # fmt: skip


@table("GOTLoc, Table V")
def outdoor_map_size(
    run: Run,
    cities: Annotated[str, option(f"{CITIES} All shared ones where left out.")] = "",
    *,
    quick: Quick = False,
) -> None:
    """Bytes of maps of 110 to 447 cells, and of whole cities."""
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        for extract in extracts_of(cities or ("monaco" if quick else ""), run.osm):
            city = extract.open(run.cache)
            middle = busiest_tile(city)
            cut = [crop(city, n, middle) for n in POINT_CLOUD if n < len(city.cells)]
            rows += [{"city": extract.name} | measure(part, Path(folder)) for part in (*cut, city)]
    print(render(COLUMNS, rows))
    print("\nVectors follow from the map and are made when first needed; they need not be stored.")
    run.save({"rows": rows}, complete=not cities)
