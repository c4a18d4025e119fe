"""`placegraph scene export`: a scene map for other programs."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click

from placegraph.cli.command import Argument, Option
from placegraph.cli.common import AsJson, Quiet
from placegraph.cli.scene.query import MapFile
from placegraph.errors import OptionError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

CameraPaths = Annotated[
    list[Path] | None,
    Option(
        "--camera-path",
        help="Way of a camera: TUM text (map_from_camera), or what `scene localize --json` "
        "printed; may be repeated.",
    ),
]


def export(
    map_file: MapFile,
    out: Annotated[
        Path, Argument(help="File to write; .glb, .ply, .json, .osm or .osmag says what.")
    ],
    camera_path: CameraPaths = None,
    force: Annotated[
        bool, Option("--force", help="Replace OUT even if no earlier export wrote it.")
    ] = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Write a scene map as a file for other programs.

    .glb opens in any 3D viewer, in Blender and in browsers: one node an object, named as it is,
    with label, id and attributes in its custom properties, textures included. Edit it and build a
    map of it again with `placegraph scene build`.

    .ply is one coloured mesh for MeshLab and CloudCompare: textures are averaged onto vertices,
    objectId of each face says whose it is, and OUT.labels.json what the ids are called. Relations
    have no place in it.

    .json is a scene graph for Hydra and Spark-DSG: objects with boxes, labels and their part of
    the mesh, relations as edges, and rooms.

    .osm holds rooms and doors of an anchored map, in Simple Indoor Tagging for JOSM; .osmag the
    same as osmAG, for robots.

    Example: placegraph scene export house.scene house.glb --camera-path walk.tum
    """
    from placegraph.indoor.mapping.export import export as write
    from placegraph.indoor.mapping.export import losses
    from placegraph.maps import open_scene

    if os.path.realpath(map_file) == os.path.realpath(out):
        raise OptionError(f"{out} is the map itself; name another file.")
    paths = camera_paths(camera_path)
    scene = open_scene(map_file)
    files = write(scene, out, camera_paths=paths, overwrite=force)
    sizes = {str(file): file.stat().st_size for file in files}
    if as_json:
        told = {
            "files": sizes,
            "objects": len(scene),
            "triangles": len(scene.mesh),
            "lost": losses(scene, out),
        }
        click.echo(json.dumps(told, ensure_ascii=False))
    elif not quiet:
        for name, size in sizes.items():
            click.echo(f"{name}: {size / 1e3:,.0f} kB.")
        for sentence in losses(scene, out):
            click.echo(sentence)


def camera_paths(files: list[Path] | None) -> dict[str, NDArray[np.float64]]:
    """Poses by name of each file's way; of files of one name the later are numbered."""
    from placegraph.io.capture.tum import read_camera_path

    found: dict[str, NDArray[np.float64]] = {}
    for file in files or []:
        name, count = file.stem, 1
        while name in found:
            count += 1
            name = f"{file.stem} {count}"
        found[name] = read_camera_path(file)
    return found
