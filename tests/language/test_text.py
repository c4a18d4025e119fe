from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.errors import DescriptionError
from placegraph.language.grammar import Chunk, Clause, IslandParser
from placegraph.language.text import Phrases, Terminal, check_text, metres, scan_text

GRAMMAR = """
pair: A B
%declare A B
"""


BUILD = {"pair": lambda children: Clause("pair", tuple(c.words for c in children))}
ISLANDS = IslandParser(GRAMMAR, "pair", BUILD, ("X",))


def parsed(types):
    chunks = [Chunk(t, i, i + 1, f"{t}{i}") for i, t in enumerate(types)]
    return [
        (clause.before, "".join(c.type for c in left_out))
        for clause, left_out in ISLANDS.parse(chunks)
    ]


@pytest.mark.parametrize(
    ("types", "found"),
    [
        ("AB", [(("A0", "B1"), "")]), ("AXB", [(("A0", "B2"), "X")]),
        ("ABAB", [(("A0", "B1"), ""), (("A2", "B3"), "")]),
        ("ABB", [(("A0", "B1"), ""), ((), "B")]), ("BAB", [((), "B"), (("A1", "B2"), "")]),
        ("A", [((), "A")]), ("", []),
    ],
)  # fmt: skip
def test_islands(types, found):
    assert parsed(types) == found


@given(st.text("ABXC", max_size=12))
def test_every_chunk_is_used_or_left_out(types):
    chunks = [Chunk(t, i, i + 1, f"{t}{i}") for i, t in enumerate(types)]
    islands = ISLANDS.parse(chunks)
    used = [w for c, left_out in islands for w in (*c.before, *[out.words for out in left_out])]
    assert sorted(used) == sorted(c.words for c in chunks)


def test_the_longest_phrase_wins():
    known = {("next",): (Terminal("A"),), ("next", "to"): (Terminal("B", 2),)}
    phrases = Phrases(known)
    assert phrases.longest(["is", "next", "to"], 1) == (2, (Terminal("B", 2),))
    assert phrases.longest(["next", "door"], 0) == (1, (Terminal("A"),))
    assert phrases.longest(["to"], 0) is None


def test_a_full_stop_shortens_what_it_is_told():
    text = "The St. Mary is old. It is 50 cm high."
    assert [len(s) for s in scan_text(text)] == [2, 3, 4]
    assert [len(s) for s in scan_text(text, shortened={"st"})] == [5, 4]
    (measure,) = [w for s in scan_text(text) for w in s if w.kind == "measure"]
    assert measure.metres == metres("50 cm", "50") == 0.5


def test_an_empty_text_is_told_what_is_wanted():
    with pytest.raises(DescriptionError, match='as in "Hello"'):
        check_text(" ", "Hello")


@pytest.mark.parametrize(
    ("text", "sentences"),
    [
        ("Elm Park - N.E. corner", ["elm park", "ne corner"]),
        ("Elm Park\nwest side", ["elm park", "west side"]),
        (f"{'a long line ' * 6}\nwest side", [f"{'a long line ' * 6}west side"]),
        ("S.W. 5th and n. w. side", ["sw 5th and nw side"]),
        ("a north-east corner", ["a north east corner"]),
    ],
)
def test_stops_of_notes(text, sentences):
    assert [" ".join(word.lower for word in found) for found in scan_text(text)] == sentences
