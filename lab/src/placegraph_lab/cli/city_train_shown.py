"""What `placegraph city train` shows while it learns."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from placegraph_lab.cli.training_shown import say_epoch
from placegraph_learn.train.city.options import Progress as Told
from placegraph_learn.train.city.options import TrainOptions
from placegraph_learn.train.curves import draw_curves
from placegraph_learn.train.training import rows_of

if TYPE_CHECKING:
    from rich.progress import Progress


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
        say_epoch(row, first=not self.told)
        self.told += 1


def draw(work: Path) -> Path:
    """Draw the curves so far."""
    return draw_curves(rows_of(work), work / "curves.png")
