"""Tables of the matchers' benchmark."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from placegraph_lab.tables.indoor.matches import KINDS, LIMITS, PIXELS, Found, Trial, summary
from placegraph_lab.tables.indoor.report import errors
from placegraph_lab.tables.indoor.windows import COVERED
from placegraph_lab.tables.tables import markdown, number, shares

PARTS: dict[str, Callable[[Found], object]] = {
    "house, unchanged": lambda f: f.changed is False,
    "house, changed": lambda f: f.changed is True,
    f"office, covered to {COVERED:.0%} or more": lambda f: (f.covered or 0.0) >= COVERED,
    "office, the others": lambda f: f.covered is not None and f.covered < COVERED,
}
"""Queries told apart."""
HEADER = [
    "", "matches",
    f"right to {'/'.join(f'{p:.0f}' for p in PIXELS)} px",
    f"right to {PIXELS[1]:.0f} px, number", "inliers",
    " / ".join(f"{100 * m:.0f} cm {d:.0f}°" for m, d in LIMITS), "median error",
]  # fmt: skip


def report(trials: Sequence[Trial]) -> str:
    """A table for each part and start, a row for each matcher; last what they cost."""
    parts = []
    for part, keep in PARTS.items():
        for kind in KINDS:
            lines, pairs = [], 0
            for trial in trials:
                found = [f for f in trial.found if f.kind == kind and keep(f)]
                if found:
                    pairs = len(found)
                    lines.append(line(trial.name, found))
            if lines:
                parts += [f"#### {part}, view {kind}, {pairs} pairs", markdown(HEADER, lines)]
    cost = [
        [t.name, number(np.median(t.seconds), 3), number(np.median(t.view_seconds), 3)]
        for t in trials
    ]
    parts += ["#### Seconds", markdown(["", "query and one view", "each further view"], cost)]
    return "\n\n".join(parts)


def line(name: str, found: Sequence[Found]) -> list[str]:
    """Cells of `HEADER`."""
    s = summary(found)
    return [
        name,
        number(s["matches"]),
        shares(s["right"]),
        number(s["right_matches"]),
        number(s["inliers"]),
        shares(s["recall"]),
        errors(s["median_error"]),
    ]


def to_dict(trial: Trial) -> dict[str, Any]:
    """Plain numbers of every part and start, ready for `json.dumps`."""
    rows = {
        f"{part}, {kind}": summary(found)
        for part, keep in PARTS.items()
        for kind in KINDS
        if (found := [f for f in trial.found if f.kind == kind and keep(f)])
    }
    return {
        "matcher": trial.name,
        "seconds": float(np.median(trial.seconds)),
        "view_seconds": float(np.median(trial.view_seconds)),
        "parts": rows,
    }
