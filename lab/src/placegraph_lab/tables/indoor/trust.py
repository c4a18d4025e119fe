"""Fits when a pose is to be believed: the coefficients of `placegraph.indoor.pose.trust`."""

from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np

from placegraph.indoor.pose.trust import SURE, Trust, features
from placegraph_lab.tables.indoor.robustness_report import HALVES
from placegraph_lab.tables.tables import markdown, share

if TYPE_CHECKING:
    from collections.abc import Sequence

    from placegraph.geometry import Floats
    from placegraph_lab.tables.indoor.robustness import Told
    from placegraph_lab.tables.indoor.robustness_report import Row

_RIDGE = 0.01
_UNRIVALLED = 0.8
TUNED = ("house", "office")
"""Sets that may be tuned on, even windows of them."""


def samples(rows: Sequence[Row]) -> list[tuple[Told, bool]]:
    """Answers that a verdict was given on, and whether the set may be tuned on; no bad input."""
    return [
        (told, row.case.set in TUNED)
        for row in rows
        if row.case.part != "bad"
        for told in row.told
        if told.trust and "labels" not in row.case.senses
    ]


def fitted(told: Sequence[Told]) -> Trust:
    """Logistic regression of being right, by Newton's method; no coefficient of a share is negative.

    Over answers without a rival: how far others may fit is another factor.
    """
    told = [t for t in told if _probability(t) >= _UNRIVALLED]
    columns = np.array([_features(t) for t in told])
    right = np.array([t.right for t in told], np.float64)
    free = np.ones(columns.shape[1], bool)
    while True:
        weights = np.zeros(len(free))
        weights[free] = _logistic(columns[:, free], right)
        wrong = (weights < 0) & _GROWING & free
        if not wrong.any():
            break
        free &= ~wrong
    rounded = weights.round(2).tolist()
    return Trust(rounded[0], (rounded[1], rounded[2], rounded[3]), (rounded[4], rounded[5]))


_GROWING = np.array([False, False, True, True, False, True])
"""Features of which more never makes an answer worse."""


def _logistic(columns: Floats, right: Floats) -> Floats:
    scale = np.maximum(np.abs(columns).max(axis=0), 1e-9)
    columns = columns / scale
    weights = np.zeros(columns.shape[1])
    for _ in range(100):
        p = 1.0 / (1.0 + np.exp(-columns @ weights))
        curvature = (columns * (p * (1.0 - p))[:, None]).T @ columns
        curvature += _RIDGE * np.eye(len(weights))
        step = np.linalg.solve(curvature, columns.T @ (right - p) - _RIDGE * weights)
        weights = weights + step
    found: Floats = weights / scale
    return found


def _features(told: Told) -> list[float]:
    known = {k: np.nan if v is None else v for k, v in told.trust.items()}
    names = ("depth", "colour", "semantic", "held")
    agreed = SimpleNamespace(**{name: known[name] for name in names})
    return features(agreed)  # type: ignore[arg-type]  # what it looks at


def _probability(told: Told) -> float:
    return told.trust["probability"] or 0.0


def honest(trust: Trust, found: Sequence[tuple[Told, bool]]) -> str:
    """What coefficients would call `OK`: of windows that were fitted, that were held out, and others."""
    weights = np.array([trust.level, *trust.depth, *trust.colour])
    lines = []
    for name, parity, tuned in [
        *((f"tuned on, {half}", parity, True) for half, parity in HALVES.items()),
        ("others", None, False),
    ]:
        some = [
            t for t, may in found if may == tuned and (parity is None or t.number % 2 == parity)
        ]
        if not some:
            continue
        right = np.array([t.right for t in some])
        odds = np.array([_features(t) for t in some]) @ weights
        ok = np.array([_probability(t) for t in some]) / (1.0 + np.exp(-odds)) >= SURE
        sure = float(ok[right].mean()) if right.any() else float("nan")
        cells = [share(float(right.mean())), share(sure), f"{(ok & ~right).mean():.3f}"]
        lines.append([name, str(len(some)), *cells])
    return markdown(["", "windows", "right", "`OK` of right", "false `OK`"], lines)
