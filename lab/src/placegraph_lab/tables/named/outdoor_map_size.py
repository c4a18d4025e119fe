"""How large is a map? Table V of the paper: bytes of 110 to 447 cells, and of whole cities.

    placegraph-lab table outdoor_map_size

The point cloud that a map replaces is the paper's, of 447 cells of 30 m that lie 10 m apart along
a drive; it is not here and was not measured. Prints Markdown, writes JSON.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated, Any

from placegraph.outdoor.city import CityMap
from placegraph_lab.tables.kitti.kitti360pose import POINT_CLOUD, SCENE_GRAPH
from placegraph_lab.tables.outdoor.extracts import busiest_tile, crop, names_of, open_city
from placegraph_lab.tables.runner import Quick, Run, markdown, number, option, table

MEGA = 1e-6


def measure(city: CityMap, folder: Path) -> dict[str, Any]:
    """Bytes of a city's file, and of its graph embeddings."""
    path = folder / "part.city"
    city.save(path)
    return {
        "cells": len(city.cells),
        "objects": len(city.objects),
        "km2": len(city.cells) * city.cells.grid.stride**2 * 1e-6,
        "bytes": path.stat().st_size,
        "vector_bytes": int(city.embeddings.nbytes),
    }


def line(name: str, row: dict[str, Any]) -> list[str]:
    cells, size = row["cells"], row["bytes"]
    cloud, paper = POINT_CLOUD.get(cells), SCENE_GRAPH.get(cells)
    both = size + row["vector_bytes"]
    return [
        name,
        number(cells),
        number(row["objects"]),
        number(row["km2"], 2),
        number(cloud, 0),
        number(paper, 2),
        number(size * MEGA, 3),
        number(both * MEGA, 3),
        number(size / cells),
        number(both / cells),
        number(cloud / (size * MEGA)) if cloud else "–",
        number(cloud / paper) if cloud and paper else "–",
    ]


@table("GOTLoc, Table V")
def outdoor_map_size(
    run: Run,
    cities: Annotated[str, option("Names with commas; all where left out.")] = "",
    *,
    quick: Quick = False,
) -> None:
    """How large is a map? Bytes of 110 to 447 cells, and of whole cities."""
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        for name in names_of("monaco" if quick else cities):
            city = open_city(name, run.osm, run.cache)
            middle = busiest_tile(city)
            cut = [crop(city, n, middle) for n in POINT_CLOUD if n < len(city.cells)]
            rows += [{"city": name} | measure(part, Path(folder)) for part in (*cut, city)]
    header = ["", "cells", "objects", "km²", "point cloud, paper [MB]", "scene graph, paper [MB]"]
    header += ["map [MB]", "with vectors [MB]", "bytes/cell", "with vectors"]
    header += ["cloud/map", "cloud/graph, paper"]
    print(markdown(header, [line(row["city"], row) for row in rows]))
    print("\nVectors follow from the map and are made when first needed; they need not be stored.")
    run.save(
        {"paper": {"point_cloud_MB": POINT_CLOUD, "scene_graph_MB": SCENE_GRAPH}, "rows": rows}
    )
