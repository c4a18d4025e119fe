"""`placegraph scene localize`: frames find their pose in a scene map."""

from __future__ import annotations

import json
from dataclasses import replace
from math import isfinite, log, radians, sqrt
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click

from placegraph.cli.command import Option
from placegraph.cli.common import AsJson, numbers_of, progress_of
from placegraph.cli.scene.answer import Files, show
from placegraph.cli.scene.query import (
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
    from placegraph.indoor.options import FilterOptions
    from placegraph.indoor.pose.prior import Prior
    from placegraph.indoor.refine.matching import Matcher
    from placegraph.indoor.refine.options import RefineOptions
    from placegraph.io.capture.capture import Capture


def localize(
    map_file: MapFile,
    capture: CaptureFolder,
    frames: Frames = None,
    seed: Seed = 0,
    near: Annotated[
        str | None,
        Option(help="X,Y or X,Y,Z [m, map] the first frame is known to be near.", panel=KNOWN),
    ] = None,
    radius: Annotated[
        float, Option(help="Radius of --near [m]: half of the prior lies within.", panel=KNOWN)
    ] = 1.0,
    yaw_deg: Annotated[
        float | None,
        Option(help="With --near: about where it looks, counter-clockwise from x.", panel=KNOWN),
    ] = None,
    description: Annotated[
        str | None,
        Option(
            help="What is known of the place: 'next to the sofa, facing the window'.", panel=KNOWN
        ),
    ] = None,
    encoder: Annotated[
        str | None,
        Option(
            help="What says which objects a patch may show: labels, appearance, or one "
            "that `scene encode` gave the map its vectors of, with its options: 'features "
            "weights=dinov2.pth'; the capture's own labels if not given.",
            panel=USED,
        ),
    ] = None,
    height: Annotated[
        list[float] | None,
        Option(help="Height of the camera above the floor [m]; may be repeated.", panel=KNOWN),
    ] = None,
    semantic: Annotated[
        bool, Option("--semantic/--no-semantic", help="Use the labels of the frames.", panel=USED)
    ] = True,
    depth: UseDepth = True,
    colour: UseColour = True,
    depth_network: Annotated[
        Path | None,
        Option(
            help="Network (.tflite, with a .json beside it) that tells depth from the images, where "
            "the capture has none; extra `segment`.",
            panel=USED,
        ),
    ] = None,
    preset: Annotated[
        str,
        Option(
            help="Recipe of the search: default (a table of what is visible from where, and a fit of "
            "all frames), paper (SG2Loc as printed: particles everywhere, three "
            "passes, one MLE, then six views and PnP), coarse (its first pass alone, then the same), "
            "published (what its code does otherwise; a filter only, nothing is refined). The paper's "
            "take many times as long.",
            panel=USED,
        ),
    ] = "default",
    refine: Annotated[
        bool,
        Option("--refine/--no-refine", help="Fit the pose to depth and images.", panel=REFINED),
    ] = True,
    matcher: MatcherName = "auto",
    weights: Weights = None,
    every: Annotated[
        float, Option(help="Keyframes: least time between frames [s]; 0 takes all.", panel=USED)
    ] = 0.0,
    device: Device = "auto",
    as_json: AsJson = False,
    png: Annotated[
        Path | None, Option(help="Write a plan with the particles of a filter.", panel=WRITTEN)
    ] = None,
    gif: Annotated[
        Path | None, Option(help="Write the plan as an animation.", panel=WRITTEN)
    ] = None,
    overlay: OverlayFile = None,
    tum: TumFile = None,
    record: Annotated[
        Path | None,
        Option(help="Write the run with all particles, for `scene view --run`.", panel=WRITTEN),
    ] = None,
    quiet: NoProgress = False,
) -> None:
    """Find the pose of a camera, from some frames of it, in a map of rooms.

    The answer is the pose of the last frame: x, y, z of the camera in the map [m], and yaw, which
    way it looks, counter-clockwise from the map's x axis. OK is to be trusted; AMBIGUOUS names
    several places that fit, LOST says that none does. The map is only read.

    The best pose is then refined: fitted to the map by depth, and by images where depth does not
    fix it. It stands only where held-back pixels speak for it; a line says what became of it.

    Example: placegraph scene localize house.scene walk/ --frames 10:20 --overlay look.png
    """
    from placegraph.indoor.refine.options import RefineOptions
    from placegraph.io.capture.capture import open_capture
    from placegraph.maps import open_scene

    options = _options(
        preset, semantic=semantic, depth=depth, colour=colour, height=height, every=every,
        record=any(file is not None for file in (png, gif, record)),
    )  # fmt: skip
    prior = _prior(near, radius, yaw_deg)
    refining = RefineOptions.preset(preset) if refine else None
    matching = _matching(matcher, weights, device, refine=refining is not None)
    chosen = chosen_frames(open_capture(capture), frames)
    if depth_network is not None:
        chosen, options, refining = _measured(chosen, depth_network, options, refining)
    scene = open_scene(map_file)
    title = f"{capture.name} {frames}" if frames else capture.name
    with progress_of(hidden=quiet or as_json) as tell:
        estimate = scene.localize(
            chosen, prior=prior, description=description, encoder=encoder, options=options,
            refine=refining or False, matcher=matching, seed=seed, device=device, progress=tell,
        )  # fmt: skip
        tell("drawing", 0, 1)
        Files(title, png, gif, tum, overlay, record).write(scene, estimate, chosen, device=device)
    if as_json:
        click.echo(json.dumps(estimate.to_dict(), ensure_ascii=False))
    else:
        show(estimate)


def _options(
    preset: str,
    *,
    semantic: bool,
    depth: bool,
    colour: bool,
    height: list[float] | None,
    every: float,
    record: bool,
) -> FilterOptions:
    from placegraph.indoor.options import FilterOptions

    options = FilterOptions.preset(preset)
    if height:
        options = replace(options, heights=tuple(height))
    return replace(
        options, semantic=semantic, depth=depth, colour=colour, every=every, record=record
    )


def _measured(
    capture: Capture, weights: Path, options: FilterOptions, refining: RefineOptions | None
) -> tuple[Capture, FilterOptions, RefineOptions | None]:
    """A capture with depth by a network, and options that trust it less than a sensor."""
    from placegraph.indoor.encode.depth_network import SLOPE, depth_network, measured

    if not options.depth:
        raise OptionError("--depth-network and --no-depth exclude each other; leave out one.")
    wide = replace(options, likelihood=replace(options.likelihood, depth_slope=SLOPE))
    blind = refining and replace(refining, depth=False)
    return measured(capture, depth_network(weights)), wide, blind


def _matching(matcher: str, weights: Path | None, device: str, *, refine: bool) -> str | Matcher:
    if not refine and (matcher != "auto" or weights is not None):
        raise OptionError(
            "--matcher and --weights belong to the refinement; leave out --no-refine or --preset "
            "published, or these."
        )
    return matcher_of(matcher, weights, device)


def _prior(near: str | None, radius: float, yaw_deg: float | None) -> Prior | None:
    from placegraph.indoor.pose.prior import Prior

    if near is None:
        if yaw_deg is not None:
            raise OptionError("--yaw-deg belongs to --near; give both.")
        return None
    mend = "give x and y, and z if it is known, as 1.5,-2."
    x, y, *z = numbers_of(near, "--near", {2, 3}, mend)
    if not (isfinite(radius) and radius > 0):
        raise OptionError(f"--radius is {radius}; it must be greater than 0.")
    yaw = None if yaw_deg is None else radians(yaw_deg)
    # half of a round Gaussian lies within 1.177 standard deviations
    return Prior(x, y, z[0] if z else None, yaw, spread=radius / sqrt(2.0 * log(2.0)))
