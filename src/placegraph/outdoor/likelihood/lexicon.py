"""What words are compiled against: a city, or a world of many."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from placegraph.outdoor.language.vocabulary import Vocabulary
from placegraph.outdoor.map.names import NameIndex


class Known(Protocol):
    """What words and names mean where a text is read. A `City` says so."""

    @property
    def vocabulary(self) -> Vocabulary:
        """What words mean."""

    @property
    def name_index(self) -> NameIndex:
        """Proper names."""

    def block_length(self, bearing: float | None) -> float:
        """How long a block is [m] in a direction [rad], or in any."""


class Labelled(Protocol):
    """Things by row, as `CityObjects` has them."""

    @property
    def labels(self) -> tuple[str, ...]:
        """All labels that there are."""

    @property
    def kind(self) -> NDArray[np.uint8]:
        """(N,) POINT, LINE or AREA."""

    def label(self, i: int) -> str:
        """Most specific label of a thing."""


class Lexicon(Protocol):
    """Words of a map; its tokens are labels, then names. A `City` is one."""

    @property
    def objects(self) -> Labelled:
        """Things, as far as `bearers` names them."""

    @property
    def label_index(self) -> Mapping[str, Sequence[int]]:
        """Tokens by label and by ``key=*``."""

    @property
    def name_index(self) -> NameIndex:
        """Proper names."""

    def frequency(self, tokens: NDArray[np.int32], weights: NDArray[np.float32]) -> float:
        """Share of all things in sight, over all viewpoints, that these tokens stand for."""

    def borne(self, tokens: NDArray[np.int32]) -> NDArray[np.int64]:
        """How many things (K,) bear each of these tokens."""

    def bearers(self, tokens: NDArray[np.int32]) -> list[NDArray[np.int64]]:
        """Rows of the things that bear each of these tokens, in the order of the tokens."""
