"""Commands of the indoor wing: `placegraph scene ...`."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path  # noqa: TC003  # Typer reads the annotations
from typing import TYPE_CHECKING, Annotated

import typer

from placegraph.cli.common import AsJson, Quiet, progress_bar, show_facts
from placegraph.cli.scene_localize import localize
from placegraph.cli.scene_query import MapFile  # noqa: TC001  # Typer reads the annotations
from placegraph.cli.scene_refine import refine
from placegraph.cli.scene_render import render

if TYPE_CHECKING:
    from placegraph.indoor.scene_map import SceneMap

app = typer.Typer(
    help="Indoor: a few frames find their pose in a map of objects.",
    no_args_is_help=True,
)
app.command("localize")(localize)
app.command("refine")(refine)
app.command("render")(render)


@app.command("build")
def build(
    file: Annotated[
        Path, typer.Argument(help="GLB with one node an object, or PLY with object ids.")
    ],
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Map file to write, such as house.scene.")
    ],
    labels: Annotated[
        Path | None, typer.Option(help="JSON file with the label of each object id.")
    ] = None,
    floor: Annotated[
        float | None, typer.Option(help="Height of the floor [m]; found if not given.")
    ] = None,
    up: Annotated[
        str, typer.Option(help="Axis of the file that points up: auto (GLB y, PLY z), y or z.")
    ] = "auto",
    scale: Annotated[
        float, typer.Option(help="Metres in one unit of the file: 0.001 for millimetres.")
    ] = 1.0,
    max_texture: Annotated[
        int, typer.Option(help="Longer sides of textures are brought to this [texels].")
    ] = 512,
    quality: Annotated[int, typer.Option(help="JPEG quality of textures encoded anew.")] = 85,
    object_property: Annotated[
        str | None, typer.Option(help="Property of a PLY that holds object ids, such as objectId.")
    ] = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Build a scene map from a 3D file.

    Example: placegraph scene build house.glb -o house.scene
    """
    from time import perf_counter

    from placegraph.indoor.build import build_scene

    left_out: Counter[str] = Counter()
    start = perf_counter()
    with progress_bar(hidden=quiet or as_json) as progress:
        progress.add_task("building")
        scene = build_scene(
            file, out, labels=labels, floor=floor, up=up, scale=scale, max_texture=max_texture,  # type: ignore[arg-type]  # `up` is checked there
            quality=quality, object_property=object_property, left_out=left_out,
        )  # fmt: skip
    seconds = perf_counter() - start
    size = out.stat().st_size
    if as_json:
        told = {**facts(scene), "left_out": left_out, "bytes": size, "seconds": round(seconds, 3)}
        typer.echo(json.dumps(told, ensure_ascii=False))
    elif not quiet:
        typer.echo(
            f"{out}: {len(scene):,} objects, {len(scene.mesh):,} triangles, floor at "
            f"{scene.floors[0]:.2f} m, {size / 1e3:,.0f} kB, built in {seconds:.1f} s."
        )
        if left_out:
            typer.echo(
                "Left out: " + ", ".join(f"{n:,} {why}" for why, n in left_out.items()) + "."
            )


@app.command("info")
def info(
    map_file: MapFile,
    as_json: AsJson = False,
    png: Annotated[Path | None, typer.Option(help="Write a plan of the (first) scene.")] = None,
) -> None:
    """Say what a scene map holds."""
    from placegraph.indoor.scene_map import SceneMap

    scene = SceneMap.open(map_file)
    told = {**facts(scene), "bytes": map_file.stat().st_size}
    if png is not None:
        from placegraph.view import draw_scene

        draw_scene(scene, png)
    if as_json:
        typer.echo(json.dumps(told, ensure_ascii=False))
    else:
        show_facts(told)


def facts(scene: SceneMap) -> dict[str, object]:
    """What a scene map holds, in plain numbers and strings."""
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
    }
