"""Every language's own examples, which say in its table what they mean; and how one is recognised."""

from __future__ import annotations

import re
import tomllib
from math import degrees, radians
from pathlib import Path

import pytest

from placegraph.outdoor.language import describe
from placegraph.outdoor.language.description import LISTENER, SPEAKER
from placegraph.outdoor.language.languages.language import tables
from placegraph.outdoor.language.vocabulary import Vocabulary

MEANING = re.compile(
    r"(?P<no>not )?(?P<relation>\w+)\((?P<nodes>[^)]*)\)(?: (?P<bearing>\d+)°)?(?: (?P<far>\d+)m)?"
)
SURE = 0.5
"""A thing's word must have the meant label at least with this weight."""


HAND = Path(__file__).parent / "hand"
"""Sentences that people wrote before they looked at a table, as "text @heading => meaning | meaning"."""


def examples():
    for file in sorted(HAND.glob("*.txt")):
        for line in file.read_text("utf-8").splitlines():
            text, _, means = line.partition(" => ")
            text, _, heading = text.partition(" @")
            example = {"text": text, "means": means.split(" | ")}
            if heading:
                example["heading"] = float(heading)
            yield pytest.param(file.stem, example, id=f"{file.stem}: {text}")
    for code, table in sorted(tables().items()):
        for example in tomllib.loads(table.read_text("utf-8")).get("examples", ()):
            yield pytest.param(code, example, id=f"{code}: {example['text']}")


def means(mention, word):
    """Whether a mention is what an example means: a "name" in quotes, or an English word."""
    if word[0] == '"':
        return mention.name.casefold() == word.strip('"').casefold()
    (meant, *_) = Vocabulary.default().senses(word)
    return any(s.label == meant.label and s.weight >= SURE for s in mention.senses)


def is_said(statement, meaning, description):
    told = MEANING.fullmatch(meaning)
    assert told, f"{meaning!r} is no meaning: write as 'direction(bakery, I) 90° 50m'"
    nodes = [n for n in (statement.source, statement.target, statement.target2) if n is not None]
    words = told["nodes"].split(", ")
    return (
        statement.relation == told["relation"]
        and statement.negated == bool(told["no"])
        and (None if statement.bearing is None else round(degrees(statement.bearing)) % 360)
        == (None if told["bearing"] is None else int(told["bearing"]))
        and (None if statement.distance is None else round(statement.distance))
        == (None if told["far"] is None else int(told["far"]))
        and len(nodes) == len(words)
        and all(
            node == {"I": SPEAKER, "you": LISTENER}[word]
            if word in ("I", "you")
            else node > LISTENER and means(description.mentions[node], word)
            for node, word in zip(nodes, words, strict=True)
        )
    )


@pytest.mark.parametrize(("code", "example"), list(examples()))
def test_examples(code, example):
    heading = example.get("heading")
    description = describe(example["text"], heading=None if heading is None else radians(heading))
    assert description.language == code
    left = list(description.statements)
    missing = []
    for meaning in example["means"]:
        found = next((s for s in left if is_said(s, meaning, description)), None)
        if found is None:
            missing.append(meaning)
        else:
            left.remove(found)
    surplus = [(s, [m.words for m in description.mentions]) for s in left]
    assert (missing, surplus) == ([], []), description.ignored
