"""From words to a query graph: what a text says about a place (Eq. 3-4)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Protocol

from placegraph.language.grammar import Chunk
from placegraph.language.text import Ignored, check_text
from placegraph.outdoor.language.build import GraphBuilder
from placegraph.outdoor.language.chunks import Chunker
from placegraph.outdoor.language.clauses import cut_clauses
from placegraph.outdoor.language.description import Description, conflicts
from placegraph.outdoor.language.grammar import parse
from placegraph.outdoor.language.language_model import LanguageModelDescriber
from placegraph.outdoor.language.languages.recognise import UNKNOWN, Stretch, stretches
from placegraph.outdoor.language.scan import clean, labels, scan
from placegraph.outdoor.language.scan import scan_any as scan_other
from placegraph.outdoor.language.words import NameFinder, Words, normalise, tokens

if TYPE_CHECKING:
    from placegraph.outdoor.language.languages import Language
    from placegraph.outdoor.language.relations import BlockLength

__all__ = [
    "Describer",
    "LanguageModelDescriber",
    "NameFinder",
    "Words",
    "describe",
    "normalise",
    "tokens",
]


NO_LANGUAGE = "in no language that is known"
"""Why nothing that a sentence seems to say is to be trusted."""


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
        Sentences of one or more of the languages that can be read (`languages.codes`). In English
        ones, the words for things may be of any language of the vocabulary.
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
        Code of the language of the text ("de"); if None, it is told from the words, sentence by
        sentence.

    Raises
    ------
    OptionError
        If there is no such language; lists those that there are.
    DescriptionError
        If the text is empty, too long, or no text. A text of which nothing is understood is no
        error: it gives a description without statements.
    """
    check_text(text)
    from placegraph.outdoor.language.vocabulary import Vocabulary

    vocabulary = vocabulary or Vocabulary.default()
    sources = vocabulary.sources if isinstance(vocabulary, Vocabulary) else None
    cleaned = clean(text)
    parts = stretches(
        cleaned,
        language,
        sources.folder if sources else None,
        sources.words.english if sources else (),
    )
    sentences = [
        (sentence, part.language)
        for part in parts
        for sentence in _sentences(cleaned, part, vocabulary, names)
    ]
    main = max(parts, key=lambda part: part.end - part.start)
    directive = any(_leads_the_way(sentence) for sentence, _ in sentences)
    builder = GraphBuilder(
        cleaned, main.language, vocabulary, heading, directive=directive, block_length=block_length
    )
    for sentence, tongue in sentences:
        _take(sentence, tongue, builder)
    builder.finish()
    builder.ignored += builder.references.list_unknown()
    if not (builder.places.statements or builder.ignored):
        builder.ignored.append(Ignored(text.strip(), "says nothing about where things stand"))
    for stretch in parts:
        if builder.places.statements and not stretch.certain:
            unread = cleaned[stretch.start : stretch.end].strip()
            builder.ignored.append(Ignored(unread, NO_LANGUAGE))
    return Description(
        text,
        tuple(builder.references.mentions),
        tuple(builder.places.statements),
        tuple(builder.ignored),
        conflicts(
            builder.places.statements,
            builder.references.heads,
            builder.places.goals,
            builder.references.kinds,
        ),
        main.language.code if main.certain else UNKNOWN,
    )


def _sentences(
    text: str, part: Stretch, vocabulary: Words, names: NameFinder | None
) -> Iterator[list[Chunk]]:
    """Chunks of the sentences of a part of a text in one language."""
    tongue, span = part.language, (part.start, part.end)
    if tongue.code == "en":
        english = Chunker(text, tongue, vocabulary, names)
        found = [
            span for span in labels(text, vocabulary, names) if part.start <= span[0] < part.end
        ]
        for sentence in scan(text[: part.end], tongue, found, part.start):
            yield english.chunks(sentence)
        return
    from placegraph.outdoor.language.chunks import InflectedChunker
    from placegraph.outdoor.language.vocabulary import Vocabulary

    known = vocabulary if isinstance(vocabulary, Vocabulary) else Vocabulary.default()
    chunker = InflectedChunker(text, tongue, known.of(tongue), names)
    for sentence in scan_other(text, tongue, chunker.known, span):
        yield chunker.chunks(sentence)


def _take(sentence: list[Chunk], language: Language, builder: GraphBuilder) -> None:
    """Add what a sentence says."""
    for part in cut_clauses(sentence, language):
        opens = part.opens
        for clause, left_out in parse(part.chunks):
            builder.take(clause, part.certainty, opens=opens)
            opens = False
            for chunk in left_out:
                if clause.verb and chunk.type == "WORD":
                    builder.ignored.append(Ignored(chunk.words, "unknown word"))


def _leads_the_way(sentence: list[Chunk]) -> bool:
    """Tell whether a sentence speaks to somebody who is to come."""
    orders = ("GO", "PASS", "CROSS", "FOLLOW", "MEET")
    return any(chunk.type in ("YOU", "YOUR", "MEET") for chunk in sentence) or (
        bool(sentence) and sentence[0].type in orders
    )
