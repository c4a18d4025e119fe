"""Is every language read as well as English? The same statements, said in each.

    placegraph-lab table languages

Frames and words are those of the languages' own tables; their nouns stand in the form of the
dictionary, so that some sentences are worse grammar than people's. Prints Markdown, writes JSON.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np

from placegraph.errors import PlacegraphError
from placegraph.outdoor.city import CityMap
from placegraph_lab.tables.outdoor.extracts import EXTRACTS
from placegraph_lab.tables.outdoor.languages import name, told
from placegraph_lab.tables.outdoor.metrics import HIT, distances, positions
from placegraph_lab.tables.outdoor.queries import Query
from placegraph_lab.tables.run import Quick, Run, Seed, option, parts, table
from placegraph_lab.tables.tables import markdown, share


def judged(city: CityMap, code: str, texts: list[tuple[str, Query]]) -> dict[str, float]:
    """Shares of texts whose language is recognised, and of places found within 50 m."""
    found, recognised, sure, wrong = [], [], 0, 0
    for text, query in texts:
        try:
            estimate = city.locate(text)
        except PlacegraphError:
            found.append(np.inf)
            recognised.append(False)
            continue
        off = np.inf
        if estimate.best is not None:
            off = float(distances(positions(estimate)[:1], query.longitude, query.latitude)[0])
        found.append(off)
        read = estimate.understood
        recognised.append(read is not None and read.language == code)
        if estimate.status.name == "OK":
            sure, wrong = sure + 1, wrong + (off > HIT)
    return {
        "recognised": float(np.mean(recognised)),
        "recall": float(np.mean(np.array(found) <= HIT)),
        "ok": sure / len(texts),
        "wrong_of_ok": wrong / sure if sure else 0.0,
    }


@table()
def languages(
    run: Run,
    cities: Annotated[str, option("Towns, by commas.")] = "vancouver,monaco",
    texts: Annotated[int, option("Texts a town and language.")] = 100,
    seed: Seed = 0,
    *,
    quick: Quick = False,
) -> None:
    """Is every language read as well as English? The same statements, said in each."""
    import placegraph as pg

    rows = []
    run.cache.mkdir(parents=True, exist_ok=True)
    towns = parts(cities)
    for town in towns:
        source, built = run.osm / EXTRACTS[town], run.cache / f"{town}.city"
        if not built.exists():
            pg.build_city(source, built)
        city = pg.CityMap.open(built)
        found = {
            c: judged(city, c, asked) for c, asked in told(source, 20 if quick else texts, seed)
        }
        for code, row in found.items():
            row["of_english"] = row["recall"] / max(found["en"]["recall"], 1e-9)
            rows.append((town, code, row))
    header = ["", "", "recognised", "within 50 m", "of English", "`OK`", "of these wrong"]
    shown = [
        [town, f"{name(code)} ({code})",
         *(share(row[k]) for k in ("recognised", "recall", "of_english", "ok", "wrong_of_ok"))]
        for town, code, row in rows
    ]  # fmt: skip
    print(markdown(header, shown))
    run.save({"rows": [{"city": town, "language": code} | row for town, code, row in rows]})
