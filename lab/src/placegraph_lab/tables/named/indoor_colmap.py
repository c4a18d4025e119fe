"""Best of both beside COLMAP: single frames, in our maps and in maps of local features.

    placegraph-lab table indoor_colmap
    placegraph-lab table indoor_colmap --only "office, beside mapped views" --frames 40

Prints a Markdown table and writes every answer as JSON. Needs `pip install './lab[colmap]'`, and for
XFeat its weights in `shared/weights`. `docs/benchmarks/indoor-colmap.md` says what is measured.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np

from placegraph_lab.tables.indoor.beside import SETS, Row, rows_of, to_dict
from placegraph_lab.tables.run import Quick, Run, Seed, known, option, parts, table
from placegraph_lab.tables.tables import markdown, number, share


@table()
def indoor_colmap(
    run: Run,
    only: Annotated[str, option("Sets, with semicolons between.")] = "",
    frames: Annotated[int, option("Single frames asked of each set.")] = 24,
    seed: Seed = 0,
    *,
    quick: Quick = False,
) -> None:
    """How near do single frames come, beside COLMAP and XFeat? Centimetres, recall, MB, milliseconds."""
    wanted = known(parts(only, ";"), [one.name for one in SETS], "set")
    rows: list[Row] = []
    for one in SETS:
        if one.name in wanted:
            run.say(one.name)
            count = 6 if quick else frames
            weights = run.shared / "weights/xfeat.pt"
            rows += rows_of(one, run.data, run.cache, weights, count, seed)
    print(report(rows))
    run.save({"rows": to_dict(rows)}, whole=not only)


def report(rows: list[Row]) -> str:
    """One table; of each row medians over all frames, those without a pose among them."""
    header = ["map, and who asks it", "median", "10 cm, 5°", "sure", "sure and wrong", "MB", "ms"]
    lines: list[list[str]] = []
    for row in rows:
        if row is rows[0] or row.set != rows[rows.index(row) - 1].set:
            lines.append([f"**{row.set}**", *[""] * 6])
        told = row.answers
        off = np.array([(a.position, a.rotation) for a in told])
        middle = np.median(off, axis=0)
        lines.append([
            row.method,
            f"{number(100 * middle[0], 1)} cm, {number(middle[1], 2)}°",
            share(float(np.mean([a.right for a in told]))),
            f"{sum(a.sure for a in told)} of {len(told)}",
            str(sum(a.wrong for a in told)),
            number(row.megabytes, 2),
            number(float(np.median([a.milliseconds for a in told]))),
        ])  # fmt: skip
    return markdown(header, lines)
