"""A trained network by itself: where candidates are given, and in the pipeline of Eq. 9-16."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from placegraph.outdoor.city import CityMap
from placegraph.outdoor.likelihood.query import compile_query
from placegraph.outdoor.network.network import EncodedCity, GraphTransformer
from placegraph.outdoor.search.posterior import find_dense_cells
from placegraph.outdoor.search.request import Matching, Request, parse
from placegraph_lab.tables import runner as lab
from placegraph_lab.tables.outdoor.extracts import (
    EXTRACTS,
    TRAINED,
    Extract,
    names_of,
    open_city,
    unseen_queries,
)
from placegraph_lab.tables.outdoor.matchers import BagMatcher
from placegraph_lab.tables.outdoor.metrics import RANKS
from placegraph_lab.tables.outdoor.nearby import Bins
from placegraph_lab.tables.outdoor.queries import Query, load
from placegraph_lab.tables.runner import Column as Col
from placegraph_lab.tables.statistics import paired_interval
from placegraph_learn.city.train import Loss, TrainOptions, train

Hits = dict[str, NDArray[np.bool_]]
"""By what was done (Q, 3): whether the true cell is the best, one of three, one of five."""
GIVEN = (5, 10, 20, 50)  # numbers of cells, the true one among them, that every network ranks
CANDIDATES = 10  # the paper's n of Eq. 12.


@dataclass(frozen=True)
class Task:
    """Queries of one city, and the cells that are given to every network beside the true one."""

    city: CityMap
    queries: tuple[Query, ...]
    truth: NDArray[np.int64]  # (Q,) rows of `city.cells.points`: the cell that covers the viewpoint
    distractors: tuple[NDArray[np.int64], ...]
    """For each query (K,) rows of wrong cells, best of the bag first."""

    @classmethod
    def of(cls, city: CityMap, bins: Bins, queries: Sequence[Query]) -> Task:
        """Let the tuned triple bag choose wrong cells; a viewpoint that no cell covers is left out."""
        bag = BagMatcher.of(city, bins, "triple bag, tuned", "none")
        row = {cell: i for i, cell in enumerate(city.cells)}
        kept, truth, others = [], [], []
        for query in queries:
            true = city.cells.at(query.longitude, query.latitude)
            if true is None:
                continue
            found = dict.fromkeys(row[c] for c in bag.rank(query, 2 * max(GIVEN)).cells)
            kept.append(query)
            truth.append(row[true])
            others.append(np.array([r for r in found if r != row[true]], np.int64))
        return cls(city, tuple(kept), np.array(truth, np.int64), tuple(others))


def evaluate(task: Task, network: GraphTransformer) -> Hits:
    """Rank the cells of every query by a network, by how cells are proposed and ranked.

    ``N given``: the true cell and the bag's N - 1 best others, by the matching logit (Eq. 17), and
    ``N given, cosine`` by Eq. 15. ``dense``: all cells by their embeddings (Eq. 11-12), ``among
    10`` whether the true one is among the best ten; ``10 candidates`` these ten by the logit, and
    ``10 candidates, cosine`` the pipeline of Eq. 9-16.
    """
    encoded = EncodedCity(task.city, network)
    found: dict[str, list[list[bool]]] = {}
    for query, truth, others in zip(task.queries, task.truth, task.distractors, strict=True):
        for name, hits in _hits(encoded, query.text, int(truth), others).items():
            found.setdefault(name, []).append(hits)
    return {name: np.array(hits) for name, hits in found.items()}


def _hits(
    encoded: EncodedCity, text: str, truth: int, distractors: NDArray[np.int64]
) -> dict[str, list[bool]]:
    query = compile_query(parse(encoded.city, text), encoded.city)
    asked = Request(encoded.city, query, matching=Matching(encoded=encoded))
    dense = find_dense_cells(asked, CANDIDATES)
    given = np.append(
        distractors[: max(GIVEN) - 1], truth
    )  # last: where all are equal, it is not found
    match, own = (encoded.match(asked.text, encoded.cells, rows) for rows in (given, dense))
    logit, cosine = match.logit, match.cosine
    table = {}
    for n in GIVEN:
        some = np.append(np.arange(min(n, len(given)) - 1), len(given) - 1)
        table[f"{n} given"] = given[some][_best(logit[some])]
        table[f"{n} given, cosine"] = given[some][_best(cosine[some])]
    table["dense"] = dense
    table[f"{CANDIDATES} candidates"] = dense[_best(own.logit)]
    table[f"{CANDIDATES} candidates, cosine"] = dense[_best(own.cosine)]
    hits = {name: [bool((rows[:k] == truth).any()) for k in RANKS] for name, rows in table.items()}
    return hits | {f"among {CANDIDATES}": [bool((dense == truth).any())] * len(RANKS)}


def _best(scores: NDArray[np.float32]) -> NDArray[np.int64]:
    return np.argsort(-scores, kind="stable")


def recall(tables: Sequence[Hits]) -> dict[str, list[float]]:
    return {
        name: np.mean([table[name].mean(axis=0) for table in tables], axis=0).tolist()
        for name in tables[0]
    }


OURS, SHIPPED, LITERAL = "ours", "shipped", "statements taken literally"
PAPER: tuple[Loss, ...] = ("eq17", "eq18")
COMPARED = ("20 given", "20 given, cosine", "10 candidates, cosine")


def variants(base: TrainOptions) -> dict[str, TrainOptions]:
    """Trainings by name."""

    def of(**shape: Any) -> TrainOptions:
        return replace(base, shape=replace(base.shape, **shape))

    shape = replace(base.shape, printed=True, layers=1, crossings=1, heads=2)
    printed = replace(base, losses=PAPER, shape=shape)
    return {
        OURS: base,
        "no cross attention": of(crossings=0),
        "GOTLoc as printed": printed,
        "GOTLoc as printed plus embedding loss": replace(printed, losses=(*PAPER, "embedding")),
        "one layer and two heads": of(layers=1, crossings=1, heads=2),
        "no message passing": of(layers=0),
        "labels: whole words only": of(subwords=0.0),
        **{f"loss: {name} alone": replace(base, losses=(name,)) for name in base.losses},
    }


def train_variant(
    name: str, options: TrainOptions, cities: Mapping[str, CityMap], work: Path, device: str
) -> GraphTransformer:
    """Train one variant, on descriptions that all share, or go on with it."""
    folder = work / f"{name}-{options.seed}".translate({ord(c): "_" for c in " :,'"})
    weights = folder / "weights"
    if not weights.exists():
        folder.mkdir(parents=True, exist_ok=True)
        train(cities, weights, folder=folder, pools=work / "pools", options=options, device=device)
    return GraphTransformer.open(weights)


@dataclass(frozen=True)
class NetworkComparison:
    """Queries that networks are evaluated on; answers go to the journal as they come."""

    run: lab.Run
    cities: Mapping[str, CityMap]
    measured: Sequence[str]
    queries: int
    seed: int
    journal: lab.Journal
    tasks: dict[str, Task] = field(default_factory=dict)

    def hits(self, network: GraphTransformer, as_what: str = "") -> list[Hits]:
        """By city, what a network finds."""
        found, code = [], lab.code_key(lab.OUTDOOR)
        for city in self.measured:
            key = f"{network.digest}{as_what}, {city}, {self.queries}, {self.seed}, {code}"
            if key not in self.journal:
                hits = evaluate(self._task(city), network)
                self.journal.put(key, {name: h.tolist() for name, h in hits.items()})
            found.append({name: np.array(h, np.bool_) for name, h in self.journal[key].items()})
        return found

    def _task(self, name: str) -> Task:
        if name not in self.tasks:
            city, path = self.cities[name], self.run.osm / EXTRACTS[name]
            asked = unseen_queries(Extract(name, path), city, path, n=self.queries, seed=self.seed)
            self.tasks[name] = Task.of(city, load(path), asked)
        return self.tasks[name]


def average_seeds(runs: Sequence[Sequence[Hits]], name: str) -> list[Any]:
    """Share of the seeds that find a query's cell at once, (Q,) for each city."""
    return [
        np.mean([hits[name][:, 0] for hits in city], axis=0) for city in zip(*runs, strict=True)
    ]


