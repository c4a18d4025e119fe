"""The benchmark's noise model of labels: what a real encoder gets wrong, in one documented way.

Each patch that says something is, independently of all others and with probability `share`, made to
say something else: with instance labels another object of the map, with class labels another class
of the map, each of the others equally likely. Patches that say nothing go on saying nothing.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING
from zlib import crc32

import numpy as np

from placegraph.errors import OptionError

if TYPE_CHECKING:
    from placegraph.formats.frame import Frame
    from placegraph.indoor.encode import MapEncoder, Patches

SHARE = 0.3


class NoisyEncoder:
    """An encoder that mislabels patches of another one.

    The noise of a frame depends on `seed`, `name` and the frame's row in its folder alone: it is
    the same in every pass and in every window that holds the frame, whatever was encoded before.

    Parameters
    ----------
    encoder
        Says what the patches are.
    share
        Probability of a patch to be mislabelled, 0 to 1.
    seed
        Of the noise.
    name
        Of the sequence, so that the frames of two sequences err differently.

    Raises
    ------
    OptionError
        Where `share` is no probability.

    """

    def __init__(
        self, encoder: MapEncoder, share: float = SHARE, *, seed: int = 0, name: str = ""
    ) -> None:
        if not 0 <= share <= 1:
            raise OptionError(f"share is {share}; it must lie between 0 and 1.")
        self.encoder = encoder
        self.share = share
        self._seed = (seed, crc32(name.encode()))

    def encode(self, frame: Frame) -> Patches | None:
        """Patches of a frame, some of them wrong; None where the encoder has none."""
        patches = self.encoder.encode(frame)
        if patches is None:
            return None
        rng = np.random.default_rng([*self._seed, frame.index])
        return mislabel(patches, self.share, rng)


def mislabel(patches: Patches, share: float, rng: np.random.Generator) -> Patches:
    """Replace a share of the patches' rows by others of the table, each equally likely."""
    count = len(patches.table)
    wrong = rng.random(len(patches.rows)) < share
    step = rng.integers(1, max(count, 2), len(patches.rows))
    wrong &= (patches.rows >= 0) & (count > 1)
    rows = np.where(wrong, (patches.rows + step) % max(count, 1), patches.rows)
    return replace(patches, rows=rows.astype(np.int32))
