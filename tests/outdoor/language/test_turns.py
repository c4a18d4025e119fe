"""Turns of phrase: what strangers say (turns.txt), and what must be read of it."""

from __future__ import annotations

import re
from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from placegraph.outdoor.language import describe
from placegraph.outdoor.language.description import LISTENER, SPEAKER, Relation

if TYPE_CHECKING:
    from collections.abc import Iterator

    from placegraph.outdoor.language.description import Description, Statement

WINDS = ("north", "northeast", "east", "southeast", "south", "southwest", "west", "northwest")
ALIKE = {
    Relation.NEAR: {Relation.NEAR, Relation.SAME, Relation.ALONG, Relation.INSIDE, Relation.ACROSS},
    Relation.INSIDE: {Relation.INSIDE, Relation.NEAR, Relation.ALONG},
    Relation.ALONG: {Relation.ALONG, Relation.NEAR},
    Relation.VISIBLE: set(Relation) - {Relation.BETWEEN},
}
"""Relations that say as much as the one that is asked for."""


class Meaning(NamedTuple):
    """A statement that must be read, or must not."""

    relation: Relation
    source: str
    targets: list[str]
    extra: list[str]
    wanted: bool
    line: str

    def is_read(self, said: Description) -> bool:
        """Whether a statement of the description says it, in either order where that is the same."""
        return any(
            self._says(s, said, source, targets)
            for s in said.statements
            for source, targets in self._orders(s)
        )

    def _orders(self, s: Statement) -> Iterator[tuple[int, list[int]]]:
        ends = [s.target] if s.target2 is None else [s.target, s.target2]
        yield s.source, ends
        if self.relation is Relation.BETWEEN:
            yield s.source, ends[::-1]
        elif self.relation is not Relation.DIRECTION:
            yield s.target, [s.source]

    def _says(self, s: Statement, said: Description, source: int, targets: list[int]) -> bool:
        return (
            s.relation in ALIKE.get(self.relation, {self.relation})
            and s.negated == ("no" in self.extra)
            and ("maybe" not in self.extra or s.certainty < 0.8)
            and all(self._measures(s, word) for word in self.extra)
            and _means(self.source, source, said)
            and all(
                _means(word, node, said) for word, node in zip(self.targets, targets, strict=False)
            )
        )

    def _measures(self, s: Statement, word: str) -> bool:
        if word in WINDS:
            off = (degrees(s.bearing or 0.0) - 45.0 * WINDS.index(word) + 180.0) % 360.0 - 180.0
            return s.bearing is not None and abs(off) < 30.0
        if re.fullmatch(r"\d+m", word):
            return s.distance is not None and abs(s.distance - float(word[:-1])) < 1.0
        return word in ("no", "maybe")


def _means(word: str, node: int, said: Description) -> bool:
    if word in ("me", "it", "place", "van", "hotel", "house", "one", "that", "restaurant"):
        at = {s.target for s in said.statements if s.relation is Relation.SAME}
        if node in {SPEAKER, *at}:
            return True
    if word == "you":
        return node == LISTENER
    mention = said.mentions[node]
    return word.lower() in f"{mention.words} {mention.name}".lower()


def meanings() -> Iterator[tuple[str, list[Meaning]]]:
    """Sentences of turns.txt, and what they mean."""
    text = Path(__file__).with_name("turns.txt").read_text("utf-8")
    for block in re.split(r"\n\s*\n", re.sub(r"(?m)^#.*\n", "", text).strip()):
        sentence, *lines = block.splitlines()
        yield sentence, [_meaning(line.strip()) for line in lines]


def _meaning(line: str) -> Meaning:
    wanted, rest = not line.startswith("not "), line.removeprefix("not ")
    relation, _, rest = rest.partition(" ")
    source, _, rest = rest.partition(">")
    words, extra = rest.split(), []
    while words and (words[-1] in (*WINDS, "no", "maybe") or re.fullmatch(r"\d+m", words[-1])):
        extra.append(words.pop())
    targets = [t.strip() for t in " ".join(words).split(",") if t.strip()]
    return Meaning(Relation(relation), source.strip(), targets, extra, wanted, line)


TURNS = list(meanings())


def test_turns_of_phrase_are_read() -> None:
    for sentence, lines in TURNS[::2]:
        said = describe(sentence)
        missed = [m.line for m in lines if m.is_read(said) != m.wanted]
        assert not missed, [(s.relation.value, s.source, s.target) for s in said.statements]


def test_most_turns_of_phrase_are_read_that_nobody_looked_at() -> None:
    read = [m.is_read(describe(said)) == m.wanted for said, lines in TURNS[1::2] for m in lines]
    assert sum(read) >= 0.75 * len(read)
