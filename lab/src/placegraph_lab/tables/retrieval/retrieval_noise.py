"""Errors that stay: a thing taken for another in one frame is taken for it in the next ones, too.

Segmentations err like that. The noise of `label_noise` is drawn for every patch by itself, so that
many frames wash it out; this one is drawn for a thing as long as it is in view.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING
from zlib import crc32

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from placegraph.io.capture.frame import Frame
from placegraph_lab.tables.indoor.label_noise import SHARE, NoisyLabels

if TYPE_CHECKING:
    from placegraph.indoor.encode.labels import LabelsEncoder

_AROUND = np.ones((3, 3), np.bool_)


class NoisyThings(NoisyLabels):
    """An encoder of labels that mislabels whole things, alike in all frames that follow.

    A thing is a connected region of patches that say the same; it is the one of the frame before
    that says the same within a patch of it, the largest of several. Frames are to be asked for
    in order, each once. Parameters and errors are those of `NoisyLabels`.
    """

    def __init__(
        self,
        encoder: LabelsEncoder,
        vocabulary: Iterable[str],
        share: float = SHARE,
        *,
        seed: int = 0,
        name: str = "",
    ) -> None:
        super().__init__(encoder, vocabulary, share, seed=seed, name=name)
        self._rng = np.random.default_rng([seed, crc32(name.encode())])
        self._words: dict[bytes, int] = {}
        self._before: tuple[NDArray[np.int64], NDArray[np.int64]] | None = None
        self._taken: list[NDArray[np.float32] | None] = []
        """Of each thing what it is taken for; None: for itself."""

    def patches(self, image: Frame) -> NDArray[np.float32] | None:
        """Vectors (rows, columns, d) of the next frame's patches, those of some things wrong."""
        clean = self.encoder.patches(image)
        if clean is None:
            return None
        words = self._numbered(clean)
        things = np.full(words.shape, -1)
        out = clean.copy()
        for word in np.unique(words[words >= 0]):
            regions, count = ndimage.label(words == word)
            for region in range(1, count + 1):
                own = regions == region
                thing = self._before_this(own, int(word))
                if thing is None:
                    thing = len(self._taken)
                    self._taken.append(self._drawn(clean[own][0]))
                things[own] = thing
                taken = self._taken[thing]
                if taken is not None:
                    out[own] = taken
        self._before = words, things
        return out

    def _numbered(self, clean: NDArray[np.float32]) -> NDArray[np.int64]:
        """Number (rows, columns) of what each patch says; -1 of nothing."""
        words = np.full(clean.shape[:2], -1)
        for at in zip(*np.nonzero(clean.any(axis=2)), strict=True):
            words[at] = self._words.setdefault(clean[at].tobytes(), len(self._words))
        return words

    def _before_this(self, own: NDArray[np.bool_], word: int) -> int | None:
        if self._before is None:
            return None
        words, things = self._before
        near = things[ndimage.binary_dilation(own, _AROUND) & (words == word)]
        return int(np.bincount(near).argmax()) if near.size else None

    def _drawn(self, vector: NDArray[np.float32]) -> NDArray[np.float32] | None:
        if self._rng.random() >= self.share:
            return None
        others = self.vectors[self.vectors @ vector < 1 - 1e-5]
        return np.asarray(others[self._rng.integers(len(others))])
