"""Sentences of the paper's form, in which whole labels stand for things.

"The Ripley's_Aquarium_of_Canada is on the north of the steps." Such labels are names and tag values
as a map has them, and may hold any words and marks: they are not to be read as English.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from placegraph.outdoor.language.words import tokens

if TYPE_CHECKING:
    from collections.abc import Iterator

    from placegraph.outdoor.language.chunk import NameFinder, Words

_LABEL = r"(?:[^.!?\n]|[.!?](?!\s|$)){1,100}?"
_SENTENCE = re.compile(
    rf"(?:(?<=[.!?]\s)|^)The (?P<source>{_LABEL}) is on the"
    r" (?:north|south|east|west)(?:-?(?:east|west))? of the"
    rf" (?P<target>{_LABEL})[.!?]?(?=\s+The\s|\s*$)",
    re.MULTILINE,
)
_ENGLISH = re.compile(
    r"\b(?:is|are|on|in|at|near|next|by|with|that|which|from|across|between|me|you|my|your|I|the|a)\b"
)
"""What makes a stretch of text more than a label."""


def labels(text: str, vocabulary: Words, names: NameFinder | None) -> Iterator[tuple[int, int]]:
    """Find the labels of sentences of the paper's form: (start, end) of each, in order."""
    for sentence in _SENTENCE.finditer(text):
        for end in ("source", "target"):
            if _is_label(sentence[end], vocabulary, names):
                yield sentence.span(end)


def _is_label(label: str, vocabulary: Words, names: NameFinder | None) -> bool:
    if "_" in label or "=" in label:
        return " " not in label
    words = tokens(label)
    if names is not None and words and names.longest_name(words, 0) == len(words):
        return True
    if _ENGLISH.search(label):
        return False
    return label[:1].isupper() or " of " in label or bool(vocabulary.senses(label))
