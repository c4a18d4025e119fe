"""How many questions until the place is found? Informative against random questions.

    placegraph-lab table outdoor_dialogue --cities vancouver,liechtenstein

Texts of six statements without names leave many places; a simulated speaker, who sees the raw
extract, answers. Prints a Markdown table and writes JSON.
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np

from placegraph_lab.tables.outdoor.dialogue import RIGHT, Asking, Speaker, dialogue, distance
from placegraph_lab.tables.outdoor.extracts import EXTRACTS, names_of, open_city
from placegraph_lab.tables.outdoor.queries import load, make_queries
from placegraph_lab.tables.run import Quick, Run, Seed, option, table
from placegraph_lab.tables.tables import markdown, share

AFTER = (0, 1, 2, 3, 5, 8)


@table()
def outdoor_dialogue(
    run: Run,
    cities: Annotated[str, option("Names with commas.")] = "vancouver,ankara,liechtenstein,andorra",
    queries: Annotated[int, option("Dialogues a city.")] = 100,
    most: Annotated[int, option("Questions at the most.")] = 8,
    seed: Seed = 0,
    *,
    quick: Quick = False,
) -> None:
    """How many questions until the place is found? Informative against random questions."""
    rows: list[dict[str, Any]] = []
    ways: tuple[Asking, Asking] = ("best", "random")
    names = names_of(cities)
    if quick:
        names, queries = names[-1:], 5
    with run.progress() as progress:
        task = progress.add_task("asking", total=len(names) * len(ways) * queries)
        for name in names:
            city = open_city(name, run.osm, run.cache)
            bins = load(run.osm / EXTRACTS[name])
            told = make_queries(run.osm / EXTRACTS[name], statements=6, n=queries, seed=seed)
            for asking in ways:
                rng = np.random.default_rng(seed)
                right, asked = [], []
                for query in told:
                    viewpoint = bins.city.plane.to_plane((query.longitude, query.latitude))
                    course = dialogue(city, query, Speaker(bins, viewpoint), asking, rng, most=most)
                    hits = [distance(e, query, city) <= RIGHT for e in course]
                    right.append([hits[min(k, len(hits) - 1)] for k in AFTER])
                    asked.append(len(course) - 1)
                    progress.advance(task)
                share_after = dict(zip(AFTER, np.mean(right, axis=0).tolist(), strict=True))
                row = {"city": name, "asking": asking, "right_after": share_after}
                rows.append(row | {"questions": float(np.mean(asked))})
    header = ["city", "questions", *[f"right after {k}" for k in AFTER], "asked on average"]
    print(markdown(header, [line(row) for row in rows]))
    run.save({"rows": rows})


def line(row: dict[str, Any]) -> list[str]:
    """Row of the table."""
    right = [share(v) for v in row["right_after"].values()]
    return [row["city"], row["asking"], *right, f"{row['questions']:.1f}"]
