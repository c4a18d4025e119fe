"""From votes to one label a face: what a face, its patch and its neighbours were said to be."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from placegraph.indoor.mapping.segment.segment_kernels import elect

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from placegraph.indoor.mapping.segment.faces import Faces
    from placegraph.indoor.mapping.segment.votes import Votes

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

_DOUBT = 0.2
"""Votes that a face has for no label at all: few votes count less than their share."""
_PATCH = 1.0
"""What the opinion of the patch around it is worth to the face's own."""
_CELL = 0.2
"""Side of the cubes that patches fall into for this [m]: pictures may lie in a wall's patch."""
_NEIGHBOURS = 0.7
"""What its neighbours' labels are worth."""
_ROUNDS = 6


def label_faces(faces: Faces, votes: Votes, patch: Ints, steps: Floats) -> Ints:
    """Row of `votes.words` (F,) of each face; `NOTHING` where none is said or known.

    A face's score for a label is its own share of votes, that of its patch around it by area, and
    the share of its neighbours that bear the label, across steps (P,) less.
    """
    patch = _local(faces, patch)
    count = len(votes.words)
    face = np.repeat(np.arange(len(faces)), np.diff(votes.starts))
    total = np.bincount(face, votes.weights, len(faces)) + _DOUBT
    share = votes.weights / total[face]
    patches = int(patch.max()) + 1
    weighed = share * faces.areas[face]
    table = np.bincount(patch[face] * count + votes.labels, weighed, patches * count)
    seen = np.zeros(len(faces), np.bool_)
    seen[face] = True
    area = np.bincount(patch, faces.areas * seen, patches)
    shares = table.reshape(patches, count) / np.maximum(area, 1e-12)[:, None]
    links = np.exp(-(np.minimum(steps, 20.0) ** 2)) * faces.lengths
    labels = np.where(area[patch] > 0, np.argmax(shares, axis=1)[patch], -1)
    for _ in range(_ROUNDS):
        labels = elect(
            votes.starts, votes.labels, share, patch, shares, faces.pairs, links, labels,
            _PATCH, _NEIGHBOURS,
        )  # fmt: skip
    return np.maximum(labels, 0)


def _local(faces: Faces, patch: Ints) -> Ints:
    """Patches (F,) cut by a grid of cubes."""
    columns = [patch, *np.floor(faces.centres / _CELL).astype(np.int64).T]
    order = np.lexsort(columns)
    fresh = np.ones(len(patch), np.bool_)
    fresh[1:] = np.any([np.diff(column[order]) != 0 for column in columns], axis=0)
    out = np.empty(len(patch), np.int64)
    out[order] = np.cumsum(fresh) - 1
    return out
