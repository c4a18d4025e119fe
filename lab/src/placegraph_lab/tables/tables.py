"""Markdown tables and the short numbers that stand in them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence


def markdown(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Table with the first column to the left and all others to the right."""
    cells = [list(header), *[list(row) for row in rows]]
    if len({len(row) for row in cells}) != 1:
        raise ValueError("The rows of a table have as many cells as its header.")
    width = [max(3, *(len(row[i]) for row in cells)) for i in range(len(header))]
    rule = ["-" * width[0], *["-" * (w - 1) + ":" for w in width[1:]]]
    lines = []
    for k, row in enumerate([cells[0], rule, *cells[1:]]):
        text = [
            cell.ljust(w) if i == 0 or k == 1 else cell.rjust(w)
            for i, (cell, w) in enumerate(zip(row, width, strict=True))
        ]
        lines.append("| " + " | ".join(text) + " |")
    return "\n".join(lines)


def share(value: float | None) -> str:
    """Write a share with two digits: ``.45``, ``1.00``; a dash where there is none."""
    if value is None or math.isnan(value):
        return "–"
    return f"{value:.2f}".removeprefix("0")


def shares(values: Iterable[float | None]) -> str:
    """Shares set off by slashes: ``.45/.60/.67``."""
    return "/".join(share(v) for v in values)


def number(value: float | None, digits: int = 0, unit: str = "") -> str:
    """Write a number with a unit: ``12 m``, ``∞ m``; a dash where there is none."""
    if value is None or math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞"
    return f"{value:,.{digits}f}{' ' + unit if unit else ''}"
