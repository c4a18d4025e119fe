"""`placegraph scene build`: a scene map of whatever the user has."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from placegraph.cli.command import Argument, Option
from placegraph.cli.common import AsJson, Quiet, progress_of
from placegraph.cli.scene.facts import facts
from placegraph.cli.scene.query import rows_of
from placegraph.errors import OptionError

if TYPE_CHECKING:
    from placegraph.indoor.map.detail import Detail
    from placegraph.indoor.mapping.from_capture import FromCapture
    from placegraph.indoor.scene_map import SceneMap


_YES, _NO = frozenset({"true", "yes", "on"}), frozenset({"false", "no", "off"})


def build(
    source: Annotated[
        Path,
        Argument(
            help="Mesh with objects (.glb, .gltf, .obj, .ply), a 3RScan or ScanNet scan's folder, a graph "
            "of SceneGraphFusion or Spark-DSG, an RGB-D capture with poses of any known recorder, or "
            "rooms of OpenStreetMap (.osm)."
        ),
    ],
    out: Annotated[Path, Option("--out", "-o", help="Map file to write, such as house.scene.")],
    labels: Annotated[
        Path | None, Option(help="JSON file with the label of each object id or name.")
    ] = None,
    floor: Annotated[
        float | None, Option(help="Height of the floor [m]; found if not given.")
    ] = None,
    up: Annotated[
        str, Option(help="Axis of a mesh that points up: auto (GLB y, others z), y or z.")
    ] = "auto",
    scale: Annotated[
        float | None,
        Option(help="Metres in one unit of a mesh: 0.001 for millimetres."),
    ] = None,
    detail: Annotated[
        str,
        Option(help="How much is kept: full (every triangle), fine, default, small, tiny."),
    ] = "default",
    error: Annotated[
        float | None, Option(help="Greatest error of the surface [m], instead of --detail's.")
    ] = None,
    texel: Annotated[
        float | None, Option(help="Length of a texel on surfaces [m], instead of --detail's.")
    ] = None,
    object_property: Annotated[
        str | None, Option(help="Property of a PLY that holds object ids, such as objectId.")
    ] = None,
    segment: Annotated[
        bool | None,
        Option(
            "--segment/--no-segment",
            help="Cut a mesh into objects by geometry and colour; if not given, only a large mesh "
            "that is one object without a name.",
        ),
    ] = None,
    frames: Annotated[
        str | None,
        Option(help="Frames of a capture that are used, such as 0:186 or ::5; all if none."),
    ] = None,
    poses: Annotated[
        str | None,
        Option(
            help="Poses of a capture: odometry, trajectory, or a TUM file; if not given, "
            "trajectory.tum where there is one, else the recorder's own."
        ),
    ] = None,
    voxel: Annotated[
        float | None,
        Option(help="Edge of a voxel that depth is fused into [m]; 0.03 if not given."),
    ] = None,
    segmenter: Annotated[
        Path | None,
        Option(help="Network (.tflite) that labels a capture's images; extra `segment`."),
    ] = None,
    landmarks: Annotated[
        bool,
        Option(
            "--landmarks",
            help="Keep local features on a capture's surfaces, at most 0.8 MB, so that images near its "
            "views are placed to a centimetre; extra `sift`.",
        ),
    ] = False,
    level: Annotated[
        str | None, Option(help="Level of OpenStreetMap's rooms, such as 1 or -1.")
    ] = None,
    reader: Annotated[
        list[str] | None,
        Option(
            "--reader",
            help="Option of a data set's reader, as reference_frame=true (3RScan) or "
            "label_column=nyu40class (ScanNet); may be repeated.",
        ),
    ] = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Build a scene map from a mesh, a scan, a predicted graph or an RGB-D capture.

    A mesh that names its objects keeps them; else, and for a capture, floor, walls and objects are
    found, by label images where there are any. What is printed below the summary was found out or
    taken for granted. The surface is simplified to an error of 5 mm, unless --detail says otherwise.

    Example: placegraph scene build house.glb -o house.scene

    Example: placegraph scene build hall.osm -o hall.scene --level 1

    Example: placegraph scene build walk/ -o office.scene --segmenter deeplab.tflite
    """
    from time import perf_counter

    from placegraph.indoor.build import build_scene

    left_out: Counter[str] = Counter()
    notes: list[str] = []
    how = _capture(frames, poses, voxel, segmenter, landmarks=landmarks)
    kept = _detail(detail, error, texel)
    start = perf_counter()
    with progress_of(hidden=quiet or as_json) as tell:
        scene = build_scene(
            source, out, labels=labels, floor=floor, up=up, scale=scale, detail=kept,  # type: ignore[arg-type]  # `up` is checked there
            object_property=object_property, segment="auto" if segment is None else segment,
            capture=how, reader=_reader(reader or [], level), left_out=left_out, notes=notes, progress=tell,
        )  # fmt: skip
    seconds = perf_counter() - start
    if as_json:
        told = {
            **facts(scene), "left_out": left_out, "notes": notes, "bytes": out.stat().st_size,
            "seconds": round(seconds, 3),
        }  # fmt: skip
        click.echo(json.dumps(told, ensure_ascii=False))
    elif not quiet:
        _summary(scene, out, seconds, notes, left_out)


