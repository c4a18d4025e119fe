"""How many questions until the place is found? Informative against random questions.

    python benchmarks/outdoor_dialogue.py --cities vancouver,liechtenstein

Texts of six statements without names leave many places; a simulated speaker, who sees the raw
extract, answers. Prints a Markdown table and writes JSON.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.progress import Progress

import placegraph as pg
from placegraph_lab.tables.machine import machine
from placegraph_lab.tables.outdoor.dialogue import RIGHT, Asking, Speaker, dialogue, distance
from placegraph_lab.tables.outdoor.queries import load, make_queries
from placegraph_lab.tables.tables import markdown, share

ROOT = Path(__file__).parents[1]
DATA = ROOT.parent / "shared/data/osm"
EXTRACTS = {path.name.split("_")[0]: path for path in sorted(DATA.glob("*_*.osm*"))}
AFTER = (0, 1, 2, 3, 5, 8)


def main(
    cities: Annotated[
        str, typer.Option(help="Names with commas.")
    ] = "vancouver,ankara,liechtenstein,andorra",
    queries: Annotated[int, typer.Option(help="Dialogues a city.")] = 100,
    most: Annotated[int, typer.Option(help="Questions at the most.")] = 8,
    seed: Annotated[int, typer.Option(help="Seed of the queries.")] = 0,
    cache: Annotated[Path, typer.Option(help="Folder for maps.")] = ROOT / ".benchmark-cache",
    out: Annotated[Path, typer.Option(help="JSON file.")] = ROOT
    / "benchmarks/results/outdoor_dialogue.json",
) -> None:
    """Let a simulated speaker answer questions and count them."""
    cache.mkdir(exist_ok=True)
    rows: list[dict[str, Any]] = []
    ways: tuple[Asking, Asking] = ("best", "random")
    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("asking", total=len(cities.split(",")) * len(ways) * queries)
        for name in cities.split(","):
            path = cache / f"{name}.city"
            city = pg.CityMap.open(path) if path.exists() else pg.build_city(EXTRACTS[name], path)
            bins = load(EXTRACTS[name])
            told = make_queries(EXTRACTS[name], statements=6, n=queries, seed=seed)
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
                rows.append(
                    {
                        "city": name,
                        "asking": asking,
                        "right_after": dict(
                            zip(AFTER, np.mean(right, axis=0).tolist(), strict=True)
                        ),
                        "questions": float(np.mean(asked)),
                    }
                )
    table = markdown(
        ["city", "questions", *[f"right after {k}" for k in AFTER], "asked on average"],
        [
            [
                r["city"],
                r["asking"],
                *[share(v) for v in r["right_after"].values()],
                f"{r['questions']:.1f}",
            ]
            for r in rows
        ],
    )
    print(table)
    out.parent.mkdir(exist_ok=True)
    told_of = {"queries": queries, "most": most, "seed": seed, "machine": machine(), "rows": rows}
    out.write_text(json.dumps(told_of, indent=1))


if __name__ == "__main__":
    typer.run(main)
