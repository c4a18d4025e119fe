"""Does a sentence find its place? Recall, calibration and time on real OpenStreetMap extracts.

`docs/benchmarks/outdoor.md` explains the protocol. The ceiling: all viewpoints of a city compete for a query.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.outdoor.city import CityMap, build_city
from placegraph_lab.tables.outdoor.baselines import Bag, Words, list_words, words_around
from placegraph_lab.tables.outdoor.extracts import EXTRACTS
from placegraph_lab.tables.outdoor.extracts import TRAINED as DEV
from placegraph_lab.tables.outdoor.extracts import UNSEEN as TEST
from placegraph_lab.tables.outdoor.metrics import (
    BAGS,
    CEILING,
    ORACLE,
    OURS,
    RADII,
    RANKS,
    Answer,
    Protocol,
    Row,
    distances,
    measure,
    of_answers,
    positions,
    report,
)
from placegraph_lab.tables.outdoor.nearby import DIRECTIONS, Bins
from placegraph_lab.tables.outdoor.outdoor_kernels import _likeliest, _rank
from placegraph_lab.tables.outdoor.places import Ints
from placegraph_lab.tables.outdoor.queries import (
    CELL,
    NOISE,
    SETTINGS,
    SIGHT,
    Query,
    load,
    make_queries,
)
from placegraph_lab.tables.runner import Quick, Run, Seed, option, parts, table

if TYPE_CHECKING:
    from rich.progress import Progress

STEP = 12.5  # edge of the grid of viewpoints that compete with the truth [m]
CHUNK = 50_000  # viewpoints looked at in one go: keeps memory small


@dataclass(frozen=True)
class Contest:
    """Viewpoints V of a grid, and the words W (statements) that the queries Q speak of."""

    words_asked: Ints
    """(A, 4) words of all queries, one query after the other: as said, and in the three other
    directions."""
    words_asked_starts: Ints  # (Q + 1,)
    served_starts: Ints  # (W + 1,) viewpoints that serve a word
    served: NDArray[np.int32]
    sayable: NDArray[
        np.int32
    ]  # (V,) different statements that the generator could make at a viewpoint
    own: Ints  # (Q,) statements that hold at the true viewpoint itself
    truth: Floats  # (Q, 2) true viewpoints, in steps of the grid
    column: NDArray[np.int32]  # (V, 2) viewpoints, in steps of the grid
    square: NDArray[np.int32]  # viewpoint of every square of the grid, -1 where there is none
    step: float

    @classmethod
    def of(
        cls,
        bins: Bins,
        queries: Sequence[Query],
        *,
        names: bool = False,
        step: float = STEP,
    ) -> Contest:
        """Look at all viewpoints of a grid over the city.

        `queries`: all about pairs of objects, or all about the speaker; `names`: objects are called
        by their names; `step`: edge of the grid [m]: 50 / step is a whole number.
        """
        city = bins.city
        label = city.named if names else city.label
        number = {name: i for i, name in enumerate(city.labels)}
        kind: Words = "triples" if queries[0].statements[0].target else "speaker"
        wanted = [list_words(q, kind, number) for q in queries]
        words = np.concatenate(wanted)
        labels = len(city.labels) + 1
        head, target = np.divmod(words, labels)
        source, said = np.divmod(head, len(DIRECTIONS))
        turned = (said[:, None] + np.arange(len(DIRECTIONS))) % len(DIRECTIONS)
        words_asked = np.asarray(
            (source[:, None] * len(DIRECTIONS) + turned) * labels + target[:, None]
        )
        known = np.unique(words_asked)
        truth = city.plane.to_plane([(q.longitude, q.latitude) for q in queries])

        def find_words(viewpoints: Floats) -> tuple[Ints, Ints, Ints]:
            """Viewpoint and word of what a query asks for; number of different words."""
            around = bins.around(viewpoints, SIGHT)
            at, word = words_around(
                kind, viewpoints, around, label, len(city.labels), SIGHT, same_label=False
            )
            pairs = np.unique(np.stack([at, word]), axis=1)
            place = np.minimum(np.searchsorted(known, pairs[1]), len(known) - 1)
            hit = known[place] == pairs[1]
            return pairs[0, hit], place[hit], np.bincount(pairs[0], minlength=len(viewpoints))

        grid = bins.centers(step)
        seen = [find_words(grid[i : i + CHUNK]) for i in range(0, len(grid), CHUNK)]
        at = np.concatenate([v + i * CHUNK for i, (v, _, _) in enumerate(seen)])
        word = np.concatenate([w for _, w, _ in seen])
        order = np.argsort(word, kind="stable")
        own_at, own_word, _ = find_words(truth)
        held = set(zip(own_at.tolist(), known[own_word].tolist(), strict=True))
        column = np.round((grid - bins.low) / step - 0.5).astype(np.int32)
        square = np.full(column.max(0) + 1, -1, np.int32)
        square[column[:, 0], column[:, 1]] = np.arange(len(grid))
        return cls(
            words_asked=np.searchsorted(known, words_asked),
            words_asked_starts=np.concatenate([[0], np.cumsum([len(w) for w in wanted])]),
            served_starts=np.searchsorted(word[order], np.arange(len(known) + 1)),
            served=at[order].astype(np.int32),
            sayable=np.concatenate([n for _, _, n in seen]).astype(np.int32),
            own=np.array([sum((q, w) in held for w in ws.tolist()) for q, ws in enumerate(wanted)]),
            truth=(truth - bins.low) / step - 0.5,
            column=column,
            square=square,
            step=step,
        )


MODE = 45.0  # the oracle sums the probability of viewpoints within this distance of a place's middle [m]
SLIP = 0.05
"""Share of wrong directions that the oracle expects of noise-free texts: its viewpoints stand on
a grid, a few metres from the true one."""


@dataclass(frozen=True)
class Ceiling:
    """Places that fit better than the true one, and others that fit as well, for each query."""

    better: Ints  # (Q,)
    tied: Ints  # (Q,)

    def recall(self, k: int) -> float:
        """Share of queries whose true place is among the first k, ties broken at random."""
        room = np.maximum(k - self.better, 0)
        return float(np.minimum(room / (self.tied + 1), 1.0).mean())


def ceiling(contest: Contest, apart: float | None = 50.0) -> Ceiling:
    """Rank the true place of every query among all places of the city.

    `apart`: a place is whatever lies within this distance of one viewpoint [m], and no two
    competitors are nearer to each other. None: a place is a 50 m cell.
    """
    counts = _rank(
        (contest.words_asked[:, 0], contest.words_asked_starts),
        (contest.served_starts, contest.served),
        (contest.column, contest.square),
        contest.own,
        contest.truth,
        (CELL if apart is None else apart) / contest.step,
        apart is None,
    )
    return Ceiling(better=counts[:, 0], tied=counts[:, 1])


def oracle(contest: Contest, *, replaced: bool = False, top: int = 5) -> Floats:
    """Distances (Q, top) [m] from the truth to the places that the generator most likely meant.

    The likelihood of a statement at a viewpoint where U different ones can be made is 1 / U if it
    is one of them. Of wrong directions it expects `NOISE` where relations were replaced.
    """
    return contest.step * _likeliest(
        (contest.words_asked, contest.words_asked_starts),
        (contest.served_starts, contest.served),
        (contest.column, contest.square),
        contest.sayable,
        contest.truth,
        (NOISE if replaced else SLIP, MODE / contest.step, CELL / contest.step),
        top,
    )


class Split(StrEnum):
    """Which cities: those that were tuned on, or those that are reported once."""

    dev = "dev"
    test = "test"
    all = "all"


def protocols(statements: Sequence[int], settings: Sequence[str]) -> list[Protocol]:
    """All settings at all lengths; the speaker and the other readings of the paper at 6."""
    chosen = [s for s in SETTINGS if s in settings]
    table = [Protocol(n, s) for n in statements for s in chosen if s != "speaker" or n == 6]
    if 6 in statements and "variants" in settings:
        table.append(Protocol(anywhere=True))
    return table


def bounds(
    city: str, bins: Bins, group: Sequence[Protocol], queries: dict[Protocol, list[Query]]
) -> list[Row]:
    """Rows of the ceiling and of the oracle; the protocols look at the city in the same way."""
    together = [q for p in group for q in queries[p]]

    contest = Contest.of(bins, together, names=group[0].setting == "names")
    ceilings = {"exact": ceiling(contest, None)}
    ceilings |= {f"{r:.0f} m": ceiling(contest, r) for r in RADII}
    loud = [p.setting == "replaced" for p in group for _ in queries[p]]
    quiet_guess, loud_guess = oracle(contest), oracle(contest, replaced=True)
    guess = np.where(np.array(loud)[:, None], loud_guess, quiet_guess)
    rows, end = [], 0
    for p in group:
        part = slice(end, end := end + len(queries[p]))
        recall = {
            name: [type(c)(c.better[part], c.tied[part]).recall(k) for k in RANKS]
            for name, c in ceilings.items()
        }
        rows.append(Row(city, p, CEILING, recall, None))
        recall = {
            f"{r:.0f} m": [float((guess[part, :k] <= r).any(1).mean()) for k in RANKS]
            for r in RADII
        }
        rows.append(Row(city, p, ORACLE, recall, None))
    return rows


def same_cell(places: Floats, query: Query, bins: Bins) -> tuple[bool, ...]:
    """Whether places (K, 2) [deg] lie in the query's cell of the grid it was drawn from."""
    at, truth = (
        bins.cells(bins.city.plane.to_plane(p), CELL)
        for p in (places, [(query.longitude, query.latitude)])
    )
    return tuple((at == truth).all(1).tolist())


