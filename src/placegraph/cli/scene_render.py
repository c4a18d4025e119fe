"""Commands `placegraph scene render|view`."""

from __future__ import annotations

import json
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click
import numpy as np

from placegraph.cli.command import Argument, Option
from placegraph.cli.common import AsJson, Quiet, progress_of
from placegraph.cli.scene_build import CameraPaths, camera_paths
from placegraph.cli.scene_options import (
    Device,
    Frames,
    MapFile,
    NoProgress,
    Seed,
    chosen_frames,
    map_from_camera_of,
    pose_of_estimate,
    read_estimate,
)
from placegraph.core.files import write_output
from placegraph.errors import InputError, OptionError

if TYPE_CHECKING:
    from placegraph.core.estimate import PoseEstimate
    from placegraph.core.geometry import Floats
    from placegraph.indoor.render import Rendering
    from placegraph.indoor.scene_map import SceneMap
    from placegraph.io.capture.capture import Capture
    from placegraph.io.capture.frame import Frame

_UNITS = 1000.0
"""Units of a depth picture per metre."""
_MOST = (1 << 16) - 1


@dataclass(frozen=True)
class Source:
    """Source of the pose: one of three."""

    pose: str | None
    tum: Path | None
    estimate: Path | None
    row: int | None
    mode: int


