"""The network as PyTorch trains it; `network.py` runs the same equations without PyTorch."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812  # PyTorch's own name for it

from placegraph.indoor.encode.compact.network import FARTHEST
from placegraph.indoor.encode.compact.picture import INPUTS
from placegraph.indoor.encode.compact.things import FEATURES

if TYPE_CHECKING:
    from placegraph.indoor.encode.compact.network import Shape


class Block(nn.Module):
    """Mix neighbours, then channels, with the mean of the whole picture beside them."""

    def __init__(self, width: int, shape: Shape) -> None:
        super().__init__()
        wide = shape.expansion * width
        self.mix = nn.Conv2d(width, width, shape.kernel, padding=shape.kernel // 2, groups=width)
        self.norm = nn.LayerNorm(width)
        self.up, self.whole = nn.Linear(width, wide), nn.Linear(width, wide)
        self.down = nn.Linear(wide, width)
        with torch.no_grad():
            self.down.weight *= 0.3  # a deep pile of blocks begins near the identity
            self.whole.weight *= 0.3

    def forward(self, x: Tensor) -> Tensor:
        """Cells (B, H, W, C) to cells."""
        y = self.norm(self.mix(x.permute(0, 3, 1, 2)).permute(0, 2, 3, 1))
        hidden = self.up(y) + self.whole(y.mean(dim=(1, 2), keepdim=True))
        return x + self.down(torch.relu(hidden))


class TorchNetwork(nn.Module):
    """Both towers."""

    usual: Tensor
    spread: Tensor

    def __init__(self, shape: Shape) -> None:
        super().__init__()
        self.shape = shape
        self.stem, self.stem_norm = nn.Linear(INPUTS, shape.fine), nn.LayerNorm(shape.fine)
        self.fine = nn.Sequential(*(Block(shape.fine, shape) for _ in range(shape.fine_blocks)))
        self.merge_norm = nn.LayerNorm(shape.fine)
        self.merge = nn.Linear(4 * shape.fine, shape.coarse)
        self.coarse = nn.Sequential(
            *(Block(shape.coarse, shape) for _ in range(shape.coarse_blocks))
        )
        self.head_norm = nn.LayerNorm(shape.coarse)
        self.head = nn.Linear(shape.coarse, shape.dimension)
        self.register_buffer("usual", torch.zeros(FEATURES))
        self.register_buffer("spread", torch.ones(FEATURES))
        self.thing, self.thing_norm = nn.Linear(FEATURES, shape.hidden), nn.LayerNorm(shape.hidden)
        self.thing_up = nn.Linear(shape.hidden, shape.hidden)
        self.thing_down = nn.Linear(shape.hidden, shape.hidden)
        self.thing_head = nn.Linear(shape.hidden, shape.dimension)

    def see(self, cells: Tensor) -> Tensor:
        """Unit vectors (B, rows, columns, d) of patches of pictures (B, 2 rows, 2 columns, INPUTS)."""
        x = self.fine(self.stem_norm(self.stem(cells)))
        b, h, w, c = x.shape
        x = self.merge_norm(x).reshape(b, h // 2, 2, w // 2, 2, c).transpose(2, 3)
        x = self.coarse(self.merge(x.reshape(b, h // 2, w // 2, 4 * c)))
        return F.normalize(self.head(self.head_norm(x)), dim=-1, eps=1e-6)

    def know(self, features: Tensor) -> Tensor:
        """Unit vectors (N, d) of objects with features (N, FEATURES)."""
        x = ((features - self.usual) / self.spread).clamp(-FARTHEST, FARTHEST)
        x = torch.relu(self.thing_norm(self.thing(x)))
        x = x + self.thing_down(torch.relu(self.thing_up(x)))
        return F.normalize(self.thing_head(x), dim=-1, eps=1e-6)
