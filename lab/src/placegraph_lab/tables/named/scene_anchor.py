"""Do walls on a footprint, and GPS fixes, say where on Earth a map stands? Turn, metres, degrees.

Homes are drawn in buildings that somebody drew into OpenStreetMap, to half a metre; walls are fitted,
with and without an entrance, where the home is the whole house and where it is a part. Captures in
and around them have fixes of 5 m with one reflection in ten.

    placegraph-lab table scene_anchor --quick

Prints a Markdown table and writes every answer as JSON.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated

from placegraph_lab.tables.runner import Quick, Run, Seed, option, table
from placegraph_lab.tables.scene.anchor import BUILDINGS, WALKS, ask, house, report


@table()
def scene_anchor(
    run: Run,
    seed: Seed = 0,
    houses: Annotated[int, option("Homes that are drawn.")] = 200,
    *,
    quick: Quick = False,
) -> None:
    """How well do walls, entrances and fixes say where a map stands? Right turn, metres, degrees."""
    asked = []
    with tempfile.TemporaryDirectory() as folder:
        for number in run.track(range(6 if quick else houses), "fitting"):
            drawn = house(seed, number)
            answers = (ask(drawn, row, Path(folder), number) for row in (*BUILDINGS, *WALKS))
            asked += [a | {"house": number} for a in answers if a is not None]
    print(report(asked))
    run.save({"rows": asked})
