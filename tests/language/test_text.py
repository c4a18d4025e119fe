"""What both wings share of reading English: phrases, islands of a grammar, sentences of words."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.errors import DescriptionError
from placegraph.language.grammar import Chunk, IslandParser
from placegraph.language.text import Phrases, Terminal, check_text, metres, scan_text

GRAMMAR = """
pair: A B
%declare A B
"""


BUILD = {"pair": lambda children: tuple(chunk.words for chunk in children)}
ISLANDS = IslandParser(GRAMMAR, "pair", BUILD, tuple, ("X",))


def parsed(types):
    chunks = [Chunk(t, i, i + 1, f"{t}{i}") for i, t in enumerate(types)]
    return [
        (found, "".join(c.type for c in left_out)) for found, _, left_out in ISLANDS.parse(chunks)
    ]


@pytest.mark.parametrize(
    ("types", "found"),
    [
        ("AB", [(("A0", "B1"), "")]), ("AXB", [(("A0", "B2"), "X")]),
        ("ABAB", [(("A0", "B1"), ""), (("A2", "B3"), "")]),
        ("ABB", [(("A0", "B1"), ""), (None, "B")]), ("BAB", [(None, "B"), (("A1", "B2"), "")]),
        ("A", [(None, "A")]), ("", []),
    ],
)  # fmt: skip
def test_islands(types, found):
    assert parsed(types) == found


@given(st.text("ABXC", max_size=12))
def test_every_chunk_is_used_or_left_out(types):
    chunks = [Chunk(t, i, i + 1) for i, t in enumerate(types)]
    used = [c for _, part, _ in ISLANDS.parse(chunks) for c in part]
    assert used == chunks


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
