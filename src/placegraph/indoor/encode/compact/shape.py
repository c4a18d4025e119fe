"""Sizes of the network, and of every array of its weights."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from placegraph.indoor.encode.compact.picture import INPUTS
from placegraph.indoor.encode.compact.things import FEATURES

if TYPE_CHECKING:
    from collections.abc import Mapping


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
