"""Reading of every language, beside English and beside names alone.

The same statements are said in each language. Frames and words are those of the languages' own tables;
their nouns stand in the form of the dictionary, so that some sentences are worse grammar than people's.
Sentences that were written by hand for places of a map (``outdoor/tongues.tsv``) are read twice: by
the grammar, and by names and kinds of things alone.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np

from placegraph.errors import PlacegraphError
from placegraph.outdoor.city import CityMap
from placegraph.outdoor.language import describe
from placegraph.outdoor.language.languages import Language, codes, english, language
from placegraph.outdoor.language.vocabulary import Vocabulary
from placegraph_lab.tables.outdoor.extracts import EXTRACTS, Extract, open_city
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


PLACED = resources.files("placegraph_lab.tables.outdoor") / "tongues.tsv"
NEAR, BLOCK = 100.0, 250.0
"""A place is found within these distances [m]."""


class PlacedText(NamedTuple):
    """A sentence that somebody wrote for a place of a map."""

    language: str
    map: str
    longitude: float
    latitude: float
    text: str


def read_placed() -> dict[tuple[str, str], list[PlacedText]]:
    """Read the sentences written by hand, by language and map; the odd ones of each tune."""
    found: dict[tuple[str, str], list[PlacedText]] = {}
    for line in PLACED.read_text("utf-8").splitlines()[1:]:
        code, extract, longitude, latitude, text = line.split("\t")
        row = PlacedText(code, extract, float(longitude), float(latitude), text)
        found.setdefault((code, extract), []).append(row)
    return found


def score_placed(city: CityMap, texts: Sequence[PlacedText], *, grammar: bool) -> dict[str, float]:
    """Shares of places found from texts, by the grammar or by names and kinds alone."""
    off, ok = np.full(len(texts), np.inf), np.zeros(len(texts), bool)
    for i, row in enumerate(texts):
        read = describe(
            row.text, vocabulary=city.vocabulary, names=city.name_index,
            block_length=city.block_length, grammar=grammar,
        )  # fmt: skip
        estimate = city.locate(read)
        if estimate.best is not None:
            off[i] = distances(positions(estimate)[:1], row.longitude, row.latitude)[0]
        ok[i] = estimate.status.name == "OK"
    return {
        "near": float((off <= NEAR).mean()),
        "block": float((off <= BLOCK).mean()),
        "ok": float(ok.mean()),
        "wrong_of_ok": float((off[ok] > BLOCK).mean()) if ok.any() else 0.0,
    }


def score_all_placed(osm: Path, cache: Path) -> Iterator[dict[str, Any]]:
    """Yield rows of the odd and the even sentences of each language, with and without grammar."""
    for (code, extract), texts in read_placed().items():
        city = Extract(extract, osm / f"{extract}.osm.pbf").open(cache)
        for part, rows in (("odd", texts[::2]), ("even", texts[1::2])):
            for reader, grammar in (("grammar", True), ("names alone", False)):
                key = {"language": code, "city": extract, "part": part, "reader": reader}
                yield key | {"texts": len(rows)} | score_placed(city, rows, grammar=grammar)


PLACED_COLUMNS = (
    Col("", lambda r: f"{name(r['language'])} ({r['language']})"), Col("map", "city"),
    Col("sentences", "part"), Col("", "texts"), Col("read by", "reader"),
    Col("within 100 m", "near", share), Col("250 m", "block", share), Col("`OK`", "ok", share),
    Col("of these wrong", "wrong_of_ok", share),
)  # fmt: skip


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
    seed: Seed = 0,
    *,
    quick: Quick = False,
) -> None:
    """Reading rate of the same statements in each language, against English."""
    rows: list[dict[str, Any]] = []
    for town in parts(cities):
        city = open_city(town, run.osm, run.cache)
        queries = translate_queries(run.osm / EXTRACTS[town], 20 if quick else 100, seed)
        found = {code: score_texts(city, code, of) for code, of in queries}
        english_recall = max(found["en"]["recall"], 1e-9)
        rows += [
            {"city": town, "language": code} | row | {"of_english": row["recall"] / english_recall}
            for code, row in found.items()
        ]
    print(render(COLUMNS, rows))
    placed = [] if quick else list(score_all_placed(run.osm, run.cache))
    print(render(PLACED_COLUMNS, placed))
    run.save({"rows": rows, "placed": placed})
