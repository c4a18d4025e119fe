"""Contradictions: statements of one text that cannot all be true."""

from __future__ import annotations

from math import pi, radians
from typing import TYPE_CHECKING

from placegraph.geometry import angle_between
from placegraph.outdoor.language.description import SPEAKER, Relation, Statement

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence

OPPOSITE = radians(120.0)
"""Directions further apart than this contradict each other."""
ALIKE = radians(60.0)
"""Directions nearer than this are the same direction."""
SURE = 0.75
"""Statements less certain than this contradict nothing."""
_HERE = (Relation.VISIBLE, Relation.NEAR, Relation.DIRECTION)


def conflicts(
    statements: Sequence[Statement], nouns: Sequence[str], here: Collection[int]
) -> tuple[str, ...]:
    """Say which statements contradict each other.

    Parameters
    ----------
    statements
        What was said.
    nouns
        Common noun of every mention.
    here
        Nodes that stand where the speaker stands.
    """
    sure = [s for s in statements if s.certainty >= SURE]
    found = [*_opposite(sure, here), *_denied(sure, nouns, here)]
    return tuple(dict.fromkeys(found))


def _opposite(statements: Sequence[Statement], here: Collection[int]) -> Iterator[str]:
    """Two things that lie in opposite directions of each other, twice."""
    first: dict[tuple[int, int], tuple[float, Statement]] = {}
    for statement in statements:
        if statement.bearing is None or statement.negated:
            continue
        a, b = (SPEAKER if n in here else n for n in (statement.source, statement.target))
        bearing = statement.bearing if a < b else statement.bearing + pi
        known = first.setdefault((min(a, b), max(a, b)), (bearing, statement))
        if angle_between(known[0], bearing) > OPPOSITE:
            yield _say(known[1], statement)


def _denied(
    statements: Sequence[Statement], nouns: Sequence[str], here: Collection[int]
) -> Iterator[str]:
    """Something that is said to be here and not to be here."""
    claims = [s for s in statements if s.relation in _HERE and s.target in here and not s.far]
    for no in claims:
        noun = nouns[no.source]
        if not no.negated or not noun:
            continue
        for yes in claims:
            if yes.negated or nouns[yes.source] != noun:
                continue
            if no.bearing is None or (
                yes.bearing is not None and angle_between(yes.bearing, no.bearing) < ALIKE
            ):
                yield _say(no, yes)
                break


def _say(one: Statement, other: Statement) -> str:
    if one.text == other.text:
        return f"“{one.text}” contradicts itself."
    return f"“{one.text}” and “{other.text}” cannot both be true."
