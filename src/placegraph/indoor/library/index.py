"""Signatures of all scenes side by side: the columns that a search runs over."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from placegraph.indoor.library.search_kernels import row_hashes
from placegraph.indoor.library.signature import Signature
from placegraph.vectors import EmbeddedStore

SAMPLE = 1024
"""Vectors that stand for all of a library's."""


@dataclass(frozen=True, slots=True, eq=False)
class Vocabulary:
    """What the objects of a library look like to one encoder: each vector once."""

    vectors: NDArray[np.float32]
    """(U, d) unit, or zero: nothing is known."""
    unknown: NDArray[np.int64]
    """Rows of these that are zero."""
    code: NDArray[np.int32]
    """(M,) vector of each object."""
    usual: NDArray[np.int64]
    """(B,) rows of `vectors` that are seen anywhere, `SAMPLE` at most."""
    common: NDArray[np.float32]
    """(B,) share of what is seen that looks like this, all scenes counting alike; adds up to 1."""

    @classmethod
    def of(cls, vectors: NDArray[np.float32], weight: NDArray[np.floating]) -> Vocabulary:
        """Vocabulary of objects with vectors (M, d), seen with these weights (M,)."""
        first, code = distinct(vectors)
        own = np.ascontiguousarray(vectors[first])
        share = np.bincount(code, weight, len(first))
        known = np.flatnonzero(own.any(axis=1))
        rows = known[np.unique(np.linspace(0, max(0, len(known) - 1), SAMPLE).astype(np.int64))]
        common = share[rows] / max(1e-12, share[rows].sum())
        unknown = np.flatnonzero(~own.any(axis=1))
        return cls(own, unknown, code.astype(np.int32), rows, common.astype(np.float32))

    @property
    def mean(self) -> NDArray[np.float32]:
        """(d,) of what is seen anywhere."""
        return np.asarray(self.common @ self.vectors[self.usual])

    def of_objects(self, rows: NDArray[np.int64]) -> Vocabulary:
        """Vocabulary of some objects, with the same notion of what is usual."""
        used = np.concatenate([self.code[rows], self.usual])
        numbers = np.arange(len(used))
        return replace(
            self,
            vectors=self.vectors[used],
            unknown=np.flatnonzero(np.isin(used, self.unknown)),
            code=numbers[: len(rows)].astype(np.int32),
            usual=numbers[len(rows) :],
        )


@dataclass(frozen=True, slots=True, eq=False)
class Unit:
    """What is compared with a capture: a scene, or one of those that a scene was merged of."""

    scene: int
    """Row of the signature."""
    objects: NDArray[np.int64]
    """(N,) rows in the signature."""
    panoramas: NDArray[np.uint16]
    """(P, bands, turns) rows of `objects`, N where the unit ends."""
    places: NDArray[np.float32]
    """(P, 2) [m]"""


def units(signatures: Sequence[Signature]) -> Iterator[Unit]:
    """Units of scenes, in their order."""
    for row, s in enumerate(signatures):
        for part in np.unique(s.part):
            objects = np.flatnonzero(s.part == part)
            number = np.full(len(s) + 1, len(objects), np.uint16)
            number[objects] = np.arange(len(objects))
            own = s.place_part == part
            yield Unit(row, objects, number[s.panoramas[own]], s.places[own])


