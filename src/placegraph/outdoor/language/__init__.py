"""Descriptions of places in free text: from words to a query graph (Eq. 3-4)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Protocol

from placegraph.language.grammar import Chunk
from placegraph.language.text import Ignored, check_text
from placegraph.outdoor.language.build import GraphBuilder
from placegraph.outdoor.language.chunks import Chunker
from placegraph.outdoor.language.description import Description, find_conflicts
from placegraph.outdoor.language.grammar import cut_clauses, parse
from placegraph.outdoor.language.language_model import LanguageModelDescriber
from placegraph.outdoor.language.scan import (
    UNKNOWN,
    Stretch,
    clean,
    find_labels,
    find_stretches,
    scan_any,
    scan_english,
)
from placegraph.outdoor.language.statements import NO_PLACE
from placegraph.outdoor.language.words import NameFinder, Words, normalise, tokens

if TYPE_CHECKING:
    from placegraph.outdoor.language.languages import Language
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


NO_LANGUAGE = "in no language that is known"
"""Reason of a sentence that may mean something else."""


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
        Code of the language of the text ("de"); if None, it is recognised, sentence by sentence.

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
    folder, things = (sources.folder, sources.words.english) if sources else (None, ())
    cleaned = clean(text)
    parts = find_stretches(cleaned, language, folder, things)
    sentences = [
        (sentence, part.language)
        for part in parts
        for sentence in _find_sentences(cleaned, part, vocabulary, names)
    ]
    main = max(parts, key=lambda part: part.end - part.start)
    directive = any(_is_directive(sentence) for sentence, _ in sentences)
    builder = GraphBuilder(
        cleaned, main.language, vocabulary, heading, directive=directive, block_length=block_length
    )
    for sentence, own in sentences:
        _read_sentence(sentence, own, builder)
    builder.finish()
    references, statements = builder.references, builder.places.statements
    builder.ignored += references.list_unknown()
    if not (statements or builder.ignored):
        builder.ignored.append(Ignored(text.strip(), NO_PLACE))
    for part in parts:
        if statements and not part.certain:
            builder.ignored.append(Ignored(cleaned[part.start : part.end].strip(), NO_LANGUAGE))
    conflicts = find_conflicts(statements, references.heads, builder.places.goals, references.kinds)
    return Description(
        text,
        tuple(references.mentions),
        tuple(statements),
        tuple(builder.ignored),
        conflicts,
        main.language.code if main.certain else UNKNOWN,
    )


def _find_sentences(
    text: str, part: Stretch, vocabulary: Words, names: NameFinder | None
) -> Iterator[list[Chunk]]:
    """Yield the chunks of the sentences of a part of a text in one language."""
    if part.language.code == "en":
        chunker = Chunker(text, part.language, vocabulary, names)
        spans = find_labels(text, vocabulary, names)
        inside = [span for span in spans if part.start <= span[0] < part.end]
        for sentence in scan_english(text[: part.end], part.language, inside, part.start):
            yield chunker.chunks(sentence)
        return
    from placegraph.outdoor.language.chunks import InflectedChunker
    from placegraph.outdoor.language.vocabulary import Vocabulary

    known = vocabulary if isinstance(vocabulary, Vocabulary) else Vocabulary.default()
    inflected = InflectedChunker(text, part.language, known.of(part.language), names)
    for sentence in scan_any(text, part.language, inflected.known, (part.start, part.end)):
        yield inflected.chunks(sentence)


def _read_sentence(sentence: list[Chunk], language: Language, builder: GraphBuilder) -> None:
    """Add what a sentence says."""
    for part in cut_clauses(sentence, language):
        opens = part.opens
        for clause, left_out in parse(part.chunks):
            builder.take(clause, part.certainty, opens=opens)
            opens = False
            for chunk in left_out:
                if clause.verb and chunk.type == "WORD":
                    builder.ignored.append(Ignored(chunk.words, "unknown word"))


def _is_directive(sentence: list[Chunk]) -> bool:
    """Tell whether a sentence speaks to somebody who is to come."""
    orders = ("GO", "PASS", "CROSS", "FOLLOW", "MEET")
    return any(chunk.type in ("YOU", "YOUR", "MEET") for chunk in sentence) or (
        bool(sentence) and sentence[0].type in orders
    )
