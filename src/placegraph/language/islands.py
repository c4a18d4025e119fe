"""A grammar at work: the chunks of a clause become what of them can be understood."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from placegraph.language.grammar import END, Grammar, UnexpectedTokenError

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

    from placegraph.language.grammar import Parse

_BACK = 4
"""How many chunks are given up at most to make sense of those before them."""
Clause = TypeVar("Clause")


@dataclass(slots=True)
class Chunk:
    """A terminal of the grammar: a phrase of the text and what it stands for."""

    type: str
    start: int
    end: int
    """Characters of the text."""
    words: str = ""
    """Lower-case."""
    value: Any = None
    capital: bool = False


class Islands(Generic[Clause]):
    """Parses by islands (LALR): what the grammar does not expect is left out, or ends an island.

    Parameters
    ----------
    grammar, start
        Of lark; the terminals are types of chunks.
    builder
        Called as soon as a rule is complete; see `Grammar`.
    kind
        What the start rule becomes.
    skipped
        Types of chunks that may be left out where the grammar expects something else.
    """

    def __init__(
        self,
        grammar: str,
        start: str,
        builder: object,
        kind: type[Clause],
        skipped: Collection[str],
    ) -> None:
        self._grammar = Grammar(grammar, start, builder)
        self._kind, self._skipped = kind, skipped

    def parse(
        self, chunks: list[Chunk]
    ) -> Iterator[tuple[Clause | None, list[Chunk], list[Chunk]]]:
        """Parse the chunks of one clause.

        Yields
        ------
        clause, used, left_out
            What could be parsed, in order, the chunks that it took, and those of them that had to
            be left out. Where nothing could be parsed, None, and all is left out.
        """
        rest = chunks
        while rest:
            clause, left_out, used = self._island(rest)
            if clause is not None and used:
                yield clause, rest[:used], left_out
            else:
                yield None, rest[:used], rest[:used]
            rest = rest[used:]

    def _island(self, chunks: list[Chunk]) -> tuple[Clause | None, list[Chunk], int]:
        """Longest clause from the first chunk on, chunks left out of it, and how many it took."""
        parser = self._grammar.parse()
        left_out: list[Chunk] = []
        for i, chunk in enumerate(chunks):
            try:
                parser.feed(chunk.type, chunk)
            except UnexpectedTokenError:
                if chunk.type in self._skipped:
                    left_out.append(chunk)
                    continue
                clause = self._finish(parser)
                if clause is not None and i:
                    return clause, left_out, i
                return self._shorter(chunks[: i + 1], left_out)
        clause = self._finish(parser)
        if clause is not None:
            return clause, left_out, len(chunks)
        return self._shorter(chunks, left_out)

    def _shorter(
        self, chunks: list[Chunk], left_out: list[Chunk]
    ) -> tuple[Clause | None, list[Chunk], int]:
        """Parse a beginning of the chunks that cannot be parsed whole."""
        kept = [chunk for chunk in chunks if chunk not in left_out]
        for n in range(len(kept) - 1, max(0, len(kept) - 1 - _BACK), -1):
            parser = self._grammar.parse()
            try:
                for chunk in kept[:n]:
                    parser.feed(chunk.type, chunk)
            except UnexpectedTokenError:
                continue
            clause = self._finish(parser)
            if clause is not None:
                used = chunks.index(kept[n])
                return clause, [chunk for chunk in left_out if chunk in chunks[:used]], used
        return None, left_out, len(chunks)

    def _finish(self, parser: Parse) -> Clause | None:
        try:
            clause = parser.feed(END)
        except UnexpectedTokenError:
            return None
        return clause if isinstance(clause, self._kind) else None
