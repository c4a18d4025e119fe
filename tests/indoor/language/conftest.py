from math import degrees

import pytest


def thing(mention):
    """A thing as a test names it: its label, its number before it, its looks before that."""
    count = f"{mention.count} " if mention.count else "some " if mention.several else ""
    looks = "".join(f"{word} " for word in mention.attributes)
    return f"{count}{looks}{mention.label}"


def statement(sentence, s):
    """One statement: ``not towards(door) 90° 2m wide ~0.6``."""
    things = ", ".join(thing(sentence.mentions[t]) for t in s.mentions)
    line = f"{'not ' if s.negated else ''}{s.kind}({things})"
    if s.relation:
        line += f" {s.relation}"
    if s.kind == "towards":
        line += f" {round(degrees(s.bearing))}°"
    if s.distance is not None:
        line += f" {s.distance:g}m"
    if s.wide:
        line += " wide"
    return line if s.certainty == 1.0 else f"{line} ~{s.certainty:g}"


@pytest.fixture(scope="session")
def list_statements():
    return lambda sentence: [statement(sentence, s) for s in sentence.statements]