def lead(runs: Sequence[Sequence[Hits]], ours: Sequence[Sequence[Hits]], seed: int) -> list[str]:
    """Cells of the differences to ours: recall@1 and its interval, by what is compared."""
    cells = []
    for key in COMPARED:
        pairs = list(zip(average_seeds(runs, key), average_seeds(ours, key), strict=True))
        found = paired_interval(pairs, np.random.default_rng(seed))
        cells += [f"{found.mean:+.3f}", f"{found.low:+.3f} to {found.high:+.3f}"]
    return cells


COLUMNS = (
    Col("", "name"), Col("seeds", "seeds", 0),
    Col("/".join(map(str, GIVEN)) + " given, logit @1",
        lambda r: lab.shares(r["mean"][f"{n} given"][0] for n in GIVEN)),
    Col("seeds, 20 given", lambda r: "-".join(map(lab.share, r["spread"]))),
    Col("the same by cosine", lambda r: lab.shares(r["mean"][f"{n} given, cosine"][0] for n in GIVEN)),
    Col("dense alone @1/3/5", "mean.dense", lab.shares),
    Col("true one of ten", lambda r: r["mean"]["among 10"][0], lab.share),
    Col("ten candidates, cosine @1/3/5", lambda r: r["mean"]["10 candidates, cosine"], lab.shares),
    Col("ten, logit @1/3/5", lambda r: r["mean"]["10 candidates"], lab.shares),
)  # fmt: skip


