"""What does each witness add: a sentence, three frames, a fix? Recall of building, room and pose.

A quarter of houses with addresses is drawn, and in each a home. Somebody in a room says address, room
and two things (one number in ten is the next house's), and films three frames with depth.

    placegraph-lab table world_locate --quick

Prints a Markdown table and writes every answer as JSON.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated

from placegraph_lab.tables.run import Quick, Run, Seed, option, table
from placegraph_lab.tables.scene.world import ROWS, ask, quarter, report


@table()
def world_locate(
    run: Run,
    seed: Seed = 0,
    buildings: Annotated[int, option("Houses of the quarter, at most 240.")] = 200,
    *,
    quick: Quick = False,
) -> None:
    """What does a sentence, a film or a fix add? Recall of building, room and pose in a quarter."""
    buildings = 6 if quick else min(buildings, 240)
    with tempfile.TemporaryDirectory() as folder:
        world, visits = quarter(buildings, Path(folder), seed)
        world.library  # noqa: B018  # made when first asked for: its time is no query's
        cases = [(visit, row) for row in ROWS for visit in visits]
        asked = [ask(world, visit, row, seed) for visit, row in run.track(cases, "asking")]
    print(f"{buildings} buildings, a visit to each\n\n{report(asked)}")
    run.save({"rows": asked})
