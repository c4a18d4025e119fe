"""Published figures that stand beside the measured ones in the indoor tables.

The paper's are from 3RScan, real scans of other rooms with a learned encoder: they say how hard the
task is there, not what the same windows would give. The trial's are from the house and
the office, with the paper's recipe in C++ and Embree on two cores.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Reference:
    """One published row."""

    table: str
    """Which of our tables it belongs to: `instances`, `none`, `b in a`, `a in b`."""
    row: str
    """The row of ours that it compares with."""
    length: int
    """Frames."""
    source: str
    """Where it stands, and what it was measured on."""
    recall: tuple[float | None, ...]
    """Within (10 cm, 5), (25 cm, 2), (25 cm, 10), (1 m, 10 degrees)."""
    mean: tuple[float | None, float | None] = (None, None)
    """[m], [deg]"""
    median: tuple[float | None, float | None] = (None, None)
    """[m], [deg]"""
    particles: float | None = None
    frame_seconds: float | None = None
    windows: int | None = None


_PAPER = "paper, 3RScan"
_TRIAL = "earlier trial"

REFERENCES = (
    Reference("instances", "semantic", 5, f"{_PAPER}, Tab. 7", (0.11, None, 0.35, None)),
    Reference(
        "instances", "semantic", 5, f"{_PAPER}, Tab. 8", (0.08, None, 0.26, None),
        mean=(1.20, 21.44), median=(0.66, 8.77),
    ),
    Reference("instances", "semantic + depth", 5, f"{_PAPER}, Tab. 7", (0.20, None, 0.54, None)),
    Reference("instances", "all", 5, f"{_PAPER}, Tab. 7", (0.35, None, 0.61, None)),
    Reference(
        "instances", "all", 5, f"{_PAPER}, Tab. 1, 2, 4, 7, after PnP", (0.50, 0.32, 0.65, None),
        mean=(2.43, 21.24), median=(0.20, 3.27), particles=2500, frame_seconds=2.90,
    ),
    Reference(
        "instances", "all", 10, f"{_PAPER}, Tab. 1, 2, after PnP", (None, 0.33, None, None),
        mean=(2.30, 20.50), median=(0.18, 2.96), particles=2500, frame_seconds=2.90,
    ),
    Reference(
        "instances", "all", 25, f"{_PAPER}, Tab. 1, 2, after PnP", (None, 0.39, None, None),
        mean=(6.15, 22.93), median=(0.14, 2.73), particles=2500, frame_seconds=2.90,
    ),
    Reference(
        "instances", "all, coarse only", 5, f"{_PAPER}, Tab. 12, 13", (None, 0.27, None, None),
        mean=(2.25, 24.37), median=(0.31, 5.05), frame_seconds=1.6,
    ),
    Reference(
        "instances", "all, coarse only", 25, f"{_PAPER}, Tab. 12, 13", (None, 0.36, None, None),
        mean=(8.08, 27.10), median=(0.14, 3.44), frame_seconds=1.6,
    ),
    Reference("instances", "semantic, uniform start", 5, f"{_PAPER}, Tab. 7", (0.10, None, 0.30, None)),
    Reference("instances", "semantic, without KLD", 5, f"{_PAPER}, Tab. 7", (0.11, None, 0.30, None)),
    Reference(
        "none", "depth", 5, f"{_PAPER}, Tab. 8", (0.09, None, 0.32, None),
        mean=(1.44, 39.01), median=(0.96, 6.42),
    ),
    Reference(
        "none", "colour", 5, f"{_PAPER}, Tab. 8", (0.14, None, 0.20, None),
        mean=(1.79, 44.78), median=(1.51, 17.37),
    ),
    Reference(
        "instances", "semantic, paper's recipe", 5, _TRIAL, (0.38, 0.62, 0.75, 1.00),
        median=(0.18, 1.1), particles=7000, frame_seconds=0.74,
    ),
    Reference(
        "instances", "semantic, paper's recipe", 10, _TRIAL, (0.75, 0.88, 0.88, 0.88),
        frame_seconds=0.74,
    ),
    Reference(
        "instances", "semantic + depth, paper's recipe", 5, _TRIAL, (0.94,) * 4,
        median=(0.02, None), particles=4300, frame_seconds=0.43,
    ),
    Reference(
        "instances", "semantic + depth, paper's recipe", 10, _TRIAL, (0.94,) * 4,
        median=(0.02, None), particles=2400, frame_seconds=0.43,
    ),
    Reference(
        "b in a", "depth + colour, paper's recipe", 10, _TRIAL, (None, 0.30, 0.40, None), windows=10,
    ),
    Reference(
        "a in b", "depth + colour, paper's recipe", 10, _TRIAL, (None, 0.00, 0.10, None), windows=10,
    ),
)  # fmt: skip

COVERED = {
    ("b in a", "depth + colour, paper's recipe", 10): Reference(
        "b in a", "depth + colour, paper's recipe", 10, _TRIAL, (None, 0.43, 0.57, None), windows=7
    ),
    ("a in b", "depth + colour, paper's recipe", 10): Reference(
        "a in b", "depth + colour, paper's recipe", 10, _TRIAL, (None, 0.0, 0.0, None), windows=3
    ),
}
"""The same, of the windows that the map covers to 60 % or more."""


def references(table: str, row: str, length: int) -> list[Reference]:
    """Published rows that compare with one of ours."""
    return [r for r in REFERENCES if (r.table, r.row, r.length) == (table, row, length)]
