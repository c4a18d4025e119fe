"""Formats of sources of scene maps that placegraph-io reads, in the order in which they are tried."""

from __future__ import annotations

from placegraph.io.formats import Format

SOURCES = (
    Format(
        "a 3RScan scan's folder",
        "",
        "placegraph_io.dataset.scan3r",
        "scan3r",
        ("reference_frame", "undo_moves", "rooms", "annotations"),
    ),
    Format(
        "a ScanNet scan's folder",
        "",
        "placegraph_io.dataset.scannet",
        "scannet",
        ("label_table", "label_column", "align"),
    ),
    Format(
        "a prediction of SceneGraphFusion",
        "",
        "placegraph_io.dataset.scenegraphfusion",
        "scenegraphfusion",
        ("mesh",),
    ),
    Format(
        "Spark-DSG's .json, or Hydra's log folder",
        "",
        "placegraph_io.graphs.spark_dsg",
        "spark_dsg",
        is_graph=True,
    ),
    Format(
        "ConceptGraphs' obj_json_*.json, or its folder",
        "",
        "placegraph_io.graphs.conceptgraphs",
        "conceptgraphs",
        ("up", "mesh"),
        is_graph=True,
    ),
)
