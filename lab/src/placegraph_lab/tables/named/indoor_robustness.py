"""What goes wrong, and what becomes of the pose? Every perturbation, bad input, absent scenes.

    placegraph-lab table indoor_robustness --quick
    placegraph-lab table indoor_robustness --only "house: drift*; office: drift*"

Prints Markdown tables and writes every row as JSON. Every answer is written down at once: run it
again and it goes on where it was cut. `docs/benchmarks/indoor-robustness.md` has the protocol.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Annotated, Any

import numpy as np

from placegraph.core.geometry import Floats
from placegraph.indoor.pose.trust import SURE, Trust, features
from placegraph.indoor.pose.verdict import ALONE
from placegraph_lab.tables.indoor.cases import Case, all_cases
from placegraph_lab.tables.indoor.cases import quick as few
from placegraph_lab.tables.indoor.jobs import ANSWERING, chosen
from placegraph_lab.tables.indoor.robustness import Asked, Places, Told, ask, spoiled, thinned
from placegraph_lab.tables.indoor.robustness_report import HALVES, Row, report
from placegraph_lab.tables.runner import (
    Device,
    Fresh,
    Quick,
    Run,
    Seed,
    fingerprint,
    markdown,
    option,
    parts,
    share,
    table,
)

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

    Over answers without a rival: how far others may fit is another factor. Best poses with depth and
    colours are seldom wrong, so that the second best are samples for tones, too.
    """
    rivals = [t.rival for t in told if t.rival and t.rival["tone"] is not None]
    told = [t for t in told if _probability(t) >= _UNRIVALLED]
    columns = np.array([_features(t.trust) for t in told])
    right = np.array([t.right for t in told], np.float64)
    free = np.arange(columns.shape[1]) < _TONES
    while True:
        weights = np.zeros(len(free))
        weights[free] = _logistic(columns[:, free], right)
        wrong = (weights < 0) & _GROWING & free
        if not wrong.any():
            break
        free &= ~wrong
    level, *rest = weights.round(2).tolist()
    single = Trust(level, (rest[0], rest[1], rest[2]), (rest[3], rest[4]), (0.0, 0.0))
    return toned(single, columns, right, rivals)


def toned(
    trust: Trust, columns: Floats, right: Floats, rivals: Sequence[dict[str, float | None]]
) -> Trust:
    """Coefficients with those of tones, by features (N, 8) of poses and whether (N,) they are right."""
    both = columns[:, _TONES] > 0
    samples = np.concatenate([columns[both], np.array([_features(r) for r in rivals])])
    told = np.append(right[both], np.zeros(len(rivals)))
    weights = _logistic(samples[:, _TONES:], told, samples @ np.array(trust.coefficients))
    there, tells = weights.round(2).tolist()
    return replace(trust, tone=(there, max(tells, 0.0)))


_TONES = 6
"""Where the features of tones begin."""
_GROWING = np.array([False, False, True, True, False, True, False, True])
"""Features of which more never makes an answer worse."""


def _logistic(columns: Floats, right: Floats, odds: Floats | float = 0.0) -> Floats:
    """Coefficients of what is added to log odds (N,)."""
    scale = np.maximum(np.abs(columns).max(axis=0), 1e-9)
    columns = columns / scale
    weights = np.zeros(columns.shape[1])
    for _ in range(100):
        p = 1.0 / (1.0 + np.exp(-odds - columns @ weights))
        curvature = (columns * (p * (1.0 - p))[:, None]).T @ columns
        curvature += _RIDGE * np.eye(len(weights))
        step = np.linalg.solve(curvature, columns.T @ (right - p) - _RIDGE * weights)
        weights = weights + step
    found: Floats = weights / scale
    return found


def _features(numbers: dict[str, float | None]) -> list[float]:
    known = {k: np.nan if v is None else v for k, v in numbers.items()}
    names = ("depth", "colour", "tone", "semantic", "held")
    agreed = SimpleNamespace(**{name: known[name] for name in names})
    return features(agreed)  # type: ignore[arg-type]  # what it looks at


