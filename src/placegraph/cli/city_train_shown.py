"""What `placegraph city train` shows while it learns."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from placegraph.outdoor.learn.curves import rows_of
from placegraph.outdoor.learn.train import Progress as Told
from placegraph.view.curves import draw_curves

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from placegraph.outdoor.learn.train import TrainOptions


def progress_bars(*, hidden: bool) -> Progress:
    """Bars on stderr; never there for a file or a pipe."""
    console = Console(stderr=True)
    return Progress(
        TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed}/{task.total}"),
        TimeElapsedColumn(), TimeRemainingColumn(), TextColumn("{task.fields[losses]}"),
        console=console, transient=True, disable=hidden or not console.is_terminal,
        redirect_stdout=sys.stdout.isatty(),
    )  # fmt: skip


class Shown(Told):
    """Shows how far a training is: bars, a line of figures an epoch, a picture of the curves."""

    def __init__(self, bars: Progress, work: Path, options: TrainOptions, *, table: bool) -> None:
        self.bars, self.work, self.options, self.table = bars, work, options, table
        self.told = 0
        self.filled = bars.add_task("describing", total=None, losses="", visible=False)
        self.stepped = bars.add_task("learning", total=None, losses="", visible=False)

    def filling(self, epoch: int, city: str, done: int, total: int) -> None:
        """Descriptions are made."""
        what = f"describing {city}"
        if epoch < self.options.epochs:
            what += f" for epoch {epoch + 1}"
        self.bars.update(
            self.filled, description=what, completed=done, total=total, visible=done < total
        )

    def step(self, epoch: int, done: int, total: int, losses: Mapping[str, float]) -> None:
        """A batch was learned."""
        self.bars.update(
            self.stepped,
            description=f"epoch {epoch + 1} of {self.options.epochs}",
            completed=done,
            total=total,
            visible=done < total,
            losses=", ".join(f"{name} {value:.3f}" for name, value in losses.items()),
        )

    def epoch(self, row: Mapping[str, float]) -> None:
        """An epoch ended with these figures."""
        draw(self.work)
        if not self.table:
            return
        if not self.told:
            typer.echo("  ".join(f"{name:>10}" for name in row))
        self.told += 1
        typer.echo("  ".join(_cell(name, value) for name, value in row.items()))


def _cell(name: str, value: float) -> str:
    width = max(10, len(name))
    return f"{value:>{width}.0f}" if name == "epoch" else f"{value:>{width}.3f}"


def draw(work: Path) -> Path:
    """Draw the curves so far."""
    return draw_curves(rows_of(work), work / "curves.png")
