"""What was done to break placegraph, and what became of it.

    placegraph-lab table reliability --minutes 5
    placegraph-lab table reliability --only fuzz --minutes 240 --seed 7

Every part works for so many minutes: mutated inputs, faults, load, properties, platforms. A part that
is run alone takes the place of its own rows; those of the others stay. Prints Markdown, writes JSON.
"""

from __future__ import annotations

import json
import tempfile
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

from placegraph_lab.campaign.row import FAULTS, OUTCOMES, PARTS, Effort, Row, total
from placegraph_lab.tables.run import LAB, Quick, Run, Seed, known, option, parts, table
from placegraph_lab.tables.tables import markdown, number

HEADER = ["", "", "tried", *OUTCOMES, "seed", "minutes"]


@table()
def reliability(
    run: Run,
    minutes: Annotated[float, option("Of each part.")] = 5.0,
    only: Annotated[str, option(f"Parts with commas: {', '.join(PARTS)}.")] = "",
    seed: Seed = 0,
    *,
    quick: Quick = False,
) -> None:
    """What was done to break placegraph, and what became of it."""
    made = [part for part in PARTS if find_spec(f"placegraph_lab.campaign.{part}")]
    rows: list[Row] = []
    for part in known(parts(only), made, "part"):
        with tempfile.TemporaryDirectory(prefix=f"placegraph-{part}-") as name:
            seconds = 60.0 * (min(minutes, 1.0) if quick else minutes)
            run.say(f"{part}, seed {seed}, {seconds / 60:g} minutes")
            effort = Effort(seconds, seed, Path(name), run.data, run.say)
            rows += import_module(f"placegraph_lab.campaign.{part}").rows(effort)
    print(shown(rows))
    run.save({"rows": [r.to_dict() for r in kept(run, rows) + rows]})


def shown(rows: list[Row]) -> str:
    """Rows, and the sum of each part."""
    told = []
    for part in dict.fromkeys(row.part for row in rows):
        own = [row for row in rows if row.part == part]
        told += [_cells(row) for row in [*own, total(own)]]
    return markdown(HEADER, told)


def _cells(row: Row) -> list[str]:
    counts = [number(getattr(row, name)) for name in ("tried", *OUTCOMES)]
    told = [f"**{c}**" if name in FAULTS and c != "0" else c
            for name, c in zip(("tried", *OUTCOMES), counts, strict=True)]  # fmt: skip
    return [row.part, row.what, *told, str(row.seed), number(row.seconds / 60, 1)]


def kept(run: Run, rows: list[Row]) -> list[Row]:
    """Rows of parts that were not run now, as they were written down before."""
    path = run.out or LAB / "results/reliability.json"
    if not path.exists():
        return []
    before = [Row.from_dict(r) for r in json.loads(path.read_text("utf-8"))["rows"]]
    return [row for row in before if row.part not in {r.part for r in rows}]