def _summary(
    scene: SceneMap, out: Path, seconds: float, notes: list[str], left_out: Counter[str]
) -> None:
    from placegraph.indoor.map.scene_file import bytes_of

    parts = ", ".join(f"{part} {size / 1e3:,.0f} kB" for part, size in bytes_of(out).items())
    click.echo(
        f"{out}: {len(scene):,} objects, {len(scene.mesh):,} triangles, floor at "
        f"{scene.floors[0]:.2f} m, {out.stat().st_size / 1e3:,.0f} kB ({parts}), built in "
        f"{seconds:.1f} s."
    )
    for note in notes:
        click.echo(note)
    if left_out:
        counts = ", ".join(f"{n:,} {why}" for why, n in left_out.items() if n)
        click.echo(f"Left out: {counts}.")


def _detail(name: str, error: float | None, texel: float | None) -> Detail:
    from dataclasses import replace

    from placegraph.indoor.map.detail import detail_named

    detail = detail_named(name)
    if error is not None:
        detail = replace(detail, error=error)
    if texel is not None:
        detail = replace(detail, texel=texel, baked=max(texel, 1e-3))
    return detail


def _capture(
    frames: str | None,
    poses: str | None,
    voxel: float | None,
    segmenter: Path | None,
    *,
    landmarks: bool,
) -> FromCapture | None:
    """How a capture is made into a mesh; None where no option says anything of it."""
    from placegraph.indoor.mapping.from_capture import FromCapture

    given: dict[str, Any] = {}
    if frames is not None:
        given["frames"] = rows_of(frames)
    if poses is not None:
        given["poses"] = poses
    if voxel is not None:
        given["voxel"] = voxel
    if segmenter is not None:
        from placegraph.indoor.encode.segmenter import segmenter as load

        given["segmenter"] = load(segmenter)
    if landmarks:
        given["landmarks"] = True
    return FromCapture(**given) if given else None


def _reader(options: list[str], level: str | None) -> dict[str, Any]:
    given: dict[str, Any] = {} if level is None else {"level": level}
    for option in options:
        name, equals, value = option.partition("=")
        if not (name and equals):
            raise OptionError(f"--reader is {option!r}; give name=value, as reference_frame=true.")
        given[name.replace("-", "_")] = _value(value)
    return given


def _value(text: str) -> Any:  # noqa: ANN401  # what a reader takes
    """Yes or no, a number or several with commas between; else the text itself."""
    if text.lower() in _YES | _NO:
        return text.lower() in _YES
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        return text
    return numbers[0] if len(numbers) == 1 else numbers
