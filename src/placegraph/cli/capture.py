"""Command `placegraph capture init`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import click

from placegraph.cli.command import Argument, Fields, Option
from placegraph.io.capture.raw import RawOptions


def init(
    recording: Annotated[Path, Argument(help="Folder with images, poses and intrinsics.")],
    given: Annotated[dict[str, Any], Fields(RawOptions)],
    out: Annotated[
        Path | None, Option("--out", "-o", help="Folder to write; RECORDING_capture if not given.")
    ] = None,
) -> None:
    """Write a capture folder from a recording in another layout or by other conventions.

    Files are found by their names, conventions by projecting depth of frames into others: swapped
    axes, inverted poses, orders of quaternions, units of depth. Options override what is found; where
    they contradict the depth, the command says which fit.

    Example: placegraph capture init chess/seq-01

    Example: placegraph capture init walk --poses traj.txt --intrinsics 525,525,320,240 --axes opengl
    """
    from placegraph.io.capture.raw import read_raw, write_capture

    capture = read_raw(recording, RawOptions(**given))
    out = out or recording.with_name(f"{recording.resolve().name}_capture")
    write_capture(capture, out)
    for note in capture.notes:
        click.echo(note)
    click.echo(f"{out}: {len(capture)} frames. Next: placegraph scene build {out} -o X.scene")
