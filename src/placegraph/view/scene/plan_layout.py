"""Where the panels of a plan stand: a row of small ones for each pass, and a large one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from placegraph.errors import OptionError

if TYPE_CHECKING:
    from placegraph.view.draw.canvas import Bounds

HEAD, FOOT, GAP = 64, 46, 4
"""Height of the strips above and below the panels, and what lies between panels [px]."""
CAPTION = 20
"""Height of the strip above a small panel [px]."""
MOST_ROWS, MOST_COLUMNS = 4, 3
"""Passes that are shown, and frames of each."""
NARROWEST, WIDEST_PAGE = 320, 6000
"""Widths of pictures [px]."""
TALLEST, WIDEST = 1.6, 2.4
"""Panels have the scene's proportions up to these: height by width, and width by height."""


@dataclass(frozen=True)
class Layout:
    """Sizes and places in pixels."""

    width: int
    height: int
    rows: tuple[int, ...]
    """Numbers of the passes that have a row."""
    columns: int
    small: tuple[int, int]
    """Width and height of a small panel."""
    large: tuple[int, int]
    large_corner: tuple[int, int]

    @classmethod
    def of(cls, bounds: Bounds, steps: Sequence[int], *, width: int | None = None) -> Layout:
        """Layout for a scene with these bounds and so many steps in each pass.

        One pass stands above the large panel, several stand to its left: then rows and columns of
        small panels and the large one are as high as each other.

        Raises `OptionError` where the width is no width of a picture.
        """
        if width is not None and not (isinstance(width, int) and NARROWEST <= width <= WIDEST_PAGE):
            raise OptionError(f"width is {width}; give {NARROWEST} to {WIDEST_PAGE} px.")
        west, south, east, north = bounds
        shape = min(max((east - west) / (north - south), 1.0 / TALLEST), WIDEST)
        passes = [k for k, count in enumerate(steps) if count]
        rows = tuple(passes[k] for k in evenly(len(passes), MOST_ROWS))
        columns = min(MOST_COLUMNS + (len(rows) == 1), max((steps[k] for k in rows), default=0))
        if len(rows) > 1:
            width = width or 1600
            unit = (width - columns * GAP) // (columns + len(rows))
            small = unit, round(unit / shape)
            left = columns * (unit + GAP)
            tall = len(rows) * (CAPTION + small[1])
            return cls(
                width, HEAD + tall + FOOT, rows, columns, small, (width - left, tall), (left, HEAD)
            )
        width = width or 1200
        small, top = (0, 0), HEAD
        if rows:
            unit = (width - (columns - 1) * GAP) // max(columns, 3)
            small = unit, round(unit / shape)
            top += CAPTION + small[1] + GAP
        large = width, round(width / shape)
        return cls(width, top + large[1] + FOOT, rows, columns, small, large, (0, top))

    def corner(self, row: int, column: int) -> tuple[int, int]:
        """Upper left corner of a small panel."""
        wide, tall = self.small
        return column * (wide + GAP), HEAD + row * (tall + CAPTION) + CAPTION


def evenly(count: int, most: int) -> list[int]:
    """At most so many of `count` indices, first and last among them, the others evenly between."""
    if count <= most:
        return list(range(count))
    if most == 1:
        return [count - 1]
    return sorted({round(k * (count - 1) / (most - 1)) for k in range(most)})
