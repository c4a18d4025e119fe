"""Table `indoor_robustness`: perturbations, bad input and absent scenes.

Every answer is written down at once: run it again and it goes on where it was cut.
`docs/benchmarks/indoor.md#what-goes-wrong` has the protocol.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import SimpleNamespace
from typing import Annotated, Any

import numpy as np

from placegraph.core.geometry import Floats
from placegraph.indoor.pose.agreement import ConfidenceModel, features
from placegraph.indoor.status import ALONE, SURE
from placegraph_lab.tables import runner as lab
from placegraph_lab.tables.indoor.bench import choose_jobs
from placegraph_lab.tables.indoor.metrics import NEAR
from placegraph_lab.tables.indoor.robustness import (
    THRESHOLDS,
    Case,
    MapWindow,
    Outcome,
    Places,
    all_cases,
    ask,
    spoil_window,
    thin_windows,
)
from placegraph_lab.tables.indoor.robustness import quick as few
from placegraph_lab.tables.runner import Column as Col

TITLES = {
    "spoiled": "Perturbations",
    "senses": "Fewer senses, fewer frames",
    "bad": "Bad input: no answer may be `OK`",
    "absent": "Absent scenes: no answer may be `OK`",
}
RECALLS = " / ".join(f"{100 * m:.0f} cm {d:.0f}°" for m, d in THRESHOLDS)
HALVES = {"even": 0, "odd": 1}


@dataclass(frozen=True)
class Row:
    """Answers of one case."""

    case: Case
    outcomes: tuple[Outcome, ...]

    @property
    def recall(self) -> list[float]:
        """Share of windows within each of `THRESHOLDS`."""
        return [float(np.mean([t.within(*limits) for t in self.outcomes])) for limits in THRESHOLDS]

    def status(self, name: str) -> float:
        """Share of windows with a status."""
        return float(np.mean([t.status == name for t in self.outcomes]))

    @property
    def ok(self) -> float:
        return self.status("OK")

    @property
    def false_ok(self) -> float:
        """Share of windows that are `OK`, and not what it promises (or nothing can be)."""
        bad = self.case.part == "bad"
        return float(np.mean([t.status == "OK" and (bad or not t.right) for t in self.outcomes]))

    @property
    def milliseconds(self) -> float:
        """Median CPU time a frame; NaN where all were refused."""
        took = [t.milliseconds for t in self.outcomes if not math.isnan(t.milliseconds)]
        return float(np.median(took)) if took else math.nan

    def record(self) -> dict[str, Any]:
        names = ("name", "set", "family", "strength", "frames", "senses", "map", "part")
        scores = {k: getattr(self, k) for k in ("recall", "ok", "false_ok", "milliseconds")}
        return {name: getattr(self.case, name) for name in names} | scores


OFTEN = Col("`OK`", "ok", lab.share)
ROWS = (
    Col("", "case.name"), Col("windows", lambda r: len(r.outcomes)),
    Col(RECALLS, lambda r: "–" if r.case.map else lab.shares(r.recall)), OFTEN,
    Col("false `OK`", "false_ok", lab.share), Col("`LOST`", lambda r: r.status("LOST"), lab.share),
    Col("ms a frame", "milliseconds", 0),
)  # fmt: skip
BAD_ROWS = (
    Col("", "case.name"),
    Col("what is said most",
        lambda r: Counter(t.reason for t in r.outcomes).most_common(1)[0][0].replace("|", "/")),
    Col("windows", lambda r: len(r.outcomes)), OFTEN,
)  # fmt: skip


def report(rows: Sequence[Row]) -> str:
    text = []
    for part, title in TITLES.items():
        own = [row for row in rows if row.case.part == part]
        if own:
            text.append(f"#### {title}\n\n{lab.render(BAD_ROWS if part == 'bad' else ROWS, own)}")
    return "\n\n".join([*text, f"#### Is `OK` right?\n\n{honesty(rows)}"])


def honesty(rows: Sequence[Row]) -> str:
    """`OK` and what of it is wrong, of windows that were tuned on, and of those held out."""
    lines = []
    for part, title in TITLES.items():
        own = [(t, row.case) for row in rows if row.case.part == part for t in row.outcomes]
        for half, parity in HALVES.items():
            pairs = [(t, case) for t, case in own if t.number % 2 == parity]
            if pairs:
                right = np.array([t.right and case.part != "bad" for t, case in pairs])
                ok = np.array([t.status == "OK" for t, _ in pairs])
                parts_ = (right, right & ok, ok & ~right)
                cells = [lab.share(float(found.mean())) for found in parts_]
                lines.append([title.partition(":")[0], half, str(len(pairs)), *cells])
    right_is = f"right ({NEAR[0]:g} m, {NEAR[1]:g}°)"
    return lab.markdown(["", "half", "windows", right_is, "`OK` and right", "false `OK`"], lines)


_RIDGE = 0.01
_UNRIVALLED = 0.8
TUNED = ("house", "office")  # sets that may be tuned on, even windows of them


def samples(rows: Sequence[Row]) -> list[tuple[Outcome, bool]]:
    """Answers that a verdict was given on, and whether the set may be tuned on; no bad input."""
    return [
        (outcomes, row.case.set in TUNED)
        for row in rows
        if row.case.part != "bad"
        for outcomes in row.outcomes
        if outcomes.agreement and "labels" not in row.case.senses
    ]


def fit_model(outcomes: Sequence[Outcome]) -> ConfidenceModel:
    """Logistic regression of being right, by Newton's method; no coefficient of a share is negative.

    Over answers without a rival: how far others may fit is another factor. Best poses with depth and
    colours are seldom wrong, so that the second best are samples for tones, too.
    """
    rivals = [t.rival for t in outcomes if t.rival and t.rival["tone"] is not None]
    outcomes = [t for t in outcomes if _probability(t) >= _UNRIVALLED]
    columns = np.array([_features(t.agreement) for t in outcomes])
    right = np.array([t.right for t in outcomes], np.float64)
    free = np.arange(columns.shape[1]) < _TONES
    while True:
        weights = np.zeros(len(free))
        weights[free] = _logistic(columns[:, free], right)
        wrong = (weights < 0) & _GROWING & free
        if not wrong.any():
            break
        free &= ~wrong
    level, *rest = weights.round(2).tolist()
    single = ConfidenceModel(level, (rest[0], rest[1], rest[2]), (rest[3], rest[4]), (0.0, 0.0))
    return fit_tones(single, columns, right, rivals)


def fit_tones(
    model: ConfidenceModel,
    columns: Floats,
    right: Floats,
    rivals: Sequence[dict[str, float | None]],
) -> ConfidenceModel:
    """Coefficients with those of tones, by features (N, 8) of poses and whether (N,) they are right."""
    both = columns[:, _TONES] > 0
    samples = np.concatenate([columns[both], np.array([_features(r) for r in rivals])])
    outcomes = np.append(right[both], np.zeros(len(rivals)))
    weights = _logistic(samples[:, _TONES:], outcomes, samples @ np.array(model.coefficients))
    there, tells = weights.round(2).tolist()
    return replace(model, tone=(there, max(tells, 0.0)))


_TONES = 6  # where the features of tones begin
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
    senses = {name: known[name] for name in ("depth", "colour", "tone", "semantic")}
    agreed = SimpleNamespace(**senses, constraint=known["held"])
    return features(agreed)  # type: ignore[arg-type]  # what it looks at


def _probability(outcomes: Outcome) -> float:
    return outcomes.agreement["probability"] or 0.0


def honest(model: ConfidenceModel, answers: Sequence[tuple[Outcome, bool]]) -> str:
    """Tabulate the `OK` of coefficients: of windows that were fitted, that were held out, and others."""
    weights = np.array(model.coefficients)
    lines = []
    for name, parity, tuned in [
        *((f"tuned on, {half}", parity, True) for half, parity in HALVES.items()),
        ("others", None, False),
    ]:
        some = [
            t for t, may in answers if may == tuned and (parity is None or t.number % 2 == parity)
        ]
        if not some:
            continue
        right = np.array([t.right for t in some])
        odds = np.array([_features(t.agreement) for t in some]) @ weights
        best = np.array([_probability(t) for t in some])
        ok = (best >= ALONE) & (best / (1.0 + np.exp(-odds)) >= SURE)
        sure = float(ok[right].mean()) if right.any() else float("nan")
        cells = [lab.share(float(right.mean())), lab.share(sure), f"{(ok & ~right).mean():.3f}"]
        lines.append([name, str(len(some)), *cells])
    return lab.markdown(["", "windows", "right", "`OK` of right", "false `OK`"], lines)


QUICK_WINDOWS = 4


@lab.table()
def indoor_robustness(
    run: lab.Run,
    only: Annotated[
        str, lab.option("Rows, with semicolons between: 'house: drift*; office: as recorded'.")
    ] = "",
    windows: Annotated[int, lab.option("Windows of each row, half of them even.")] = 8,
    seed: lab.Seed = 0,
    device: lab.Device = "auto",
    *,
    fit: Annotated[
        bool, lab.option("Fit the coefficients of pose/agreement.py, and print only them.")
    ] = False,
    quick: lab.Quick = False,
    fresh: lab.Fresh = False,
) -> None:
    """Recall, `OK`, false `OK` and time for damaged frames, cameras and maps."""
    cases = all_cases()
    if quick:
        cases, windows = few(cases), min(windows, QUICK_WINDOWS)
    names = lab.parts(only, ";")
    cases = choose_jobs(cases, names)
    places = Places(run.data, run.cache)
    journal, code = run.journal(fresh=fresh), lab.code_key(lab.INDOOR)  # what is loaded now answers
    rows, known = {}, {}
    with run.progress() as bar:
        for case in sorted(cases, key=lambda c: (c.set, c.frames)):
            if (case.set, case.frames) not in known:  # windows of the last set and length are kept
                known = {(case.set, case.frames): places.windows(case.set, case.frames)}
            asked = thin_windows(known[case.set, case.frames], windows, case.family)
            keys = [f"{code} {case.name} {a.clip.name} seed {seed} {device}" for a in asked]
            once = partial(_ask_window, places, case, asked, seed, device)
            task = bar.add_task(case.name, total=len(journal.find_missing(keys)))
            outcomes = journal.fill(
                keys, once, warm=partial(once, 0), tick=partial(bar.advance, task)
            )
            bar.remove_task(task)
            rows[case.name] = Row(case, tuple(Outcome(**t) for t in outcomes))
    ordered = [rows[case.name] for case in cases]
    if fit:
        found = samples(ordered)
        model = fit_model([outcomes for outcomes, may in found if may and outcomes.number % 2 == 0])
        print(f"{model}\n\n{honest(model, found)}")
        return
    print(report(ordered))
    run.save({"rows": [row.record() for row in ordered]}, complete=not names)


def _ask_window(
    places: Places, case: Case, windows: list[MapWindow], seed: int, device: str, row: int
) -> Outcome:
    asked = windows[row]
    other = next(iter(places.recordings(case.other).values()))[0] if case.other else None
    clip = spoil_window(asked, case, other, seed)
    scene = places.scene(case.map or asked.map)
    outcomes = ask(scene, asked, clip, case, seed=seed, device=device)
    return replace(outcomes, window=asked.clip.name)
