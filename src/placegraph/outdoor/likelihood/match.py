"""How well a viewpoint explains a description: a generative reading, compiled.

A speaker at viewpoint v picks things in sight and says how they lie. A statement s then has

    P(s | v) = (1 - noise) * sum over map objects that serve s of sight * word * geometry / normaliser
               + noise * P(s | anywhere)

and its log-likelihood ratio log P(s | v) / P(s | anywhere) is the evidence it brings. Directions are
soft: a little wrong costs little, the opposite costs all that `noise` leaves. What no map object in
sight serves may still be served from afar, if the thing is rare enough to be spoken of from there.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


class Statements(NamedTuple):
    """Columns of a compiled query, one row a statement."""

    op: NDArray[np.int64]
    source: NDArray[np.int64]
    """Mention, or ME."""
    target: NDArray[np.int64]
    """Mention, or ME."""
    target2: NDArray[np.int64]
    """Mention, or ME; of BETWEEN only."""
    bearing: NDArray[np.float32]
    """(S, 2) unit vector east, north."""
    table: NDArray[np.float32]
    """(S, TABLE) P(the direction was said | cosine of the angle to it)."""
    distance: NDArray[np.float32]
    """Stated distance [m], 0 where unsaid."""
    negated: NDArray[np.bool_]
    number: NDArray[np.float32]
    """Stated number of sources, 0 where unsaid."""
    noise: NDArray[np.float32]
    """Share of statements of this kind that are wrong or about something else."""
    background: NDArray[np.float32]
    """P(statement | anywhere)."""
    crowd: float
    """Added to the number of pairs in sight: who sees few things is no more likely to be heard."""
