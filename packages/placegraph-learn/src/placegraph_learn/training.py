"""Parts shared by the trainings of both wings: folder, figures of epochs and their curves."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from placegraph.core.files import write_output
from placegraph.core.geometry import Floats
from placegraph.errors import InputError, OptionError

CURVES = "curves.jsonl"
PLAN = "plan.json"


class Progress:
    """Receiver of a training's progress; override the methods of interest."""

    def report_descriptions(self, epoch: int, city: str, done: int, total: int) -> None:
        """Take note of descriptions made of a city."""

    def report_place(self, name: str, done: int, total: int) -> None:
        """Take note of a place that was looked at."""

    def step(self, epoch: int, done: int, total: int, losses: Mapping[str, float]) -> None:
        """Take note of a learned batch; `losses` are means of the epoch so far, by name."""

    def epoch(self, row: Mapping[str, float]) -> None:
        """Take note of the figures of an epoch."""


def open_folder(folder: str | PathLike[str], plan: Mapping[str, Any]) -> dict[str, Any]:
    """Make the folder of a training, or find it again; returns its plan as JSON gives it back.

    Raises `InputError`: the folder cannot be made or read; `OptionError`: it holds a training of
    another plan.
    """
    path = Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
        if not (path / PLAN).exists():
            # written whole: half of a plan would end all trainings here
            write_output(path / PLAN, json.dumps(plan, indent=1).encode())
        known: dict[str, Any] = json.loads((path / PLAN).read_text(encoding="utf-8"))
    except (OSError, ValueError, InputError) as error:
        raise InputError(
            f"{path} cannot be used as the folder of a training ({error}); name another."
        ) from error
    if known != json.loads(json.dumps(plan)):
        raise OptionError(
            f"{path} contains a training with other maps or options; choose another folder, or "
            "delete it to start again."
        )
    return known


def rows_of(folder: str | PathLike[str]) -> list[dict[str, float]]:
    """Read the figures of the epochs so far; lines cut short by a crash are skipped."""
    path = Path(folder) / CURVES
    rows: list[dict[str, float]] = []
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
        try:
            rows.append(dict(json.loads(line)))
        except (TypeError, ValueError):
            continue
    return rows


def add_row(folder: str | PathLike[str], row: Mapping[str, float]) -> None:
    """Add the figures of an epoch, replacing older ones of it and of later epochs.

    The file is replaced in one go, so that none is ever cut short.
    """
    path = Path(folder) / CURVES
    temporary = path.with_suffix(".tmp")
    before = [r for r in rows_of(folder) if r.get("epoch", 0) < row.get("epoch", 1)]
    temporary.write_text("".join(json.dumps(r) + "\n" for r in [*before, row]), encoding="utf-8")
    temporary.replace(path)


class Snapshots(Protocol):
    """Trainer that an interrupted training goes on from."""

    epochs: int
    """Finished epochs."""

    def write(self, path: Path) -> None:
        """Write the state after an epoch."""


def run_epochs(
    trainer: Snapshots,
    epochs: int,
    learn: Callable[[int], Mapping[str, float]],
    snapshot: Path,
    progress: Progress,
) -> None:
    """Learn the epochs that are left; `learn` returns the figures of one, by its number from 0."""
    for epoch in range(trainer.epochs, epochs):
        row = {"epoch": epoch + 1, **learn(epoch)}
        trainer.epochs = epoch + 1
        add_row(snapshot.parent, row)  # first: an epoch that is done again gives the same row
        trainer.write(snapshot)
        progress.epoch(row)


def refuse_twins(names: Sequence[str]) -> None:
    """Raise `OptionError` if two maps or places to learn from have the same name."""
    twins = sorted({name for name in names if names.count(name) > 1})
    if twins:
        raise OptionError(
            f"Several maps are named {twins[0]}; rename one, because examples are stored by name."
        )


WIDTH, HEIGHT = 1180, 460
PANEL_WIDTH, PANEL_HEIGHT = 370.0, 320.0
SUPERSAMPLE = 2
SERIES = ("match", "similarity", "embedding", "fusion", "eq17", "eq18", "loss")
"""Series that are losses."""
RECALL = "recall@1 within 50 m, held-out tiles"
PAPER, GRID, INK, SOFT_INK = "#f4f1ea", "#d9d1c3", "#33312d", "#6e6a62"
RED, BLUE, GREEN, AMBER = "#b3261e", "#3b74b5", "#3f8a63", "#9a5b00"
COLORS = {
    "match": RED, "similarity": BLUE, "embedding": GREEN, "fusion": AMBER,
    "relational": SOFT_INK, "network": BLUE, "dense": GREEN, "fused": RED,
    "loss": RED, "patch": BLUE, "changed": GREEN, "room": RED,
}  # fmt: skip
"""Colours by series."""


