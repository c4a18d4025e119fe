"""The network as PyTorch trains it; `network.py` runs the same equations without PyTorch."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from placegraph.outdoor.network.network_kernels import BUCKETS, CHANNELS, LITERAL
from placegraph.outdoor.network.weights import Shape

R = len(CHANNELS)
EPSILON = 1e-5
DROPOUT = 0.5
"""Dropout of the joint embeddings before the perceptron, as in the paper's code."""
FEW = -11.0
"""Log odds that a text was given at one of a city's many viewpoints."""


class Graphs(NamedTuple):
    """B padded graphs of n nodes; node 0 is the speaker, or the centre, unless `Shape.printed`."""

    nodes: Tensor
    """(B, n, F) see `batches.GraphBatch`."""
    words: Tensor
    """(B, n, d) summed vectors of the words of a node."""
    mask: Tensor
    """(B, n) 1 where there is a node."""
    relations: Tensor
    """(B, R, n, n)"""


class Pairs(NamedTuple):
    """P pairs of a text and a place; the network as printed takes the first two alone."""

    text: Tensor
    """(P,) row of the texts."""
    place: Tensor
    """(P,) row of the places."""
    agreement: Tensor
    """(P, n, m) how well a thing fits a mention by its words."""
    rarity: Tensor
    """(P, n) how rare a mention is on the map."""
    ends: Tensor
    """(P, S, 2) source and target of the statements of the text."""
    channels: Tensor
    """(P, S, R + 1) channels, and whether it is negated."""
    spoken: Tensor
    """(P, S) 1 where there is a statement."""
    holds: Tensor
    """(P, S, m, m) how far things i, j of the place stand to each other as the statement says."""
    literal: Tensor
    """(P, S, LITERAL) what a statement says if words alone decide."""


class Scores(NamedTuple):
    """Outputs of the network for Q texts and P pairs with P places."""

    logit: Tensor
    """(P,)"""
    cosine: Tensor
    """(P,)"""
    embedding: Tensor
    """(Q, P) cosine of the graph embeddings of every text and every place."""
    residual: Tensor
    """(P,) what relational matching should have added."""


class Truth(NamedTuple):
    """Right answers of a batch."""

    text: Tensor
    """(P,) text of a pair."""
    right: Tensor
    """(P,) 1 right, 0 wrong, -1 neither."""
    everywhere: Tensor
    """(Q, P) the same of every text and every place."""
    relational: Tensor
    """(P,) log-likelihood ratio of relational matching, NaN where it was not asked."""


class Packing:
    """Moves node states between one row a node (N, ...) and padded graphs (B, n, ...)."""

    def __init__(self, mask: Tensor) -> None:
        self.shape = mask.shape
        self.rows = mask.reshape(-1).nonzero()[:, 0]

    def pack(self, x: Tensor) -> Tensor:
        """Convert from (B, n, c) to (N, c)."""
        return x.reshape(-1, x.shape[-1])[self.rows]

    def pad(self, x: Tensor) -> Tensor:
        """Convert from (N, c) to (B, n, c), 0 where there is no node."""
        padded = x.new_zeros(self.shape[0] * self.shape[1], x.shape[-1])
        return padded.index_copy(0, self.rows, x).reshape(*self.shape, -1)


