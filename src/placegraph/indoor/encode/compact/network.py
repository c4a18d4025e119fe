"""Both towers without PyTorch; equations and names are `torch_network.py`'s, and a test compares."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from placegraph.indoor.encode.compact.picture_kernels import mixed, normalized

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from placegraph.indoor.encode.compact.shape import Shape

    Floats = NDArray[np.float32]

FARTHEST = 4.0
"""Features of objects are cut off this many deviations from what is usual."""


class Network:
    """Weights, laid out for the processor.

    Parameters
    ----------
    shape
        Sizes.
    arrays
        Weights by the names of `Shape.arrays`, float32.

    """

    def __init__(self, shape: Shape, arrays: Mapping[str, Floats]) -> None:
        self.shape = shape
        self.arrays = dict(arrays)
        for name in arrays:
            if name.endswith(".mix.weight"):  # (C, 1, K, K): channels side by side are quicker
                own = arrays[name][:, 0].transpose(1, 2, 0)
                self.arrays[name] = np.ascontiguousarray(own)

    def see(self, cells: Floats) -> Floats:
        """Unit vectors (rows, columns, d) of patches from `picture.inputs` of a picture."""
        rows, columns = cells.shape[:2]
        x = self._norm("stem_norm", self._linear("stem", cells.reshape(rows * columns, -1)))
        for i in range(self.shape.fine_blocks):
            x = self._block(f"fine.{i}", x, rows, columns)
        x = self._norm("merge_norm", x)
        rows, columns = rows // 2, columns // 2
        x = x.reshape(rows, 2, columns, 2, -1).swapaxes(1, 2).reshape(rows * columns, -1)
        x = self._linear("merge", np.ascontiguousarray(x))
        for i in range(self.shape.coarse_blocks):
            x = self._block(f"coarse.{i}", x, rows, columns)
        x = self._linear("head", self._norm("head_norm", x))
        return unit(x).reshape(rows, columns, -1)

    def know(self, features: Floats) -> Floats:
        """Unit vectors (N, d) of objects from their `things.features` (N, FEATURES)."""
        x = (features - self.arrays["usual"]) / self.arrays["spread"]
        x = np.clip(x, -FARTHEST, FARTHEST).astype(np.float32)
        x = np.maximum(self._norm("thing_norm", self._linear("thing", x)), 0.0)
        x += self._linear("thing_down", np.maximum(self._linear("thing_up", x), 0.0))
        return unit(self._linear("thing_head", x))

    def _block(self, name: str, x: Floats, rows: int, columns: int) -> Floats:
        """Mix neighbours, then channels, with the mean of the whole picture beside them."""
        of = self.arrays
        y = mixed(
            x.reshape(rows, columns, -1), of[f"{name}.mix.weight"], of[f"{name}.mix.bias"],
            of[f"{name}.norm.weight"], of[f"{name}.norm.bias"],
        )  # fmt: skip
        hidden = self._linear(f"{name}.up", y)
        hidden += self._linear(f"{name}.whole", y.mean(axis=0, keepdims=True))
        np.maximum(hidden, 0.0, out=hidden)
        return x + self._linear(f"{name}.down", hidden)

    def _linear(self, name: str, x: Floats) -> Floats:
        y: Floats = x @ self.arrays[f"{name}.weight"].T
        y += self.arrays[f"{name}.bias"]
        return y

    def _norm(self, name: str, x: Floats) -> Floats:
        out: Floats = normalized(x, self.arrays[f"{name}.weight"], self.arrays[f"{name}.bias"])
        return out


def unit(x: Floats) -> Floats:
    """Rows of length 1."""
    lengths = np.sqrt((x * x).sum(axis=-1, keepdims=True))
    out: Floats = x / np.maximum(lengths, np.float32(1e-6))
    return out
