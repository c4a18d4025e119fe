"""Vectors of labels, offline and for any word: what is alike, or spelled alike, has a high cosine.

A label means what the tree of things (`load_tree`) says of it. One that is not there is taken for a
kind of what it ends in ("leather desk chair", "wallcabinet", "chair with wheels"), or for what it is
spelled like ("refridgerater"); the rest of its vector, and all of it where nothing is alike, is the
sum of vectors of its letters in threes to fives.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from zlib import crc32

import numpy as np
from numpy.typing import NDArray
from rapidfuzz import process
from rapidfuzz.distance import OSA

from placegraph.indoor.map.floor import singular_forms, split_label

__all__ = ["DIMENSION", "embed_label", "hash_tree", "is_known_label"]

_SILENT = (
    "unknown unlabeled unlabelled unannotated undefined unclassified unidentified void none null "
    "background nothing ignore ignored remove removed misc miscellaneous clutter mess object "
    "objects other others thing things item items stuff something prop props furniture na "
    "otherfurniture otherstructure otherprop otherobject otherobjects otheritem otherstuff"
)
SILENT = frozenset(_SILENT.split())  # Labels, written without spaces, that say nothing
_BETWEEN = re.compile(r"[;,/|(]|\bor\b")  # "sofa; couch", "sofa/couch", "cabinet (kitchen)"
_AFTER = frozenset(["of", "with", "for", "on", "in", "at", "from", "without", "to"])
_MANY = frozenset(["pile", "stack", "heap", "set", "pair", "group", "bunch", "row", "collection"])
_ENDING = 4  # letters of a known word that another may end in: a "carpet" is no pet
_ALIKE = 0.75  # share of letters that words have in common, to be taken for the same
_SHORTEST, _LONGEST = 3, 5  # letters of a subword
GROUP = 0.45  # Cosine of a thing with its group
KIN = 0.8  # Cosine of a kind of thing with the thing
_INDENT = 2
DIMENSION = 64
_FIELD = 32
_MODULUS = 0b100101  # x^5 + x^2 + 1, which makes GF(32)


def embed_label(label: str) -> NDArray[np.float32]:
    """Return unit vector (d,) float32 of a label; zero of one that says nothing ("", "unknown", "other")."""
    meanings = [words for part in _BETWEEN.split(label) if (words := split_label(part))]
    meanings = [words for words in meanings if "".join(words) not in SILENT]
    if not meanings:
        return np.zeros(DIMENSION, np.float32)
    for words in meanings:
        row = _find_row(words)
        if row is not None:
            return load_tree().vectors[row]
    row, likeness, rest = _find_nearest(meanings[0])
    letters = _embed_letters(rest)
    return letters if row is None else mix_vectors(load_tree().vectors[row], letters, likeness)


def is_known_label(label: str) -> bool:
    """Return whether a label stands in the tree of things, in the singular or the plural."""
    return any(_find_row(split_label(part)) is not None for part in _BETWEEN.split(label))


def hash_tree() -> str:
    """Return a digest of the tree of things: only vectors of one digest compare."""
    return load_tree().digest


def _find_row(words: Sequence[str]) -> int | None:
    if not words:
        return None
    rows = load_tree().row_of
    found = (rows.get("".join(words[:-1]) + last) for last in singular_forms(words[-1]))
    return next((row for row in found if row is not None), None)


def _find_nearest(words: list[str]) -> tuple[int | None, float, list[str]]:
    """Find the thing that unknown words are a kind of or spelled like: row, cosine, remaining words."""
    # a pile of books shows books, a chair with wheels a chair
    first = 2 if words[0] in _MANY and words[1:2] == ["of"] and words[2:] else 0
    end = next((i for i in range(first + 1, len(words)) if words[i] in _AFTER), len(words))
    for start in range(first, end):  # "leather desk chair": the desk chair, before the chair
        row = _find_row(words[start:end])
        if row is not None:
            return row, KIN, words[:start] + words[end:]
    last = words[end - 1]
    for cut in range(1, len(last) - _ENDING + 1):
        row = _find_row([last[cut:]])
        if row is not None:
            return row, KIN, [*words[: end - 1], last[:cut]]
    found = process.extractOne(
        "".join(words),
        load_tree().row_of.keys(),
        scorer=OSA.normalized_similarity,
        score_cutoff=_ALIKE,
    )
    return (None, 0.0, words) if found is None else (load_tree().row_of[found[0]], found[1], words)


def _embed_letters(words: Sequence[str]) -> NDArray[np.float32]:
    """Return unit vector (d,) of how words are spelled: the sum of the codes of their subwords."""
    total = np.zeros(DIMENSION)
    for word in words:
        marked = f"<{word}>"
        for size in range(_SHORTEST, _LONGEST + 1):
            for i in range(max(len(marked) - size + 1, 0)):
                row = crc32(marked[i : i + size].encode("utf-8", "surrogatepass"))
                total += make_codes()[row % len(make_codes())]
    return (total / max(math.sqrt(float(total @ total)), 1e-12)).astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class Tree:
    """Words and what they mean: how near two are is how far they share a branch.

    A group's vector is a code of its own (`make_codes`); what hangs below another is that one's vector
    and a code of its own, mixed so that their cosine is `KIN`, or `GROUP` below a group. So the
    cosine of two words is about 1 of synonyms, 0.8 of a thing and its kind, 0.64 of two kinds of
    it, 0.2 of two things of a group, and 0 else, 1/8 more or less.
    """

    row_of: dict[str, int]  # Row of each word, written without spaces: `nightstand`
    vectors: NDArray[np.float32]  # (N, d) unit vectors
    digest: str  # Of the file: vectors of other files do not compare


@cache
def load_tree() -> Tree:
    """Return the tree that placegraph brings."""
    content = files("placegraph.indoor.encode").joinpath("data/things.txt").read_bytes()
    return parse_tree(content.decode("utf-8"))


def parse_tree(text: str) -> Tree:
    """Return tree of lines of synonyms with commas between them, two spaces deeper below what they are of.

    A word that stands there twice means what it means first. `#` begins a comment.
    """
    row_of: dict[str, int] = {}
    vectors: list[NDArray[np.float32]] = []
    branch: list[int] = []
    groups = 0
    for line in text.splitlines():
        words = line.partition("#")[0].split(",")
        depth = (len(words[0]) - len(words[0].lstrip())) // _INDENT
        keys = [key for word in words if (key := join_words(word))]
        if not keys:
            continue
        row = len(vectors)
        if depth == 0:
            vectors.append(make_codes()[groups])  # groups are orthogonal
            groups += 1
        else:
            likeness = GROUP if depth == 1 else KIN
            own = make_codes()[DIMENSION + row]
            vectors.append(mix_vectors(vectors[branch[depth - 1]], own, likeness))
        branch[depth:] = [row]
        for key in keys:
            row_of.setdefault(key, row)
    return Tree(row_of, np.stack(vectors), hashlib.sha256(text.encode()).hexdigest()[:8])


def join_words(words: str) -> str:
    """Return letters of words, in lower case and without spaces: as `Tree.row_of` knows them."""
    return "".join(split_label(words))


def mix_vectors(
    vector: NDArray[np.float32], other: NDArray[np.float32], cosine: float
) -> NDArray[np.float32]:
    """Return unit vector (d,) with this cosine to a unit vector; the rest of it points along another."""
    rest = other - (other @ vector) * vector
    rest /= max(float(np.linalg.norm(rest)), 1e-12)
    return (cosine * vector + np.sqrt(1.0 - cosine**2) * rest).astype(np.float32)


@cache
def make_codes() -> NDArray[np.float32]:
    """Return unit vectors (2048, 64) float32; rows 64 i to 64 i + 63 are orthogonal.

    The code words of Kerdock's code of length 64: any two of different sets have a cosine of 1/8
    or -1/8, and no larger set is less alike (Cameron and Seidel, Quadratic forms over GF(2), 1973).
    Sign of place (x, y), x in GF(32), y in GF(2), of code (a, b, c): the parity of
    Tr((ax)^3 + (ax)^5 + bx) + y Tr(ax) + cy.
    """
    table, trace = _multiply_field(), _compute_traces()
    x = np.arange(_FIELD)
    ax = table[x[:, None], x]  # (a, x)
    square = table[ax, ax]
    cube = table[square, ax]
    form = trace[cube] ^ trace[table[cube, square]]
    quadratic = np.stack([form, form ^ trace[ax]], axis=-1)  # (a, x, y)
    bx, y = trace[table[x[:, None], x]], np.arange(2)
    linear = bx[:, None, :, None] ^ (y[:, None] & y)[None, :, None, :]  # (b, c, x, y)
    parity = quadratic[:, None, None] ^ linear
    out = ((1.0 - 2.0 * parity) / np.sqrt(DIMENSION)).reshape(-1, DIMENSION).astype(np.float32)
    out.flags.writeable = False
    return out


def _multiply_field() -> NDArray[np.int64]:
    """Return products (32, 32) of elements of GF(32), numbers whose bits are coefficients."""
    a, b = np.mgrid[:_FIELD, :_FIELD]
    product = np.zeros_like(a)
    for bit in range(5):
        product ^= (a << bit) * (b >> bit & 1)
    for bit in range(9, 4, -1):
        product ^= (_MODULUS << (bit - 5)) * (product >> bit & 1)
    return product


def _compute_traces() -> NDArray[np.int64]:
    """Return trace (32,) in GF(2) of each element: x + x^2 + x^4 + x^8 + x^16."""
    table, x = _multiply_field(), np.arange(_FIELD)
    total = x.copy()
    for _ in range(4):
        x = table[x, x]
        total ^= x
    return total
