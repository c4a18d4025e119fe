"""Tables of sentences: what is understood of them, and what is left out."""

from __future__ import annotations

from math import radians
from pathlib import Path
from typing import NamedTuple

import pytest

from placegraph.outdoor.language import describe


class Case(NamedTuple):
    text: str
    heading: float | None
    said: list[str]
    ignored: list[str]
    conflicts: list[str]


def cases(name):
    found = []
    for line in Path(__file__).with_name(name).read_text("utf-8").splitlines():
        if not line.strip() or line.startswith("#"):
            continue
        if line[0] != " ":
            text, bar, heading = line.partition(" | ")
            found.append(Case(text, radians(float(heading)) if bar else None, [], [], []))
            continue
        mark, rest = line.strip()[:2], line.strip()[2:]
        if mark == "- ":
            found[-1].ignored.append(rest)
        elif mark == "! ":
            found[-1].conflicts.append(rest)
        else:
            found[-1].said.append(line.strip())
    return found


@pytest.mark.parametrize(("name", "least"), [("sentences.txt", 110), ("human.txt", 10)])
def test_understood(name, least, said):
    found = cases(name)
    assert len(found) >= least
    for case in found:
        read = describe(case.text, heading=case.heading)
        ignored = [f"{i.text}: {i.reason}" for i in read.ignored]
        told = case.text, said(read), ignored, list(read.conflicts)
        assert told == (case.text, case.said, case.ignored, case.conflicts)


@pytest.mark.parametrize(
    ("text", "labels"),
    [
        ("A bakery is north of me.", "shop=bakery"),
        ("Eine Bäckerei is north of me.", "shop=bakery"),
        ("The bakrey is north of me.", "shop=bakery"),
        ("An amenity=bench is north of me.", "amenity=bench"),
        ("The bicycle_parking is north of me.", "amenity=bicycle_parking"),
        ("The alcohol shop is north of me.", "shop=alcohol"),
        ("Two bus stops are north of me.", "highway=bus_stop"),
        ("There are steps north of me.", "highway=steps"),
    ],
)
def test_what_words_stand_for(text, labels):
    thing = describe(text).mentions[2]
    assert labels in {sense.label for sense in thing.senses}


def test_counts_and_articles():
    things = describe("Two benches, several trees and the church are north of me.").mentions[2:]
    assert [(t.count, t.definite) for t in things] == [(2, False), (3, False), (None, True)]


def test_a_name_keeps_a_weaker_sense_of_its_noun():
    thing = describe("I'm next to the Dollar Tree.").mentions[2]
    assert thing.name == "Dollar Tree"
    assert {s.label: s.weight for s in thing.senses}["natural=tree"] <= 0.5


def test_the_same_thing_is_one_node_and_another_is_not():
    text = (
        "The road is north of me. The road is east of a bench. A bench is south of me."
        " The same bench is west of a tree. Another bench is west of the road."
    )
    assert [m.words for m in describe(text).mentions[2:]] == [
        "The road", "a bench", "A bench", "a tree", "Another bench",
    ]  # fmt: skip


def test_adjectives_tell_things_apart():
    text = "A red house is north of me. A grey house is south of me. The red house is old."
    houses = describe(text).mentions[2:]
    assert [m.words for m in houses] == ["A red house", "A grey house"]


def test_statements_quote_the_text():
    description = describe("A bakery is north of me, and a church is south of it.")
    assert [s.text for s in description.statements] == [
        "A bakery is north of me",
        "a church is south of it",
    ]


@pytest.mark.parametrize(
    ("text", "sigma"),
    [("north of", 0.5), ("north-east of", 0.4), ("due north of", 0.25), ("mostly north of", 0.6)],
)
def test_how_loosely_a_direction_is_meant(text, sigma):
    assert describe(f"I'm {text} a church.").statements[0].bearing_sigma == pytest.approx(sigma)


def test_a_description_becomes_plain_json():
    import json

    description = describe("Two benches are 30 m north of me. Blah.")
    assert json.loads(json.dumps(description.to_dict()))["mentions"][2]["count"] == 2