def render(
    map_file: Annotated[
        Path, Argument(help="Scene map (.scene), made by `placegraph scene build`.")
    ],
    out: Annotated[
        Path, Option("--out", "-o", help="Folder for the pictures; created if it does not exist.")
    ],
    pose: Annotated[
        str | None,
        Option(
            help="X,Y,Z,YAW_DEG[,PITCH_DEG,ROLL_DEG] of the camera in the map [m]: yaw is "
            "counter-clockwise from x, pitch is up, roll is right side down."
        ),
    ] = None,
    tum: Annotated[
        Path | None,
        Option(help="TUM file of poses (map_from_camera), as written by `scene localize --tum`."),
    ] = None,
    row: Annotated[
        int | None,
        Option(
            help="With --tum: row index from 0; -1 is the last. If not given, the row with the "
            "stamp of --frame, or the last."
        ),
    ] = None,
    estimate: Annotated[Path | None, Option(help="JSON output of `scene localize --json`.")] = None,
    mode: Annotated[int, Option(help="With --estimate: its mode 1 (the best), 2, ...")] = 1,
    camera: Annotated[
        Path | None, Option(help="camera.json with the intrinsics of the picture.")
    ] = None,
    capture: Annotated[
        Path | None,
        Option(help="Capture folder that gives the camera and a frame to draw the map over."),
    ] = None,
    frame: Annotated[
        int | None,
        Option(
            help="With --capture: frame index from 0; -1 is the last. If not given, the "
            "estimate's frame or the last."
        ),
    ] = None,
    samples: Annotated[int, Option(help="Rays per pixel at edges: 1, 2, 4, 8 or 16.")] = 4,
    device: Annotated[str, Option(help="auto or cpu.")] = "auto",
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Render colour, depth and objects of a map from a pose.

    Writes into the folder --out: colour.png; depth.png (16 bits, millimetres, 0: nothing or beyond
    65.5 m); objects.png (16 bits, row of the object + 1, 0: nothing) with objects.json, which names
    them, and objects_preview.png in colours. With --capture it also writes overlay.png, with the map's
    edges in pink and its colour borders in green: if they lie on the edges of the photograph, the
    pose is right.

    Example: placegraph scene render house.scene -o out --pose 1.5,2,1.6,90 --camera camera.json

    Example: placegraph scene render house.scene -o out --estimate est.json --capture walk/

    Example: placegraph scene render house.scene -o out --tum walk.tum --capture walk/ --frame 12
    """
    from placegraph.io.capture.capture import open_capture
    from placegraph.io.capture.json_files import read_camera
    from placegraph.maps import open_scene

    source = Source(pose, tum, estimate, row, mode)
    _check(source, camera=camera, capture=capture, frame=frame)
    chosen = None if capture is None else _frame(open_capture(capture), frame, source)
    if chosen is None:
        assert camera is not None  # noqa: S101  # `_check` saw to it
        view = read_camera(camera).camera
    else:
        view = chosen.camera
    map_from_camera = _pose(source, chosen, has_frame=frame is not None)
    scene = open_scene(map_file)
    drawn = scene.render(map_from_camera, view, samples=samples, device=device)
    files = _write(scene, drawn, map_from_camera, chosen, out)
    facts = _describe(scene, drawn, map_from_camera, chosen, files)
    if as_json:
        click.echo(json.dumps(facts, ensure_ascii=False))
    elif not quiet:
        click.echo(f"{out}: {', '.join(file.name for file in files)}.")
        click.echo(_summarize(facts))


def _check(source: Source, *, camera: Path | None, capture: Path | None, frame: int | None) -> None:
    """Refuse options that contradict each other."""
    given = [source.pose, source.tum, source.estimate]
    if sum(value is not None for value in given) != 1:
        raise OptionError("The pose must be given once, with --pose, --tum or --estimate.")
    if (camera is None) == (capture is None):
        raise OptionError("The camera must be given once, with --camera or --capture.")
    if frame is not None and capture is None:
        raise OptionError("--frame applies only to --capture; give both, or remove --frame.")
    if source.row is not None and source.tum is None:
        raise OptionError("--row applies only to --tum; give both, or remove --row.")
    if source.mode != 1 and source.estimate is None:
        raise OptionError("--mode applies only to --estimate; give both, or remove --mode.")


def _frame(clip: Capture, number: int | None, source: Source) -> Frame:
    """Frame that the pose is laid over: the one asked for, the estimate's last, or the last."""
    if number is None:
        number = -1
        if source.estimate is not None:
            number = read_estimate(source.estimate)[1][-1]
    if not -len(clip) <= number < len(clip):
        raise OptionError(
            f"--frame is {number}, but {clip.path} has {len(clip)} frames; choose 0 to "
            f"{len(clip) - 1}."
        )
    return clip[number]


def _pose(source: Source, frame: Frame | None, *, has_frame: bool) -> Floats:
    if source.pose is not None:
        return map_from_camera_of(source.pose)
    if source.tum is not None:
        return _pose_of_tum(source.tum, source.row, frame if has_frame else None)
    assert source.estimate is not None  # noqa: S101  # `_check` saw to it
    return pose_of_estimate(source.estimate, source.mode, frame if has_frame else None)


def _pose_of_tum(path: Path, row: int | None, frame: Frame | None) -> Floats:
    from placegraph.io.capture.tum import read_tum

    track = read_tum(path)
    if row is None and frame is not None:
        row = int(np.abs(track.stamps - frame.stamp).argmin())
        if abs(track.stamps[row] - frame.stamp) > 1e-6 * max(1.0, abs(frame.stamp)):
            raise InputError(
                f"{path} has no row with the stamp {frame.stamp:.10g} of frame "
                f"{frame.index}; choose one with --row."
            )
    row = -1 if row is None else row
    if not -len(track) <= row < len(track):
        raise OptionError(
            f"--row is {row}, but {path} has {len(track)} rows; choose 0 to {len(track) - 1}."
        )
    pose: Floats = track.poses[row]
    return pose


def _write(
    scene: SceneMap, drawn: Rendering, map_from_camera: Floats, frame: Frame | None, out: Path
) -> list[Path]:
    """Write all pictures; returns their files."""
    from PIL import Image

    from placegraph.view.draw.painter import write_image
    from placegraph.view.scene.overlay import colour_objects, draw_overlay

    if len(scene) >= _MOST:
        raise OptionError(
            f"The map has {len(scene):,} objects, but objects.png can store at most {_MOST - 1:,}."
        )
    normals = drawn.normals(scene.mesh, map_from_camera)
    units = np.rint(np.nan_to_num(drawn.depth) * _UNITS)
    units[units > _MOST] = 0
    pictures = {
        "colour": Image.fromarray(drawn.colour),
        "depth": Image.fromarray(units.astype(np.uint16)),
        "objects": Image.fromarray((drawn.objects + 1).astype(np.uint16)),
        "objects_preview": Image.fromarray(colour_objects(drawn.objects, normals)),
    }
    if frame is not None:
        pictures["overlay"] = draw_overlay(frame.rgb(), drawn, normals)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"The folder {out} cannot be created ({error.strerror}); choose another --out."
        ) from error
    files = []
    for name, picture in pictures.items():
        files.append(out / f"{name}.png")
        write_image(picture, files[-1], "PNG")
        if name == "objects":
            files.append(out / "objects.json")
            named = {str(o["value"]): o for o in _objects(scene, drawn)}
            write_output(
                files[-1], (json.dumps(named, ensure_ascii=False, indent=1) + "\n").encode()
            )
    return files


