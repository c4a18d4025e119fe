"""Tables of `indoor_robustness`."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from placegraph_lab.tables.indoor.cases import Case
from placegraph_lab.tables.indoor.metrics import NEAR, rounded
from placegraph_lab.tables.indoor.robustness import THRESHOLDS, Told
from placegraph_lab.tables.runner import markdown, number, share, shares

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
    told: tuple[Told, ...]

    @property
    def recall(self) -> list[float]:
        """Share of windows within each of `THRESHOLDS`."""
        return [float(np.mean([t.within(*limits) for t in self.told])) for limits in THRESHOLDS]

    def status(self, name: str) -> float:
        """Share of windows with a status."""
        return float(np.mean([t.status == name for t in self.told]))

    @property
    def false_ok(self) -> float:
        """Share of windows that are `OK`, and not what it promises (or nothing can be)."""
        return float(np.mean([wrongly_sure(t, self.case) for t in self.told]))

    @property
    def milliseconds(self) -> float:
        """Median CPU time a frame; NaN where all were refused."""
        took = [t.milliseconds for t in self.told if not math.isnan(t.milliseconds)]
        return float(np.median(took)) if took else math.nan

    @property
    def said(self) -> str:
        """What the answer says most often."""
        (reason, _), *_ = Counter(t.reason for t in self.told).most_common(1)
        return reason

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings, ready for `json.dumps`."""
        case = self.case
        return {
            "name": case.name, "set": case.set, "family": case.family, "strength": case.strength,
            "frames": case.frames, "senses": list(case.senses), "map": case.map, "part": case.part,
            "recall": {
                f"{m:g} m, {d:g} deg": round(r, 4)
                for (m, d), r in zip(THRESHOLDS, self.recall, strict=True)
            },
            "ok": round(self.status("OK"), 4),
            "false_ok": round(self.false_ok, 4),
            "milliseconds": rounded(self.milliseconds, 2),
        }  # fmt: skip


def wrongly_sure(told: Told, case: Case) -> bool:
    """Whether an answer is `OK` that may not be."""
    return told.status == "OK" and (case.part == "bad" or not told.right)


def report(rows: Sequence[Row]) -> str:
    """Markdown of all tables that there are rows for, and how honest all of them are."""
    parts = []
    for part, title in TITLES.items():
        own = [row for row in rows if row.case.part == part]
        if own:
            parts.append(f"#### {title}\n\n{_bad(own) if part == 'bad' else _table(own)}")
    parts.append(f"#### Is `OK` right?\n\n{honesty(rows)}")
    return "\n\n".join(parts)


def _table(rows: Sequence[Row]) -> str:
    header = ["", "windows", RECALLS, "`OK`", "false `OK`", "`LOST`", "ms a frame"]
    return markdown(
        header,
        [
            [
                row.case.name,
                str(len(row.told)),
                shares(row.recall) if not row.case.map else "–",
                share(row.status("OK")),
                share(row.false_ok),
                share(row.status("LOST")),
                number(row.milliseconds),
            ]
            for row in rows
        ],
    )


def _bad(rows: Sequence[Row]) -> str:
    return markdown(
        ["", "what is said most", "windows", "`OK`"],
        [
            [row.case.name, row.said.replace("|", "/"), str(len(row.told)), share(row.status("OK"))]
            for row in rows
        ],
    )


def honesty(rows: Sequence[Row]) -> str:
    """`OK` and what of it is wrong, of windows that were tuned on, and of those held out."""
    lines = []
    for part, title in TITLES.items():
        for half, parity in HALVES.items():
            pairs = [
                (t, row.case)
                for row in rows
                if row.case.part == part
                for t in row.told
                if t.number % 2 == parity
            ]
            if not pairs:
                continue
            right = np.array([t.right and c.part != "bad" for t, c in pairs])
            ok = np.array([t.status == "OK" for t, _ in pairs])
            lines.append(
                [
                    title.partition(":")[0], half, str(len(pairs)), share(float(right.mean())),
                    share(float((right & ok).mean())), share(float((ok & ~right).mean())),
                ]
            )  # fmt: skip
    right_is = f"right ({NEAR[0]:g} m, {NEAR[1]:g}°)"
    return markdown(["", "half", "windows", right_is, "`OK` and right", "false `OK`"], lines)
