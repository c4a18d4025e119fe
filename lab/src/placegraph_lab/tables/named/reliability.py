"""Table `reliability`: what was done to break placegraph, and what became of it.

Every part works for so many minutes: mutated inputs, faults, load, properties, platforms. Each row is
written down as soon as it is there, so that nothing is lost where a run is cut short, and takes the
place of that of the same name and seed; all others stay. Prints Markdown, writes JSON; no minutes
print what was written down, here and elsewhere. Where the JSON is that of the lab, its page and README
are written anew.
"""

from __future__ import annotations

import json
import re
import tempfile
from importlib import import_module
from pathlib import Path
from typing import Annotated

from typer import BadParameter

from placegraph.core.files import write_output
from placegraph_lab.campaign.row import (
    FAULTS,
    OUTCOMES,
    PARTS,
    Effort,
    Row,
    mark_fixed,
    merge_rows,
    total,
)
from placegraph_lab.tables import runner as lab

PAGE = "docs/benchmarks/reliability.md"
TABLE = re.compile(r"(?m)^\|\s+\|\s+\| +tried \|.*(?:\n\|.*)*")
SUM = re.compile(r"[\d,]+ trials(?: \([^)]*\))?, [\d,]+ faults(?: found, [\d,]+ open)?")
COUNTS = ("tried", *OUTCOMES, "mended")
HEADER = ["", "", *COUNTS, "seeds", "minutes", "measured"]


@lab.table()
def reliability(
    run: lab.Run,
    minutes: Annotated[float, lab.option("Of each part; 0 prints what was written down.")] = 5.0,
    only: Annotated[str, lab.option(f"Parts with commas: {', '.join(PARTS)}.")] = "",
    seed: lab.Seed = 0,
    mended: Annotated[
        str,
        lab.option(
            "Rows whose faults are mended, each with a test; with semicolons: PART/WHAT/SEED."
        ),
    ] = "",
    names: Annotated[
        str,
        lab.option(
            "Rows of fuzz, soak and platforms that are wanted, with semicolons; all by default."
        ),
    ] = "",
    layouts: Annotated[
        str, lab.option("Python file that writes seeds of more formats, as the tests do.")
    ] = "tests/lab/campaign/layouts.py",
    *,
    quick: lab.Quick = False,
    fresh: Annotated[bool, lab.option("Forget what was written down of these parts.")] = False,
) -> None:
    """Faults, load and damaged inputs: trials, outcomes and open defects."""
    wanted, path = (
        lab.check_names(lab.parts(only), PARTS, "part"),
        run.out or lab.LAB / "results/reliability.json",
    )
    now: list[Row] = []
    dropped = set(wanted) if fresh else set()
    healed, asked = ({n.strip() for n in told.split(";")} - {""} for told in (mended, names))

    def save() -> None:
        rows = merge_rows(read_rows(path), now, dropped)  # others may have written meanwhile
        try:
            rows = mark_fixed(rows, healed)
        except KeyError as error:
            raise BadParameter(f"{error} is not a row with faults") from None
        run.save({"rows": [r.to_dict() for r in rows]})
        dropped.clear()

    seconds = 60.0 * (min(minutes, 1.0) if quick else minutes)
    for part in wanted if seconds else ():
        with tempfile.TemporaryDirectory(prefix=f"placegraph-{part}-") as name:
            run.log(f"{part}, seed {seed}, {seconds / 60:g} minutes")
            file = Path(layouts).absolute() if layouts and Path(layouts).is_file() else None
            effort = Effort(seconds, seed, Path(name), run.data, run.log, asked, file)
            for row in import_module(f"placegraph_lab.campaign.{part}").rows(effort):
                now.append(row)
                save()
    if (now or healed) and not seconds:
        save()
    rows = read_rows(path)
    if run.out is None and not quick:
        publish(rows)
    print(render_rows(now if seconds else [row for row in rows if row.part in wanted]))


def render_rows(rows: list[Row]) -> str:
    told = []
    for part in dict.fromkeys(row.part for row in rows):
        own = [row for row in rows if row.part == part]
        alike: dict[str, list[Row]] = {}
        for row in own:
            alike.setdefault(row.what, []).append(row)
        for what, each in alike.items():
            told.append(_cells(each, what, max(each, key=lambda row: row.tried).note))
        told.append(_cells(own, "all", ""))
    return lab.markdown(HEADER, told)


def publish(rows: list[Row], root: Path = lab.LAB.parent) -> None:
    for name, pattern, new in (
        (PAGE, TABLE, render_rows(rows)),
        ("README.md", SUM, summarize_rows(rows)),
    ):
        before, after = pattern.split((root / name).read_text("utf-8"))
        write_output(root / name, f"{before}{new}{after}".encode())


def summarize_rows(rows: list[Row]) -> str:
    """Write the README's sum of all rows; answers of the soak test stand apart."""
    whole, borne = total(rows), total(row for row in rows if row.part == "soak").tried
    apart = f" ({borne:,} of them to wear it out)" if borne else ""
    return f"{whole.tried:,} trials{apart}, {whole.faults:,} faults found, {whole.open:,} open"


def _cells(rows: list[Row], what: str, note: str) -> list[str]:
    row, seeds = total(rows), ", ".join(map(str, sorted({r.seed for r in rows})))
    counts = [lab.number(getattr(row, name)) for name in COUNTS]
    told = [f"**{c}**" if row.open and name in FAULTS and c != "0" else c
            for name, c in zip(COUNTS, counts, strict=True)]  # fmt: skip
    return [row.part, what, *told, seeds, lab.number(row.seconds / 60, 1), note]


def read_rows(path: Path) -> list[Row]:
    """Rows that were written down; none where there is no file."""
    if not path.exists():
        return []
    return [Row.from_dict(r) for r in json.loads(path.read_text("utf-8"))["rows"]]
