"""Which scene of a library was a walk taken in? Homes, rooms of the house, the office.

    placegraph-lab table scene_retrieval
    placegraph-lab table scene_retrieval --encoders "labels; labels, 30 % wrong" --development

Prints Markdown tables in the shape of the paper's Table 5 and writes every figure as JSON. Walks,
vectors and answers are written down at once: run it again and it goes on where it was cut.
`docs/benchmarks.md` explains the protocol.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import numpy as np

from placegraph.errors import MissingExtraError
from placegraph_lab.tables.retrieval.retrieval_places import (
    FIRST,
    HOMES,
    Place,
    Walk,
    homes,
    house_rooms,
    office_half,
)
from placegraph_lab.tables.retrieval.retrieval_report import PAPER, figures, report
from placegraph_lab.tables.retrieval.retrieval_study import Study
from placegraph_lab.tables.retrieval.retrieval_vectors import BOTH, ROWS
from placegraph_lab.tables.runner import Fresh, Quick, Run, known, option, parts, table

LARGE = BOTH
"""The row that is asked in the large library, too: what a library does by default."""


def asked(run: Run, first: int, *, thin: bool) -> tuple[list[Place], list[Walk]]:
    """All scenes, and all walks through them, or of homes one each."""
    places, walks = house_rooms(run.data, run.cache)
    office, half = office_half(run.data, run.cache)
    places.append(office)
    walks.append(half)
    seeds = range(first, first + HOMES)
    for place, own in run.track(homes(seeds, run.cache), "homes", total=len(seeds)):
        walks += [own[len(places) % 2]] if thin else own
        places.append(place)
    return places, walks


@table("SG2Loc, Table 5")
def scene_retrieval(
    run: Run,
    encoders: Annotated[str, option(f"Rows, with semicolons between: {'; '.join(ROWS)}.")] = "",
    scenes: Annotated[int, option("Scenes of the large library; 0: none.")] = 10_000,
    *,
    development: Annotated[bool, option("Homes to tune with; tables are of others.")] = False,
    thin: Annotated[
        bool, option("One walk a home: as it was, of every second months later.")
    ] = False,
    fresh: Fresh = False,
    quick: Quick = False,
) -> None:
    """Which scene of a library was a walk taken in? Homes, rooms of the house, the office."""
    rows = known(parts(encoders, ";"), ROWS, "row")
    if quick:
        rows, scenes, thin = rows[:1], 0, True
    journal = run.journal(fresh=fresh)
    places, walks = asked(run, 0 if development else FIRST, thin=thin)
    study = Study(places, walks, run.cache, journal, run.say)
    measured, large = [], []
    for name in rows:
        try:
            measured.append(study.row(name))
            if scenes and name == LARGE:
                large += study.scale(name, np.random.default_rng(0), scenes)
        except MissingExtraError as error:
            run.say(f"{name}: {error}")
    print(report(measured, large))
    record = {
        "scenes": [p.name for p in places],
        "walks": [w.name for w in walks],
        "walks_of_a_home": 1 if thin else 2,
        "paper": PAPER,
        "rows": figures(measured),
        "scale": [asdict(s) for s in large],
    }
    run.save(record, whole=not (encoders or development))
