"""The losses (Eq. 17-19): done so that they teach, and as printed.

`match`: binary cross-entropy of the matching probability on hard pairs. `similarity`: the cosine of
the joint embeddings, contrastive with a temperature over a text's own hard candidates, and the same
over matching logits, so that they rank. `embedding`: contrastive cosine of the graph embeddings
that candidates are found by, over all places of a batch. `fusion`, beyond the paper: what the
network adds to relational matching is contrastive too, over the candidates that relational matching
has scored. Places at or near the true one never count as wrong, whoever's candidates they are.

As printed, with the signs that print leaves open: `eq17` is the cross-entropy of the matching
probability that the perceptron gives, 1 where text and place belong together and 0 elsewhere;
`eq18` is the sum of cosines, taken as S of wrong pairs and 1 - S of right ones, a mean of each, no
temperature. They do not know of other candidates of the same text.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812  # PyTorch's own name for it

from placegraph_learn.train.city.options import LOSSES

NEVER = -1e9


class Scores(NamedTuple):
    """What the network says of a batch of Q texts and P pairs with P places."""

    logit: Tensor
    """(P,)"""
    cosine: Tensor
    """(P,)"""
    embedding: Tensor
    """(Q, P) cosine of the graph embeddings of every text and every place."""
    residual: Tensor
    """(P,) what relational matching should have added."""


class Truth(NamedTuple):
    """What is right."""

    text: Tensor
    """(P,) text of a pair."""
    right: Tensor
    """(P,) 1 right, 0 wrong, -1 neither."""
    everywhere: Tensor
    """(Q, P) the same of every text and every place."""
    relational: Tensor
    """(P,) log-likelihood ratio of relational matching, NaN where it was not asked."""


class Temperatures(NamedTuple):
    """Learned scales of cosines (logs of inverse temperatures) and of relational matching."""

    similarity: Tensor
    embedding: Tensor
    relational: Tensor


def contrastive(scores: Tensor, right: Tensor) -> Tensor:
    """Minus log share of what is right (Q, P: 1, 0 or -1) among what is right or wrong."""
    known = scores.masked_fill(right < 0, NEVER)
    good = scores.masked_fill(right != 1, NEVER)
    told = (right == 1).any(1) & (right == 0).any(1)
    loss = torch.logsumexp(known, 1) - torch.logsumexp(good, 1)
    return (loss * told).sum() / told.sum().clamp(min=1)


def losses(
    scores: Scores, truth: Truth, scales: Temperatures, wanted: Collection[str] = LOSSES
) -> dict[str, Tensor]:
    """The losses asked for, by name; their sum is what is minimised (Eq. 19)."""
    found: dict[str, Tensor] = {}
    q = len(scores.embedding)
    own = torch.arange(q)[:, None].to(truth.text) == truth.text[None]  # (Q, P)
    right = torch.where(own, truth.right[None], -1)
    known = truth.right >= 0
    belong = (truth.right[known] == 1).float()
    if "match" in wanted or "eq17" in wanted:
        entropy = F.binary_cross_entropy_with_logits(scores.logit[known], belong)
        if "eq17" in wanted:
            found["eq17"] = entropy
        if "match" in wanted:
            found["match"] = entropy + contrastive(scores.logit[None].expand(q, -1), right)
    if "eq18" in wanted:
        cosine = scores.cosine[known]
        wrong = (cosine * (1 - belong)).sum() / (1 - belong).sum().clamp(min=1)
        found["eq18"] = wrong + ((1 - cosine) * belong).sum() / belong.sum().clamp(min=1)
    if "similarity" in wanted:
        cosine = scores.cosine * scales.similarity.exp()
        found["similarity"] = contrastive(cosine[None].expand(q, -1), right)
    if "embedding" in wanted:
        found["embedding"] = contrastive(
            scores.embedding * scales.embedding.exp(), truth.everywhere
        )
    if "fusion" in wanted:
        asked = truth.relational.isfinite()
        fused = scales.relational * truth.relational.nan_to_num() + scores.residual
        found["fusion"] = contrastive(
            fused[None].expand(q, -1), torch.where(asked[None], right, -1)
        )
    return found
