"""Sizes of the network: what a weights file must agree with."""

from __future__ import annotations

from dataclasses import asdict, dataclass

from placegraph.outdoor.network.labels_kernels import BUCKETS
from placegraph.outdoor.network.network_kernels import LITERAL
from placegraph.outdoor.network.relations_kernels import CHANNELS


@dataclass(frozen=True)
class Shape:
    """Sizes of the network."""

    width: int = 48
    """Of node states."""
    dimension: int = 64
    """Of graph embeddings."""
    heads: int = 4
    layers: int = 2
    """GPS layers of each side."""
    crossings: int = 2
    """Layers in which the two graphs see each other; 0 leaves the sides alone."""
    evidence: int = 32
    """Numbers by which a statement is judged."""
    subwords: float = 1.0
    """Length of what a word's subwords add together, against 1 of the whole word (`labels`)."""

    def arrays(self) -> dict[str, tuple[int, ...]]:  # noqa: C901  # one line a weight
        """Shape of every weight, by PyTorch's names."""
        d, out, e, heads = self.width, self.dimension, self.evidence, self.heads
        found: dict[str, tuple[int, ...]] = {"table": (BUCKETS, d)}

        def linear(name: str, to: int, of: int, *, bias: bool = True) -> None:
            found[f"{name}.weight"] = (to, of)
            if bias:
                found[f"{name}.bias"] = (to,)

        def norm(name: str) -> None:
            found[f"{name}.weight"] = found[f"{name}.bias"] = (d,)

        def feed(name: str) -> None:
            linear(f"{name}.up", 2 * d, d)
            linear(f"{name}.down", d, 2 * d)
            norm(f"{name}.norm")

        def pool(name: str) -> None:
            linear(f"{name}.gate", 1, d)
            linear(f"{name}.out", out, d)

        for side, features in (("text", 2), ("place", 7)):
            linear(f"{side}.features", d, features)
            norm(f"{side}.norm")
            pool(f"{side}.pool")
            for i in range(self.layers):
                layer = f"{side}.layers.{i}"
                linear(f"{layer}.message", d // 2, d, bias=False)
                linear(f"{layer}.along", d, len(CHANNELS) * (d // 2))
                linear(f"{layer}.qkv", 3 * d, d, bias=False)
                linear(f"{layer}.out", d, d, bias=False)
                norm(f"{layer}.norm")
                feed(f"{layer}.feed")
        for i in range(self.crossings):
            layer = f"cross.{i}"
            for name in ("query", "key", "of_place", "of_text"):
                linear(f"{layer}.{name}", d, d, bias=False)
            for side in ("text", "place"):
                linear(f"{layer}.out_{side}", d, d)
                norm(f"{layer}.norm_{side}")
                feed(f"{layer}.feed_{side}")
            found[f"{layer}.nothing"] = found[f"{layer}.word"] = (2, heads)
            linear(f"{layer}.evidence", e, 3 * heads + LITERAL + len(CHANNELS) + 3)
            linear(f"{layer}.said", 2 * d, e, bias=False)
            linear(f"{layer}.verdict", 2, e, bias=False)
        pool("pool_text")
        pool("pool_place")
        linear("judge.0", out, 3 * out)
        linear("judge.2", 1, out)
        found["prior"] = (3,)
        return found

    def to_dict(self) -> dict[str, float]:
        """Plain numbers."""
        return asdict(self)

    @classmethod
    def from_dict(cls, plain: dict[str, float]) -> Shape:
        """Undo `to_dict`; raises `TypeError` or `ValueError` where it is no shape."""
        sizes = {k: float(v) if k == "subwords" else int(v) for k, v in dict(plain).items()}
        shape = cls(**sizes)  # type: ignore[arg-type]
        numbers = asdict(shape)
        least = {"layers": 0, "crossings": 0, "subwords": 0.0}
        if any(not least.get(k, 1) <= v <= 4096 for k, v in numbers.items()):
            raise ValueError(f"sizes {numbers}")
        if shape.width % shape.heads or shape.width % 2:
            raise ValueError(f"width {shape.width} for {shape.heads} heads")
        return shape
