"""Does time grow with the map? Table IV of the paper: 447 to 1,000,000 cells, with candidates and without.

Parts of Vancouver around one held-out place, the whole of it, and copies of it in memory. The
queries come from the smallest part and are the same at every size. With and without candidates, GOTLoc
as printed ranks the cells.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np

from placegraph.core.geometry import Floats
from placegraph.outdoor.city import CityMap
from placegraph_lab.tables import runner as lab
from placegraph_lab.tables.outdoor.extracts import (
    CITY,
    busiest_tile,
    crop,
    extract_of,
    in_held_out_tiles,
    tile,
)
from placegraph_lab.tables.outdoor.matchers import (
    STAGES,
    LocateMatcher,
    ask,
    cell_centers,
    found_within,
    medians,
    run,
    slope,
)
from placegraph_lab.tables.outdoor.metrics import score
from placegraph_lab.tables.outdoor.queries import Query, make_queries
from placegraph_lab.tables.runner import Column as Col
from placegraph_lab.tables.statistics import peak

PAPER = {447: (1.06, 0.03), 1616: (3.34, 0.07), 3409: (6.67, 0.13), 5225: (10.71, 0.17)}
"""Table IV: seconds without and with candidates, by cells."""
PAPER_RATIO = 71.94  # how much steeper the paper's line is without candidates
LARGER = (52_911, 200_000, 1_000_000)
HIT = 50.0


def resize_city(city: CityMap, cells: int, middle: Floats, seed: int) -> CityMap:
    if cells <= len(city.cells):
        return crop(city, cells, middle)
    copies = round(cells / len(city.cells))
    return tile(city, copies, np.random.default_rng(seed))


def measure(
    city: CityMap, queries: Sequence[Query], *, without: int, candidates: int
) -> dict[str, Any]:
    """Times of one size; `without` says how many queries run without candidates."""
    start = time.perf_counter()
    encoded = city.encoded_as_printed
    store = encoded.store
    prepared = time.perf_counter() - start
    for query in queries[:5]:
        run(encoded, query.text, candidates)
        city.locate(query.text)
    runs = [run(encoded, q.text, candidates) for q in queries]
    slow = [run(encoded, q.text, None) for q in queries[:without]]
    default = score(ask(LocateMatcher(city), city, queries))
    at = cell_centers(city)
    return {
        "cells": len(city.cells),
        "objects": len(city.objects),
        "prepare_s": prepared,
        "vectors": len(store),
        "with_s": medians(runs),
        "without_s": medians(slow) if slow else None,
        "without_queries": len(slow),
        "with_recall": found_within(city, queries, [at[r.rows[0]] for r in runs], HIT),
        "without_recall": found_within(city, queries[:without], [at[r.rows[0]] for r in slow], HIT)
        if slow
        else None,
        "default_p50_s": default.p50,
        "default_p95_s": default.p95,
        "default_recall": default.within[HIT][1],
        "peak_bytes": peak(),
    }


COLUMNS = (
    Col("cells", "cells", 0), Col("paper: without", lambda r: PAPER.get(r["cells"], (None, None))[0], 2, "s"),
    Col("with", lambda r: PAPER.get(r["cells"], (None, None))[1], 2, "s"),
    Col("without candidates", "without_s.total", 1, "ms", 1e3), Col("@1 50 m", "without_recall", lab.share),
    Col("queries", "without_queries", 0), Col("with: all", "with_s.total", 2, "ms", 1e3),
    Col("@1 50 m", "with_recall", lab.share), *(Col(f"{s} [ms]", f"with_s.{s}", 2, "", 1e3) for s in STAGES),
    Col("default, p50", "default_p50_s", 1, "ms", 1e3), Col("p95", "default_p95_s", 1, "ms", 1e3),
    Col("@1 50 m", "default_recall", lab.share), Col("prepared in", "prepare_s", 1, "s"),
    Col("peak", "peak_bytes", 0, "MB", 1e-6),
)  # fmt: skip


@lab.table("GOTLoc, Table IV")
def outdoor_candidates(
    run: lab.Run,
    city: Annotated[str, lab.option(f"City that is cut and copied. {CITY}")] = "vancouver",
    sizes: Annotated[str, lab.option("Cells with commas, rising.")] = "",
    queries: Annotated[int, lab.option("Queries.")] = 200,
    without: Annotated[int, lab.option("Pairs of a size without candidates.")] = 2_000_000,
    candidates: Annotated[int, lab.option("Candidates.")] = 10,
    seed: lab.Seed = 0,
    *,
    quick: lab.Quick = False,
) -> None:
    """Time and recall against the number of cells (447 to 1,000,000), with candidates and without."""
    if quick:
        queries, without = 10, 20_000
    wanted = [int(n) for n in lab.parts(sizes)] or [*PAPER, *(() if quick else LARGER)]
    extract = extract_of(city, run.osm)
    whole = extract.open(run.cache)
    middle = busiest_tile(whole, unseen=extract.is_trained)
    smallest = crop(whole, min(*wanted, len(whole.cells)), middle)
    unseen = in_held_out_tiles(whole)

    def where(lonlat: Floats) -> Any:
        inside = np.array([smallest.cells.at(*at) is not None for at in lonlat.tolist()])
        return inside & unseen(lonlat) if extract.is_trained else inside

    asked = make_queries(
        extract.osm(run.cache), n=queries, seed=seed, anywhere=True, where=where,
        cells=extract.cells_of(smallest),
    )  # fmt: skip
    run.one_core()
    rows = []
    for n in wanted:
        run.log(f"{n:,} cells")
        few = max(1, min(queries, without // n))
        rows.append(
            measure(resize_city(whole, n, middle, seed), asked, without=few, candidates=candidates)
        )
    print(lab.render(COLUMNS, rows))
    found = {}
    if len(small := [r for r in rows if r["cells"] in PAPER and r["without_s"]]) > 1:
        seconds = {"with": "with_s.total", "without": "without_s.total", "default": "default_p50_s"}
        cells = [r["cells"] for r in small]
        found = {k: slope(cells, [lab.lookup(r, s) for r in small]) for k, s in seconds.items()}
        flat = found["with"] <= 0.0  # measured times scatter by more than they grow
        ratio = "flat" if flat else f"{found['without'] / found['with']:,.0f} times"
        print(
            f"\nSlope at the paper's sizes: {1e6 * found['without']:.2f} µs a cell without "
            f"candidates, {1e6 * found['with']:.3f} with them: {ratio} (paper: {PAPER_RATIO} "
            f"times). Default: {1e6 * found['default']:.3f} µs."
        )
    run.save({"paper_s": PAPER, "slopes_s_per_cell": found, "rows": rows})
