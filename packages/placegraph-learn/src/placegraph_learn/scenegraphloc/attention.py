"""Attention among the objects of a room, and among the views of an object."""

from __future__ import annotations

from collections.abc import Sequence
from math import log

import torch
from torch import Tensor, nn

SHARPEST = log(100.0)
"""Logarithm of the largest scale of cosines among views."""


class GraphAttention(nn.Module):
    """One layer of graph attention (Velickovic et al. 2018), heads side by side."""

    def __init__(self, before: int, after: int, heads: int) -> None:
        super().__init__()
        self.att_src = nn.Parameter(torch.empty(1, heads, after // heads))
        self.att_dst = nn.Parameter(torch.empty(1, heads, after // heads))
        self.bias = nn.Parameter(torch.zeros(after))
        self.lin = nn.Linear(before, after, bias=False)
        for weight in (self.att_src, self.att_dst, self.lin.weight):
            nn.init.xavier_uniform_(weight)

    def forward(self, x: Tensor, edges: Tensor) -> Tensor:
        """(n, before) of a room's objects to (n, after); messages go along edges (E, 2)."""
        n, heads = len(x), self.att_src.shape[1]
        h = self.lin(x).reshape(n, heads, -1)
        source, target = (h * self.att_src).sum(-1), (h * self.att_dst).sum(-1)  # (n, heads)
        scores = nn.functional.leaky_relu(source[:, None] + target[None], 0.2)  # (from, to, heads)
        times = torch.zeros(n, n, dtype=x.dtype, device=x.device)  # that an edge is there
        times = times.index_put(
            (edges[:, 0], edges[:, 1]), times.new_ones(len(edges)), accumulate=True
        ).fill_diagonal_(1.0)
        shares = torch.softmax(scores + times.log()[:, :, None], dim=0)
        out: Tensor = torch.einsum("sth,shc->thc", shares, h).reshape(n, -1) + self.bias
        return out


class GraphEncoder(nn.Module):
    """Two layers of graph attention, room by room."""

    def __init__(self, before: int, width: int, heads: int, dropout: float) -> None:
        super().__init__()
        self.layer_stack = nn.ModuleList(
            [GraphAttention(before, width, heads), GraphAttention(width, width, heads)]
        )
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: Tensor, edges: Sequence[Tensor], sizes: Sequence[int]) -> Tensor:
        """(N, before) of the objects of rooms of these sizes, with edges of each, to (N, width)."""
        first, second = self.layer_stack
        rooms = [
            second(self.dropout(nn.functional.elu(first(self.dropout(part), among))), among)
            for part, among in zip(x.split(list(sizes)), edges, strict=True)
        ]
        return torch.cat(rooms)


class CosineAttention(nn.Module):
    """Attention by cosines, each head with a scale of its own."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.logit_scale = nn.Parameter(torch.full((heads, 1, 1), log(10.0)))
        self.to_qkv = nn.Linear(width, 3 * width)
        self.to_out = nn.Linear(width, width, bias=False)

    def forward(self, x: Tensor, there: Tensor) -> Tensor:
        """(N, K, C) to the same, among those of each row that are `there` (N, K)."""
        n, k, width = x.shape
        heads = len(self.logit_scale)
        qkv = self.to_qkv(x).reshape(n, k, 3, heads, width // heads)
        query, key, value = qkv.permute(2, 0, 3, 1, 4)  # (N, heads, K, C / heads) each
        query, key = (nn.functional.normalize(v, dim=-1, eps=1e-12) for v in (query, key))
        scale = self.logit_scale.clamp(max=SHARPEST).exp()
        scores = query @ key.transpose(-1, -2) * scale
        scores = scores.masked_fill(~there[:, None, None, :], -torch.inf)
        mixed = (scores.softmax(dim=-1) @ value).transpose(1, 2).reshape(n, k, width)
        out: Tensor = self.to_out(mixed)
        return out


class ViewLayer(nn.Module):
    """What each view learns from the others of its object."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.self_attn = CosineAttention(width, heads)
        self.norm = nn.LayerNorm(width)

    def forward(self, x: Tensor, owner: Tensor) -> Tensor:
        """Views (V, C), and the object (V,) of each, ascending, to the same."""
        counts = torch.bincount(owner)
        place = torch.arange(len(x), device=x.device) - (counts.cumsum(0) - counts)[owner]
        shape = len(counts), int(counts.max())
        there = torch.zeros(shape, dtype=torch.bool, device=x.device)
        there[owner, place] = True
        table = x.new_zeros(*shape, x.shape[1]).index_put((owner, place), x)
        attended = self.self_attn(table, there)[owner, place]
        return nn.functional.gelu(x + self.norm(attended))


class ViewEncoder(nn.Module):
    """The one layer of attention among views; there is no order of views."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.transformer_encoder = ViewLayer(width, heads)

    def forward(self, x: Tensor, owner: Tensor) -> Tensor:
        """As `ViewLayer`."""
        out: Tensor = self.transformer_encoder(x, owner)
        return out
