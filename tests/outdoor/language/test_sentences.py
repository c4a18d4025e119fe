from __future__ import annotations

import json
import re
from math import degrees, radians
from pathlib import Path
from typing import NamedTuple

import pytest

from placegraph.outdoor.language import describe
from placegraph.outdoor.language.description import LISTENER, SPEAKER, Relation


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
def test_understood(name, least, list_statements):
    found = cases(name)
    assert len(found) >= least
    for case in found:
        read = describe(case.text, heading=case.heading)
        ignored = [f"{i.text}: {i.reason}" for i in read.ignored]
        told = case.text, list_statements(read), ignored, list(read.conflicts)
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
    texts = [s.text for s in description.statements]
    assert texts == ["A bakery is north of me", "a church is south of it"]


@pytest.mark.parametrize(
    ("text", "sigma"),
    [("north of", 0.5), ("north-east of", 0.4), ("due north of", 0.25), ("mostly north of", 0.6)],
)
def test_how_loosely_a_direction_is_meant(text, sigma):
    assert describe(f"I'm {text} a church.").statements[0].bearing_sigma == pytest.approx(sigma)


def test_a_description_becomes_plain_json():
    description = describe("Two benches are 30 m north of me. Blah.")
    assert json.loads(json.dumps(description.to_dict()))["mentions"][2]["count"] == 2


# turns of phrase: what strangers say (turns.txt), and what must be read of it

WINDS = ("north", "northeast", "east", "southeast", "south", "southwest", "west", "northwest")
ALIKE = {
    Relation.NEAR: {Relation.NEAR, Relation.SAME, Relation.ALONG, Relation.INSIDE, Relation.ACROSS},
    Relation.INSIDE: {Relation.INSIDE, Relation.NEAR, Relation.ALONG},
    Relation.ALONG: {Relation.ALONG, Relation.NEAR},
    Relation.VISIBLE: set(Relation) - {Relation.BETWEEN},
}
"""Relations that say as much as the one that is asked for."""
PLACES = ("me", "it", "place", "van", "hotel", "house", "one", "that", "restaurant")


def turns():
    """Sentences of turns.txt, and the lines that say what they mean."""
    text = Path(__file__).with_name("turns.txt").read_text("utf-8")
    for block in re.split(r"\n\s*\n", re.sub(r"(?m)^#.*\n", "", text).strip()):
        sentence, *lines = block.splitlines()
        yield sentence, [line.strip() for line in lines]


def is_read(line, description):
    """Whether a line is so: "relation source > targets", then bearing, distance, no, maybe."""
    relation, _, rest = line.removeprefix("not ").partition(" ")
    relation = Relation(relation)
    source, _, rest = rest.partition(">")
    words, extra = rest.split(), []
    while words and (words[-1] in (*WINDS, "no", "maybe") or re.fullmatch(r"\d+m", words[-1])):
        extra.append(words.pop())
    targets = [t.strip() for t in " ".join(words).split(",") if t.strip()]
    found = False
    for s in description.statements:
        ends = [s.target] if s.target2 is None else [s.target, s.target2]
        orders = [(s.source, ends)]
        if relation is not Relation.DIRECTION:  # in either order, where that is the same
            between = relation is Relation.BETWEEN
            orders.append((s.source, ends[::-1]) if between else (s.target, [s.source]))
        found = found or (
            s.relation in ALIKE.get(relation, {relation})
            and s.negated == ("no" in extra)
            and ("maybe" not in extra or s.certainty < 0.8)
            and all(measures(s, word) for word in extra)
            and any(
                names(source.strip(), one, description)
                and all(names(t, n, description) for t, n in zip(targets, nodes, strict=False))
                for one, nodes in orders
            )
        )
    return found != line.startswith("not ")


def measures(s, word):
    if word in WINDS:
        off = (degrees(s.bearing or 0.0) - 45.0 * WINDS.index(word) + 180.0) % 360.0 - 180.0
        return s.bearing is not None and abs(off) < 30.0
    if word in ("no", "maybe"):
        return True
    return s.distance is not None and abs(s.distance - float(word[:-1])) < 1.0


def names(word, node, description):
    at = {s.target for s in description.statements if s.relation is Relation.SAME}
    if word in PLACES and node in {SPEAKER, *at}:
        return True
    if word == "you":
        return node == LISTENER
    mention = description.mentions[node]
    return word.lower() in f"{mention.words} {mention.name}".lower()


TURNS = list(turns())


def test_turns_of_phrase_are_read():
    for sentence, lines in TURNS[::2]:
        description = describe(sentence)
        assert [line for line in lines if not is_read(line, description)] == [], sentence


def test_most_turns_of_phrase_are_read_that_nobody_looked_at():
    read = [is_read(line, describe(said)) for said, lines in TURNS[1::2] for line in lines]
    assert sum(read) >= 0.75 * len(read)
