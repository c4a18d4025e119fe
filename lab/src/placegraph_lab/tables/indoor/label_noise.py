"""The benchmark's noise model of labels: what a real encoder gets wrong, in one documented way.

Each patch that says something is, independently of all others and with probability `share`, made to
say something else: with instance labels another object of the map, with class labels another class
of the map, each of the others equally likely. `NoisyLabels` does that where there is no map: its
other labels are those of a vocabulary. Patches that say nothing go on saying nothing.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera
from placegraph.errors import OptionError
from placegraph.indoor.encode import MapEncoder, Patches
from placegraph.indoor.map.scene import Scene
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame

if TYPE_CHECKING:
    from placegraph.indoor.encode.labels import LabelsEncoder

SHARE = 0.3
_SAME = 1e-5  # cosines nearer to 1 are of one label


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
        self.encoder = encoder
        self.share = _checked(share)
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


class NoisyLabels:
    """An encoder of labels that mislabels patches, each as another label of a vocabulary.

    What a patch is taken for does not depend on any map. Synonyms are one label. The noise of a
    frame depends on what `NoisyEncoder`'s does.

    Parameters
    ----------
    encoder
        Says what the patches are.
    vocabulary
        Labels that a patch can be taken for; what says nothing is left out.
    share, seed, name
        As of `NoisyEncoder`.

    Raises
    ------
    OptionError
        `share` is no probability, or the vocabulary has no two labels.

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
        self.encoder = encoder
        self.share = _checked(share)
        self._seed = (seed, crc32(name.encode()))
        said = {v.tobytes(): v for v in map(encoder.vector, vocabulary) if v.any()}
        if len(said) < 2:
            raise OptionError("vocabulary: noise needs two labels at least that say something.")
        self.vectors = np.stack(list(said.values()))
        """(L, d) of the labels that a patch can be taken for."""
        self.name = encoder.name
        self.key = encoder.key
        self.dimension = encoder.dimension
        self.temperature = encoder.temperature

    def patches(self, image: Frame) -> NDArray[np.float32] | None:
        """Vectors (rows, columns, d) of a frame's patches, some of them wrong."""
        clean = self.encoder.patches(image)
        if clean is None:
            return None
        rng = np.random.default_rng([*self._seed, image.index])
        flat = clean.reshape(-1, self.dimension)
        wrong = (rng.random(len(flat)) < self.share) & flat.any(axis=1)
        cosines = flat @ self.vectors.T
        count = len(self.vectors)
        # counted on from its own label, or from any where that is not in the vocabulary
        known = cosines.max(axis=1) > 1 - _SAME
        own = np.where(known, cosines.argmax(axis=1), rng.integers(count, size=len(flat)))
        step = rng.integers(1, count, len(flat))
        other = self.vectors[(own + step) % count]
        return np.where(wrong[:, None], other, flat).reshape(clean.shape)

    def camera(self, image: Frame) -> Camera:
        """Camera whose image the grid divides."""
        return self.encoder.camera(image)

    def objects(self, scene: Scene, captures: Sequence[Capture] = ()) -> NDArray[np.float32]:
        """Vectors (N, d) of a map's objects: without noise."""
        return self.encoder.objects(scene, captures)


def _checked(share: float) -> float:
    if not 0 <= share <= 1:
        raise OptionError(f"share is {share}; it must lie between 0 and 1.")
    return share
