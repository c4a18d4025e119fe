"""Tables of poses: rows of a recipe, a set and a length; by keyframes, in merged scenes, with drift."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from placegraph_lab.tables.indoor.metrics import rounded, score
from placegraph_lab.tables.indoor.report import errors
from placegraph_lab.tables.indoor.windows import DRIFT
from placegraph_lab.tables.retrieval.retrieval import Cosines, Scenes
from placegraph_lab.tables.retrieval.retrieval_places import Place
from placegraph_lab.tables.runner import markdown, number, shares
from placegraph_lab.tables.sg2loc.ask import Asking, Reply, group
from placegraph_lab.tables.sg2loc.paper import figures as said
from placegraph_lab.tables.sg2loc.sets import Set
from placegraph_lab.tables.sg2loc.spec import SPECS, Spec

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


ODOMETRY = {
    "exact": (0.0, 0.0), "SLAM-like": DRIFT, "drifting": (0.05, math.radians(1.0)),
}  # fmt: skip
"""Error of a step as a share of its length, and in yaw [rad]."""
MERGED = {"homes": (2, 5, 10), "3RScan": (3,), "ScanNet": (3,)}
"""Scenes that are one map; the paper has 3."""


def poses(table: int, spec: Spec, asking: Asking, of: Sequence[Set]) -> tuple[str, list[Any]]:
    """A table of poses: as Markdown, and as rows."""
    by = {6: _keyframes, 11: _merged, 14: _drifting}.get(table, _plain)
    rows = printed(table, spec.columns, SPECS[table].lengths)
    rows += [row for its in of for row in by(spec, asking, its)]
    return report(rows, spec.columns), rows


def _plain(spec: Spec, asking: Asking, of: Set) -> Iterator[dict[str, Any]]:
    for length in spec.lengths:
        for name, recipe, whole in spec.rows:
            yield from measured(of.name, name, asking.replies(of, recipe, length), whole=whole)


def _keyframes(spec: Spec, asking: Asking, of: Set) -> Iterator[dict[str, Any]]:
    """Of a sequence, as many frames as there is time for, at the pace of short sequences."""
    for length in spec.lengths:
        for name, recipe, whole in spec.rows:
            if length > of.longest:
                continue
            pace = spec.pace or _pace(asking, of, recipe)
            step = max(1, math.ceil(pace * of.rate))
            replies = asking.replies(of, recipe, length, step=step)
            yield from measured(of.name, f"{name}, one frame in {step}", replies, whole=whole)


def _pace(asking: Asking, of: Set, recipe: str) -> float:
    """Seconds that a frame takes, by sequences of five."""
    replies = asking.replies(of, recipe, 5)
    return float(np.median([r.filter.seconds / r.filter.frames for r in replies]))


def _merged(spec: Spec, asking: Asking, of: Set) -> Iterator[dict[str, Any]]:
    for count in MERGED[of.name]:
        for length in spec.lengths:
            for title, frames in (("SGL, one frame", 1), ("Seq. SGL", length)):
                found = _retrieved(asking, of, length, frames, count)
                if found:
                    told = {"windows": len(found), "R@1": [float(np.mean(found))]}
                    yield {
                        "set": of.name,
                        "row": f"{count} scenes, {title}",
                        "frames": frames,
                    } | told
            for name, recipe, whole in spec.rows:
                replies = asking.replies(of, recipe, length, merged=count)
                yield from measured(of.name, f"{count} scenes, {name}", replies, whole=whole)


def _retrieved(asking: Asking, of: Set, length: int, frames: int, count: int) -> list[bool]:
    """Whether the paper's sum (Sec. 4) names the right one of the scenes that are merged."""
    found = []
    for walk, window in of.windows(length, asking.how.frames, asking.how.seed):
        names = group(of, walk.map, count)
        scenes = Scenes([Place(name, of.scene(name)) for name in names])
        its = asking.unbound(window)
        scenes.know(its)
        told = Cosines(scenes.library(names, [its])).search(window.capture[:frames])
        found.append(told.names[0] == walk.map)
    return found


def _drifting(spec: Spec, asking: Asking, of: Set) -> Iterator[dict[str, Any]]:
    for title, drift in ODOMETRY.items():
        for length in spec.lengths:
            for name, recipe, whole in spec.rows:
                replies = asking.replies(of, recipe, length, drift=drift)
                yield from measured(of.name, f"{name}, {title} odometry", replies, whole=whole)