def report(networks: Mapping[str, Sequence[Sequence[Hits]]], seed: int) -> str:
    """Markdown: recall where cells are given and in the pipeline, then differences to ours."""
    rows = []
    for name, runs in networks.items():
        each = [recall(run) for run in runs]
        mean = {key: np.mean([r[key] for r in each], axis=0).tolist() for key in each[0]}
        best = [r["20 given"][0] for r in each]
        spread = min(best), max(best)
        rows.append({"name": name, "seeds": len(runs), "mean": mean, "spread": spread})
    text = lab.render(COLUMNS, rows)
    others = [name for name in networks if OURS in networks and name != OURS]
    if others:
        header = ["", *(part for key in COMPARED for part in (f"{key} @1", "95 % interval"))]
        leads = [[name, *lead(networks[name], networks[OURS], seed)] for name in others]
        text += "\n\nMinus ours:\n\n" + lab.markdown(header, leads)
    return text


@lab.table("GOTLoc, Sec. III-C")
def outdoor_ablation(
    run: lab.Run,
    queries: Annotated[int, lab.option("Queries a city.")] = 200,
    epochs: Annotated[int, lab.option("Epochs of a training.")] = 5,
    only: Annotated[str, lab.option("Variants, or VARIANT/SEED, with commas; all.")] = "",
    seeds: Annotated[str, lab.option("Seeds of the trainings, with commas.")] = "0,1",
    *,
    seed: lab.Seed = 0,
    device: lab.Device = "auto",
    quick: lab.Quick = False,
) -> None:
    """Ablation of the network: trainings of full length that differ in one part."""
    names, work = list(TRAINED), run.cache / "ablation"
    base = TrainOptions(epochs=epochs, descriptions=seed, check=100)
    measured = names_of("")
    if quick:
        names, queries, only, seeds = names[2:3], 20, only or f"{OURS},no cross attention", "0"
        base = replace(base, epochs=1, examples=32, steps=4, batch=8, check=16)
        work, measured = work / "quick", names
    every = variants(base)
    asked_for = [entry.partition("/")[::2] for entry in lab.parts(only) or every]
    lab.check_names([name for name, _ in asked_for], every, "variant")
    wanted = [(n, s) for n, one in asked_for for s in ([one] if one else lab.parts(seeds))]
    cities = {name: open_city(name, run.osm, run.cache) for name in {*names, *measured}}
    judging = NetworkComparison(run, cities, measured, queries, seed, run.journal())
    shipped = GraphTransformer.default()
    silent = {"judge.2.weight": np.zeros_like(shipped.arrays["judge.2.weight"])}
    shape = replace(shipped.shape, crossings=0)
    found = {
        LITERAL: [
            judging.hits(replace(shipped, shape=shape, arrays=shipped.arrays | silent), LITERAL)
        ]
    }
    found[SHIPPED] = [judging.hits(shipped)]
    for name, its in wanted:
        run.log(f"{name}, seed {its}")
        options = replace(every[name], seed=int(its))
        network = train_variant(name, options, {n: cities[n] for n in names}, work, device)
        found.setdefault(name, []).append(judging.hits(network))
    print(report(found, seed))
    rows = [
        {
            "name": name,
            "recall": [recall(r) for r in runs],
            "options": every.get(name, base),
        }
        for name, runs in found.items()
    ]
    asked = {c: len(hits["dense"]) for c, hits in zip(measured, found[SHIPPED][0], strict=True)}
    run.save({"asked": asked, "rows": rows}, complete=not only)
