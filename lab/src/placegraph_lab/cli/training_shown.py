"""What `city train` and `scene train` show while they learn."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import click
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from placegraph.cli.command import Option
from placegraph.cli.terminal import bare
from placegraph_learn.train.training import rows_of

INTERRUPTED = 130
"""Exit code of shells for what Ctrl-C ended."""

WorkFolder = Annotated[
    Path,
    Option(help="Folder for what an interrupted training goes on from, and its curves."),
]
TrainingDevice = Annotated[str, Option(help="cpu, cuda, or auto.")]


@contextmanager
def training(work: Path, *, hidden: bool) -> Iterator[Progress]:
    """Bars of a training; one that Ctrl-C ends says how it goes on, and exits as shells do."""
    with progress_bars(hidden=hidden) as bars:
        try:
            yield bars
        except KeyboardInterrupt:
            bars.stop()
            click.echo(go_on(work), err=True)
            raise click.exceptions.Exit(INTERRUPTED) from None


def progress_bars(*, hidden: bool) -> Progress:
    """Bars on stderr; never there for a file or a pipe."""
    console = Console(file=bare(sys.stderr))
    return Progress(
        TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed}/{task.total}"),
        TimeElapsedColumn(), TimeRemainingColumn(), TextColumn("{task.fields[losses]}"),
        console=console, transient=True, disable=hidden or not console.is_terminal,
        redirect_stdout=sys.stdout.isatty(),
    )  # fmt: skip


def say_epoch(row: Mapping[str, float], *, first: bool) -> None:
    """Print the figures of an epoch, under their names where it is the first."""
    if first:
        click.echo("  ".join(f"{name:>10}" for name in row))
    click.echo("  ".join(_cell(name, value) for name, value in row.items()))


def go_on(work: Path) -> str:
    """Say how an interrupted training goes on."""
    done = len(rows_of(work))
    kept = f"{done} epochs are kept" if done != 1 else "1 epoch is kept"
    command = shlex.join(["placegraph", *sys.argv[1:]])
    return f"Interrupted; {kept} in {work}. The same command goes on from there:\n  {command}"


def _cell(name: str, value: float) -> str:
    width = max(10, len(name))
    return f"{value:>{width}.0f}" if name == "epoch" else f"{value:>{width}.3f}"
