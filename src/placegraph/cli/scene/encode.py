"""`placegraph scene encode`: what an encoder knows of a map's objects, kept in the map."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click

from placegraph.cli.command import Option
from placegraph.cli.common import AsJson, Quiet, echo_json, progress_of
from placegraph.cli.encoders import (
    WITH_CAPTURES,
    WeightsFile,
    encoders_of,
)
from placegraph.cli.scene.query import Frames, MapFile, chosen_frames
from placegraph.errors import OptionError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from placegraph.indoor.encode import Encoder
    from placegraph.indoor.scene_map import SceneMap
    from placegraph.io.capture.capture import Capture

_BEYOND = 1.0  # how far outside a map's box its cameras may stand [m]


def encode(
    map_file: MapFile,
    out: Annotated[Path, Option("--out", "-o", help="Map file to write; the same one will do.")],
    encoder: Annotated[
        str,
        Option(
            help="labels and appearance know objects by the map alone; features and "
            "scenegraphloc (extra `learn`) by images of it, --captures. Options of an encoder are said "
            "with its name: 'scenegraphloc feature_weights=dinov2_vitg14.pth'."
        ),
    ],
    weights: WeightsFile = None,
    captures: Annotated[
        list[Path] | None,
        Option(
            help="Folder of a capture of the map itself, with poses in the map; may be repeated."
        ),
    ] = None,
    poses: Annotated[
        str | None,
        Option(
            help="Poses of the captures, map_from_camera: odometry, trajectory, or a TUM file, as "
            "`scene localize --tum` writes; if not given, trajectory.tum where there is one, else "
            "the recorder's own."
        ),
    ] = None,
    frames: Frames = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Give a map's objects the vectors of an encoder, so that images are compared with them.

    The map holds those of one encoder, and says of which: frames that another one encoded, or other
    weights of it, are refused. labels and appearance are made as they are needed, and encoding
    saves that; features and scenegraphloc need it, as they know objects by images.

    Example: placegraph scene encode house.scene -o house.scene --encoder appearance

    Example: placegraph scene encode house.scene -o house.scene --encoder scenegraphloc
    --weights mine.safetensors --captures walk/ --poses walk.tum
    """
    from time import perf_counter

    from placegraph.core.mapfile import writing
    from placegraph.indoor.encode import vectors_of
    from placegraph.indoor.scene_map import SceneMap

    shown = _given(encoder, captures or [], poses, frames)
    with writing(out):
        pass  # a place that cannot be written to is refused now, not when all is encoded
    start = perf_counter()
    with progress_of(hidden=quiet or as_json) as tell:
        tell(f"opening {map_file.name}", 0, 3)
        scene = SceneMap.open(map_file)
        images = [_opened(path, poses, frames, scene) for path in shown]
        tell(f"making the encoder {encoder}", 1, 3)
        (made,) = encoders_of([encoder], weights)
        count = sum(map(len, images))
        of = f", {count:,} images" if count else ""
        tell(f"encoding {len(scene):,} objects by {encoder}{of}", 2, 3)
        # what another encoder made of it is of no use to this one
        bare = replace(scene, graph=replace(scene.graph, embeddings=None), encoder="")
        vectors = vectors_of(made, bare, images)
        known = int(vectors.any(axis=1).sum())
        if not known:
            raise OptionError(
                f"{map_file}: {encoder} knows none of its {len(scene)} objects; it needs "
                f"{_needs(encoder)}."
            )
        bare.with_embeddings(vectors, encoder=made.key).save(out)
    _say(out, made, len(scene), known, count, perf_counter() - start, as_json, quiet)


def _given(
    encoder: str, captures: list[Path], poses: str | None, frames: str | None
) -> Sequence[Path]:
    """Folders of captures; `OptionError` where options contradict each other."""
    from placegraph.indoor.encode import spoken

    encoder, _ = spoken(encoder)
    if captures and encoder not in WITH_CAPTURES:
        raise OptionError(
            f"--captures belongs to {' and '.join(WITH_CAPTURES)}; {encoder} knows objects by the "
            "map alone, so leave them out."
        )
    if encoder in WITH_CAPTURES and not captures:
        raise OptionError(
            f"--encoder {encoder} knows objects by images of the map; give --captures FOLDER, whose "
            "poses are in the map."
        )
    for name, value in (("--poses", poses), ("--frames", frames)):
        if value is not None and not captures:
            raise OptionError(f"{name} belongs to --captures, and there are none.")
    return captures


def _opened(path: Path, poses: str | None, frames: str | None, scene: SceneMap) -> Capture:
    """A capture of the map; `OptionError` where it was taken elsewhere."""
    from placegraph.io.capture.capture import open_capture

    true = (path / "trajectory.tum").is_file()
    by = poses if poses is not None else "trajectory" if true else None
    capture = chosen_frames(open_capture(path, poses=by), frames)
    low, high = scene.bounds
    at = capture.odometry[:, :3, 3]
    inside = ((at > low - _BEYOND) & (at < high + _BEYOND)).all(axis=1)
    if not inside.any():
        raise OptionError(
            f"{path}: no camera of it stands in {scene.source or 'the map'}; its poses must be in "
            "the map: give those that `scene localize --tum` writes, by --poses."
        )
    return capture


def _needs(encoder: str) -> str:
    return {
        "labels": "labels that are words it knows",
        "appearance": "surfaces with colours, and free floor to look around from",
    }.get(encoder, "images that show them")


def _say(
    out: Path, made: Encoder, objects: int, known: int, images: int, seconds: float,
    as_json: bool, quiet: bool,
) -> None:  # fmt: skip
    size = out.stat().st_size
    if as_json:
        echo_json({
            "map": str(out), "encoder": made.key, "dimension": made.dimension, "objects": objects,
            "known": known, "images": images, "bytes": size, "seconds": round(seconds, 3),
        })  # fmt: skip
    elif not quiet:
        click.echo(
            f"{out}: {known:,} of {objects:,} objects have vectors of {made.dimension} numbers by "
            f"{made.key}, {size / 1e3:,.0f} kB, encoded in {seconds:.1f} s."
        )
