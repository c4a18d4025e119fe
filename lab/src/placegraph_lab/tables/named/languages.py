"""Is every language read as well as English? The same statements, said in each.

Frames and words are those of the languages' own tables; their nouns stand in the form of the
dictionary, so that some sentences are worse grammar than people's.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from placegraph.errors import PlacegraphError
from placegraph.outdoor.city import CityMap
from placegraph.outdoor.language.languages import Language, codes, english, language
from placegraph.outdoor.language.vocabulary import Vocabulary
from placegraph_lab.tables.outdoor.extracts import EXTRACTS, open_city
from placegraph_lab.tables.outdoor.metrics import HIT, distances, positions
from placegraph_lab.tables.outdoor.queries import Query, Teller, load, make_queries
from placegraph_lab.tables.runner import Column as Col
from placegraph_lab.tables.runner import Quick, Run, Seed, option, parts, render, share, table

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
    def words_of_labels(self) -> dict[str, str]:
        found: dict[str, str] = {}
        for meaning, said in self.table.things.items():
            for sense in self.words.senses(meaning)[:1]:
                found.setdefault(sense.label, said[0])
        return found

    def word(self, label: str) -> str:
        """Word for a label: of the table, of the presets, or else the tag itself."""
        if self.code == "en":
            return self.words.name_label(label)
        fallback = self.words.name_label(label)
        key, _, value = label.partition("=")
        if own := self.words_of_labels.get(label) or self.words_of_labels.get(
            f"{key}=*" if key == value else label
        ):
            return own
        for code in (self.code, *VARIANTS.get(self.code, ())):
            word = self.words.name_label(label, language=code)
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

    def translate(self, query: Query, labels: dict[str, str]) -> str:
        """Text of a query whose words are tag values, with their labels."""
        say = self.table.say or ENGLISH
        told = []
        for s in query.statements:
            words = {
                "source": self.word(labels[s.source]),
                "target": self.word(labels[s.target]),
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


def list_languages() -> tuple[str, ...]:
    """Codes of the languages that say how a statement is said; English first."""
    return ("en", *[code for code in codes() if language(code).say.get("direction")])


def translate_queries(
    path: Path, n: int, seed: int
) -> Iterator[tuple[str, list[tuple[str, Query]]]]:
    """Yield every language with the texts of the same `n` queries of an extract."""
    queries = make_queries(path, n=n, seed=seed)
    teller = Teller(load(path), "none", 6)
    words = Vocabulary.default()
    labels = [{k: f"{v}={k}" for k, v in teller.keys(q.statements).items()} for q in queries]
    for code in list_languages():
        tongue = Tongue(code, words)
        yield (
            code,
            [(tongue.translate(q, named), q) for q, named in zip(queries, labels, strict=True)],
        )


def name(code: str) -> str:
    return english().name if code == "en" else language(code).name


def score_texts(city: CityMap, code: str, texts: list[tuple[str, Query]]) -> dict[str, float]:
    """Shares of texts whose language is recognised, and of places found within 50 m."""
    off, recognised, ok = np.full(len(texts), np.inf), [], np.zeros(len(texts), bool)
    for i, (text, query) in enumerate(texts):
        try:
            estimate = city.locate(text)
        except PlacegraphError:
            recognised.append(False)
            continue
        if estimate.best is not None:
            off[i] = distances(positions(estimate)[:1], query.longitude, query.latitude)[0]
        read = estimate.understood
        recognised.append(read is not None and read.language == code)
        ok[i] = estimate.status.name == "OK"
    return {
        "recognised": float(np.mean(recognised)),
        "recall": float((off <= HIT).mean()),
        "ok": float(ok.mean()),
        "wrong_of_ok": float((off[ok] > HIT).mean()) if ok.any() else 0.0,
    }


COLUMNS = (
    Col("", "city"), Col("", lambda r: f"{name(r['language'])} ({r['language']})"),
    Col("recognised", "recognised", share), Col("within 50 m", "recall", share),
    Col("of English", "of_english", share), Col("`OK`", "ok", share),
    Col("of these wrong", "wrong_of_ok", share),
)  # fmt: skip


@table()
def languages(
    run: Run,
    cities: Annotated[str, option("Towns, by commas.")] = "vancouver,monaco",
    texts: Annotated[int, option("Texts a town and language.")] = 100,
    seed: Seed = 0,
    *,
    quick: Quick = False,
) -> None:
    """Reading rate of the same statements in each language, against English."""
    rows: list[dict[str, Any]] = []
    for town in parts(cities):
        city = open_city(town, run.osm, run.cache)
        queries = translate_queries(run.osm / EXTRACTS[town], 20 if quick else texts, seed)
        found = {code: score_texts(city, code, of) for code, of in queries}
        english_recall = max(found["en"]["recall"], 1e-9)
        rows += [
            {"city": town, "language": code} | row | {"of_english": row["recall"] / english_recall}
            for code, row in found.items()
        ]
    print(render(COLUMNS, rows))
    run.save({"rows": rows})
