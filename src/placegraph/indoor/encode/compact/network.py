"""Both towers without PyTorch; equations and names are `torch_network.py`'s, and a test compares."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph.indoor.encode.compact.picture import INPUTS
from placegraph.indoor.encode.compact.picture_kernels import mixed, normalized
from placegraph.indoor.encode.compact.things import FEATURES

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

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


@dataclass(frozen=True, slots=True)
class Shape:
    """Of both towers."""

    fine: int = 48
    """Channels of a quarter of a patch ..."""
    coarse: int = 128
    """... and of a patch."""
    fine_blocks: int = 2
    coarse_blocks: int = 4
    kernel: int = 5
    """Cells that a block mixes, each way."""
    expansion: int = 3
    hidden: int = 192
    """Channels of the tower of objects."""
    dimension: int = 64
    """Of the vectors that both towers give."""

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Shape:
        """Shape as a file holds it; `KeyError`, `TypeError` or `ValueError` where it is none."""
        shape = cls(**values)
        if any(type(v) is not int or not 0 < v <= 4096 for v in asdict(shape).values()):
            raise ValueError(f"sizes are {dict(values)}")
        if shape.kernel % 2 == 0:
            raise ValueError(f"kernel is {shape.kernel}, not odd")
        return shape

    def to_dict(self) -> dict[str, int]:
        """Plain numbers."""
        return asdict(self)

    def blocks(self) -> list[tuple[str, int]]:
        """Names and widths of the blocks, in order."""
        fine = [(f"fine.{i}", self.fine) for i in range(self.fine_blocks)]
        return fine + [(f"coarse.{i}", self.coarse) for i in range(self.coarse_blocks)]

    def arrays(self) -> dict[str, tuple[int, ...]]:
        """Names and shapes of all weights, as PyTorch has them."""
        out: dict[str, tuple[int, ...]] = {}

        def linear(name: str, inputs: int, outputs: int) -> None:
            out[f"{name}.weight"], out[f"{name}.bias"] = (outputs, inputs), (outputs,)

        def norm(name: str, width: int) -> None:
            out[f"{name}.weight"] = out[f"{name}.bias"] = (width,)

        linear("stem", INPUTS, self.fine)
        norm("stem_norm", self.fine)
        for name, width in self.blocks():
            out[f"{name}.mix.weight"] = (width, 1, self.kernel, self.kernel)
            out[f"{name}.mix.bias"] = (width,)
            norm(f"{name}.norm", width)
            linear(f"{name}.up", width, self.expansion * width)
            linear(f"{name}.whole", width, self.expansion * width)
            linear(f"{name}.down", self.expansion * width, width)
        norm("merge_norm", self.fine)
        linear("merge", 4 * self.fine, self.coarse)
        norm("head_norm", self.coarse)
        linear("head", self.coarse, self.dimension)
        out["usual"] = out["spread"] = (FEATURES,)
        linear("thing", FEATURES, self.hidden)
        norm("thing_norm", self.hidden)
        linear("thing_up", self.hidden, self.hidden)
        linear("thing_down", self.hidden, self.hidden)
        linear("thing_head", self.hidden, self.dimension)
        return out