def attend(q: Tensor, k: Tensor, v: Tensor, mask: Tensor, heads: int) -> Tensor:
    """Return attention of every node to all nodes of its graph."""
    b, n, d = q.shape
    split = (b, -1, heads, d // heads)
    q, k, v = (x.reshape(split).transpose(1, 2) for x in (q, k, v))
    logits = q @ k.transpose(2, 3) / (d // heads) ** 0.5
    logits = logits.masked_fill(mask[:, None, None, :] == 0, -1e9)
    return (logits.softmax(-1) @ v).transpose(1, 2).reshape(b, n, d)


class Feed(nn.Module):
    """LayerNorm(x + MLP(x))."""

    def __init__(self, d: int) -> None:
        super().__init__()
        self.up, self.down, self.norm = nn.Linear(d, 2 * d), nn.Linear(2 * d, d), nn.LayerNorm(d)

    def forward(self, x: Tensor) -> Tensor:
        """Return node states (N, d)."""
        return self.norm(x + self.down(F.relu(self.up(x))))


class Gps(nn.Module):
    """GPS layer: messages along labelled edges plus attention to the whole graph."""

    def __init__(self, shape: Shape) -> None:
        super().__init__()
        d, self.heads, self.channels = shape.width, shape.heads, len(shape.channels)
        self.message = nn.Linear(d, d // 2, bias=False)
        self.along = nn.Linear(self.channels * (d // 2), d)
        self.qkv = nn.Linear(d, 3 * d, bias=False)
        self.out = nn.Linear(d, d, bias=False)
        self.norm = nn.LayerNorm(d)
        self.feed = Feed(d)

    def forward(self, x: Tensor, packing: Packing, mask: Tensor, relations: Tensor) -> Tensor:
        """Return node states (N, d) after one exchange; `relations` (B, R, n, n) scaled by degree."""
        b, n = mask.shape
        # one product a graph: a product a relation would copy the states for each
        messages = relations.reshape(b, self.channels * n, n) @ packing.pad(self.message(x))
        messages = messages.reshape(b, self.channels, n, -1).transpose(1, 2)
        local = self.along(packing.pack(messages.reshape(b, n, -1)))
        q, k, v = packing.pad(self.qkv(x)).chunk(3, -1)
        seen = self.out(packing.pack(attend(q, k, v, mask, self.heads)))
        return self.feed(self.norm(x + local + seen))


class Pool(nn.Module):
    """Gated sum over nodes, projected."""

    def __init__(self, d: int, dimension: int) -> None:
        super().__init__()
        self.gate, self.out = nn.Linear(d, 1), nn.Linear(d, dimension)

    def forward(self, x: Tensor, packing: Packing, mask: Tensor) -> Tensor:
        """Return one vector (B, D) a graph, of node states (N, d)."""
        total = packing.pad(torch.sigmoid(self.gate(x)) * x).sum(1)
        return self.out(total / mask.sum(1, keepdim=True).sqrt())


class Side(nn.Module):
    """Encoder of one side (Eq. 9-10): node states, and one vector for the graph."""

    def __init__(self, features: int, shape: Shape) -> None:
        super().__init__()
        if features:
            self.features = nn.Linear(features, shape.width)
        self.norm = nn.LayerNorm(shape.width)
        self.layers = nn.ModuleList(Gps(shape) for _ in range(shape.layers))
        self.pool = Pool(shape.width, shape.dimension)

    def forward(self, graphs: Graphs) -> tuple[Tensor, Tensor]:
        """Return node states (B, n, d), and embeddings (B, D) of unit length."""
        packing = Packing(graphs.mask)
        x = packing.pack(graphs.words)
        if graphs.nodes.shape[-1]:
            x = x + self.features(packing.pack(graphs.nodes))
        x = self.norm(x)
        degree = (1.0 + graphs.relations.abs().sum(3, keepdim=True)).rsqrt()
        relations = degree * graphs.relations
        for layer in self.layers:
            x = layer(x, packing, graphs.mask, relations)
        return packing.pad(x), F.normalize(self.pool(x, packing, graphs.mask), dim=-1)


class Cross(nn.Module):
    """Cross attention both ways, and what the attention says of every statement."""

    def __init__(self, shape: Shape) -> None:
        super().__init__()
        d, heads = shape.width, shape.heads
        self.heads = heads
        self.query, self.key = nn.Linear(d, d, bias=False), nn.Linear(d, d, bias=False)
        self.of_place, self.of_text = nn.Linear(d, d, bias=False), nn.Linear(d, d, bias=False)
        self.out_text, self.out_place = nn.Linear(d, d), nn.Linear(d, d)
        self.printed = shape.printed
        if not self.printed:
            self.nothing = nn.Parameter(torch.zeros(2, heads))
            self.word = nn.Parameter(torch.full((2, heads), 3.0))
            self.evidence = nn.Linear(3 * heads + LITERAL + R + 3, shape.evidence)
            self.said = nn.Linear(shape.evidence, 2 * d, bias=False)
            self.verdict = nn.Linear(shape.evidence, 2, bias=False)
            nn.init.zeros_(self.verdict.weight)
        self.norm_text, self.norm_place = nn.LayerNorm(d), nn.LayerNorm(d)
        self.feed_text, self.feed_place = Feed(d), Feed(d)

    def forward(
        self,
        t: Tensor,
        m: Tensor,
        t_packing: Packing,
        m_packing: Packing,
        masks: tuple[Tensor, Tensor],
        pairs: Pairs,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return node states of texts (N, d) and places (M, d), and the verdict on statements (P, 2)."""
        (p, n), d = t_packing.shape, t.shape[1]
        t_mask, m_mask = masks
        heads, size = self.heads, d // self.heads
        q = t_packing.pad(self.query(t)).reshape(p, n, heads, size).transpose(1, 2)
        k = m_packing.pad(self.key(m)).reshape(p, -1, heads, size).transpose(1, 2)
        alike = q @ k.transpose(2, 3) / size**0.5
        to_place = self._weights(alike, pairs.agreement, m_mask, 0)
        to_text = self._weights(alike, pairs.agreement, t_mask, 1)
        values = m_packing.pad(self.of_place(m)).reshape(p, -1, heads, size).transpose(1, 2)
        seen = t_packing.pack((to_place @ values).transpose(1, 2).reshape(p, n, d))
        values = t_packing.pad(self.of_text(t)).reshape(p, n, heads, size).transpose(1, 2)
        meant = m_packing.pack((to_text @ values).transpose(1, 2).reshape(p, -1, d))
        t, verdict = t + self.out_text(seen), t.new_zeros(p, 2)
        if not self.printed:
            heard, verdict = self._attend_statements(to_place, pairs)
            t = t + t_packing.pack(heard)
        t = self.norm_text(t)
        m = self.norm_place(m + self.out_place(meant))
        return self.feed_text(t), self.feed_place(m), verdict

    def _weights(self, logits: Tensor, agreement: Tensor, mask: Tensor, side: int) -> Tensor:
        """Return attention weights; what is missing to 1 goes to nothing at all, unless `printed`."""
        if not self.printed:
            logits = logits + self.word[side, :, None, None] * agreement[:, None]
        logits = logits.transpose(2, 3) if side else logits
        logits = logits.masked_fill(mask[:, None, None, :] == 0, -1e9)
        if self.printed:
            return logits.softmax(-1)
        nothing = self.nothing[side, None, :, None, None].expand(*logits.shape[:3], 1)
        return torch.cat([nothing, logits], -1).softmax(-1)[..., 1:]

    def _attend_statements(self, weights: Tensor, pairs: Pairs) -> tuple[Tensor, Tensor]:
        """Return the messages of statements after attention to their ends: by node (P, n, d), all (P, 2)."""
        p, _, n, _ = weights.shape
        by_node = weights.transpose(1, 2)  # (P, n, H, m)
        rows = torch.arange(p, device=weights.device)[:, None]
        source, target = by_node[rows, pairs.ends[..., 0]], by_node[rows, pairs.ends[..., 1]]
        held = ((source @ pairs.holds) * target).sum(-1)  # (P, S, H)
        there = source.sum(-1) * target.sum(-1)
        rare = torch.stack([pairs.rarity[rows, pairs.ends[..., i]] for i in range(2)], -1)
        ratio = held / (there + 0.05)
        features = torch.cat([held, there, ratio, pairs.literal, pairs.channels, rare], -1)
        evidence = F.relu(self.evidence(features)) * pairs.spoken[..., None]
        verdict = self.verdict(evidence).sum(1)
        to_source, to_target = self.said(evidence).chunk(2, -1)
        heard = weights.new_zeros(p, n, to_source.shape[-1])
        for end, message in ((0, to_source), (1, to_target)):
            index = pairs.ends[..., end, None].expand_as(message)
            heard = heard.scatter_add(1, index, message)
        return heard, verdict


class Network(nn.Module):
    """Graph encoders of both sides, and the joint model (Eq. 9-19).

    `vector_size` is the length of the word vectors that stand for words; 0 where there are none.
    """

    def __init__(self, shape: Shape, vector_size: int = 0) -> None:
        super().__init__()
        self.shape = shape
        if vector_size:
            self.meaning = nn.Linear(vector_size, shape.width, bias=False)
        self.table = nn.Parameter(torch.randn(BUCKETS, shape.width) * shape.width**-0.5)
        for side, features in shape.sides.items():
            setattr(self, side, Side(features, shape))
        self.cross = nn.ModuleList(Cross(shape) for _ in range(shape.crossings))
        if not shape.printed:
            self.pool_text = Pool(shape.width, shape.dimension)
            self.pool_place = Pool(shape.width, shape.dimension)
        self.forget = nn.Dropout(DROPOUT)
        verdict = nn.Linear(shape.dimension, 1)
        nn.init.zeros_(verdict.weight)
        nn.init.constant_(verdict.bias, 0.0 if shape.printed else FEW)
        seen = (2 if shape.printed else 3) * shape.dimension
        self.judge = nn.Sequential(nn.Linear(seen, shape.dimension), nn.ReLU(), verdict)
        # training begins with what the statements say literally, and with relational matching alone
        self.prior = None if shape.printed else nn.Parameter(torch.ones(3))

    def encoders(self) -> tuple[Side, Side]:
        """Return the encoders of texts and of places; one and the same if `Shape.printed`."""
        text, place = (("graph",) * 2) if self.shape.printed else ("text", "place")
        return getattr(self, text), getattr(self, place)

    def words(
        self, buckets: Tensor, starts: Tensor, weights: Tensor, means: Tensor | None = None
    ) -> Tensor:
        """Return vectors (W, d) of words, from their parts (`labels.Bags`)."""
        sums = F.embedding_bag(buckets, self.table, starts, mode="sum", per_sample_weights=weights)
        return sums if means is None else sums + self.meaning(means)

    def match(
        self, texts: tuple[Tensor, Tensor], places: tuple[Tensor, Tensor], pairs: Pairs
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return logit of the matching probability (Eq. 17), cosine (Eq. 15), and residual, (P,) each.

        `texts` and `places` are node states and masks. What the statements say literally is where
        the logit starts from; the residual is what relational matching should have added. As printed
        (`Shape`), the logit is the perceptron's alone, of (E^T || E^M).
        """
        masks = texts[1][pairs.text], places[1][pairs.place]
        t_packing, m_packing = Packing(masks[0]), Packing(masks[1])
        t = t_packing.pack(texts[0][pairs.text])
        m = m_packing.pack(places[0][pairs.place])
        total = t.new_zeros(len(pairs.text), 2)
        for layer in self.cross:
            t, m, verdict = layer(t, m, t_packing, m_packing, masks, pairs)
            total = total + verdict
        of_text, of_place = (
            [side.pool for side in self.encoders()] if self.prior is None
            else [self.pool_text, self.pool_place]
        )  # fmt: skip
        e_t, e_m = of_text(t, t_packing, masks[0]), of_place(m, m_packing, masks[1])
        cosine = F.cosine_similarity(e_t, e_m, dim=-1, eps=EPSILON)
        if self.prior is None:
            return self.judge(self.forget(torch.cat([e_t, e_m], -1)))[:, 0], cosine, total[:, 1]
        # a whole graph is soon known by heart, statements are not: only these speak of the residual
        judged = self.judge(self.forget(torch.cat([e_t, e_m, e_t * e_m], -1)))[:, 0]
        literally = (pairs.literal[..., -1] * pairs.spoken).sum(1)
        return self.prior[0] * literally + total[:, 0] + judged, cosine, total[:, 1]
