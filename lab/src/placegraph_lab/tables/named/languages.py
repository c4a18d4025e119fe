"""Is every language read as well as English? The same statements, said in each.

    placegraph-lab table languages

Frames and words are those of the languages' own tables; their nouns stand in the form of the
dictionary, so that some sentences are worse grammar than people's. Prints Markdown, writes JSON.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated

import numpy as np

from placegraph.errors import PlacegraphError
from placegraph.outdoor.city import CityMap
from placegraph.outdoor.language.languages import Language, codes, english, language
from placegraph.outdoor.language.vocabulary import Vocabulary
from placegraph_lab.tables.outdoor.extracts import EXTRACTS
from placegraph_lab.tables.outdoor.metrics import HIT, distances, positions
from placegraph_lab.tables.outdoor.queries import Query, Teller, load, make_queries
from placegraph_lab.tables.runner import Quick, Run, Seed, markdown, option, parts, share, table

BEARINGS = {"north": "0", "east": "90", "south": "180", "west": "270"}
_SLOT = re.compile(r"\{(?:(\w+):)?(\w+)\}")
ENGLISH = {"direction": "The {source} is {direction} of the {target}.", "0": "north"}


@dataclass(frozen=True)
class Tongue:
    """Says statements in a language."""

    code: str
    words: Vocabulary

    @cached_property
    def table(self) -> Language:
        return language(self.code)

    @cached_property
    def things(self) -> dict[str, str]:
        found: dict[str, str] = {}
        for meaning, said in self.table.things.items():
            for sense in self.words.senses(meaning)[:1]:
                found.setdefault(sense.label, said[0])
        return found

    def thing(self, label: str) -> str:
        """Word for a label: of the table, of the presets, or else the tag itself."""
        if self.code == "en":
            return self.words.spoken(label)
        fallback = self.words.spoken(label)
        key, _, value = label.partition("=")
        if own := self.things.get(label) or self.things.get(f"{key}=*" if key == value else label):
            return own
        for code in (self.code, *VARIANTS.get(self.code, ())):
            word = self.words.spoken(label, language=code)
            if word != fallback:
                return word
        return label

    def direction(self, name: str) -> str:
        """First way to say a direction, or the one that the frame wants."""
        bearing = BEARINGS[name]
        if self.code == "en":
            return name
        listed = self.table.say.get("directions", {})
        first = next(p for p in self.table.said_of_compass(int(bearing)))
        return str(listed.get(bearing, first))

    def say(self, query: Query, labels: dict[str, str]) -> str:
        """Text of a query whose words are tag values, with their labels."""
        say = self.table.say or ENGLISH
        told = []
        for s in query.said:
            words = {
                "source": self.thing(labels[s.source]),
                "target": self.thing(labels[s.target]),
                "direction": self.direction(s.direction),
            }

            def slot(match: re.Match[str], words: dict[str, str] = words) -> str:
                pattern = str(say.get(match[1], "{}")) if match[1] else "{}"
                return pattern.replace("{}", words[match[2]])

            text = _SLOT.sub(slot, str(say["direction"]))
            told.append(text if "=" in text.split()[0] else text[0].upper() + text[1:])
        return " ".join(told)


VARIANTS = {
    "zh": ("zh-CN", "zh-TW"),
    "pt": ("pt-BR",),
}  # how the presets call varieties of a language


def spoken() -> tuple[str, ...]:
    """Codes of the languages that say how a statement is said; English first."""
    return ("en", *[code for code in codes() if language(code).say.get("direction")])


def told(path: Path, n: int, seed: int) -> Iterator[tuple[str, list[tuple[str, Query]]]]:
    """Every language with the texts of the same `n` queries of an extract."""
    queries = make_queries(path, n=n, seed=seed)
    teller = Teller(load(path), "none", 6, "nearest", same_label=False)
    words = Vocabulary.default()
    labels = [{k: f"{v}={k}" for k, v in teller.keys(q.said).items()} for q in queries]
    for code in spoken():
        tongue = Tongue(code, words)
        yield code, [(tongue.say(q, named), q) for q, named in zip(queries, labels, strict=True)]


def name(code: str) -> str:
    return english().name if code == "en" else language(code).name


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
