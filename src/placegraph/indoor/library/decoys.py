"""Homes that are in no library: what a capture shows is weighed against them, too.

A library of one scene could say nothing of what is rare, and every capture would be of the best of
its scenes. So drawn homes of many styles stand beside it (`placegraph-lab decoys` makes them, of homes
that no figure is taken on): they tell what is usual in homes, and a capture that fits some of them
as well as any scene was taken elsewhere. Speaker verification calls such a set a cohort.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from importlib.resources import as_file, files
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from placegraph.indoor.encode import Encoder
    from placegraph.indoor.library.signature import Signature

FILE = "data/decoys.library"


def decoys(encoders: Sequence[Encoder]) -> list[Signature]:
    """Signatures of the homes, with vectors of these encoders.

    Vectors of labels are made of the labels; of encoders that the file has no vectors of, they are
    zero: to these, the homes say neither yes nor no.
    """
    return [replace(s, vectors={e.key: _vectors(s, e) for e in encoders}) for s in _signatures()]


@lru_cache(maxsize=1)
def _signatures() -> tuple[Signature, ...]:
    from placegraph.indoor.library.library_file import signatures_of

    with as_file(files("placegraph.indoor.library").joinpath(FILE)) as path:
        return signatures_of(path)


def _vectors(
    signature: Signature, encoder: Encoder
) -> np.ndarray[tuple[int, int], np.dtype[np.float32]]:
    if encoder.name == "labels":
        from placegraph.indoor.encode.labels import LabelsEncoder

        assert isinstance(encoder, LabelsEncoder)  # noqa: S101
        return np.stack([encoder.vector(label) for label in signature.graph.labels])
    zeros = np.zeros((len(signature), encoder.dimension), np.float32)
    return signature.vectors.get(encoder.key, zeros)
