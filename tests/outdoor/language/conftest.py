"""How the tests of this folder write down what was understood."""

from __future__ import annotations

from math import degrees

import pytest

from placegraph.outdoor.language.description import LISTENER, SPEAKER

ARTICLES = ("the ", "a ", "an ", "no ", "any ", "another ")


def node(description, n):
    """Node as a test names it: I, you, a name, or the words without their article."""
    if n in (SPEAKER, LISTENER):
        return ("I", "you")[n]
    mention = description.mentions[n]
    words = mention.name or mention.words
    for article in ARTICLES:
        if not mention.name and words.lower().startswith(article):
            words = words[len(article) :]
    return words


def statement(description, s):
    """One statement: ``not direction(bakery, I) 90° 30m far ~0.8``."""
    nodes = [node(description, n) for n in (s.source, s.target, s.target2) if n is not None]
    line = f"{'not ' if s.negated else ''}{s.relation}({', '.join(nodes)})"
    if s.bearing is not None:
        line += f" {round(degrees(s.bearing)) % 360}°"
    if s.distance is not None:
        line += f" {'<' if s.within else ''}{s.distance:.0f}m"
    if s.far:
        line += " far"
    return line if s.certainty == 1.0 else f"{line} ~{s.certainty:g}"


@pytest.fixture(scope="session")
def list_statements():
    """Return what a description says, one line a statement."""
    return lambda description: [statement(description, s) for s in description.statements]
