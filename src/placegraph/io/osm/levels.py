"""Levels of buildings as OpenStreetMap writes them: ``0;1``, ``0-2``, ``-1``, ``0.5``."""

from __future__ import annotations

import re
from math import ceil, floor

_PART = re.compile(
    r"\s*([+-]?\d{1,4}(?:\.\d{1,3})?)\s*(?:-\s*([+-]?\d{1,4}(?:\.\d{1,3})?)\s*)?", re.ASCII
)
_MOST = 300
"""Levels of one range: no building has more."""


def levels_of(text: str) -> tuple[float, ...]:
    """Levels that a tag lists, ascending; ``a-b`` is a, b and all whole levels between.

    Parts that are no levels are passed over; () where none is one.
    """
    found: set[float] = set()
    for part in re.split(r"[;,]", text):
        match = _PART.fullmatch(part)
        if match is None:
            continue
        first = float(match[1])
        last = first if match[2] is None else float(match[2])
        low, high = min(first, last), max(first, last)
        if high - low <= _MOST:
            found |= {low, high, *map(float, range(ceil(low), floor(high) + 1))}
    return tuple(sorted(found))


def level_text(level: float) -> str:
    """A level as it is written in a tag: ``1``, ``0.5``."""
    return f"{level:g}"