def ask_map(city: CityMap, bins: Bins, queries: Sequence[Query]) -> list[Answer]:
    """Give every text, and only the text, to a city map."""
    answers = []
    for query in queries:
        start = time.perf_counter()
        estimate = city.locate(query.text, top=max(RANKS))
        seconds = time.perf_counter() - start
        answers.append(
            measure(
                estimate,
                query.longitude,
                query.latitude,
                seconds=seconds,
                exact=same_cell(positions(estimate), query, bins),
                cell=city.cells.at(query.longitude, query.latitude),
            )
        )
    return answers


def run_city(
    name: str,
    path: Path,
    table: Sequence[Protocol],
    *,
    n: int,
    seed: int,
    city: CityMap,
    tick: Progress,
) -> list[Row]:
    """All rows of a city: the baselines', the ceiling's and the map's."""
    bins = load(path)
    task = tick.add_task(name, total=len(table) + len({p.group for p in table}))
    queries = {
        p: make_queries(
            path,
            statements=p.statements,
            setting=p.setting,
            n=n,
            seed=seed,
            anywhere=p.anywhere,
        )
        for p in table
    }
    ask_map(city, bins, make_queries(path, n=20, seed=seed + 1))  # warm
    bags: dict[tuple[object, ...], Bag] = {}
    rows = []
    for p, asked in queries.items():
        for method, (reach, longest) in BAGS.items():
            pairs: Words = "speaker" if p.setting == "speaker" else "triples"
            words: Words = "labels" if method == "label bag" else pairs
            key = (words, method, p.setting == "names")
            if key not in bags:
                bags[key] = Bag.of(
                    bins,
                    words,
                    reach=reach,
                    longest=longest,
                    names=p.setting == "names",
                    seed=seed,
                )
            bag = bags[key]
            answers = []
            for query in asked:
                start = time.perf_counter()
                places = bag.locate(query, top=max(RANKS))
                seconds = time.perf_counter() - start
                off = distances(places, query.longitude, query.latitude)
                answers.append(Answer(off, same_cell(places, query, bins), seconds))
            rows.append(of_answers(name, p, method, answers))
        rows.append(of_answers(name, p, OURS, ask_map(city, bins, asked)))
        tick.advance(task)
    del bags
    for group in {p.group: None for p in table}:
        rows += bounds(name, bins, [p for p in table if p.group == group], queries)
        tick.advance(task)
    return rows


