"""Triples (label, relation, label) between the objects around viewpoints (Eq. 5-6)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph_lab.tables.outdoor.nearby import Around
from placegraph_lab.tables.outdoor.raw import Ints
from placegraph_lab.tables.outdoor.triples_kernels import EAST, LONGEST, NORTH, SOUTH, WEST, _pairs

DIRECTIONS = ("north", "south", "east", "west")


def relations(delta: ArrayLike) -> NDArray[np.int8]:
    """Direction (...) of A seen from B, for A - B (..., 2) east, north [m] (Eq. 6).

    An index into `DIRECTIONS`. The equation leaves |dx| = |dy| open: north and south win here.
    """
    dx, dy = np.moveaxis(np.asarray(delta, np.float64), -1, 0)
    upright = np.where(dy > 0.0, NORTH, SOUTH)
    return np.where(np.abs(dx) <= np.abs(dy), upright, np.where(dx > 0.0, EAST, WEST)).astype(
        np.int8
    )


@dataclass(frozen=True)
class Triples:
    """Ordered pairs of objects around V viewpoints; viewpoint v has `starts[v]:starts[v + 1]`."""

    starts: Ints
    """(V + 1,)"""
    source: NDArray[np.int32]
    """(T,) entry of the `Around`: what is described."""
    target: NDArray[np.int32]
    """(T,) entry of the `Around`: what it is described by."""
    relation: NDArray[np.int8]
    """(T,) index into `DIRECTIONS`: the source seen from the target."""

    @classmethod
    def of(cls, around: Around, longest: float = LONGEST) -> Triples:
        """All ordered pairs of objects `SHORTEST` to `longest` apart [m]."""
        return cls(*_pairs(around.starts, around.points, longest))

    def codes(self, around: Around, label: NDArray[np.int32], labels: int) -> Ints:
        """(T,) one integer a triple of labels, where `label` (N,) counts up to `labels`."""
        return encode(
            label[around.objects[self.source]],
            self.relation,
            label[around.objects[self.target]],
            labels,
        )


def encode(source: ArrayLike, relation: ArrayLike, target: ArrayLike, labels: int) -> Ints:
    """Code of triples: ``(source * 4 + relation) * labels + target``."""
    head = np.asarray(source, np.int64) * len(DIRECTIONS) + np.asarray(relation, np.int64)
    return np.asarray(head * labels + np.asarray(target, np.int64))
