"""The tree of things found indoors, as vectors: how near two words are is how far they share a branch.

A group's vector is a code of its own (`word_codes`); what hangs below another is that one's vector
and a code of its own, mixed so that their cosine is `KIN`, or `GROUP` below a group. So the cosine
of two words is about 1 of synonyms, 0.8 of a thing and its kind, 0.64 of two kinds of it, 0.2 of two
things of a group, and 0 else, 1/8 more or less.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING

import numpy as np

from placegraph.indoor.encode.word_codes import DIMENSION, codes
from placegraph.indoor.map.floor import label_words

if TYPE_CHECKING:
    from numpy.typing import NDArray

GROUP = 0.45
"""Cosine of a thing with its group."""
KIN = 0.8
"""Cosine of a kind of thing with the thing."""
_INDENT = 2


@dataclass(frozen=True, slots=True, eq=False)
class Tree:
    """Words and what they mean."""

    row_of: dict[str, int]
    """Row of each word, written without spaces: `nightstand`."""
    vectors: NDArray[np.float32]
    """(N, d) unit vectors."""
    digest: str
    """Of the file: vectors of other files do not compare."""


@cache
def tree() -> Tree:
    """The tree that placegraph brings."""
    content = files("placegraph.indoor.encode").joinpath("data/things.txt").read_bytes()
    return grown(content.decode("utf-8"))


def grown(text: str) -> Tree:
    """Tree of lines of synonyms with commas between them, two spaces deeper below what they are of.

    A word that stands there twice means what it means first. `#` begins a comment.
    """
    row_of: dict[str, int] = {}
    vectors: list[NDArray[np.float32]] = []
    branch: list[int] = []
    groups = 0
    for line in text.splitlines():
        words = line.partition("#")[0].split(",")
        depth = (len(words[0]) - len(words[0].lstrip())) // _INDENT
        keys = [key for word in words if (key := spelled(word))]
        if not keys:
            continue
        row = len(vectors)
        if depth == 0:
            vectors.append(codes()[groups])  # groups are orthogonal
            groups += 1
        else:
            likeness = GROUP if depth == 1 else KIN
            own = codes()[DIMENSION + row]
            vectors.append(mixed(vectors[branch[depth - 1]], own, likeness))
        branch[depth:] = [row]
        for key in keys:
            row_of.setdefault(key, row)
    return Tree(row_of, np.stack(vectors), hashlib.sha256(text.encode()).hexdigest()[:8])


def spelled(words: str) -> str:
    """Letters of words, in lower case and without spaces: as `Tree.row_of` knows them."""
    return "".join(label_words(words))


def mixed(
    vector: NDArray[np.float32], other: NDArray[np.float32], cosine: float
) -> NDArray[np.float32]:
    """Unit vector (d,) with this cosine to a unit vector; the rest of it points along another."""
    rest = other - (other @ vector) * vector
    rest /= max(float(np.linalg.norm(rest)), 1e-12)
    return (cosine * vector + np.sqrt(1.0 - cosine**2) * rest).astype(np.float32)
