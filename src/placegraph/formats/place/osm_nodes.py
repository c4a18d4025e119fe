"""Positions of the nodes of an extract by id: in memory, or in a file where they are too many."""

from __future__ import annotations

import mmap
from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np

from placegraph.files import cannot_write
from placegraph.formats.place import osm_nodes_kernels as kernels

if TYPE_CHECKING:
    from pathlib import Path
    from typing import BinaryIO

    from numpy.typing import NDArray

    Numbers = NDArray[np.int64]
    Steps = NDArray[np.int32]

WIDE = 1 << 32
"""Ids of a chunk are less than this apart."""
TOUCHED = 256 << 20
"""Bytes of a file that are looked at until the system may have their memory back, about."""


class Nodes:
    """Positions of nodes, 12 bytes each, in `index` where that is named; it is made, and removed by `close`.

    They stand in chunks by rising id: `first` (C,) ids, `bounds` (C + 1,) of nodes, and of each chunk in
    `words` how far ids lie behind the first, and then longitudes and latitudes by turns.
    """

    def __init__(self, index: Path | None = None) -> None:
        self.index = index
        self.first: list[int] = []
        self.last: list[int] = []
        self.counts: list[int] = []
        self._words: list[Steps] = []
        self._file: BinaryIO | None = None
        self._ready: tuple[Numbers, Numbers, Steps] | None = None
        self._map: mmap.mmap | None = None
        self._looked = 0

    def add(self, ids: Numbers, steps: Steps) -> None:
        """Add nodes (N,) at steps (N, 2); `MapError` where there is no room for them."""
        if (np.diff(ids) <= 0).any():
            order = np.argsort(ids, kind="stable")
            order = order[np.append(np.diff(ids[order]) > 0, True)]  # the last of one id counts
            ids, steps = ids[order], steps[order]
        self._ready = None
        while len(ids):
            n = (
                int(np.searchsorted(ids, int(ids[0]) + WIDE))
                if int(ids[-1]) - int(ids[0]) >= WIDE
                else len(ids)
            )
            offsets = (ids[:n] - ids[0]).astype(np.uint32).view(np.int32)
            self.first.append(int(ids[0]))
            self.last.append(int(ids[n - 1]))
            self.counts.append(n)
            self._write(np.concatenate([offsets, steps[:n].reshape(-1)]))
            ids, steps = ids[n:], steps[n:]

    def find(self, ids: Numbers) -> tuple[Steps, NDArray[np.bool_]]:
        """Positions (K, 2) of nodes by id in steps of 1e-7 degrees, and which are known."""
        first, bounds, words = self._ready or self._settled()
        found: tuple[Steps, NDArray[np.bool_]] = kernels.placed(first, bounds, words, ids)
        self._looked += 64 * len(ids)
        if self._map is not None and self._looked > TOUCHED:
            self._map.madvise(mmap.MADV_DONTNEED)
            self._looked = 0
        return found

    def close(self) -> None:
        """Remove the file."""
        self._ready = self._map = None
        with suppress(OSError):  # what was not written yet
            if self._file is not None:
                self._file.close()
        with suppress(OSError):
            if self.index is not None:
                self.index.unlink(missing_ok=True)

    def _write(self, words: Steps) -> None:
        if self.index is None:
            self._words.append(words)
            return
        try:
            if self._file is None:
                self.index.unlink(missing_ok=True)
                self._file = self.index.open("xb+")
            self._file.write(words.data)
        except OSError as error:
            raise cannot_write(self.index, error) from error

    def _settled(self) -> tuple[Numbers, Numbers, Steps]:
        if any(a >= b for a, b in zip(self.last, self.first[1:], strict=False)):
            self._sort()
        words = np.zeros(0, np.int32)
        if self._file is not None and self.index is not None:
            try:
                self._file.flush()
            except OSError as error:
                raise cannot_write(self.index, error) from error
            self._map = mmap.mmap(self._file.fileno(), 0, access=mmap.ACCESS_READ)
            words = np.frombuffer(self._map, np.int32)
        elif self._words:
            words = np.concatenate(self._words)
            self._words = [words]
        bounds = np.concatenate(([0], np.cumsum(self.counts, dtype=np.int64)))
        self._ready = np.array(self.first, np.int64), bounds, words
        return self._ready

    def _sort(self) -> None:
        """Put nodes that were added in no order, in memory, into order."""
        if self._file is not None and self.index is not None:
            self._file.flush()
            self._words = [np.fromfile(self.index, np.int32)]
            self._file.close()
            self._file = None
        words, ids, steps = np.concatenate(self._words), [], []
        for first, n, end in zip(self.first, self.counts, np.cumsum(self.counts), strict=True):
            mine = words[3 * (end - n) : 3 * end]
            ids.append(first + mine[:n].view(np.uint32).astype(np.int64))
            steps.append(mine[n:].reshape(-1, 2))
        self.first, self.last, self.counts, self._words = [], [], [], []
        self.add(np.concatenate(ids), np.concatenate(steps))
