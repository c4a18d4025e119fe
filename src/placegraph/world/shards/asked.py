"""What is sent to shards, and what they send back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from placegraph.outdoor.likelihood.query import Query
    from placegraph.world.shards.lexicon import Thing


class Fix(NamedTuple):
    """Where the speaker is known to be near."""

    longitude: float
    latitude: float
    radius: float
    """[m]"""
    norm: float = 0.0
    """Log of what all viewpoints of the world weigh together, before it is known how far off it is."""


@dataclass(frozen=True, eq=False)
class Asked:
    """A query against the whole world, as every shard gets it."""

    query: Query
    """Its tokens are those of the world, its rare objects rows of `things`."""
    words: tuple[str, ...]
    """What each of its tokens reads (`Words.reads`)."""
    things: tuple[Thing, ...]
    viewpoints: int
    """Of the world."""
    fix: Fix | None


class Proposed(NamedTuple):
    """Candidates of a shard, the most promising first."""

    rows: NDArray[np.int32]
    """(K,) viewpoints of the shard."""
    bounds: NDArray[np.float64]
    """(K,) on the likelihood ratio, times the prior against `highest`."""
    far: NDArray[np.float32]
    """(K, S) what things out of sight add."""
    log_prior: NDArray[np.float64]
    """(K,)"""
    left_out: float
    """Sum of the bounds of what is not listed."""
    highest: float
    """Largest log prior of the shard."""
    origin: tuple[float, float]
    """Of the shard's plane [deg]."""

    def part(self, kept: NDArray[np.int64]) -> Proposed:
        """Some of the candidates."""
        return self._replace(
            rows=self.rows[kept], bounds=self.bounds[kept], far=self.far[kept],
            log_prior=self.log_prior[kept],
        )  # fmt: skip


class Compared(NamedTuple):
    """Scores of candidates."""

    scores: NDArray[np.float64]
    """(K,) log-likelihood ratios; -inf where one cannot matter in its shard."""
    hopes: NDArray[np.float64]
    """(K,) as of `Scored`."""
    positions: NDArray[np.float64]
    """(K, 2) east, north in the shard's plane [m]."""
