"""Tables of poses: rows of a recipe, a set and a length; by keyframes, in merged scenes, with drift."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from placegraph_lab.tables.indoor.windows import DRIFT
from placegraph_lab.tables.retrieval.retrieval import Cosines, Scenes
from placegraph_lab.tables.retrieval.retrieval_places import Place
from placegraph_lab.tables.sg2loc.ask import Asking, group
from placegraph_lab.tables.sg2loc.report import measured, printed, report
from placegraph_lab.tables.sg2loc.sets import Set
from placegraph_lab.tables.sg2loc.spec import SPECS, Spec

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