def _probability(told: Told) -> float:
    return told.trust["probability"] or 0.0


def honest(trust: Trust, found: Sequence[tuple[Told, bool]]) -> str:
    """What coefficients would call `OK`: of windows that were fitted, that were held out, and others."""
    weights = np.array(trust.coefficients)
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
        odds = np.array([_features(t.trust) for t in some]) @ weights
        best = np.array([_probability(t) for t in some])
        ok = (best >= ALONE) & (best / (1.0 + np.exp(-odds)) >= SURE)
        sure = float(ok[right].mean()) if right.any() else float("nan")
        cells = [share(float(right.mean())), share(sure), f"{(ok & ~right).mean():.3f}"]
        lines.append([name, str(len(some)), *cells])
    return markdown(["", "windows", "right", "`OK` of right", "false `OK`"], lines)


QUICK_WINDOWS = 4


@table()
def indoor_robustness(
    run: Run,
    only: Annotated[
        str, option("Rows, with semicolons between: 'house: drift*; office: as recorded'.")
    ] = "",
    windows: Annotated[int, option("Windows of each row, half of them even.")] = 8,
    seed: Seed = 0,
    device: Device = "auto",
    *,
    fit: Annotated[
        bool, option("Fit the coefficients of pose/trust.py, and print only them.")
    ] = False,
    quick: Quick = False,
    fresh: Fresh = False,
) -> None:
    """What goes wrong, and what becomes of the pose? Recall, `OK`, false `OK`, milliseconds."""
    cases = all_cases()
    if quick:
        cases, windows = few(cases), min(windows, QUICK_WINDOWS)
    names = parts(only, ";")
    cases = chosen(cases, names)
    asking = _Asking(Places(run.data, run.cache), seed, device)
    journal = run.journal(fresh=fresh)
    code = fingerprint(ANSWERING)  # once: what is loaded now is what answers
    rows = {}
    with run.progress() as bar:
        for case in sorted(cases, key=lambda c: (c.set, c.frames)):
            asked = asking.windows(case, windows)
            keys = [f"{code} {case.name} {a.shot.name} seed {seed} {device}" for a in asked]
            task = bar.add_task(case.name, total=len(journal.missing(keys)))
            told = journal.filled(
                keys,
                partial(asking.once, case, asked),
                warm=partial(asking.once, case, asked, 0),
                tick=partial(bar.advance, task),
            )
            bar.remove_task(task)
            rows[case.name] = Row(case, tuple(map(Told.from_dict, told)))
    ordered = [rows[case.name] for case in cases]
    if fit:
        found = samples(ordered)
        trust = fitted([told for told, may in found if may and told.number % 2 == 0])
        print(f"{trust}\n\n{honest(trust, found)}")
        return
    print(report(ordered))
    run.save({"rows": [row.to_dict() for row in ordered]}, whole=not names)


class _Asking:
    """Asks windows of cases; windows of the last set and length are kept."""

    def __init__(self, places: Places, seed: int, device: str) -> None:
        self._places, self._seed, self._device = places, seed, device
        self._windows: dict[tuple[str, int], list[Asked]] = {}

    def windows(self, case: Case, count: int) -> list[Asked]:
        """Windows that a case asks about."""
        key = (case.set, case.frames)
        if key not in self._windows:
            self._windows = {key: self._places.windows(*key)}
        return thinned(self._windows[key], count, case.family)

    def once(self, case: Case, windows: list[Asked], row: int) -> dict[str, Any]:
        """What becomes of one window."""
        asked = windows[row]
        other = None
        if case.other:
            other = next(iter(self._places.recordings(case.other).values()))[0]
        shot = spoiled(asked, case, other, self._seed)
        scene = self._places.scene(case.map or asked.map)
        told = ask(scene, asked, shot, case, seed=self._seed, device=self._device)
        return replace(told, window=asked.shot.name).to_dict()
