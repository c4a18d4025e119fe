"""The encoder itself: pictures and maps in, vectors out."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from placegraph.indoor.encode.compact import picture, things
from placegraph.indoor.encode.compact.network import Network
from placegraph.indoor.encode.compact.weights import Weights, read_weights, shipped
from placegraph.indoor.encode.words import digest, vector

if TYPE_CHECKING:
    from collections.abc import Sequence
    from os import PathLike

    from numpy.typing import NDArray

    from placegraph.formats.capture.capture import Capture
    from placegraph.formats.capture.frame import Frame
    from placegraph.geometry import Camera
    from placegraph.indoor.map.scene import Scene

    Floats = NDArray[np.float32]


class CompactEncoder:
    """Patches of colour images against shape, size, colours and label of objects.

    Labels help where a map has some; none are needed. Depth and label images are not looked at.

    Parameters
    ----------
    weights
        A weights file of `placegraph-lab compact train`; those that come with placegraph if not given.

    Raises
    ------
    InputError
        There is no such file.
    MapError
        It is damaged, or no weights file.

    """

    name = "compact"

    def __init__(self, weights: str | PathLike[str] | None = None) -> None:
        held = _shipped() if weights is None else read_weights(weights)
        self.network = Network(held.shape, held.arrays)
        self.key = f"compact {held.fingerprint} {digest()}"
        self.dimension = held.shape.dimension
        self.temperature = held.temperature

    def patches(self, image: Frame) -> Floats:
        """Unit vectors (rows, columns, d) of patches of the colour image; it needs gravity.

        About 144 patches, nearly square. All are zero where the image shows one colour only, as
        behind a lid. Raises `InputError` where the image is broken.
        """
        grid = picture.grid_of(image.camera)
        rgb = picture.small(image.rgb(), grid)
        if (rgb == rgb[0, 0]).all():
            return np.zeros((*grid, self.dimension), np.float32)
        cells = picture.inputs(
            picture.log_of_bytes()[rgb],
            picture.rises(image.camera, image.gravity, grid),
            picture.span(image.camera, grid),
        )
        return self.network.see(cells)

    def camera(self, image: Frame) -> Camera:
        """Camera of the colour images."""
        return image.camera

    def objects(self, scene: Scene, captures: Sequence[Capture] = ()) -> Floats:  # noqa: ARG002
        """Unit vectors (N, d) of a map's objects; `captures` are not needed."""
        words = np.stack([vector(label) for label in scene.graph.labels])
        return self.network.know(things.features(things.describe(scene), words))


@lru_cache(maxsize=1)
def _shipped() -> Weights:
    return read_weights(shipped())
