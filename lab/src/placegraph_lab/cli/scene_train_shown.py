"""What `placegraph scene train` shows while it learns."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from placegraph_lab.cli.training_shown import say_epoch
from placegraph_learn.train.curves import draw_curves
from placegraph_learn.train.scenegraphloc.options import Progress as Told
from placegraph_learn.train.training import rows_of

if TYPE_CHECKING:
    from rich.progress import Progress


class Shown(Told):
    """Shows how far a training is: bars, a line of figures an epoch, a picture of the curves."""

    def __init__(self, bars: Progress, work: Path, epochs: int, *, table: bool) -> None:
        self.bars, self.work, self.epochs, self.table = bars, work, epochs, table
        self.told = 0
        self.looked = bars.add_task("looking at places", total=None, losses="", visible=False)
        self.stepped = bars.add_task("learning", total=None, losses="", visible=False)

    def preparing(self, name: str, done: int, total: int) -> None:
        """A place was looked at."""
        self.bars.update(
            self.looked, description=f"looked at {name}", completed=done, total=total,
            visible=done < total,
        )  # fmt: skip

    def step(self, epoch: int, done: int, total: int, loss: float) -> None:
        """A batch was learned."""
        self.bars.update(
            self.stepped,
            description=f"epoch {epoch + 1} of {self.epochs}",
            completed=done,
            total=total,
            visible=done < total,
            losses=f"loss {loss:.3f}",
        )

    def epoch(self, row: dict[str, float]) -> None:
        """An epoch ended with these figures."""
        draw(self.work)
        if self.table:
            say_epoch(row, first=not self.told)
            self.told += 1


def draw(work: Path) -> Path:
    """Draw the curves so far."""
    return draw_curves(rows_of(work), work / "curves.png", good_for="right, in places not learned")
