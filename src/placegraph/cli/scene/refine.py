"""`placegraph scene refine`: a pose known roughly, from elsewhere, becomes one to centimetres."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click

from placegraph.cli.command import Option
from placegraph.cli.common import AsJson, progress_of
from placegraph.cli.scene.answer import Files, show
from placegraph.cli.scene.pose import map_from_camera_of, pose_of_estimate, read_estimate
from placegraph.cli.scene.query import (
    CaptureFolder,
    Device,
    Frames,
    MapFile,
    MatcherName,
    NoProgress,
    OverlayFile,
    PlanFile,
    Seed,
    TumFile,
    UseColour,
    UseDepth,
    Weights,
    chosen_frames,
    matcher_of,
)
from placegraph.errors import OptionError

if TYPE_CHECKING:
    from placegraph.io.capture.capture import Capture


def refine(
    map_file: MapFile,
    capture: CaptureFolder,
    pose: Annotated[
        str | None,
        Option(
            help="X,Y,Z,YAW_DEG[,PITCH_DEG,ROLL_DEG] of the camera at the last frame, in the map "
            "[m], to about 0.3 m and 15 degrees; without pitch and roll gravity gives them."
        ),
    ] = None,
    estimate: Annotated[
        Path | None,
        Option(help="JSON file of what `scene localize --json` printed, instead of --pose."),
    ] = None,
    mode: Annotated[int, Option(help="With --estimate: its mode 1 (the best), 2, ...")] = 1,
    frames: Frames = None,
    seed: Seed = 0,
    depth: UseDepth = True,
    colour: UseColour = True,
    matcher: MatcherName = "auto",
    weights: Weights = None,
    device: Device = "auto",
    as_json: AsJson = False,
    png: PlanFile = None,
    overlay: OverlayFile = None,
    tum: TumFile = None,
    quiet: NoProgress = False,
) -> None:
    """Refine a pose that is roughly known from elsewhere; the map is not searched.

    The pose is that of the last frame chosen; with --estimate the frames are those it tells of,
    where --frames chooses no others. The answer is OK at the refined pose, or AMBIGUOUS at the
    pose given, with the reason why that stands.

    Example: placegraph scene refine house.scene walk/ --frames 10:20 --pose 1.5,2,1.6,90

    Example: placegraph scene refine house.scene walk/ --estimate est.json --overlay look.png
    """
    from placegraph.indoor.refine import RefineOptions
    from placegraph.io.capture.capture import open_capture
    from placegraph.maps import open_scene

    if (pose is None) == (estimate is None):
        raise OptionError("Give one of --pose and --estimate: about where the camera is.")
    if mode != 1 and estimate is None:
        raise OptionError("--mode belongs to --estimate; give both.")
    options = RefineOptions(depth=depth, images="auto" if colour else False)
    matching = matcher_of(matcher, weights, device)
    chosen = _chosen(open_capture(capture), frames, estimate)
    if pose is not None:
        start = map_from_camera_of(pose, chosen[-1].gravity)
    else:
        assert estimate is not None  # noqa: S101  # one of both is there
        start = pose_of_estimate(estimate, mode, chosen[-1])
    scene = open_scene(map_file)
    title = f"{capture.name} {frames}" if frames else capture.name
    with progress_of(hidden=quiet or as_json) as tell:
        refined = scene.refine(
            chosen, start, matcher=matching, options=options, seed=seed, device=device,
            progress=tell,
        )  # fmt: skip
        tell("drawing", 0, 1)
        files = Files(title, png=png, tum=tum, overlay=overlay)
        files.write(scene, refined, chosen, device=device)
    if as_json:
        click.echo(json.dumps(refined.to_dict(), ensure_ascii=False))
    else:
        show(refined, before="pose given")


def _chosen(clip: Capture, frames: str | None, estimate: Path | None) -> Capture:
    """Frames asked for; else those that an estimate is of; else all."""
    if frames is not None or estimate is None:
        return chosen_frames(clip, frames)
    rows = read_estimate(estimate)[1]
    if not (min(rows) >= 0 and max(rows) < len(clip)):
        raise OptionError(
            f"{estimate} tells of frame {max(rows)}, but {clip.path} has {len(clip)} frames; give "
            "the capture it was made of, or --frames."
        )
    return replace(clip, frames=tuple(clip[row] for row in rows))
