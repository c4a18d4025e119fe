"""Phrases: what groups of words stand for in a grammar."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple


class Terminal(NamedTuple):
    """What a phrase stands for: a terminal of the grammar and what it carries."""

    type: str
    value: Any = None


class Phrases:
    """Phrases by their first word, longest first.

    Parameters
    ----------
    known
        Terminals of each phrase, by its words in lower case.
    """

    def __init__(self, known: Mapping[tuple[str, ...], tuple[Terminal, ...]]) -> None:
        first: dict[str, list[tuple[tuple[str, ...], tuple[Terminal, ...]]]] = {}
        for words in sorted(known, key=len, reverse=True):
            first.setdefault(words[0], []).append((words, known[words]))
        self.by_word = {word: tuple(entries) for word, entries in first.items()}
        self._known = known
        self._lengths = {
            word: sorted({len(words) for words, _ in entries}, reverse=True)
            for word, entries in first.items()
        }

    def longest(self, words: Sequence[str], start: int) -> tuple[int, tuple[Terminal, ...]] | None:
        """Number of words of the longest phrase that begins at `start`, and its terminals."""
        for n in self._lengths.get(words[start], ()):
            phrase = tuple(words[start : start + n])
            if phrase in self._known:
                return len(phrase), self._known[phrase]
        return None