@table()
def outdoor_recall(
    run: Run,
    split: Annotated[Split, option("Cities: dev (tuned on), test, all.")] = Split.dev,
    cities: Annotated[str, option("Names with commas, instead of a split.")] = "",
    queries: Annotated[int, option("Queries a city and setting.")] = 500,
    statements: Annotated[str, option("Lengths with commas.")] = "4,6,10",
    settings: Annotated[str, option("Settings with commas.")] = "",
    seed: Seed = 0,
    *,
    quick: Quick = False,
) -> None:
    """Recall, calibration and time of sentences on OpenStreetMap extracts."""
    if quick:
        queries, statements, settings = 100, "6", settings or "none,replaced"
    asked = protocols(
        [int(n) for n in statements.split(",")],
        settings.split(",") if settings else [*SETTINGS, "variants"],
    )
    names = parts(cities) or list({Split.dev: DEV, Split.test: TEST, Split.all: EXTRACTS}[split])
    rows: list[Row] = []
    maps: dict[str, CityMap] = {}
    run.cache.mkdir(parents=True, exist_ok=True)
    for name in names:  # always anew: the map's making is part of what is measured
        build_city(run.osm / EXTRACTS[name], run.cache / f"{name}.city")
        maps[name] = CityMap.open(run.cache / f"{name}.city")
    run.one_core()
    with run.progress() as tick:
        for name in names:
            path = run.osm / EXTRACTS[name]
            rows += run_city(name, path, asked, n=queries, seed=seed, city=maps[name], tick=tick)
    for title, group in (("Tuned on", DEV), ("Reported once", TEST)):
        chosen = [c for c in names if c in group]
        if chosen:
            print(f"### {title}\n\n{report([r for r in rows if r.city in chosen], chosen)}\n")
    cells = {name: len(m.cells) for name, m in maps.items()}
    run.save({"queries": queries, "cells": cells, "rows": [r.to_dict() for r in rows]})
