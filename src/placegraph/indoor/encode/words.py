"""Vectors of labels, offline and for any word: what is alike, or spelled alike, has a high cosine.

A label means what the tree of things (`word_tree`) says of it. One that is not there is taken for a
kind of what it ends in ("leather desk chair", "wallcabinet", "chair with wheels"), or for what it is
spelled like ("refridgerater"); the rest of its vector, and all of it where nothing is alike, is the
sum of vectors of its letters in threes to fives.
"""

from __future__ import annotations

import math
import re
from functools import cache
from typing import TYPE_CHECKING
from zlib import crc32

import numpy as np
from rapidfuzz import process
from rapidfuzz.distance import OSA

from placegraph.indoor.encode.word_codes import DIMENSION, codes
from placegraph.indoor.encode.word_tree import KIN, mixed, tree
from placegraph.indoor.map.floor import label_words

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

__all__ = ["DIMENSION", "digest", "known", "vector"]

_SILENT = (
    "unknown unlabeled unlabelled unannotated undefined unclassified unidentified void none null "
    "background nothing ignore ignored remove removed misc miscellaneous clutter mess object "
    "objects other others thing things item items stuff something prop props furniture na "
    "otherfurniture otherstructure otherprop otherobject otherobjects otheritem otherstuff"
)
SILENT = frozenset(_SILENT.split())
"""Labels, written without spaces, that say nothing."""
_BETWEEN = re.compile(r"[;,/|(]|\bor\b")  # "sofa; couch", "sofa/couch", "cabinet (kitchen)"
_AFTER = frozenset(["of", "with", "for", "on", "in", "at", "from", "without", "to"])
_MANY = frozenset(["pile", "stack", "heap", "set", "pair", "group", "bunch", "row", "collection"])
_ENDING = 4  # letters of a known word that another may end in: a "carpet" is no pet
_ALIKE = 0.75  # share of letters that words have in common, to be taken for the same
_SHORTEST, _LONGEST = 3, 5  # letters of a subword


def vector(label: str) -> NDArray[np.float32]:
    """Unit vector (d,) float32 of a label; zero of one that says nothing ("", "unknown", "other")."""
    meanings = [words for part in _BETWEEN.split(label) if (words := label_words(part))]
    meanings = [words for words in meanings if "".join(words) not in SILENT]
    if not meanings:
        return np.zeros(DIMENSION, np.float32)
    for words in meanings:
        row = _row(words)
        if row is not None:
            return tree().vectors[row]
    row, likeness, rest = _nearest(meanings[0])
    letters = _letters(rest)
    return letters if row is None else mixed(tree().vectors[row], letters, likeness)


def known(label: str) -> bool:
    """Whether a label stands in the tree of things, in the singular or the plural."""
    return any(_row(label_words(part)) is not None for part in _BETWEEN.split(label))


def digest() -> str:
    """What decides the vectors beside this code: only vectors of one digest compare."""
    return tree().digest


def _row(words: Sequence[str]) -> int | None:
    """Row of words in the tree; None where they are not there."""
    if not words:
        return None
    rows = tree().row_of
    found = (rows.get("".join(words[:-1]) + last) for last in _singulars(words[-1]))
    return next((row for row in found if row is not None), None)


def _singulars(word: str) -> Iterator[str]:
    """The word, and what it may be the plural of."""
    yield word
    if word.endswith("ves"):
        yield word[:-3] + "f"
        yield word[:-3] + "fe"
    if word.endswith("ies"):
        yield word[:-3] + "y"
    if word.endswith("es"):
        yield word[:-2]
    if word.endswith("s"):
        yield word[:-1]


def _nearest(words: list[str]) -> tuple[int | None, float, list[str]]:
    """What unknown words are a kind of or spelled like: row, cosine, and the words that say more."""
    # a pile of books shows books, a chair with wheels a chair
    first = 2 if words[0] in _MANY and words[1:2] == ["of"] and words[2:] else 0
    end = next((i for i in range(first + 1, len(words)) if words[i] in _AFTER), len(words))
    for start in range(first, end):  # "leather desk chair": the desk chair, before the chair
        row = _row(words[start:end])
        if row is not None:
            return row, KIN, words[:start] + words[end:]
    last = words[end - 1]
    for cut in range(1, len(last) - _ENDING + 1):
        row = _row([last[cut:]])
        if row is not None:
            return row, KIN, [*words[: end - 1], last[:cut]]
    found = process.extractOne(
        "".join(words), _all_words(), scorer=OSA.normalized_similarity, score_cutoff=_ALIKE
    )
    return (None, 0.0, words) if found is None else (tree().row_of[found[0]], found[1], words)


@cache
def _all_words() -> list[str]:
    return list(tree().row_of)


def _letters(words: Sequence[str]) -> NDArray[np.float32]:
    """Unit vector (d,) of how words are spelled: the sum of the codes of their subwords."""
    total = np.zeros(DIMENSION)
    for word in words:
        marked = f"<{word}>"
        for size in range(_SHORTEST, _LONGEST + 1):
            for i in range(max(len(marked) - size + 1, 0)):
                row = crc32(marked[i : i + size].encode("utf-8", "surrogatepass"))
                total += codes()[row % len(codes())]
    return (total / max(math.sqrt(float(total @ total)), 1e-12)).astype(np.float32)
