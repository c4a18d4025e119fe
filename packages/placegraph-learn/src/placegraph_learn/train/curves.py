"""Curves of a training: losses on the left, what it is good for on the right, epochs along both."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np
from PIL import ImageColor

from placegraph.core.geometry import Floats
from placegraph.view.draw.painter import SUPERSAMPLE
from placegraph.view.draw.sheet import XY, Sheet
from placegraph.view.draw.style import PALETTE
from placegraph_learn.train.city.options import LOSSES, PRINTED

WIDTH, HEIGHT = 1180, 460
SERIES = (*LOSSES, *PRINTED, "loss")
"""Series that are losses."""
RECALL = "recall@1 within 50 m, tiles held out"
COLORS = {
    "match": "mode", "similarity": "transit", "embedding": "leisure", "fusion": "amber",
    "relational": "soft-ink", "network": "transit", "dense": "leisure", "fused": "mode",
    "loss": "mode", "patch": "transit", "changed": "leisure", "room": "mode",
}  # fmt: skip
"""Of the palette, by series."""


def draw_curves(
    rows: Sequence[Mapping[str, float]], path: str | PathLike[str], *, good_for: str = RECALL
) -> Path:
    """Draw figures of epochs (``epoch``, losses, others by name) as a PNG; returns its path.

    `good_for`: what stands over the panel of the others.
    """
    sheet = Sheet(WIDTH, HEIGHT)
    names = list(dict.fromkeys(name for row in rows for name in row if name != "epoch"))
    losses = [_series(rows, name) for name in names if name in SERIES]
    recall = [_series(rows, name) for name in names if name not in SERIES]
    _Panel(sheet, (70.0, 64.0), "loss", losses).draw()
    _Panel(sheet, (650.0, 64.0), good_for, recall).draw()
    if not rows:
        sheet.text((WIDTH / 2, HEIGHT / 2), "no epoch has ended yet", 15, "soft-ink", anchor="m")
    return sheet.save(str(path))


@dataclass(frozen=True)
class _Series:
    name: str
    color: str
    epochs: Floats
    values: Floats


def _series(rows: Sequence[Mapping[str, float]], name: str) -> _Series:
    known = [row for row in rows if name in row]
    return _Series(
        name,
        COLORS.get(name, "ink"),
        np.array([row["epoch"] for row in known], np.float64),
        np.array([row[name] for row in known], np.float64),
    )


def ticks(low: float, high: float, most: int = 6) -> Floats:
    """Round numbers, at least two and at most about `most`, that span low to high."""
    span = max(high - low, 1e-6)
    power = 10.0 ** np.floor(np.log10(span / most))
    step = next(power * f for f in (1.0, 2.0, 5.0, 10.0, 20.0) if span / (power * f) <= most)
    first, last = np.floor(low / step + 1e-9), np.ceil(high / step - 1e-9)
    return np.asarray(step * np.arange(first, max(last, first + 1.0) + 1.0), np.float64)


def apart(heights: Sequence[float], least: float) -> list[float]:
    """Heights moved as little as keeps any two `least` apart, their order kept."""
    order = np.argsort(heights, kind="stable")
    moved = np.asarray(heights, np.float64)[order] - least * np.arange(len(heights))
    blocks: list[list[float]] = []
    for height in moved:  # what would overlap shares its mean
        blocks.append([float(height)])
        while len(blocks) > 1 and np.mean(blocks[-2]) > np.mean(blocks[-1]):
            blocks[-2:] = [blocks[-2] + blocks[-1]]
    flat = [float(np.mean(block)) for block in blocks for _ in block]
    out = np.empty(len(heights))
    out[order] = np.array(flat) + least * np.arange(len(heights))
    return [float(height) for height in out]


class _Panel:
    """Axes with their series."""

    width, height = 370.0, 320.0

    def __init__(self, sheet: Sheet, corner: XY, title: str, series: list[_Series]) -> None:
        self.sheet, self.corner, self.title, self.series = sheet, corner, title, series
        values = np.concatenate([np.zeros(0), *(s.values for s in series)])
        epochs = np.concatenate([np.zeros(0), *(s.epochs for s in series)])
        low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
        self.y = ticks(low, high)
        self.last = max(2.0, float(epochs.max(initial=1.0)))

    def draw(self) -> None:
        left, top = self.corner
        self.sheet.text((left, top - 28), self.title, 15, "ink")
        for value in self.y:
            at = self.at(1.0, value)[1]
            self.line([(left, at), (left + self.width, at)], "road-edge", 1)
            self.sheet.text((left - 10, at), f"{value:g}", 12, "soft-ink", anchor="r")
        for epoch in range(1, int(self.last) + 1, max(1, int(np.ceil(self.last / 12)))):
            x, y = self.at(epoch, self.y[0])
            self.line([(x, y), (x, y + 5)], "soft-ink", 1)
            self.sheet.text((x, y + 16), str(epoch), 12, "soft-ink", anchor="m")
        middle = left + self.width / 2, top + self.height + 40
        self.sheet.text(middle, "epoch", 13, "soft-ink", anchor="m")
        ends = []
        for s in self.series:
            points = [self.at(e, v) for e, v in zip(s.epochs, s.values, strict=True)]
            if len(points) > 1:
                self.line(points, s.color, 2)
            for point in points:
                self.dot(point, s.color)
            ends.append(points[-1])
        heights = apart([y for _, y in ends], 17.0)
        for s, (x, _), height in zip(self.series, ends, heights, strict=True):
            words = f"{s.name}: {s.values[-1]:.3g}"
            self.sheet.text((max(x, left + self.width) + 12, height), words, 13, s.color)

    def at(self, epoch: float, value: float) -> XY:
        """Pixels of a point."""
        left, top = self.corner
        x = left + 12 + (self.width - 24) * (epoch - 1.0) / (self.last - 1.0)
        share = (value - self.y[0]) / (self.y[-1] - self.y[0])
        return x, top + self.height * (1.0 - share)

    def line(self, points: Sequence[XY], color: str, width: int) -> None:
        large = [x * SUPERSAMPLE for point in points for x in point]
        self.sheet.draw.line(large, _rgb(color), width * SUPERSAMPLE, joint="curve")

    def dot(self, at: XY, color: str) -> None:
        x, y = (value * SUPERSAMPLE for value in at)
        r = 3 * SUPERSAMPLE
        self.sheet.draw.ellipse((x - r, y - r, x + r, y + r), _rgb(color))


def _rgb(color: str) -> tuple[int, int, int]:
    red, green, blue = ImageColor.getrgb(PALETTE[color][0])[:3]
    return red, green, blue
