"""From words to a query graph: what a text says about a place (Eq. 3-4)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from placegraph.language.check import Ignored, check
from placegraph.outdoor.language.build import Builder
from placegraph.outdoor.language.chunk import Chunker
from placegraph.outdoor.language.clauses import clauses
from placegraph.outdoor.language.description import Description, conflicts
from placegraph.outdoor.language.languages import language as read_language
from placegraph.outdoor.language.model import LanguageModelDescriber
from placegraph.outdoor.language.parse import parse
from placegraph.outdoor.language.words import NameFinder, Words, labels, normalise, scan, tokens

if TYPE_CHECKING:
    from placegraph.language.islands import Chunk
    from placegraph.outdoor.language.statements import BlockLength

__all__ = [
    "Describer",
    "LanguageModelDescriber",
    "NameFinder",
    "Words",
    "describe",
    "normalise",
    "tokens",
]


class Describer(Protocol):
    """Turns a text into a query graph."""

    def describe(
        self,
        text: str,
        *,
        vocabulary: Words | None = None,
        names: NameFinder | None = None,
        heading: float | None = None,
    ) -> Description:
        """Return what a text says; raises DescriptionError where it cannot be read at all."""


def describe(
    text: str,
    *,
    vocabulary: Words | None = None,
    names: NameFinder | None = None,
    heading: float | None = None,
    language: str | None = None,
    block_length: BlockLength | None = None,
) -> Description:
    """Read a text: what stands where, as seen from whom.

    Parameters
    ----------
    text
        Sentences; the words for things may be of any language of the vocabulary.
    vocabulary
        What words may mean on a map; the one that comes with placegraph if None.
    names
        Proper names of a map.
    heading
        Bearing in which the speaker faces [rad, clockwise from north], for "left of me".
    block_length
        Length of a block [m] in the direction of a bearing [rad], or in any (None), on the map at
        hand; 100 m if not given.
    language
        Code of the language of the text ("en"); English if None.

    Raises
    ------
    OptionError
        If there is no such language; lists those that there are.
    DescriptionError
        If the text is empty, too long, or no text. A text of which nothing is understood is no
        error: it gives a description without statements.
    """
    check(text)
    if vocabulary is None:
        from placegraph.outdoor.language.vocabulary import Vocabulary

        vocabulary = Vocabulary.default()
    tongue = read_language(language or "en")
    chunker = Chunker(text, tongue, vocabulary, names)
    sentences = [
        chunker.chunks(sentence) for sentence in scan(text, tongue, labels(text, vocabulary, names))
    ]
    directive = any(map(_leads_the_way, sentences))
    builder = Builder(
        text, tongue, vocabulary, heading, directive=directive, block_length=block_length
    )
    for sentence in sentences:
        for part in clauses(sentence, tongue):
            opens = part.opens
            for clause, left_out in parse(part.chunks):
                builder.take(clause, part.certainty, opens=opens)
                opens = False
                for chunk in left_out:
                    if clause.verb and chunk.type == "WORD":
                        builder.ignored.append(Ignored(chunk.words, "unknown word"))
    builder.finish()
    builder.ignored += builder.refer.unknown()
    if not (builder.relator.statements or builder.ignored):
        builder.ignored.append(Ignored(text.strip(), "says nothing about where things stand"))
    return Description(
        text,
        tuple(builder.refer.mentions),
        tuple(builder.relator.statements),
        tuple(builder.ignored),
        conflicts(
            builder.relator.statements,
            builder.refer.heads,
            builder.relator.goals,
            builder.refer.kinds,
        ),
        tongue.code,
    )


def _leads_the_way(sentence: list[Chunk]) -> bool:
    """Tell whether a sentence speaks to somebody who is to come."""
    orders = ("GO", "PASS", "CROSS", "FOLLOW", "MEET")
    return any(chunk.type in ("YOU", "YOUR", "MEET") for chunk in sentence) or (
        bool(sentence) and sentence[0].type in orders
    )
