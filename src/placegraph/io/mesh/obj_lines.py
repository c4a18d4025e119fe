"""Lines of Wavefront OBJ files, told apart by whole arrays, a block of some megabytes at a time."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import regular
from placegraph.errors import InputError

Bytes = NDArray[np.uint8]
Rows = NDArray[np.int64]


BLOCK = 1 << 24
_LONGEST_LINE = 1 << 22
NEWLINE, SPACE, SLASH, _HASH = b"\n /#"


class Lines(NamedTuple):
    """Some lines of a block, one after the other."""

    text: Bytes
    """Without the keywords and comments."""
    starts: Rows
    rows: Rows
    """Which lines of the block they are."""

    def words(self) -> Rows:
        """Where words begin."""
        begins = (self.text != SPACE) & (self.text != NEWLINE)
        begins[1:] &= ~begins[:-1]
        return np.flatnonzero(begins)

    def held(self, places: Rows) -> Rows:
        """How many of these places (ascending) each line holds."""
        ends = np.append(self.starts[1:], len(self.text))
        return np.searchsorted(places, ends) - np.searchsorted(places, self.starts)


def blocks(path: Path) -> Iterator[bytes]:
    """Whole lines, some megabytes at a time; a line that ends with a backslash goes on."""
    try:
        with regular(path).open("rb") as file:
            rest = file.read(3).removeprefix(b"\xef\xbb\xbf")
            while block := file.read(BLOCK):
                rest += block
                cut = rest.rfind(b"\n") + 1
                while cut and rest[:cut].rstrip(b"\r\n").endswith(b"\\"):
                    cut = rest.rfind(b"\n", 0, cut - 1) + 1
                if not cut and len(rest) > _LONGEST_LINE:
                    break
                yield rest[:cut]
                rest = rest[cut:]
    except FileNotFoundError as error:
        raise InputError(f"{path} does not exist.") from error
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise InputError(f"{path} cannot be read: {why}.") from error
    if len(rest) > _LONGEST_LINE:
        raise InputError(f"{path} is not an OBJ file: it has no lines; export it again.")
    yield rest


def lines_of(
    data: Bytes, starts: Rows, first: Rows, ends: Rows, wanted: NDArray[np.bool_], keyword: int
) -> Lines:
    """Lines of one kind; `first` is where their keywords of so many letters stand."""
    rows = np.flatnonzero(wanted)
    lengths = (ends - starts + 1)[rows]
    text = data[: ends[-1] + 1 if len(ends) else 0][np.repeat(wanted, ends - starts + 1)].copy()
    begin = np.cumsum(lengths) - lengths
    for i in range(keyword):
        text[begin + (first - starts)[rows] + i] = SPACE
    if _HASH in text:
        hashes = np.cumsum(text == _HASH)
        before = np.where(begin > 0, hashes[begin - 1], 0)
        text[(hashes > np.repeat(before, lengths)) & (text != NEWLINE)] = SPACE
    return Lines(text, begin, rows)


def following(numbers: NDArray[Any], at: Rows) -> NDArray[Any]:
    """Numbers after these places, or any where there is none."""
    after: NDArray[Any] = numbers[np.minimum(at + 1, max(len(numbers) - 1, 0))]
    return after


def resolved(numbers: Rows, count: Rows) -> Rows:
    """Rows from 0 of numbers from 1, or of negative ones from the last; negative: none."""
    return np.where(numbers > 0, numbers - 1, np.where(numbers < 0, count + numbers, -1))
