"""The small encoder of our own: patches of colour images against objects by shape, colour, label.

Two towers give vectors of one space (Sec. 3.1): `network.see` those of the patches of a picture,
`network.know` those of objects that `things` describes. They run on NumPy and numba; `train` and
`torch_network`, which need PyTorch, made the weights in `data` (`docs/compact-encoder.md`).
"""

from placegraph.indoor.encode.compact.encoder import CompactEncoder

__all__ = ["CompactEncoder"]
