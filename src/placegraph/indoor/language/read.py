"""From words to statements: what a text says of a place, and what of it was left unread."""

from __future__ import annotations

from placegraph.indoor.language.build import Builder
from placegraph.indoor.language.chunk import chunks, clauses
from placegraph.indoor.language.parse import parse
from placegraph.indoor.language.sentence import Sentence
from placegraph.language.check import Ignored, check
from placegraph.language.words import scan

_EXAMPLE = "I am next to the sofa, facing the window."


def read(text: str) -> Sentence:
    """Read a text: where somebody is in a place, and what it holds.

    Parameters
    ----------
    text
        English; the words for things may be any ("KitchenTable", "chest of drawers").

    Raises
    ------
    DescriptionError
        If the text is empty, too long, or no text. A text of which nothing is understood is no
        error: it gives a sentence without statements that says what was ignored.

    """
    check(text, _EXAMPLE)
    builder = Builder(text)
    for sentence in scan(text):
        for part, certainty in clauses(chunks(sentence, text)):
            for clause, left_out in parse(part):
                if clause is not None:
                    builder.take(clause, certainty)
                builder.leave(left_out)
    builder.finish()
    if not builder.statements and not builder.ignored:
        builder.ignored.append(Ignored(text.strip(), "says nothing about a place"))
    return Sentence(
        text, tuple(builder.mentions), tuple(builder.statements), tuple(builder.ignored)
    )
