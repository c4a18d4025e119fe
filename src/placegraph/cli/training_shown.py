"""What `city train` and `scene train` show while they learn."""

from __future__ import annotations

import shlex
import sys
from typing import TYPE_CHECKING

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from placegraph.training import rows_of

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

INTERRUPTED = 130
"""Exit code of shells for what Ctrl-C ended."""


def progress_bars(*, hidden: bool) -> Progress:
    """Bars on stderr; never there for a file or a pipe."""
    console = Console(stderr=True)
    return Progress(
        TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed}/{task.total}"),
        TimeElapsedColumn(), TimeRemainingColumn(), TextColumn("{task.fields[losses]}"),
        console=console, transient=True, disable=hidden or not console.is_terminal,
        redirect_stdout=sys.stdout.isatty(),
    )  # fmt: skip


def say_epoch(row: Mapping[str, float], *, first: bool) -> None:
    """Print the figures of an epoch, under their names where it is the first."""
    if first:
        typer.echo("  ".join(f"{name:>10}" for name in row))
    typer.echo("  ".join(_cell(name, value) for name, value in row.items()))


def go_on(work: Path) -> str:
    """Say how an interrupted training goes on."""
    done = len(rows_of(work))
    kept = f"{done} epochs are kept" if done != 1 else "1 epoch is kept"
    command = shlex.join(["placegraph", *sys.argv[1:]])
    return f"Interrupted; {kept} in {work}. The same command goes on from there:\n  {command}"


def _cell(name: str, value: float) -> str:
    width = max(10, len(name))
    return f"{value:>{width}.0f}" if name == "epoch" else f"{value:>{width}.3f}"
