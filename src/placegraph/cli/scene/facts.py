"""What a scene map holds, in plain numbers and strings; `placegraph scene info`."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click

from placegraph.cli.command import Option
from placegraph.cli.common import AsJson, show_facts
from placegraph.cli.scene.anchor import summary
from placegraph.cli.scene.query import MapFile

if TYPE_CHECKING:
    from placegraph.indoor.scene_map import SceneMap


def info(
    map_file: MapFile,
    as_json: AsJson = False,
    png: Annotated[
        Path | None, Option(help="Write a plan with names; of merged scenes, of the first.")
    ] = None,
) -> None:
    """Say what a scene map holds, and how many bytes its parts take.

    Example: placegraph scene info house.scene --png plan.png
    """
    from placegraph.indoor.map.scene_file import bytes_of
    from placegraph.indoor.scene_map import SceneMap

    scene = SceneMap.open(map_file)
    told = {**facts(scene), "bytes": map_file.stat().st_size, "bytes_of": bytes_of(map_file)}
    if png is not None:
        from placegraph.view import draw_scene

        draw_scene(scene, png)
    if as_json:
        click.echo(json.dumps(told, ensure_ascii=False))
    else:
        show_facts(told)


def facts(scene: SceneMap) -> dict[str, object]:
    """What a scene map holds."""
    graph, mesh = scene.graph, scene.mesh
    return {
        "source": scene.source,
        "scenes": list(scene.scenes),
        "objects": len(scene),
        "labels": dict(Counter(graph.labels).most_common(12)),
        "relations": dict(Counter(graph.relations).most_common()),
        "triangles": len(mesh),
        "textures": len(mesh.textures),
        "embedding_length": 0 if graph.embeddings is None else int(graph.embeddings.shape[1]),
        "floor_m": [round(float(f), 3) for f in scene.floors],
        "low_m": [round(float(v), 3) for v in scene.bounds[0]],
        "high_m": [round(float(v), 3) for v in scene.bounds[1]],
        "anchors": [summary(anchor) for anchor in scene.anchors],
    }
