"""Commands that make and inspect scene maps: `placegraph scene build|info|check|encode|export`."""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any

import click

from placegraph.cli.command import Argument, Fields, Option
from placegraph.cli.common import AsJson, Quiet, console, echo_json, progress_of, show_facts
from placegraph.cli.scene_anchor import summary
from placegraph.cli.scene_options import (
    WITH_CAPTURES,
    Frames,
    MapFile,
    WeightsFile,
    chosen_frames,
    encoders_of,
    rows_of,
)
from placegraph.errors import MapError, OptionError
from placegraph.indoor.options import PoseSearchOptions

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from placegraph.indoor.encode import Encoder
    from placegraph.indoor.map.textures import Detail
    from placegraph.indoor.mapping.check import Finding
    from placegraph.indoor.mapping.from_capture import FromCapture
    from placegraph.indoor.scene_map import SceneMap
    from placegraph.io.capture.capture import Capture

_YES, _NO = frozenset({"true", "yes", "on"}), frozenset({"false", "no", "off"})


def build(
    source: Annotated[
        Path,
        Argument(
            help="Mesh with objects (.glb, .gltf, .obj, .ply), folder of a 3RScan or ScanNet "
            "scan, scene graph of SceneGraphFusion or Spark-DSG, posed RGB-D capture, or "
            "OpenStreetMap rooms (.osm)."
        ),
    ],
    out: Annotated[Path, Option("--out", "-o", help="Map file to write, such as house.scene.")],
    labels: Annotated[
        Path | None, Option(help="JSON file that maps object ids or names to labels.")
    ] = None,
    floor: Annotated[
        float | None, Option(help="Height of the floor [m]; found if not given.")
    ] = None,
    up: Annotated[
        str, Option(help="Up axis of a mesh: auto (y for GLB, z otherwise), y or z.")
    ] = "auto",
    scale: Annotated[
        float | None,
        Option(help="Metres per unit of the mesh, such as 0.001 for millimetres."),
    ] = None,
    detail: Annotated[
        str,
        Option(help="Level of detail: full (every triangle), fine, default, small or tiny."),
    ] = "default",
    error: Annotated[
        float | None, Option(help="Maximum surface error [m]; overrides --detail.")
    ] = None,
    texel: Annotated[float | None, Option(help="Texel size [m]; overrides --detail.")] = None,
    object_property: Annotated[
        str | None, Option(help="PLY property with the object ids, such as objectId.")
    ] = None,
    segment: Annotated[
        bool | None,
        Option(
            "--segment/--no-segment",
            help="Segment a mesh into objects by geometry and colour; if not given, only a large "
            "unnamed mesh is segmented.",
        ),
    ] = None,
    frames: Annotated[
        str | None,
        Option(help="Frames of the capture to use, such as 0:186 or ::5; all if not given."),
    ] = None,
    poses: Annotated[
        str | None,
        Option(
            help="Poses of a capture: odometry, trajectory, or a TUM file; if not given, "
            "trajectory.tum if it exists, else the recorder's own."
        ),
    ] = None,
    voxel: Annotated[
        float | None,
        Option(help="Voxel size of the depth fusion [m]; 0.03 if not given."),
    ] = None,
    segmenter: Annotated[
        Path | None,
        Option(
            help="Segmentation network (.tflite) that labels the capture's images; needs the extra "
            "`segment`."
        ),
    ] = None,
    landmarks: Annotated[
        bool,
        Option(
            "--landmarks",
            help="Store local image features on a capture's surfaces (at most 0.8 MB), which "
            "give centimetre poses near its views; needs the extra `sift`.",
        ),
    ] = False,
    level: Annotated[
        str | None, Option(help="OpenStreetMap level to build, such as 1 or -1.")
    ] = None,
    reader: Annotated[
        list[str] | None,
        Option(
            "--reader",
            help="Option of a data set reader, such as reference_frame=true (3RScan) or "
            "label_column=nyu40class (ScanNet); may be repeated.",
        ),
    ] = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Build a scene map from a mesh, a scan, a predicted graph or an RGB-D capture.

    Objects that the mesh names are kept. Other meshes and captures are segmented into floor, walls and
    objects, by label images if there are any. Lines below the summary list findings and assumptions.
    The surface is simplified to an error of 5 mm; --detail changes this.

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
        result = {
            **facts(scene), "left_out": left_out, "notes": notes, "bytes": out.stat().st_size,
            "seconds": round(seconds, 3),
        }  # fmt: skip
        click.echo(json.dumps(result, ensure_ascii=False))
    elif not quiet:
        _summary(scene, out, seconds, notes, left_out)


def _summary(
    scene: SceneMap, out: Path, seconds: float, notes: list[str], left_out: Counter[str]
) -> None:
    from placegraph.indoor.map.scene_file import measure_parts

    parts = ", ".join(f"{part} {size / 1e3:,.0f} kB" for part, size in measure_parts(out).items())
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

    from placegraph.indoor.map.textures import get_detail

    detail = get_detail(name)
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
    """Return the options of fusing a capture; None if none is given."""
    from placegraph.indoor.mapping.from_capture import FromCapture

    given: dict[str, Any] = {}
    if frames is not None:
        given["frames"] = rows_of(frames)
    if poses is not None:
        given["poses"] = poses
    if voxel is not None:
        given["voxel"] = voxel
    if segmenter is not None:
        from placegraph.indoor.encode.networks import segmenter as load

        given["segmenter"] = load(segmenter)
    if landmarks:
        given["landmarks"] = True
    return FromCapture(**given) if given else None


def _reader(options: list[str], level: str | None) -> dict[str, Any]:
    given: dict[str, Any] = {} if level is None else {"level": level}
    for option in options:
        name, equals, value = option.partition("=")
        if not (name and equals):
            raise OptionError(
                f"--reader is {option!r}; give name=value, such as reference_frame=true."
            )
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


MOST_IDS = 6
"""Objects of a finding that are named; JSON names more."""


def check(
    map_file: MapFile,
    search: Annotated[dict[str, Any], Fields(PoseSearchOptions, "heights")],
    as_json: AsJson = False,
) -> None:
    """Check units, floor, gravity, holes and objects of a scene map; print remedies.

    Exit code 4 means that localization would fail; 0 means that it can work.

    Example: placegraph scene check house.scene
    """
    from placegraph.indoor.mapping.check import check as findings_of
    from placegraph.indoor.scene_map import SceneMap

    begun = perf_counter()
    scene = SceneMap.open(map_file)
    opened = perf_counter() - begun
    size = map_file.stat().st_size
    findings = findings_of(scene, options=PoseSearchOptions(**search), size=size, seconds=opened)
    errors = sum(f.severity == "error" for f in findings)
    if as_json:
        result = {
            "map": str(map_file),
            "bytes": size,
            "opened_s": round(opened, 3),
            "errors": errors,
            "findings": [f.to_dict() for f in findings],
        }
        click.echo(json.dumps(result, ensure_ascii=False))
    else:
        _show(findings)
        click.echo(
            f"{map_file}: {len(scene):,} objects, {len(scene.mesh):,} triangles, "
            f"{size / 1e3:,.0f} kB, opened in {opened:.2f} s; "
            + (f"{errors} error{'s' * (errors != 1)}." if errors else "no errors.")
        )
    if errors:
        raise click.exceptions.Exit(MapError.exit_code)


def _show(findings: list[Finding]) -> None:
    out = console()
    for f in findings:
        out.print(f"{f.severity}: {f.what}")
        if f.objects:
            more = " ..." if len(f.objects) > MOST_IDS else ""
            out.print(f"    objects: {', '.join(f.objects[:MOST_IDS])}{more}")
        if f.remedy:
            out.print(f"    mend: {f.remedy}")


def info(
    map_file: MapFile,
    as_json: AsJson = False,
    png: Annotated[
        Path | None,
        Option(help="Write a floor plan with object names (merged scenes: the first one)."),
    ] = None,
) -> None:
    """Show the contents of a scene map, and the size of its parts.

    Example: placegraph scene info house.scene --png plan.png
    """
    from placegraph.indoor.map.scene_file import measure_parts
    from placegraph.indoor.scene_map import SceneMap

    scene = SceneMap.open(map_file)
    result = {**facts(scene), "bytes": map_file.stat().st_size, "bytes_of": measure_parts(map_file)}
    if png is not None:
        from placegraph.view import draw_scene

        draw_scene(scene, png)
    if as_json:
        click.echo(json.dumps(result, ensure_ascii=False))
    else:
        show_facts(result)


def facts(scene: SceneMap) -> dict[str, object]:
    """Summarize a scene map."""
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


_BEYOND = 1.0  # how far outside a map's box its cameras may stand [m]


def encode(
    map_file: MapFile,
    out: Annotated[Path, Option("--out", "-o", help="Map file to write; may be the same file.")],
    encoder: Annotated[
        str,
        Option(
            help="Encoder: labels and appearance need only the map; features and scenegraphloc "
            "(extra `learn`) need images of it (--captures). Append its options: "
            "'scenegraphloc feature_weights=dinov2_vitg14.pth'."
        ),
    ],
    weights: WeightsFile = None,
    captures: Annotated[
        list[Path] | None,
        Option(help="Folder of a capture with poses in the map's frame; may be repeated."),
    ] = None,
    poses: Annotated[
        str | None,
        Option(
            help="Poses of the captures, map_from_camera: odometry, trajectory, or a TUM file, "
            "as `scene localize --tum` writes; if not given, trajectory.tum if it exists, "
            "else the recorder's own."
        ),
    ] = None,
    frames: Frames = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Compute the vectors of a map's objects by an encoder, and store them in the map.

    A map stores the vectors of one encoder. Queries by another encoder, or by other weights, are
    refused. For labels and appearance this only saves time; features and scenegraphloc need it,
    because they describe objects by images.

    Example: placegraph scene encode house.scene -o house.scene --encoder appearance

    Example: placegraph scene encode house.scene -o house.scene --encoder scenegraphloc
    --weights mine.safetensors --captures walk/ --poses walk.tum
    """
    from time import perf_counter

    from placegraph.core.mapfile import map_writer
    from placegraph.indoor.encode import encode_objects
    from placegraph.indoor.scene_map import SceneMap

    shown = _given(encoder, captures or [], poses, frames)
    with map_writer(out):
        pass  # a place that cannot be written to is refused now, not when all is encoded
    start = perf_counter()
    with progress_of(hidden=quiet or as_json) as tell:
        tell(f"opening {map_file.name}", 0, 3)
        scene = SceneMap.open(map_file)
        images = [_open_capture(path, poses, frames, scene) for path in shown]
        tell(f"making the encoder {encoder}", 1, 3)
        (made,) = encoders_of([encoder], weights)
        count = sum(map(len, images))
        of = f", {count:,} images" if count else ""
        tell(f"encoding {len(scene):,} objects by {encoder}{of}", 2, 3)
        # what another encoder made of it is of no use to this one
        bare = replace(scene, graph=replace(scene.graph, embeddings=None), encoder="")
        vectors = encode_objects(made, bare, images)
        encoded = int(vectors.any(axis=1).sum())
        if not encoded:
            raise OptionError(
                f"{map_file}: the encoder {encoder} can use none of the {len(scene)} "
                f"objects; it needs {_needs(encoder)}."
            )
        bare.with_embeddings(vectors, encoder=made.key).save(out)
    _print_encoded(out, made, len(scene), encoded, count, perf_counter() - start, as_json, quiet)


def _given(
    encoder: str, captures: list[Path], poses: str | None, frames: str | None
) -> Sequence[Path]:
    """Folders of captures; `OptionError` where options contradict each other."""
    from placegraph.indoor.encode import parse_encoder

    encoder, _ = parse_encoder(encoder)
    if captures and encoder not in WITH_CAPTURES:
        raise OptionError(
            f"--captures applies only to {' and '.join(WITH_CAPTURES)}; {encoder} uses the "
            "map alone, so remove --captures."
        )
    if encoder in WITH_CAPTURES and not captures:
        raise OptionError(
            f"--encoder {encoder} needs images of the map; give --captures FOLDER, with "
            "poses in the map's frame."
        )
    for name, value in (("--poses", poses), ("--frames", frames)):
        if value is not None and not captures:
            raise OptionError(f"{name} applies only to --captures; give captures, or remove it.")
    return captures


def _open_capture(path: Path, poses: str | None, frames: str | None, scene: SceneMap) -> Capture:
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
            f"{path}: none of its cameras lies in {scene.source or 'the map'}; its poses "
            "must be in the map's frame. Give poses written by `scene localize --tum` with "
            "--poses."
        )
    return capture


def _needs(encoder: str) -> str:
    return {
        "labels": "labels that it knows",
        "appearance": "coloured surfaces, and free floor to view them from",
    }.get(encoder, "images that show them")


def _print_encoded(
    out: Path, made: Encoder, objects: int, encoded: int, images: int, seconds: float,
    as_json: bool, quiet: bool,
) -> None:  # fmt: skip
    size = out.stat().st_size
    if as_json:
        echo_json({
            "map": str(out), "encoder": made.key, "dimension": made.dimension, "objects": objects,
            "known": encoded, "images": images, "bytes": size, "seconds": round(seconds, 3),
        })  # fmt: skip
    elif not quiet:
        click.echo(
            f"{out}: {encoded:,} of {objects:,} objects have vectors of {made.dimension} numbers by "
            f"{made.key}, {size / 1e3:,.0f} kB, encoded in {seconds:.1f} s."
        )


CameraPaths = Annotated[
    list[Path] | None,
    Option(
        "--camera-path",
        help="Camera path: TUM file (map_from_camera) or output of `scene localize --json`; may "
        "be repeated.",
    ),
]


def export(
    map_file: MapFile,
    out: Annotated[
        Path,
        Argument(
            help="File to write; its ending (.glb, .ply, .json, .osm or .osmag) sets the format."
        ),
    ],
    camera_path: CameraPaths = None,
    force: Annotated[
        bool, Option("--force", help="Replace OUT even if it is not an earlier export.")
    ] = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Write a scene map as a file for other programs.

    .glb opens in any 3D viewer, in Blender and in browsers. Each object is a node with its name,
    textures, and label, id and attributes as custom properties. You can edit it and build a map
    from it again with `placegraph scene build`.

    .ply is one coloured mesh for MeshLab and CloudCompare. Textures are averaged onto vertices, each
    face has the objectId of its object, and OUT.labels.json names the ids. Relations are lost.

    .json is a scene graph for Hydra and Spark-DSG: objects with boxes, labels and their part of
    the mesh, relations as edges, and rooms.

    .osm has the rooms and doors of an anchored map as Simple Indoor Tagging, for JOSM; .osmag has
    them as osmAG, for robots.

    Example: placegraph scene export house.scene house.glb --camera-path walk.tum
    """
    from placegraph.indoor.mapping.export import export as write
    from placegraph.indoor.mapping.export import list_losses
    from placegraph.maps import open_scene

    if os.path.realpath(map_file) == os.path.realpath(out):
        raise OptionError(f"{out} is the input map; name another output file.")
    paths = camera_paths(camera_path)
    scene = open_scene(map_file)
    files = write(scene, out, camera_paths=paths, overwrite=force)
    sizes = {str(file): file.stat().st_size for file in files}
    if as_json:
        result = {
            "files": sizes,
            "objects": len(scene),
            "triangles": len(scene.mesh),
            "lost": list_losses(scene, out),
        }
        click.echo(json.dumps(result, ensure_ascii=False))
    elif not quiet:
        for name, size in sizes.items():
            click.echo(f"{name}: {size / 1e3:,.0f} kB.")
        for sentence in list_losses(scene, out):
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
