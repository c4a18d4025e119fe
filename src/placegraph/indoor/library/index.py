"""Signatures of all scenes side by side: the columns that a search runs over."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from placegraph.indoor.library.signature import Signature


@dataclass(frozen=True, slots=True, eq=False)
class Vocabulary:
    """What the objects of a library look like to one encoder: each vector once."""

    vectors: NDArray[np.float32]
    """(U, d) unit, or zero."""
    code: NDArray[np.int32]
    """(M,) vector of each object."""
    common: NDArray[np.float64]
    """(U,) share of what is seen that looks like this, all scenes counting alike; adds up to 1."""


@dataclass(frozen=True, slots=True, eq=False)
class Index:
    """S scenes of M objects and K panoramas in all; made anew when scenes come or go."""

    starts: NDArray[np.int64]
    """(S + 1,) first object of each scene."""
    share: NDArray[np.float32]
    """(M,) of what is seen in its scene, by the square root: who stands before a thing sees more
    of it than who looks around, and no scene is the less likely for being large."""
    vocabularies: dict[str, Vocabulary]
    """By the key of the encoder."""
    place_starts: NDArray[np.int64]
    """(S + 1,) first panorama of each scene."""
    places: NDArray[np.float32]
    """(K, 2) [m]"""
    panoramas: NDArray[np.uint16]
    """(K, bands, turns)"""

    @classmethod
    def of(cls, signatures: Sequence[Signature], keys: Sequence[str]) -> Index:
        """Index of scenes that all have vectors under these keys."""
        seen = np.concatenate([s.share for s in signatures])
        roots = [np.sqrt(s.share) for s in signatures]
        return cls(
            starts=starts_of([len(s) for s in signatures]),
            share=np.concatenate([r / r.sum() for r in roots]),
            vocabularies={
                key: vocabulary(
                    np.concatenate([s.vectors[key] for s in signatures]), seen / len(signatures)
                )
                for key in keys
            },
            place_starts=starts_of([len(s.places) for s in signatures]),
            places=np.concatenate([s.places for s in signatures]),
            panoramas=np.concatenate([s.panoramas for s in signatures]),
        )

    def __len__(self) -> int:
        return len(self.starts) - 1


def vocabulary(vectors: NDArray[np.float32], weight: NDArray[np.floating]) -> Vocabulary:
    """Vocabulary of objects with vectors (M, d), seen with these weights (M,)."""
    first, code = distinct(vectors)
    common = np.bincount(code, weight, len(first))
    return Vocabulary(vectors[first], code.astype(np.int32), common / common.sum())


def distinct(rows: NDArray[np.float32]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First rows (U,) of those that differ of rows (P, d), and which of them each is (P,).

    By a 64-bit hash: sorting the rows themselves would take a hundred times as long.
    """
    bits = np.ascontiguousarray(rows, np.float32).view(np.uint32).astype(np.uint64)
    factors = np.cumprod(np.full(rows.shape[1], 0x9E3779B97F4A7C15, np.uint64), dtype=np.uint64)
    mixed = (bits + np.uint64(0x632BE5AB)) * factors
    hashes = (mixed ^ (mixed >> np.uint64(29))).sum(axis=1, dtype=np.uint64)
    _, first, code = np.unique(hashes, return_index=True, return_inverse=True)
    return first, code.ravel()


def starts_of(counts: Sequence[int] | NDArray[np.int64]) -> NDArray[np.int64]:
    """First row (S + 1,) of each of S runs of these lengths, and where the last ends."""
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