def draw_curves(
    rows: Sequence[Mapping[str, float]], path: str | PathLike[str], *, title: str | None = None
) -> Path:
    """Draw figures of epochs (``epoch``, losses, others by name) as a PNG; returns its path.

    Losses stand on the left, all others on the right below `title` (`RECALL` where not given).
    """
    picture = Image.new("RGB", (WIDTH * SUPERSAMPLE, HEIGHT * SUPERSAMPLE), PAPER)
    draw = ImageDraw.Draw(picture)
    names = list(dict.fromkeys(name for row in rows for name in row if name != "epoch"))
    _draw_panel(draw, (70.0, 64.0), "loss", rows, [n for n in names if n in SERIES])
    others = [n for n in names if n not in SERIES]
    _draw_panel(draw, (650.0, 64.0), title or RECALL, rows, others)
    if not rows:
        _text(draw, (WIDTH / 2, HEIGHT / 2), "no epoch is finished yet", 15, SOFT_INK, "mm")
    picture.resize((WIDTH, HEIGHT), Image.Resampling.BOX).save(path)
    return Path(path)


def _draw_panel(
    draw: ImageDraw.ImageDraw,
    corner: tuple[float, float],
    title: str,
    rows: Sequence[Mapping[str, float]],
    names: Sequence[str],
) -> None:
    """Draw axes and the named series, with their last values beside them."""
    left, top = corner
    series = {n: [(row["epoch"], row[n]) for row in rows if n in row] for n in names}
    points = [point for line in series.values() for point in line]
    last = max([2.0, *(epoch for epoch, _ in points)])
    values = [value for _, value in points] or [0.0, 1.0]
    marks = ticks(min(values), max(values))

    def at(epoch: float, value: float) -> tuple[float, float]:
        x = left + 12 + (PANEL_WIDTH - 24) * (epoch - 1.0) / (last - 1.0)
        return x, top + PANEL_HEIGHT * (1.0 - (value - marks[0]) / (marks[-1] - marks[0]))

    def line(line: Sequence[tuple[float, float]], color: str, width: int) -> None:
        large = [x * SUPERSAMPLE for point in line for x in point]
        draw.line(large, color, width * SUPERSAMPLE, joint="curve")

    _text(draw, (left, top - 28), title, 15, INK, "lm")
    for value in marks:
        y = at(1.0, value)[1]
        line([(left, y), (left + PANEL_WIDTH, y)], GRID, 1)
        _text(draw, (left - 10, y), f"{value:g}", 12, SOFT_INK, "rm")
    for epoch in range(1, int(last) + 1, max(1, int(np.ceil(last / 12)))):
        x, y = at(epoch, marks[0])
        line([(x, y), (x, y + 5)], SOFT_INK, 1)
        _text(draw, (x, y + 16), str(epoch), 12, SOFT_INK, "mm")
    middle = left + PANEL_WIDTH / 2, top + PANEL_HEIGHT + 40
    _text(draw, middle, "epoch", 13, SOFT_INK, "mm")
    curves = {name: [at(*point) for point in found] for name, found in series.items()}
    heights = spread([curve[-1][1] for curve in curves.values()], 17.0)
    for (name, curve), height in zip(curves.items(), heights, strict=True):
        color = COLORS.get(name, INK)
        line(curve, color, 2)
        for x, y in curve:
            draw.circle((x * SUPERSAMPLE, y * SUPERSAMPLE), 3 * SUPERSAMPLE, color)
        label = max(curve[-1][0], left + PANEL_WIDTH) + 12, height
        _text(draw, label, f"{name}: {series[name][-1][1]:.3g}", 13, color, "lm")


def _text(
    draw: ImageDraw.ImageDraw,
    at: tuple[float, float],
    text: str,
    size: float,
    color: str,
    anchor: str,
) -> None:
    font = ImageFont.load_default(size * SUPERSAMPLE)
    draw.text((at[0] * SUPERSAMPLE, at[1] * SUPERSAMPLE), text, color, font, anchor)


def ticks(low: float, high: float, most: int = 6) -> Floats:
    """Return round numbers, at least two and at most about `most`, that span low to high."""
    span = max(high - low, 1e-6)
    power = 10.0 ** np.floor(np.log10(span / most))
    step = next(power * f for f in (1.0, 2.0, 5.0, 10.0, 20.0) if span / (power * f) <= most)
    first, last = np.floor(low / step + 1e-9), np.ceil(high / step - 1e-9)
    return np.asarray(step * np.arange(first, max(last, first + 1.0) + 1.0), np.float64)


def spread(heights: Sequence[float], gap: float) -> list[float]:
    """Move heights as little as keeps any two `gap` apart, in their order."""
    order = np.argsort(heights, kind="stable")
    moved = np.asarray(heights, np.float64)[order] - gap * np.arange(len(heights))
    blocks: list[list[float]] = []
    for height in moved:  # heights that would overlap share their mean
        blocks.append([float(height)])
        while len(blocks) > 1 and np.mean(blocks[-2]) > np.mean(blocks[-1]):
            blocks[-2:] = [blocks[-2] + blocks[-1]]
    means = [float(np.mean(block)) for block in blocks for _ in block]
    out = np.empty(len(heights))
    out[order] = np.array(means) + gap * np.arange(len(heights))
    return [float(height) for height in out]
