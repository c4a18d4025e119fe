"""What is each part of the network worth? Short trainings that differ in one thing.

    placegraph-lab table outdoor_ablation
    placegraph-lab table outdoor_ablation --quick

All are trained alike, on the same descriptions, and evaluated on held-out tiles. Interrupted, the
same command goes on. Prints Markdown, writes JSON.
"""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Annotated, Any

from placegraph.outdoor.network.network import GraphTransformer
from placegraph_lab.tables.outdoor.ablation import CANDIDATES, Task, evaluate, mean_of
from placegraph_lab.tables.outdoor.extracts import EXTRACTS, TRAINED, open_city, unseen_queries
from placegraph_lab.tables.outdoor.queries import load
from placegraph_lab.tables.run import Device, Quick, Run, Seed, option, table
from placegraph_lab.tables.tables import markdown, number, share, shares
from placegraph_lab.train.city.options import TrainOptions
from placegraph_lab.train.city.train import train

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from placegraph.outdoor.city import CityMap

SHIPPED = "shipped"


def variants(base: TrainOptions) -> dict[str, TrainOptions]:
    """Trainings by name."""
    every = base.losses
    return {
        "all": base,
        "no cross attention": replace(base, shape=replace(base.shape, crossings=0)),
        "one crossing": replace(base, shape=replace(base.shape, crossings=1)),
        "no message passing": replace(base, shape=replace(base.shape, layers=0)),
        "labels: whole words only": replace(base, shape=replace(base.shape, subwords=0.0)),
        "labels: more of subwords": replace(base, shape=replace(base.shape, subwords=3.0)),
        **{f"loss: {name} alone": replace(base, losses=(name,)) for name in every},
    }


def trained(
    name: str, options: TrainOptions, cities: Mapping[str, CityMap], work: Path, device: str
) -> GraphTransformer:
    """Train one variant, on examples that all share, or go on with it."""
    folder = work / name.replace(":", "").replace(" ", "_")
    weights = folder / "weights"
    if not weights.exists():
        folder.mkdir(parents=True, exist_ok=True)
        train(cities, weights, folder=folder, pools=work / "pools", options=options, device=device)
    return GraphTransformer.open(weights)


def printed(rows: list[dict[str, Any]]) -> str:
    """Markdown: recall@1/3/5 within 50 m, mean of the cities."""
    own = [f"{n} candidates" for n in CANDIDATES]
    header = ["", "weights", "20 given cells", "by cosine", "dense alone", "one of ten", *own]
    lines = [
        [
            row["name"],
            number(row["weights"]),
            *(shares(row["recall"][n]) for n in ("given", "given, cosine", "dense")),
            share(row["recall"]["dense, of 10"][0]),
            *(shares(row["recall"][n]) for n in own),
        ]
        for row in rows
    ]
    return markdown(header, lines)


@table()
def outdoor_ablation(
    run: Run,
    queries: Annotated[int, option("Queries a city.")] = 200,
    epochs: Annotated[int, option("Epochs of a training.")] = 2,
    examples: Annotated[int, option("New descriptions a city and epoch.")] = 1200,
    steps: Annotated[int, option("Batches an epoch.")] = 300,
    only: Annotated[str, option("Names of variants with commas.")] = "",
    on: Annotated[str, option("Cities to measure on, with commas; all.")] = "",
    *,
    seed: Seed = 0,
    device: Device = "auto",
    quick: Quick = False,
) -> None:
    """What is each part of the network worth? Short trainings that differ in one thing."""
    names, work = list(TRAINED), run.cache / "ablation"
    base = TrainOptions(epochs=epochs, examples=examples, steps=steps, seed=seed)
    if quick:
        names, queries, only = names[2:3], 20, only or "all,no cross attention"
        base = TrainOptions(epochs=1, examples=32, steps=4, batch=8, check=16, seed=seed)
        work /= "quick"
    wanted = variants(base)
    wanted = {n: o for n, o in wanted.items() if not only or n in only.split(",")}
    cities = {name: open_city(name, run.osm, run.cache) for name in names}
    measured = [n for n in names if not on or n in on.split(",")]
    tasks = []
    for name in measured:
        path = run.osm / EXTRACTS[name]
        told = unseen_queries(name, cities[name], path, n=queries, seed=seed)
        tasks.append(Task.of(cities[name], load(path), told))
    rows: list[dict[str, Any]] = []
    for name in (*wanted, SHIPPED):
        run.say(name)
        network = GraphTransformer.default()
        if name in wanted:
            network = trained(name, wanted[name], cities, work, device)
        rows.append(
            {
                "name": name,
                "weights": sum(a.size for a in network.arrays.values()),
                "options": asdict(wanted[name]) if name in wanted else None,
                "recall": mean_of([evaluate(task, network) for task in tasks]),
            }
        )
    print(printed(rows))
    run.save({"cities": measured, "rows": rows})
