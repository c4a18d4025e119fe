"""Query texts said in other languages: the same statements, by the frame and the words of a table."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from placegraph.outdoor.language.languages import Language, codes, english, language
from placegraph.outdoor.language.vocabulary import Vocabulary
from placegraph_lab.tables.outdoor.queries import Query, Teller, load, make_queries

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
        """The language's table."""
        return language(self.code)

    @cached_property
    def things(self) -> dict[str, str]:
        """The table's own first word for a label."""
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


VARIANTS = {"zh": ("zh-CN", "zh-TW"), "pt": ("pt-BR",)}
"""How the presets call varieties of a language."""


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
    """A language's own name."""
    return english().name if code == "en" else language(code).name
