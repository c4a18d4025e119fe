from __future__ import annotations

import unicodedata
from contextlib import suppress
from math import degrees

import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.errors import DescriptionError
from placegraph.language.text import LONGEST_TEXT
from placegraph.outdoor.language import describe, normalise, tokens
from placegraph.outdoor.language.description import LISTENER, Relation

COMPASS = {
    "north": 0, "northeast": 45, "north-east": 45, "east": 90, "southeast": 135, "south": 180,
    "south-west": 225, "southwest": 225, "west": 270, "northwest": 315,
}  # fmt: skip
LABELS = [
    "bench", "steps", "residential", "bicycle_parking", "fast_food", "grass", "tree", "stop",
    "traffic signals", "access road", "block of flats", "art", "Ripley's_Aquarium_of_Canada",
    "Café_de_Paris", "I_♥_Hats", "CNR_/_BCR", "St._Mary's_Church", "7-Eleven_(closed)",
    "17e_Avenue", "479._Sokak", "Is_This_A_Shop?_Yes", "Ripley's Aquarium of Canada", "Rue Grimaldi",
    "West North Ave", "Hôtel Port Palace",
]  # fmt: skip
TALK = """
north south-east of the a an bakery church is are on in at near between and , . ; : you me my it its
there meet go head past across where with street Penn Avenue 16th zorp blocks 30 m left right not if
until river corner next to that no two several this another from I'm don't you've gone too far while
facing behind down over end side let's see have called
"""
WORDS = TALK.split()

sentences = st.tuples(
    st.sampled_from(LABELS), st.sampled_from(sorted(COMPASS)), st.sampled_from(LABELS)
)


def label(description, n):
    mention = description.mentions[n]
    return normalise(mention.name or mention.words).removeprefix("the ")


@given(st.lists(sentences, min_size=1, max_size=8))
def test_the_papers_form_comes_back(list_statements):
    text = " ".join(f"The {a} is on the {d} of the {b}." for a, d, b in list_statements)
    found = [
        (label(d, s.source), round(degrees(s.bearing)), label(d, s.target))
        for d in [describe(text)]
        for s in d.statements
    ]
    assert found == [(normalise(a), COMPASS[d], normalise(b)) for a, d, b in list_statements]


@given(st.lists(sentences, min_size=1, max_size=6))
def test_things_of_one_label_are_one_thing(list_statements):
    text = " ".join(
        f"The {a} is on the {d} of the {b}."
        for a, d, b in list_statements
        if normalise(a) != normalise(b)
    )
    if text:
        mentions = describe(text).mentions[2:]
        names = [normalise(m.name or m.words).removeprefix("the ") for m in mentions]
        assert len(names) == len(set(names))


@given(
    st.sampled_from(sorted(COMPASS)),
    st.sampled_from(["bakery", "church", "tram stop", "park"]),
    st.sampled_from(
        ["A {thing} is {d} of me.", "There is a {thing} to my {d}.", "To the {d} there's a {thing}.",
         "I see a {thing} to the {d}.", "{d} of here is a {thing}.", "The {thing} is {d}."]
    ),
)  # fmt: skip
def test_the_speaker_is_the_centre(direction, thing, form):
    (statement,) = describe(form.format(thing=thing, d=direction)).statements
    assert statement.relation is Relation.DIRECTION
    assert (statement.source, statement.target) == (2, 0)
    assert round(degrees(statement.bearing)) == COMPASS[direction]


@given(st.sampled_from(sorted(COMPASS)), st.integers(1, 900))
def test_distances_come_back(direction, n):
    (statement,) = describe(f"I'm {n} m {direction} of a church.").statements
    assert statement.distance == pytest.approx(n)
    assert round(degrees(statement.bearing)) == COMPASS[direction]


def sound(description):
    """Check what must hold of every description."""
    n = len(description.mentions)
    assert [m.id for m in description.mentions] == list(range(n))
    for s in description.statements:
        nodes = [s.source, s.target] + ([] if s.target2 is None else [s.target2])
        assert all(0 <= node < n for node in nodes)
        assert s.source != s.target
        assert 0.0 < s.certainty <= 1.0
        assert (s.bearing is not None) == (s.relation is Relation.DIRECTION)
        assert s.bearing is None or 0.0 <= s.bearing < 6.2832
        assert s.far or LISTENER not in (s.source, s.target)
        assert s.relation is not Relation.BETWEEN or s.target2 not in (None, s.target)
        assert s.text in description.text
    assert description.statements or description.ignored


@given(st.text(max_size=300))
def test_any_text_is_read_or_refused(text):
    if text.strip() and not any(unicodedata.category(c) in ("Cc", "Cs") for c in text):
        sound(describe(text))
    else:
        with suppress(DescriptionError):
            sound(describe(text))


@given(st.lists(st.sampled_from(WORDS), min_size=1, max_size=60), st.none() | st.floats(-7, 7))
def test_any_salad_of_known_words_is_read(words, heading):
    sound(describe(" ".join(words), heading=heading))


@given(st.text(st.characters(codec="utf-8"), max_size=60))
def test_normal_form_is_stable(text):
    assert tokens(normalise(text)) == tokens(text)


PIECES = [
    "a ", "north of ", "the bakery and ", "Name ", "(", ". ", "1 m ", "not ",
    "The zorp is north of me. ", "The bench is on the north of the ",
]  # fmt: skip
MORE = [
    "x", "a_", "a'", "1-", "it's ", "half a ", "between ", "a a of ", "two and a half blocks ",
    "Another bench is north of me. ",
]  # fmt: skip


@pytest.mark.parametrize(
    "piece", [*PIECES, *[pytest.param(piece, marks=pytest.mark.all) for piece in MORE]]
)
def test_long_texts_are_read_to_their_end(piece):
    sound(describe((piece * LONGEST_TEXT)[:LONGEST_TEXT]))
