"""Positions of the nodes of an extract by id: in memory, or in a file where they are too many."""

from __future__ import annotations

import mmap
from contextlib import closing, suppress
from typing import TYPE_CHECKING

import numpy as np

from placegraph.core.files import cannot_write
from placegraph.io.osm import osm_nodes_kernels as kernels

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
AT_ONCE = 1 << 22
"""Nodes in no order that are sorted in memory at once: some 50 bytes each."""
SAMPLE = 256
"""Of so many nodes one tells where the others of its chunk may be cut."""


class Nodes:
    """Positions of nodes, 12 bytes each, in `index` where that is named; it is made, and removed by `close`.

    They stand in chunks by rising id: `first` (C,) ids, `bounds` (C + 1,) of nodes, and of each chunk in
    `words` how far ids lie behind the first, and then longitudes and latitudes by turns. What is added
    in no order is sorted `at_once` nodes at a time, and such runs are merged before any is looked for.
    """

    def __init__(self, index: Path | None = None, at_once: int = AT_ONCE) -> None:
        self.index, self.at_once = index, at_once
        self.first: list[int] = []
        self.last: list[int] = []
        self.counts: list[int] = []
        self.words: list[Steps] = []
        self.file: BinaryIO | None = None
        self._ready: tuple[Numbers, Numbers, Steps] | None = None
        self._map: mmap.mmap | None = None
        self._looked = 0
        self._run: list[tuple[Numbers, Steps]] = []  # what waits to be sorted

    def add(self, ids: Numbers, steps: Steps) -> None:
        """Add nodes (N,) at steps (N, 2); `MapError` where there is no room for them."""
        self._ready = None
        rising = bool((np.diff(ids) > 0).all())
        if rising and not self._run and not (len(ids) and self.last and ids[0] <= self.last[-1]):
            self.put(ids, steps)
            return
        self._run.append((ids, steps))
        if sum(len(some) for some, _ in self._run) >= self.at_once:
            self._end_run()

    def _end_run(self) -> None:
        """Sort what waits, and put it down."""
        if self._run:
            ids, steps = (np.concatenate(column) for column in zip(*self._run, strict=True))
            self._run = []
            self.put(*_in_order(ids, steps))

    def put(self, ids: Numbers, steps: Steps) -> None:
        """Put down nodes whose ids rise."""
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
            if self.file is not None:
                self.file.close()
        with suppress(OSError):
            if self.index is not None:
                self.index.unlink(missing_ok=True)

    def _write(self, words: Steps) -> None:
        if self.index is None:
            self.words.append(words)
            return
        try:
            if self.file is None:
                self.index.unlink(missing_ok=True)
                self.file = self.index.open("xb+")
            self.file.write(words.data)
        except OSError as error:
            raise cannot_write(self.index, error) from error

    def _settled(self) -> tuple[Numbers, Numbers, Steps]:
        self._end_run()
        if any(a >= b for a, b in zip(self.last, self.first[1:], strict=False)):
            self._merge()
        bounds = np.concatenate(([0], np.cumsum(self.counts, dtype=np.int64)))
        self._ready = np.array(self.first, np.int64), bounds, self.all_words()
        return self._ready

    def all_words(self) -> Steps:
        """What was put down so far."""
        if self.file is not None and self.index is not None:
            try:
                self.file.flush()
            except OSError as error:
                raise cannot_write(self.index, error) from error
            self._map = mmap.mmap(self.file.fileno(), 0, access=mmap.ACCESS_READ)
            return np.frombuffer(self._map, np.int32)
        self.words = [np.concatenate(self.words)] if self.words else []
        return self.words[0] if self.words else np.zeros(0, np.int32)

    def _merge(self) -> None:
        """Write chunks that overlap anew, in order: of all of them what lies between two ids, and so on."""
        first, counts = np.array(self.first, np.int64), np.array(self.counts, np.int64)
        bounds, words = np.concatenate(([0], np.cumsum(counts))), self.all_words()
        some = np.sort(kernels.sampled(first, bounds, words, SAMPLE))
        cuts = np.unique(some[:: max(1, self.at_once // SAMPLE)])
        beside = None if self.index is None else self.index.with_name(f"{self.index.name}.sorted")
        with closing(Nodes(beside)) as made:
            for low, high in zip(cuts, np.append(cuts[1:], max(self.last) + 1), strict=True):
                made.put(*_in_order(*kernels.between(first, bounds, words, low, high)))
                if self._map is not None:
                    self._map.madvise(mmap.MADV_DONTNEED)
            del words
            made.all_words()
            self.close()
            self.first, self.last, self.counts = made.first, made.last, made.counts
            self.words, self.file, made.file = made.words, made.file, None
            if self.index is not None and made.index is not None:
                made.index.rename(self.index)


def _in_order(ids: Numbers, steps: Steps) -> tuple[Numbers, Steps]:
    """Nodes by rising id; of one id the last."""
    order = np.argsort(ids, kind="stable")
    order = order[np.append(np.diff(ids[order]) > 0, True)]
    return ids[order], steps[order]
