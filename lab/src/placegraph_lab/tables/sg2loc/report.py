"""Rows of the tables of SG2Loc: the paper's figures, and ours below them in the same columns."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph_lab.tables.indoor.metrics import rounded, score
from placegraph_lab.tables.indoor.report import errors
from placegraph_lab.tables.sg2loc.paper import figures as said
from placegraph_lab.tables.tables import markdown, number, shares

if TYPE_CHECKING:
    from placegraph_lab.tables.sg2loc.ask import Reply

COLUMNS = {
    "R@1": 1, "mean": 2, "median": 2, "25 cm / 2° / both": 3, "25 cm 2°": 1,
    "10 cm 5° / 25 cm 10°": 2,
}  # fmt: skip
"""Numbers in each column: errors in metres and degrees, or recalls."""
_STATES = {False: "unchanged", True: "changed", None: ""}


def printed(table: int, columns: Sequence[str], lengths: Sequence[int]) -> list[dict[str, Any]]:
    """Rows of a table of the paper, one a sequence length."""
    rows: list[dict[str, Any]] = []
    for name, by_length in said(table):
        for length, part in zip(lengths, by_length, strict=False):
            left = iter(part)
            told = {c: [next(left) for _ in range(COLUMNS[c])] for c in columns}
            rows.append({"set": "paper", "row": name, "frames": length} | told)
    return rows


def measured(name: str, row: str, replies: Sequence[Reply], *, whole: bool) -> list[dict[str, Any]]:
    """Rows of a set, one for each state that its scenes were in; `whole`: with the final fit."""
    rows = []
    for state in dict.fromkeys(r.whole.changed for r in replies):
        told = [r for r in replies if r.whole.changed is state]
        of = [r.whole if whole else r.filter for r in told]
        its = score(of)
        at = {
            (m, d): sum(a.within(m, d) for a in of) / len(of)
            for m in (0.1, 0.25, math.inf)
            for d in (2.0, 5.0, 10.0, 180.0)
        }
        figures = {
            "R@1": (sum(r.right for r in told) / len(told),),
            "mean": its.mean,
            "median": its.median,
            "25 cm / 2° / both": (at[0.25, 180.0], at[math.inf, 2.0], at[0.25, 2.0]),
            "25 cm 2°": (at[0.25, 2.0],),
            "10 cm 5° / 25 cm 10°": (at[0.1, 5.0], at[0.25, 10.0]),
        }
        rows.append(
            {"set": name, "state": _STATES[state], "row": row, "frames": of[0].frames, "windows": len(of)}
            | {c: [rounded(v, 4) for v in values] for c, values in figures.items()}
            | {"seconds": rounded(float(np.median([a.seconds / a.frames for a in of])), 4)}
            | {"particles": rounded(its.particles, 0)}
        )  # fmt: skip
    return rows


def report(rows: Sequence[dict[str, Any]], columns: Sequence[str]) -> str:
    """Markdown of rows; what a row does not know is a dash."""
    lines = []
    for row in rows:
        title = ": ".join(filter(None, [row["set"], row.get("state"), row["row"]]))
        cells = [
            errors(row.get(c, [None] * 2)) if c in {"mean", "median"} else shares(row.get(c, [None]))
            for c in columns
        ]  # fmt: skip
        known = [number(row.get(k), 2 * (k == "seconds")) for k in ("seconds", "particles")]
        windows = number(row.get("windows"))
        lines.append([title, number(row.get("frames")), windows, *cells, *known])
    return markdown(["", "frames", "windows", *columns, "s/frame", "particles"], lines)
