"""Commands `placegraph scene localize|refine`."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from math import degrees, hypot, isfinite, log, radians, sqrt
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import click

from placegraph.cli.command import Fields, Option
from placegraph.cli.common import (
    AsJson,
    console,
    evidence_cells,
    numbers_of,
    print_remainder,
    progress_of,
    table,
)
from placegraph.cli.scene_options import (
    KNOWN,
    REFINED,
    USED,
    WRITTEN,
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
    Weights,
    chosen_frames,
    map_from_camera_of,
    matcher_of,
    pose_of_estimate,
    read_estimate,
)
from placegraph.errors import OptionError
from placegraph.indoor.options import FilterOptions, PoseSearchOptions, RefineOptions

if TYPE_CHECKING:
    from placegraph.core.estimate import PoseEstimate, PoseMode, Refinement
    from placegraph.indoor.pose.prior import Prior
    from placegraph.indoor.refine.matching import Matcher
    from placegraph.indoor.scene_map import SceneMap
    from placegraph.io.capture.capture import Capture

MOST_OBJECTS = 6
"""Objects of the evidence that are printed."""
LEAST = 0.001
"""Probability of a mode that is printed; JSON has all."""


@dataclass(frozen=True)
class Files:
    """Pictures and texts that are asked for."""

    title: str
    png: Path | None = None
    gif: Path | None = None
    tum: Path | None = None
    overlay: Path | None = None
    record: Path | None = None

    def write(self, scene: SceneMap, estimate: PoseEstimate, chosen: Capture) -> None:
        """Write them; of an estimate without a pose there is no overlay, which is said on stderr."""
        if self.tum is not None:
            write_tum_of(estimate, chosen, self.tum)
        if self.record is not None:
            from placegraph.indoor.pose.record import write_run

            write_run(self.record, estimate, source=scene.source)
        if self.png is not None:
            from placegraph.view import write_plan

            camera = chosen[-1].camera
            write_plan(scene, estimate, self.png, title=self.title, camera=camera, capture=chosen)
        if self.gif is not None:
            from placegraph.view import write_plan_animation

            write_plan_animation(
                scene, estimate, self.gif, title=self.title, camera=chosen[-1].camera
            )
        if self.overlay is not None and estimate.best is not None:
            from placegraph.view import write_overlay

            write_overlay(scene, estimate, chosen, self.overlay)
        elif self.overlay is not None:
            click.echo(f"{self.overlay} was not written, because there is no pose.", err=True)


def write_tum_of(estimate: PoseEstimate, capture: Capture, path: Path) -> None:
    """Write the pose of every frame, and how it came about."""
    from placegraph.io.capture.tum import write_tum

    stamp_of = {frame.index: frame.stamp for frame in capture}
    stamps = [stamp_of[row] for row in estimate.frames.tolist()]
    comment_text = f"map_from_camera, {estimate.status.name}: {estimate.reason}"
    if estimate.refinement is not None and estimate.refinement.reason != estimate.reason:
        comment_text = f"{comment_text} {estimate.refinement.reason}"
    write_tum(path, stamps, estimate.trajectory, comment=comment_text)


def show(estimate: PoseEstimate, *, before: str = "coarse pose") -> None:
    """Print an estimate so that a person can read it; `before`: what was refined."""
    out = console()
    out.print(f"{estimate.status.name}: {estimate.reason}")
    shown = [m for m in estimate.modes if m.probability >= LEAST] or list(estimate.modes[:1])
    for rank, mode in enumerate(shown, 1):
        out.print(f"{rank}. {pose_words(mode)}")
    print_remainder(out, estimate, len(shown))
    if estimate.refinement is not None:
        out.print(refinement_words(estimate.refinement, before))
    of_objects = [e for e in estimate.evidence if e.objects]
    of_senses = [e for e in estimate.evidence if not e.objects]
    if estimate.evidence:
        rows = table("", "evidence", "log-likelihood ratio", "")
        for e in [*of_objects[:MOST_OBJECTS], *of_senses]:
            sign, statement, ratio = evidence_cells(e)
            rows.add_row(sign, statement, ratio if e.objects else "", e.note)
        out.print(rows)
    if len(of_objects) > MOST_OBJECTS:
        out.print(f"and {len(of_objects) - MOST_OBJECTS} more objects (--json names them)")


def pose_words(mode: PoseMode) -> str:
    """A mode in numbers: x, y, z [m], yaw [deg], probability, standard deviations."""
    x, y, z, yaw = mode.pose.tolist()
    sx, sy, *_, turn = (sqrt(max(v, 0.0)) for v in mode.covariance.diagonal().tolist())
    scene = f"  in {mode.scene}" if mode.scene else ""
    return (
        f"x {x:.3f} m  y {y:.3f} m  z {z:.3f} m  yaw {degrees(yaw):.2f}°  "
        f"{mode.probability:6.1%}  ±{100 * hypot(sx, sy):.1f} cm ±{degrees(turn):.2f}°{scene}"
    )


def refinement_words(refinement: Refinement, before: str = "coarse pose") -> str:
    """Describe a refinement in a line: accepted or not, why, and how far the pose moved."""
    shift, turn = (refinement.stats.get(key, 0.0) for key in ("shift_m", "turn_deg"))
    way = f"{100 * shift:.1f} cm and {turn:.2f}°"
    if refinement.accepted:
        return f"{refinement.reason} The pose moved by {way}."
    away = f"; the rejected pose lies {way} from it" if shift > 0.002 or turn > 0.1 else ""
    return f"{refinement.reason} The {before} stands{away}."


def localize(
    map_file: MapFile,
    capture: CaptureFolder,
    search: Annotated[dict[str, Any], Fields(PoseSearchOptions)],
    frames: Frames = None,
    seed: Seed = 0,
    near: Annotated[
        str | None,
        Option(
            help="X,Y or X,Y,Z: approximate position of the first frame in the map [m].",
            panel=KNOWN,
        ),
    ] = None,
    radius: Annotated[
        float | None,
        Option(
            help="Radius of --near [m], which contains half of the prior probability; 1 if not given.",
            panel=KNOWN,
        ),
    ] = None,
    yaw_deg: Annotated[
        float | None,
        Option(
            help="With --near: approximate viewing direction [deg], counter-clockwise from x.",
            panel=KNOWN,
        ),
    ] = None,
    description: Annotated[
        str | None,
        Option(
            help="Description of the camera's place: 'next to the sofa, facing the window'.",
            panel=KNOWN,
        ),
    ] = None,
    encoder: Annotated[
        str | None,
        Option(
            help="Encoder that matches image patches with objects: labels, appearance, or one "
            "used in `scene encode`, with its options ('features weights=dinov2.pth'); the "
            "capture's own labels if not given.",
            panel=USED,
        ),
    ] = None,
    depth_network: Annotated[
        Path | None,
        Option(
            help="Depth network (.tflite, with a .json beside it) for captures without depth; "
            "needs the extra `segment`.",
            panel=USED,
        ),
    ] = None,
    preset: Annotated[
        str,
        Option(
            help="Preset of the search: default (visibility table, and a fit of all frames), "
            "paper (SG2Loc as printed: uniform particles, three passes, one MLE, six "
            "rendered views and PnP), coarse (the same with the first pass only) or "
            "published (as in the paper's code: filter only, no refinement). The last three "
            "are many times slower.",
            panel=USED,
        ),
    ] = "default",
    refine: Annotated[
        bool,
        Option("--refine/--no-refine", help="Fit the pose to depth and images.", panel=REFINED),
    ] = True,
    matcher: MatcherName = "auto",
    weights: Weights = None,
    device: Device = "auto",
    as_json: AsJson = False,
    png: Annotated[
        Path | None,
        Option(help="Write a plan; with --gif or --record, also of particles.", panel=WRITTEN),
    ] = None,
    gif: Annotated[
        Path | None, Option(help="Write an animation of a filter's particles.", panel=WRITTEN)
    ] = None,
    overlay: OverlayFile = None,
    tum: TumFile = None,
    record: Annotated[
        Path | None,
        Option(help="Write the run with all particles, for `scene view --run`.", panel=WRITTEN),
    ] = None,
    quiet: NoProgress = False,
) -> None:
    """Find the pose of a camera in a scene map, from some frames.

    The answer is the pose of the last frame: x, y, z of the camera in the map [m], and yaw, its
    viewing direction counter-clockwise from the map's x axis. OK: use the pose. AMBIGUOUS: several
    places fit. LOST: no place fits. The map is not changed.

    The best pose is then refined: fitted to the map by depth, and by images if depth is not enough.
    The refined pose is used only if held-back pixels confirm it; a line reports the result.

    Example: placegraph scene localize house.scene walk/ --frames 10:20 --overlay look.png
    """
    from placegraph.indoor.options import RefineOptions
    from placegraph.io.capture.capture import open_capture
    from placegraph.maps import open_scene

    options = replace(FilterOptions.preset(preset), **search)
    filtered = options.with_filter(record=True) if gif or record else None
    if filtered and options.particle_filter:
        options, filtered = filtered, None
    prior = _prior(near, radius, yaw_deg)
    refining = RefineOptions.preset(preset) if refine else None
    matching = _matching(matcher, weights, device, refine=refining is not None)
    chosen = chosen_frames(open_capture(capture), frames)
    if depth_network is not None:
        chosen, options, refining = _measured(chosen, depth_network, options, refining)
    scene = open_scene(map_file)
    title = f"{capture.name} {frames}" if frames else capture.name
    with progress_of(hidden=quiet or as_json) as tell:
        asked: dict[str, Any] = {
            "prior": prior, "description": description, "encoder": encoder, "seed": seed,
            "device": device, "progress": tell,
        }  # fmt: skip
        estimate = scene.localize(
            chosen, options=options, refine=refining or False, matcher=matching, **asked
        )
        if filtered:  # a second run, so that pictures change no answer
            run = scene.localize(chosen, options=filtered, refine=False, **asked)
            estimate = replace(estimate, history=run.history)
        tell("drawing", 0, 1)
        Files(title, png, gif, tum, overlay, record).write(scene, estimate, chosen)
    if as_json:
        click.echo(json.dumps(estimate.to_dict(), ensure_ascii=False))
    else:
        show(estimate)


def _measured(
    capture: Capture, weights: Path, options: PoseSearchOptions, refining: RefineOptions | None
) -> tuple[Capture, PoseSearchOptions, RefineOptions | None]:
    """A capture with depth by a network, and options that trust it less than a sensor."""
    from placegraph.indoor.encode.networks import SLOPE, depth_network, estimate_depth

    if not options.depth:
        raise OptionError("--depth-network and --no-depth exclude each other; remove one.")
    wide = replace(options, likelihood=replace(options.likelihood, depth_slope=SLOPE))
    blind = refining and replace(refining, depth=False)
    return estimate_depth(capture, depth_network(weights)), wide, blind


def _matching(matcher: str, weights: Path | None, device: str, *, refine: bool) -> str | Matcher:
    if not refine and (matcher != "auto" or weights is not None):
        raise OptionError(
            "--matcher and --weights apply only to the refinement, which --no-refine and "
            "--preset published switch off; remove one or the other."
        )
    return matcher_of(matcher, weights, device)


def _prior(near: str | None, radius: float | None, yaw_deg: float | None) -> Prior | None:
    from placegraph.indoor.pose.prior import Prior

    if near is None:
        if yaw_deg is not None:
            raise OptionError("--yaw-deg applies only to --near; give both, or remove --yaw-deg.")
        if radius is not None:
            raise OptionError("--radius applies only to --near; give both, or remove --radius.")
        return None
    radius = 1.0 if radius is None else radius
    mend = "give x and y, and optionally z, such as 1.5,-2."
    x, y, *z = numbers_of(near, "--near", {2, 3}, mend)
    if not (isfinite(radius) and radius > 0):
        raise OptionError(f"--radius is {radius}; it must be greater than 0.")
    yaw = None if yaw_deg is None else radians(yaw_deg)
    # half of a round Gaussian lies within 1.177 standard deviations
    return Prior(x, y, z[0] if z else None, yaw, spread=radius / sqrt(2.0 * log(2.0)))


def refine(
    map_file: MapFile,
    capture: CaptureFolder,
    used: Annotated[dict[str, Any], Fields(PoseSearchOptions, "depth", "colour")],
    pose: Annotated[
        str | None,
        Option(
            help="X,Y,Z,YAW_DEG[,PITCH_DEG,ROLL_DEG] of the camera at the last frame, in the map "
            "[m], accurate to about 0.3 m and 15 degrees; pitch and roll are taken from "
            "gravity if not given."
        ),
    ] = None,
    estimate: Annotated[
        Path | None,
        Option(help="JSON output of `scene localize --json`, in place of --pose."),
    ] = None,
    mode: Annotated[int, Option(help="With --estimate: its mode 1 (the best), 2, ...")] = 1,
    frames: Frames = None,
    seed: Seed = 0,
    matcher: MatcherName = "auto",
    weights: Weights = None,
    device: Device = "auto",
    as_json: AsJson = False,
    png: PlanFile = None,
    overlay: OverlayFile = None,
    tum: TumFile = None,
    quiet: NoProgress = False,
) -> None:
    """Refine a roughly known pose, without searching the map.

    The pose is that of the last frame. With --estimate, the frames are those of the estimate, unless
    --frames is given. The answer is OK with the refined pose, or AMBIGUOUS with the given pose and
    the reason why it stays.

    Example: placegraph scene refine house.scene walk/ --frames 10:20 --pose 1.5,2,1.6,90

    Example: placegraph scene refine house.scene walk/ --estimate est.json --overlay look.png
    """
    from placegraph.indoor.refine import RefineOptions
    from placegraph.io.capture.capture import open_capture
    from placegraph.maps import open_scene

    if (pose is None) == (estimate is None):
        raise OptionError("The initial pose must be given once, with --pose or --estimate.")
    if mode != 1 and estimate is None:
        raise OptionError("--mode applies only to --estimate; give both, or remove --mode.")
    images: Literal["auto", False] = "auto" if used.get("colour", True) else False
    options = RefineOptions(depth=used.get("depth", True), images=images)
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
        files.write(scene, refined, chosen)
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
            f"{estimate} refers to frame {max(rows)}, but {clip.path} has {len(clip)} "
            "frames; give the capture that it was made from, or --frames."
        )
    return replace(clip, frames=tuple(clip[row] for row in rows))
