"""Files of word2vec, in text or binary form: vectors of the words that are asked for.

Both forms begin with a line "COUNT LENGTH". In the text form every further line is a word and its
numbers, parted by spaces. In the binary form every word ends with a space, and its numbers follow as
32-bit floats, low byte first; a line feed after them is optional (word2vec writes it, gensim does
not). Layout as `word2vec.c` writes it and gensim's `save_word2vec_format`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from os import PathLike
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import InputError
from placegraph.outdoor.network.graphs import WordVectors

LONGEST = 4096
"""Numbers of a vector at most."""
WORD = 4096
"""Bytes of a word at most."""
NUMBER = 64
"""Bytes of a number in text form at most."""


def read_word2vec(path: str | PathLike[str], wanted: Collection[str]) -> WordVectors:
    """Return vectors of those of the wanted words (in small letters) that a file knows.

    A word that the file has in small letters is that one; else the first that differs in capitals
    alone, the more frequent one where the file is sorted as word2vec sorts it. Vectors are rounded
    to 16 bits, as weights files keep them. The file is read once from front to back: only what is
    wanted is kept.

    Raises `InputError`: the file is missing, packed, cut short, or of neither form; its header does
    not agree with its size; a number is none; or it knows no wanted word.
    """
    path = Path(path)
    exact: dict[str, NDArray[np.float32]] = {}
    similar: dict[str, NDArray[np.float32]] = {}
    try:
        with path.open("rb") as file:
            for word, vector in _entries(file, path):
                small = word.lower()
                if small in wanted:
                    (exact if small == word else similar).setdefault(small, vector())
    except OSError as error:
        raise InputError(
            f"{path}: {error.strerror or error}; give a word2vec file, text or binary."
        ) from error
    found = similar | exact
    if not found:
        raise InputError(
            f"{path} has vectors for none of the {len(wanted):,} words needed; give another file."
        )
    words = tuple(sorted(found))
    with np.errstate(over="ignore"):
        vectors = np.stack([found[word] for word in words]).astype(np.float16)
    if not np.isfinite(vectors).all():
        bad = words[int(np.argmin(np.isfinite(vectors).all(axis=1)))]
        raise InputError(
            f"{path}: the vector of {bad!r} contains a value that is not a number below 65,504; "
            "copy it again."
        )
    return WordVectors(words, vectors.astype(np.float32))


class _RawVector:
    """Numbers of a word, read from their bytes when they are wanted."""

    def __init__(self, raw: bytes, length: int, *, text: bool) -> None:
        self.raw, self.length, self.text = raw, length, text

    def __call__(self) -> NDArray[np.float32]:
        if not self.text:
            return np.frombuffer(self.raw, "<f4")
        try:
            return np.array([float(x) for x in self.raw.split()], np.float32)
        except ValueError:
            return np.full(self.length, np.nan, np.float32)  # told with the word's name


def _entries(file: BinaryIO, path: Path) -> Iterator[tuple[str, _RawVector]]:
    head = file.readline(64)
    fields = head.split()
    if head[:2] == b"\x1f\x8b":
        raise InputError(f"{path} is compressed; decompress it first (gunzip).")
    if len(fields) != 2 or not all(f.isdigit() for f in fields) or not head.endswith(b"\n"):
        raise InputError(
            f"{path} does not begin with the number of words and the length of their vectors; give "
            "a word2vec file, text or binary."
        )
    count, length = map(int, fields)
    if not 1 <= length <= LONGEST or not count:
        raise InputError(
            f"{path}: {count} words of {length} numbers cannot be word vectors; give a word2vec "
            "file."
        )
    begin = file.tell()
    first = file.readline(WORD + NUMBER * length)
    left = file.seek(0, 2) - begin
    file.seek(begin)
    text = _is_text(first, length)
    least = 2 + (2 if text else 4) * length  # a letter, a space, and the numbers
    if count * least > left + 1:  # the last line may end without a line feed
        raise InputError(
            f"{path} declares {count:,} words of {length} numbers, but is too short for them, so "
            "it is truncated; copy it again."
        )
    entries = _lines(file, count, length) if text else _blocks(file, count, length)
    for number, entry in enumerate(entries, 1):
        if entry is None:
            raise InputError(
                f"{path}, word {number:,} of {count:,}: expected a word and {length} numbers; the "
                "file is damaged or its first line is wrong, copy it again."
            )
        yield entry
    if file.read(64).strip():
        raise InputError(
            f"{path} continues after the {count:,} words that its first line declares, so it is "
            "damaged; copy it again."
        )


def _is_text(line: bytes, length: int) -> bool:
    """Return whether a line is a word and its numbers in text."""
    fields = line.split()
    try:
        return len([float(field) for field in fields[1:]]) == length
    except ValueError:
        return False


def _lines(file: BinaryIO, count: int, length: int) -> Iterator[tuple[str, _RawVector] | None]:
    for _ in range(count):
        line = file.readline(WORD + NUMBER * length)
        word, _, numbers = line.strip().partition(b" ")
        right = len(numbers.split()) == length
        yield (
            (str(word, "utf-8", "replace"), _RawVector(numbers, length, text=True))
            if right
            else None
        )


def _blocks(file: BinaryIO, count: int, length: int) -> Iterator[tuple[str, _RawVector] | None]:
    for _ in range(count):
        word = bytearray()
        while (letter := file.read(1)) not in (b" ", b"") and len(word) <= WORD:
            word += letter
        raw = file.read(4 * length)
        right = letter == b" " and word.strip() and len(raw) == 4 * length
        name = str(bytes(word).lstrip(b"\n"), "utf-8", "replace")
        yield (name, _RawVector(raw, length, text=False)) if right else None
