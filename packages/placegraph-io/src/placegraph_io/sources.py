"""Formats of sources of scene maps that placegraph-io reads, in the order in which they are tried."""

from __future__ import annotations

from placegraph.io.formats import Format

_DATASET, _GRAPHS = "placegraph_io.dataset.", "placegraph_io.graphs."
SOURCES = (
    Format("a 3RScan scan's folder", "", f"{_DATASET}scan3r", "scan3r",
           ("reference_frame", "undo_moves", "rooms", "annotations")),
    Format("a ScanNet scan's folder", "", f"{_DATASET}scannet", "scannet",
           ("label_table", "label_column", "align")),
    Format("a prediction of SceneGraphFusion", "", f"{_DATASET}scenegraphfusion", "scenegraphfusion",
           ("mesh",)),
    Format("Spark-DSG's .json, or Hydra's log folder", "", f"{_GRAPHS}spark_dsg", "spark_dsg",
           is_graph=True),
    Format("ConceptGraphs' obj_json_*.json, or its folder", "", f"{_GRAPHS}conceptgraphs",
           "conceptgraphs", ("up", "mesh"), is_graph=True),
)  # fmt: skip