@dataclass(frozen=True, eq=False)
class Index:
    """S units of M objects and K panoramas in all; made anew when scenes come or go."""

    owner: NDArray[np.int64]
    """(S,) scene of each unit, ascending."""
    starts: NDArray[np.int64]
    """(S + 1,) first object of each unit."""
    share: NDArray[np.float32]
    """(M,) of what is seen in its unit, by the square root: who stands before a thing sees more of
    it than who looks around."""
    vocabularies: dict[str, Vocabulary]
    """By the key of the encoder."""
    place_starts: NDArray[np.int64]
    """(S + 1,) first panorama of each unit."""
    places: NDArray[np.float32]
    """(K, 2) [m]"""
    panoramas: NDArray[np.uint16]
    """(K, bands, turns)"""

    @classmethod
    def of(cls, signatures: Sequence[Signature], keys: Sequence[str]) -> Index:
        """Index of scenes that all have vectors under these keys."""
        parts = list(units(signatures))
        seen = [signatures[u.scene].share[u.objects] for u in parts]
        roots = [np.sqrt(share) for share in seen]
        return cls(
            owner=np.array([u.scene for u in parts]),
            starts=starts_of([len(u.objects) for u in parts]),
            share=np.concatenate([r / r.sum() for r in roots]).astype(np.float32),
            vocabularies={
                key: Vocabulary.of(
                    np.concatenate([signatures[u.scene].vectors[key][u.objects] for u in parts]),
                    np.concatenate([share / share.sum() for share in seen]),
                )
                for key in keys
            },
            place_starts=starts_of([len(u.places) for u in parts]),
            places=np.concatenate([u.places for u in parts]),
            panoramas=np.concatenate([u.panoramas for u in parts]),
        )

    def __len__(self) -> int:
        return len(self.starts) - 1

    @cached_property
    def shown(self) -> NDArray[np.bool_]:
        """(M,) whether any panorama shows an object."""
        first = np.repeat(self.starts[:-1], np.diff(self.place_starts))[:, None, None]
        last = np.repeat(self.starts[1:], np.diff(self.place_starts))[:, None, None]
        seen = first + self.panoramas.astype(np.int64)
        out = np.zeros(int(self.starts[-1]), np.bool_)
        out[seen[seen < last]] = True
        return out

    @cached_property
    def store(self) -> EmbeddedStore:
        """Vectors of whole scenes, for `nearest`; made on first use."""
        rows = np.zeros((len(self), sum(v.vectors.shape[1] for v in self.vocabularies.values())))
        first = 0
        for v in self.vocabularies.values():
            last = first + v.vectors.shape[1]
            parts = (v.vectors - v.mean)[v.code] * self.share[:, None]
            rows[:, first:last] = np.add.reduceat(parts, self.starts[:-1], axis=0)
            first = last
        rows += 1e-9  # a scene that is like all others has no direction
        return EmbeddedStore.of(np.arange(len(self)), rows, bits=32)

    def nearest(self, words: Mapping[str, NDArray[np.floating]], most: int) -> NDArray[np.int64]:
        """Rows of the scenes most like what was said: the mean vector (d,) by encoder's key."""
        parts = [
            words[key] - v.mean if key in words else np.zeros(v.vectors.shape[1])
            for key, v in self.vocabularies.items()
        ]
        found = self.store.search(np.concatenate(parts)[None].astype(np.float32) + 1e-9, most)
        return np.sort(found.ids[0])

    def subset(self, rows: NDArray[np.int64]) -> Index:
        """Index of some scenes, with the same notion of what is usual."""
        objects = runs(self.starts, rows)
        places = runs(self.place_starts, rows)
        return Index(
            owner=np.unique(self.owner[rows], return_inverse=True)[1].ravel(),
            starts=starts_of(np.diff(self.starts)[rows]),
            share=self.share[objects],
            vocabularies={key: v.of_objects(objects) for key, v in self.vocabularies.items()},
            place_starts=starts_of(np.diff(self.place_starts)[rows]),
            places=self.places[places],
            panoramas=self.panoramas[places],
        )


def distinct(rows: NDArray[np.float32]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First rows (U,) of those that differ of rows (P, d), and which of them each is (P,).

    By a 64-bit hash: sorting the rows themselves would take a hundred times as long.
    """
    hashes = row_hashes(np.ascontiguousarray(rows, np.float32).view(np.uint32))
    _, first, code = np.unique(hashes, return_index=True, return_inverse=True)
    return first, code.ravel()


def starts_of(counts: Sequence[int] | NDArray[np.int64]) -> NDArray[np.int64]:
    """First row (S + 1,) of each of S runs of these lengths, and where the last ends."""
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)


def runs(starts: NDArray[np.int64], rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """All numbers from starts[r] to starts[r + 1], for each of some rows."""
    counts = np.diff(starts)[rows]
    first = np.repeat(starts[rows] - starts_of(counts)[:-1], counts)
    return np.asarray(first + np.arange(int(counts.sum())))
