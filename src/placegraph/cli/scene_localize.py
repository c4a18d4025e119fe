"""`placegraph scene localize`: frames find their pose in a scene map."""

from __future__ import annotations

import json
from dataclasses import replace
from math import degrees, hypot, isfinite, log, radians, sqrt
from pathlib import Path  # noqa: TC003  # Typer reads the annotations
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from placegraph.cli.common import AsJson  # noqa: TC001  # Typer reads the annotations
from placegraph.errors import OptionError

if TYPE_CHECKING:
    from placegraph.estimate import PoseEstimate, PoseMode
    from placegraph.formats.capture import Capture
    from placegraph.indoor.options import FilterOptions
    from placegraph.indoor.search import Prior

MOST_OBJECTS = 6
"""Objects of the evidence that are printed."""
LEAST = 0.001
"""Probability of a mode that is printed; JSON has all."""


def localize(
    map_file: Annotated[
        Path, typer.Argument(help="Scene map (.scene), made by `placegraph scene build`.")
    ],
    capture: Annotated[
        Path,
        typer.Argument(help="Folder with rgb/, camera.json, odometry.tum; depth/ and labels help."),
    ],
    frames: Annotated[
        str | None,
        typer.Option(help="Which frames, as in Python: 10:20, -5:, ::2; 7 is frame 7 alone."),
    ] = None,
    seed: Annotated[int, typer.Option(help="The same seed gives the same answer.")] = 0,
    near: Annotated[
        str | None,
        typer.Option(help="X,Y or X,Y,Z [m, map] the first frame is known to be near."),
    ] = None,
    radius: Annotated[
        float, typer.Option(help="Radius of --near [m]: half of the prior lies within.")
    ] = 1.0,
    yaw_deg: Annotated[
        float | None,
        typer.Option(help="With --near: about where it looks, counter-clockwise from x."),
    ] = None,
    height: Annotated[
        list[float] | None,
        typer.Option(help="Height of the camera above the floor [m]; may be repeated."),
    ] = None,
    semantic: Annotated[
        bool, typer.Option("--semantic/--no-semantic", help="Use the labels of the frames.")
    ] = True,
    depth: Annotated[bool, typer.Option("--depth/--no-depth", help="Use depth images.")] = True,
    colour: Annotated[
        bool, typer.Option("--colour/--no-colour", help="Use colours where the map has some.")
    ] = True,
    coarse: Annotated[
        bool, typer.Option("--coarse", help="No polish: quicker, less exact: faster, less exact.")
    ] = False,
    every: Annotated[
        float, typer.Option(help="Keyframes: least time between frames [s]; 0 takes all.")
    ] = 0.0,
    device: Annotated[str, typer.Option(help="auto, cpu or cuda.")] = "auto",
    as_json: AsJson = False,
    png: Annotated[
        Path | None, typer.Option(help="Write a plan with the particles of every pass.")
    ] = None,
    gif: Annotated[Path | None, typer.Option(help="Write the plan as an animation.")] = None,
    tum: Annotated[
        Path | None, typer.Option(help="Write every frame's pose, map_from_camera, as TUM text.")
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress.")] = False,
) -> None:
    """Find the pose of a camera, from some frames of it, in a map of rooms.

    The answer is the pose of the last frame: x, y, z of the camera in the map [m], and yaw, which
    way it looks, counter-clockwise from the map's x axis. OK is to be trusted; AMBIGUOUS names
    several places that fit, LOST says that none does. The map is only read.

    Example: placegraph scene localize house.scene walk/ --frames 10:20 --png plan.png
    """
    from placegraph.formats.capture import open_capture
    from placegraph.indoor.scene_map import SceneMap

    options = _options(
        coarse=coarse, semantic=semantic, depth=depth, colour=colour, height=height, every=every,
        record=png is not None or gif is not None,
    )  # fmt: skip
    prior = _prior(near, radius, yaw_deg)
    chosen = chosen_frames(open_capture(capture), frames)
    scene = SceneMap.open(map_file)
    with _bar(hidden=quiet or as_json) as progress:
        task = progress.add_task("starting", total=None)
        estimate = scene.localize(
            chosen,
            prior=prior,
            options=options,
            seed=seed,
            device=device,
            progress=lambda step, done, total: progress.update(
                task, description=step, completed=done, total=total
            ),
        )
        progress.update(task, description="drawing")
        if tum is not None:
            _write_tum(estimate, chosen, tum)
        if png is not None or gif is not None:
            from placegraph.view import write_plan, write_plan_animation

            title = f"{capture.name} {frames}" if frames else capture.name
            if png is not None:
                write_plan(scene, estimate, png, title=title, camera=chosen.camera)
            if gif is not None:
                write_plan_animation(scene, estimate, gif, title=title, camera=chosen.camera)
    if as_json:
        typer.echo(json.dumps(estimate.to_dict(), ensure_ascii=False))
    else:
        show(estimate)


def chosen_frames(capture: Capture, frames: str | None) -> Capture:
    """Frames of a capture by a text such as 10:20, -5:, ::2 or 7; all where there is none.

    Raises
    ------
    OptionError
        The text is no such thing, goes backwards, or selects nothing.

    """
    if frames is None:
        return capture
    parts = frames.split(":")
    try:
        numbers = [int(part) if part.strip() else None for part in parts]
    except ValueError:
        numbers = []
    first, last, step = [*numbers, None, None, None][:3]
    if not 1 <= len(numbers) <= 3 or (len(parts) == 1 and first is None):
        raise OptionError(f"--frames is {frames!r}; give frames as 10:20, -5:, ::2 or 7.")
    if step is not None and step < 1:
        raise OptionError(f"--frames is {frames!r}; time runs forward, so the step is 1 or more.")
    if len(parts) == 1 and first is not None:
        last = first + 1 or None  # -1 is the last frame, and -1:0 would be none
    chosen = capture[first:last:step]
    if not len(chosen):
        raise OptionError(
            f"--frames {frames} selects none of the {len(capture)} frames of {capture.path}; "
            f"they are 0 to {len(capture) - 1}."
        )
    return chosen


def show(estimate: PoseEstimate) -> None:
    """Print an estimate so that a person can read it."""
    console = Console(soft_wrap=True, highlight=False, markup=False, emoji=False)
    console.print(f"{estimate.status.name}: {estimate.reason}")
    for rank, mode in enumerate(estimate.modes, 1):
        if rank == 1 or mode.probability >= LEAST:
            console.print(f"{rank}. {pose_words(mode)}")
    of_objects = [e for e in estimate.evidence if e.objects]
    of_senses = [e for e in estimate.evidence if not e.objects]
    if estimate.evidence:
        table = Table("", "evidence", "nat", "", box=None, pad_edge=False)
        for e in [*of_objects[:MOST_OBJECTS], *of_senses]:
            sign = {"for": "+", "against": "-"}.get(e.verdict, " ")
            table.add_row(sign, e.statement, f"{e.weight:+.1f}" if e.objects else "", e.note)
        console.print(table)
    if len(of_objects) > MOST_OBJECTS:
        console.print(f"and {len(of_objects) - MOST_OBJECTS} more objects (--json names them)")


def pose_words(mode: PoseMode) -> str:
    """A mode in numbers: x, y, z [m], yaw [deg], probability, standard deviations."""
    x, y, z, yaw = mode.pose.tolist()
    sx, sy, *_, turn = (sqrt(max(v, 0.0)) for v in mode.covariance.diagonal().tolist())
    scene = f"  in {mode.scene}" if mode.scene else ""
    return (
        f"x {x:.3f} m  y {y:.3f} m  z {z:.3f} m  yaw_deg {degrees(yaw):.2f}  "
        f"{mode.probability:6.1%}  ±{100 * hypot(sx, sy):.1f} cm ±{degrees(turn):.2f}°{scene}"
    )


def _options(
    *,
    coarse: bool,
    semantic: bool,
    depth: bool,
    colour: bool,
    height: list[float] | None,
    every: float,
    record: bool,
) -> FilterOptions:
    from placegraph.indoor.options import FilterOptions

    options = FilterOptions.coarse() if coarse else FilterOptions()
    if height:
        options = replace(options, heights=tuple(height))
    return replace(
        options, semantic=semantic, depth=depth, colour=colour, every=every, record=record
    )


def _prior(near: str | None, radius: float, yaw_deg: float | None) -> Prior | None:
    from placegraph.indoor.search import Prior

    if near is None:
        if yaw_deg is not None:
            raise OptionError("--yaw-deg belongs to --near; give both.")
        return None
    try:
        numbers = [float(part) for part in near.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in {2, 3}:
        raise OptionError(f"--near is {near!r}; give x and y, and z if it is known, as 1.5,-2.")
    if not (isfinite(radius) and radius > 0):
        raise OptionError(f"--radius is {radius}; it must be greater than 0.")
    x, y, *z = numbers
    yaw = None if yaw_deg is None else radians(yaw_deg)
    # half of a round Gaussian lies within 1.177 standard deviations
    return Prior(x, y, z[0] if z else None, yaw, spread=radius / sqrt(2.0 * log(2.0)))


def _write_tum(estimate: PoseEstimate, capture: Capture, path: Path) -> None:
    """Write the pose of every frame; of a capture that is lost, nothing but the reason."""
    from placegraph.formats.tum import write_tum

    stamp_of = {frame.index: frame.stamp for frame in capture}
    stamps = [stamp_of[row] for row in estimate.frames.tolist()]
    said = f"map_from_camera, {estimate.status.name}: {estimate.reason}"
    write_tum(path, stamps, estimate.trajectory, comment=said)


def _bar(*, hidden: bool) -> Progress:
    """Spinner, bar and time, on stderr; gone when done."""
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(bar_width=28),
        TimeElapsedColumn(),
    )
    return Progress(*columns, console=Console(stderr=True), disable=hidden, transient=True)
