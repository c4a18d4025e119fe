"""Reliability diagrams: how often what is said to be so sure is right."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from placegraph.view.draw.canvas import Disc, Frame, Mark, Points, Stroke, Text
from placegraph.view.draw.painter import paint_picture
from placegraph_lab.tables.calibration import Reliability

if TYPE_CHECKING:
    from PIL.Image import Image


SIDE = 100.0
"""Of the square of a diagram, in units of the drawing; a probability of 1 is as long."""
STEP = 130.0
"""From one diagram to the next."""
PIXELS = 2.2
"""A unit, drawn [px]."""


def diagrams(panels: dict[str, Reliability]) -> Image:
    """Draw diagrams side by side, by title: stated probability to the right, share that is right up."""
    center, half = (STEP * len(panels) / 2 - 15.0, SIDE / 2), STEP / 2
    frame = Frame(center, PIXELS, round(PIXELS * STEP * len(panels)), round(PIXELS * 2 * half))
    items = [m for k, (title, of) in enumerate(panels.items()) for m in _panel(k * STEP, title, of)]
    return paint_picture(items, frame)


def _panel(left: float, title: str, of: Reliability) -> list[Mark]:
    def at(x: float, y: float) -> Points:
        return np.array([left + SIDE * x, SIDE * y])

    corners = [at(x, y) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1), (0, 0))]
    marks: list[Mark] = [
        Stroke(np.array(corners), "ink", 1.0),
        Stroke(np.array([at(0, 0), at(1, 1)]), "ink", 1.0, dash=(4.0, 4.0)),
        Text(at(0.5, 1.05), title, 11.0, "ink"),
    ]
    for tick in (0.0, 0.5, 1.0):
        marks.append(Text(at(tick, -0.05), f"{tick:g}", 10.0, "ink"))
        marks.append(Text(at(-0.03, tick), f"{tick:g}", 10.0, "ink", anchor="r"))
    points = [at(x, y) for x, y in zip(of.confidence, of.accuracy, strict=True)]
    marks.append(Stroke(np.array(points), "for", 2.0))
    return marks + [Disc(p, 3.5, "for") for p in points]
