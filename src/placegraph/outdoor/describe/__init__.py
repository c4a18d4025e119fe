"""From words to a query graph: what a text says about a place (Eq. 3-4)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from placegraph.errors import DescriptionError
from placegraph.outdoor.describe.build import Builder
from placegraph.outdoor.describe.chunk import Chunker, NameFinder
from placegraph.outdoor.describe.clauses import clauses
from placegraph.outdoor.describe.parse import parse
from placegraph.outdoor.describe.words import normalise, scan, tokens
from placegraph.outdoor.description import Description, Ignored

if TYPE_CHECKING:
    from placegraph.outdoor.describe.nodes import Chunk
    from placegraph.outdoor.vocabulary import Vocabulary

__all__ = ["Describer", "NameFinder", "describe", "normalise", "tokens"]

LONGEST_TEXT = 20_000
"""Characters."""


class Describer(Protocol):
    """Turns a text into a query graph."""

    def describe(
        self,
        text: str,
        *,
        vocabulary: Vocabulary | None = None,
        names: NameFinder | None = None,
        heading: float | None = None,
    ) -> Description:
        """Return what a text says; raises DescriptionError where it cannot be read at all."""


def describe(
    text: str,
    *,
    vocabulary: Vocabulary | None = None,
    names: NameFinder | None = None,
    heading: float | None = None,
) -> Description:
    """Read a text: what stands where, as seen from whom.

    Parameters
    ----------
    text
        English sentences; the words for things may be of any language of the vocabulary.
    vocabulary
        What words may mean on a map; the one that comes with placegraph if None.
    names
        Proper names of a map.
    heading
        Bearing in which the speaker faces [rad, clockwise from north], for "left of me".

    Raises
    ------
    DescriptionError
        If the text is empty, too long, or no text. A text of which nothing is understood is no
        error: it gives a description without statements.
    """
    check(text)
    if vocabulary is None:
        from placegraph.outdoor.vocabulary import Vocabulary

        vocabulary = Vocabulary.default()
    chunker = Chunker(text, vocabulary, names)
    sentences = [chunker.chunks(sentence) for sentence in scan(text)]
    directive = any(map(_leads_the_way, sentences))
    builder = Builder(text, vocabulary, heading, directive=directive)
    for sentence in sentences:
        for part in clauses(sentence):
            opens = part.opens
            for clause, left_out in parse(part.chunks):
                builder.take(clause, part.certainty, opens=opens)
                opens = False
                for chunk in left_out:
                    if clause.verb and chunk.type == "WORD":
                        builder.ignored.append(Ignored(chunk.words, "unknown word"))
    builder.finish()
    return Description(
        text,
        tuple(builder.refer.mentions),
        tuple(builder.relator.statements),
        tuple(builder.ignored),
    )


def _leads_the_way(sentence: list[Chunk]) -> bool:
    """Tell whether a sentence speaks to somebody who is to come."""
    orders = ("GO", "PASS", "CROSS", "FOLLOW", "MEET")
    return any(chunk.type in ("YOU", "YOUR", "MEET") for chunk in sentence) or (
        bool(sentence) and sentence[0].type in orders
    )


def check(text: str) -> None:
    """Refuse what is no readable text.

    Raises
    ------
    DescriptionError
        Saying what is wrong and how to mend it.
    """
    if not isinstance(text, str):
        raise DescriptionError(
            f"The description is of type {type(text).__name__}, not text; pass a str."
        )
    if len(text) > LONGEST_TEXT:
        raise DescriptionError(
            f"The description has {len(text):,} characters, more than {LONGEST_TEXT:,};"
            " keep what describes the place."
        )
    if not text.strip():
        raise DescriptionError(
            'The description is empty; say what stands around you, as in "A bakery is north of me."'
        )
    control = next((c for c in text if c < " " and c not in "\t\n\r"), None)
    if control is not None or "\x7f" in text:
        raise DescriptionError(
            f"The description contains the control character {control or chr(127)!r};"
            " is it a file that is not text? Remove it."
        )
