"""Kinds of sources of scene maps that placegraph-io reads, in the order in which they are asked."""

from __future__ import annotations

from placegraph.indoor.mapping.sources import SourceKind

SOURCES = (
    SourceKind(
        "a 3RScan scan's folder",
        "placegraph_io.dataset.scan3r",
        "scan3r",
        own=("reference_frame", "undo_moves", "rooms", "annotations"),
    ),
    SourceKind(
        "a ScanNet scan's folder",
        "placegraph_io.dataset.scannet",
        "scannet",
        own=("label_table", "label_column", "align"),
    ),
    SourceKind(
        "what SceneGraphFusion predicted",
        "placegraph_io.dataset.scenegraphfusion",
        "scenegraphfusion",
        own=("mesh",),
    ),
    SourceKind(
        "Spark-DSG's .json, or Hydra's log folder",
        "placegraph_io.graphs.spark_dsg",
        "spark_dsg",
        is_graph=True,
    ),
    SourceKind(
        "ConceptGraphs' obj_json_*.json, or its folder",
        "placegraph_io.graphs.conceptgraphs",
        "conceptgraphs",
        takes=("up",),
        own=("mesh",),
        is_graph=True,
    ),
)