def _objects(scene: SceneMap, drawn: Rendering) -> list[dict[str, Any]]:
    """Objects in the picture, those that fill most of it first."""
    rows, counts = np.unique(drawn.objects[drawn.objects >= 0], return_counts=True)
    graph, order = scene.graph, np.argsort(-counts, kind="stable")
    return [
        {
            "value": int(rows[i]) + 1,
            "id": graph.ids[rows[i]],
            "label": graph.labels[rows[i]],
            "name": graph.names[rows[i]] if graph.names else "",
            "share": round(float(counts[i]) / drawn.objects.size, 6),
        }
        for i in order
    ]


def _describe(
    scene: SceneMap,
    drawn: Rendering,
    map_from_camera: Floats,
    frame: Frame | None,
    files: list[Path],
) -> dict[str, Any]:
    depth = drawn.depth[drawn.mask]
    return {
        "map_from_camera": map_from_camera.tolist(),
        "frame": None if frame is None else frame.index,
        "covered": round(float(drawn.mask.mean()), 6),
        "depth_m": [round(float(v), 3) for v in (depth.min(), depth.max())] if depth.size else [],
        "objects": _objects(scene, drawn),
        "files": [str(file) for file in files],
    }


def _summarize(facts: dict[str, Any]) -> str:
    """Describe the picture in a sentence."""
    if not facts["objects"]:
        return "The map is not visible from this pose, so the picture is empty; check the pose."
    low, high = facts["depth_m"]
    named = [f"{o['label'] or o['id']} {o['share']:.0%}" for o in facts["objects"][:6]]
    return (
        f"The map fills {facts['covered']:.0%} of the picture, {low:.2f} to {high:.2f} m "
        f"away: {', '.join(named)}."
    )


def view(
    map_file: MapFile,
    capture: Annotated[
        Path | None,
        Option(help="Capture to localize first; its path and particles are shown."),
    ] = None,
    frames: Frames = None,
    run: Annotated[
        Path | None,
        Option(help="Recorded run to show, from `scene localize --record FILE`."),
    ] = None,
    camera_path: CameraPaths = None,
    host: Annotated[
        str, Option(help="Address to listen at; 0.0.0.0 also admits other computers.")
    ] = "127.0.0.1",
    port: Annotated[int, Option(help="Port; if it is taken, the next free one.")] = 8080,
    seed: Seed = 0,
    device: Device = "auto",
    quiet: NoProgress = False,
) -> None:
    """View a scene map in the browser; needs `pip install 'placegraph[view]'`.

    Click, list and hide objects with their labels, attributes and relations. With --capture, or with
    --run of an earlier localization, a slider shows the particles of every frame and pass. The map
    is not changed. Ctrl-C ends the viewer.

    Example: placegraph scene view house.scene --capture walk/ --frames 0:10
    """
    from placegraph.maps import open_scene
    from placegraph.view.scene_viewer import open_viewer

    if capture is not None and run is not None:
        raise OptionError("--capture and --run both give particles; remove one.")
    if frames is not None and capture is None:
        raise OptionError("--frames applies only to --capture; give both, or remove --frames.")
    paths = camera_paths(camera_path)
    scene = open_scene(map_file)
    estimate = None
    if run is not None:
        from placegraph.indoor.pose.record import read_run

        estimate = read_run(run)
    elif capture is not None:
        estimate = _localized(scene, capture, frames, seed=seed, device=device, quiet=quiet)
    with open_viewer(scene, camera_paths=paths, run=estimate, host=host, port=port) as viewer:
        click.echo(f"{map_file} at {viewer.address} (press Ctrl-C to stop)")
        wait()


def wait() -> None:
    """Return when the user presses Ctrl-C."""
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        return


def _localized(
    scene: SceneMap, folder: Path, frames: str | None, *, seed: int, device: str, quiet: bool
) -> PoseEstimate:
    from placegraph.indoor.options import FilterOptions
    from placegraph.io.capture.capture import open_capture

    chosen = chosen_frames(open_capture(folder), frames)
    with progress_of(hidden=quiet) as tell:
        return scene.localize(
            chosen, options=FilterOptions(record=True), seed=seed, device=device, progress=tell
        )
