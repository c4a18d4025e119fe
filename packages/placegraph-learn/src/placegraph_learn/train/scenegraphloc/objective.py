"""The training loss of one image against the objects of its room and of others."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

TEMPERATURE = 0.1
PATCH_SHARE = 0.5
"""Of the patch side; the rest is the object side's."""
EPSILON = 1e-8


@dataclass(frozen=True, eq=False)
class Truth:
    """What the P patches of an image show of M candidate objects."""

    marks: Tensor
    """(P,) int64 number of what each patch shows, be it a candidate or not; 0: nothing."""
    target: Tensor
    """(P,) int64 row of the candidate that it is; -1: none."""
    categories: Tensor
    """(M,) int64 category of each candidate."""

    @property
    def valid(self) -> Tensor:
        """(P,) patches that have a loss."""
        return self.target >= 0

    def positives(self) -> Tensor:
        """(P, M) which candidate a patch shows."""
        candidates = torch.arange(len(self.categories), device=self.target.device)
        return self.target[:, None] == candidates

    def other_patches(self) -> Tensor:
        """(P, P) which patches show something else than each patch does."""
        marks = self.marks
        return (marks[:, None] != marks[None]) & (marks[None] != 0)

    def other_categories(self) -> Tensor:
        """(M, M) which candidates are of another category."""
        return self.categories[:, None] != self.categories[None]


def losses(patches: Tensor, objects: Tensor, truth: Truth) -> Tensor:
    """Loss of each valid patch, in their order.

    Parameters
    ----------
    patches
        (P, E) unit vectors of one image.
    objects
        (M, E) unit vectors of the candidates: the objects of the image's room and of others.
    truth
        What the patches show.

    """
    near = torch.exp(patches @ objects.T / TEMPERATURE)  # (P, M)
    right = truth.positives()
    rows, target = truth.valid, truth.target[truth.valid]
    own = near[rows, target]
    alike = torch.exp(patches[rows] @ patches.T / TEMPERATURE) * truth.other_patches()[rows]
    others = (near * ~right)[rows].sum(dim=1)
    patch_side = own / (own + alike.sum(dim=1) + others + EPSILON)
    kin = torch.exp(objects @ objects.T / TEMPERATURE) * truth.other_categories()
    elsewhere = (near * ~right).sum(dim=0)  # (M,) over all patches that do not show it
    object_side = own / (own + kin.sum(dim=1)[target] + elsewhere[target] + EPSILON)
    return -(
        PATCH_SHARE * torch.log(patch_side + EPSILON)
        + (1.0 - PATCH_SHARE) * torch.log(object_side + EPSILON)
    )


def right(patches: Tensor, objects: Tensor, truth: Truth) -> Tensor:
    """Which valid patches are nearest to the object they show, among all of `objects`."""
    best = (patches[truth.valid] @ objects.T).argmax(dim=1)
    return best == truth.target[truth.valid]
