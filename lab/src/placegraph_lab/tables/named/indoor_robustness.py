"""What goes wrong, and what becomes of the pose? Every perturbation, bad input, absent scenes.

    placegraph-lab table indoor_robustness --quick
    placegraph-lab table indoor_robustness --only "house: drift*; office: drift*"

Prints Markdown tables and writes every row as JSON. Every answer is written down at once: run it
again and it goes on where it was cut. `docs/benchmarks/indoor-robustness.md` has the protocol.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Annotated, Any

from placegraph_lab.tables.indoor.cases import Case, all_cases
from placegraph_lab.tables.indoor.cases import quick as few
from placegraph_lab.tables.indoor.jobs import ANSWERING, chosen
from placegraph_lab.tables.indoor.robustness import Asked, Places, Told, ask, spoiled, thinned
from placegraph_lab.tables.indoor.robustness_report import Row, report
from placegraph_lab.tables.indoor.trust import fitted, honest, samples
from placegraph_lab.tables.journal import fingerprint
from placegraph_lab.tables.run import Device, Fresh, Quick, Run, Seed, option, parts, table

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
