"""`placegraph locate`: where in a world of cities and rooms, from all that is known."""

from __future__ import annotations

from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from placegraph.cli.city import Near, location_prior
from placegraph.cli.command import Argument, Fields, Option
from placegraph.cli.common import (
    AsJson,
    console,
    echo_json,
    evidence_cells,
    print_remainder,
    progress_of,
    table,
)
from placegraph.cli.scene_localize import MOST_OBJECTS, pose_words
from placegraph.cli.scene_options import Device, Frames, NoProgress, Seed, chosen_frames
from placegraph.errors import OptionError
from placegraph.outdoor.options import KNOWN, LocateOptions

if TYPE_CHECKING:
    from placegraph.world import WorldEstimate, WorldMode


def locate(
    world: Annotated[
        str,
        Argument(
            help="Folder of .city, .scene and .library files and library shards, a single one of "
            "these, or a world in shards (a folder or a URL such as s3://...)."
        ),
    ],
    prior: Annotated[dict[str, Any], Fields(LocateOptions)],
    text: Annotated[
        str | None,
        Argument(help="Description of the place, outdoors and indoors: streets, buildings, rooms."),
    ] = None,
    capture: Annotated[
        Path | None,
        Option(help="Capture (folder or recording), as in `scene localize`.", panel=KNOWN),
    ] = None,
    frames: Frames = None,
    near: Near = None,
    refine: Annotated[
        bool, Option("--refine/--no-refine", help="Fit the pose to depth and images.")
    ] = True,
    seed: Seed = 0,
    device: Device = "auto",
    budget: Annotated[
        float | None,
        Option(
            help="World in shards: time limit [s], after which the best answer so far is returned; 2 s, "
            "but not before the 4 likeliest shards, if not given."
        ),
    ] = None,
    scheduler: Annotated[
        str | None,
        Option(help="Dask scheduler whose workers search a world in shards, as tcp://host:8786."),
    ] = None,
    keep: Annotated[
        Path | None, Option(help="Local folder for the parts fetched from a world at a URL.")
    ] = None,
    memory: Annotated[
        str | None,
        Option(help="World in shards: memory of this process for open shards, such as 4GB."),
    ] = None,
    as_json: AsJson = False,
    quiet: NoProgress = False,
) -> None:
    """Find place, room and pose at once, from a text, frames and a fix, or any of them.

    A sentence selects buildings, a building selects its scenes, frames give the pose, and a GPS fix
    (--near) is a prior. `placegraph scene anchor` places scenes in buildings. OK: use the answer.
    AMBIGUOUS: several places fit, or something contradicts the best one. LOST: no place fits.

    Examples: placegraph locate town/ "I am in the library on Lange Straße, by the window";
    placegraph locate town/ "in the library" --capture walk/ --frames :3 --near 9.99,53.55
    """
    from placegraph.io.capture.capture import open_capture
    from placegraph.world import open_world

    if frames is not None and capture is None:
        raise OptionError("--frames applies only to captures; give one with --capture.")
    with progress_of(hidden=quiet or as_json) as tell:
        shown = None if capture is None else chosen_frames(open_capture(capture), frames)
        opened = open_world(world, scheduler=scheduler, keep=keep, memory=memory)
        estimate = opened.locate(
            text, shown, seed=seed, refine=refine, device=device, progress=tell, budget=budget,
            **location_prior(near, prior),
        )  # fmt: skip
    question = estimate.next_question(opened)
    if as_json:
        echo_json(estimate.to_dict() | {"question": question.text if question else None})
        return
    show(estimate)
    if question is not None:
        console().print(f"To be sure: {question.text}")


def show(estimate: WorldEstimate) -> None:
    """Print an estimate so that a person can read it."""
    out = console()
    out.print(f"{estimate.status.name}: {estimate.reason}")
    for rank, mode in enumerate(estimate.modes, 1):
        out.print(f"{rank}. {mode.where}  {mode.probability:6.1%}{_earth(mode)}")
        if rank == 1 and mode.pose is not None:
            out.print(f"   {pose_words(mode.pose)}")
    print_remainder(out, estimate, len(estimate.modes))
    if estimate.evidence:
        rows = table("", "evidence", "log-likelihood ratio", "matched objects")
        for e in estimate.evidence[: MOST_OBJECTS + 4]:
            things = ", ".join(o.name or o.label for o in e.objects[:3])
            rows.add_row(*evidence_cells(e), "; ".join(x for x in (things, e.note) if x))
        out.print(rows)
    parsed = estimate.understood
    if parsed is not None and parsed.ignored:
        out.print(
            "Ignored: " + "; ".join(f"“{i.text.strip()}” ({i.reason})" for i in parsed.ignored)
        )
    for note in estimate.notes:
        out.print(note)


def _earth(mode: WorldMode) -> str:
    """Format the place of a mode on Earth."""
    if mode.earth is None:
        return ""
    heading = f"heading {round(degrees(mode.earth.heading)) % 360}°"
    return f"  {mode.earth.latitude:.6f}, {mode.earth.longitude:.6f}, {mode.earth.height:.1f} m, {heading}"
