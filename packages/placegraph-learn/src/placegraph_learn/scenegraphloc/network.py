"""The network of SceneGraphLoc: patches of images and objects of scene graphs to one space.

Modules and parameters bear the names of the published checkpoint, so that its keys are theirs.
The layers of the graph and of the views are in `attention`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn

from placegraph_learn.scenegraphloc.attention import GraphEncoder, ViewEncoder
from placegraph_learn.scenegraphloc.widths import POSE, Widths

MODALITIES = ("point", "gat", "rel", "attr", "img_patch")
"""What is known of an object, in the order in which the network joins it."""
DROPOUT = 0.1


@dataclass(frozen=True, eq=False)
class Objects:
    """What the network is told of the N objects of several rooms, as tensors."""

    points: Tensor
    """(N, P, 3) points of the surface, less the room's mean [m]."""
    offsets: Tensor
    """(N, 3) barycentre of the room's root less the object's [m]."""
    edges: tuple[Tensor, ...]
    """Of each room (E, 2): rows in the room of source and target."""
    sizes: tuple[int, ...]
    """Objects of each room, which follow each other."""
    relations: Tensor
    """(N, R) counts of relations leaving the object."""
    attributes: Tensor
    """(N, A) counts of its attributes."""
    owner: Tensor
    """(V,) row of the object of each view; ascending, each object has at least one."""
    views: Tensor
    """(V, F) image features."""
    poses: Tensor
    """(V, 7) quaternion x, y, z, w and translation [m] of map_from_camera."""


class Perceptron(nn.Module):
    """Linear layers with GELU between them; dropout behind every layer."""

    def __init__(self, widths: Sequence[int], dropout: float) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for before, after in pairwise(widths):
            layers += [nn.Linear(before, after), nn.GELU(), nn.Dropout(dropout)]
        del layers[-2]  # nothing bends what comes out
        self.mlp_layers = nn.Sequential(*layers)

    def forward(self, x: Tensor) -> Tensor:
        """(..., first) to (..., last)."""
        out: Tensor = self.mlp_layers(x)
        return out


class ChannelGate(nn.Module):
    """Weighs channels by what the whole image holds of them."""

    def __init__(self, width: int, waist: int) -> None:
        super().__init__()
        self.fc = nn.Sequential(
            nn.Linear(width, waist, bias=False), nn.GELU(), nn.Linear(waist, width, bias=False),
            nn.Sigmoid(),
        )  # fmt: skip

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) to the same."""
        gate: Tensor = self.fc(x.mean(dim=(2, 3)))
        return x * gate[:, :, None, None]


class PatchMixer(nn.Module):
    """Lets features of neighbouring patches know of each other."""

    def __init__(self, width: int, waist: int) -> None:
        super().__init__()
        self.conv = nn.Sequential(
            nn.Conv2d(width, width, 3, padding=1, groups=width, bias=False), nn.GELU(),
            ChannelGate(width, waist), nn.Conv2d(width, width, 1, bias=False),
        )  # fmt: skip
        self.norm2 = nn.LayerNorm(width)
        self.norm1 = nn.LayerNorm(width)

    def forward(self, x: Tensor) -> Tensor:
        """(B, H, W, C) to the same; what is added to is normalised already."""
        x = self.norm1(x)
        mixed: Tensor = self.conv(x.permute(0, 3, 1, 2)).permute(0, 2, 3, 1)
        out: Tensor = self.norm2(x + mixed)
        return out


class GridBlock(nn.Module):
    """Two 3 x 3 convolutions over the grid and what came in."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(width, width, 3, padding=1)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, padding=1)
        self.bn2 = nn.BatchNorm2d(width)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) to the same, nowhere negative."""
        y = torch.relu(self.bn1(self.conv1(x)))
        return torch.relu(self.bn2(self.conv2(y)) + x)


class GridNetwork(nn.Module):
    """Blocks over the grid of patches."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.blocks = nn.ModuleList([GridBlock(width)])

    def forward(self, x: Tensor) -> Tensor:
        """(B, H, W, C) to the same."""
        x = x.permute(0, 3, 1, 2)
        for block in self.blocks:
            x = block(x)
        return x.permute(0, 2, 3, 1)


class PointEncoder(nn.Module):
    """The same small network for every point, and the largest of each number.

    The published network normalises batches here and forgets the result: `bn1` to `bn3` are among
    its weights and have no say.
    """

    def __init__(self, widths: tuple[int, int, int]) -> None:
        super().__init__()
        first, second, third = widths
        self.conv1 = nn.Conv1d(3, first, 1)
        self.conv2 = nn.Conv1d(first, second, 1)
        self.conv3 = nn.Conv1d(second, third, 1)
        self.bn1 = nn.BatchNorm1d(first)
        self.bn2 = nn.BatchNorm1d(second)
        self.bn3 = nn.BatchNorm1d(third)

    def forward(self, points: Tensor) -> Tensor:
        """(N, P, 3) to (N, C)."""
        x = points
        for layer in (self.conv1, self.conv2, self.conv3):  # a kernel of one point is a matrix
            x = torch.relu(nn.functional.linear(x, layer.weight[:, :, 0], layer.bias))
        return x.amax(dim=1)


class Fusion(nn.Module):
    """Weighs the modalities and joins them."""

    def __init__(self, count: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(count, 1))

    def forward(self, vectors: Sequence[Tensor]) -> Tensor:
        """Vectors (N, ...) of each modality to one (N, sum); the norm of each is its share."""
        shares = torch.softmax(self.weight[:, 0], dim=0)
        parts = zip(shares, vectors, strict=True)
        return torch.cat([share * unit(vector) for share, vector in parts], dim=1)


class ObjectEncoder(nn.Module):
    """The five modalities of objects."""

    def __init__(self, w: Widths) -> None:
        super().__init__()
        self.object_encoder = PointEncoder(w.points)
        self.object_embedding = nn.Linear(w.points[2], w.modality)
        self.structure_encoder = GraphEncoder(3, w.graph, w.graph_heads, DROPOUT)
        self.structure_embedding = nn.Linear(w.graph, w.modality)
        self.meta_embedding_rel = nn.Linear(w.relations, w.modality)
        self.meta_embedding_attr = nn.Linear(w.attributes, w.modality)
        self.img_patch_encoder = Perceptron((w.feature, w.hidden, w.view), 0.0)
        self.pose_encoder = Perceptron((POSE, w.pose_hidden, w.view), 0.0)
        self.multiview_encoder = ViewEncoder(w.view, w.view_heads)
        self.multiview_norm = nn.LayerNorm(w.view)
        self.img_patch_embedding = nn.Linear(w.view, w.view)
        self.fusion = Fusion(len(MODALITIES))

    def forward(self, objects: Objects) -> Tensor:
        """All that is known of objects, (N, 4 modality + view)."""
        graph = self.structure_encoder(objects.offsets, objects.edges, objects.sizes)
        out: Tensor = self.fusion([
            self.object_embedding(self.object_encoder(objects.points)),
            self.structure_embedding(graph),
            self.meta_embedding_rel(objects.relations),
            self.meta_embedding_attr(objects.attributes),
            self.img_patch_embedding(self._seen(objects)),
        ])  # fmt: skip
        return out

    def _seen(self, objects: Objects) -> Tensor:
        """Views of each object, joined (N, view)."""
        view = self.img_patch_encoder(objects.views) + self.pose_encoder(objects.poses)
        told = self.multiview_norm(self.multiview_encoder(view, objects.owner))
        count, row = len(objects.points), objects.owner[:, None].expand_as(view)
        pooled = view.new_full((count, view.shape[1]), -torch.inf)
        return pooled.scatter_reduce(0, row, view + told, "amax")


class SceneGraphLoc(nn.Module):
    """Both sides of the network; `widths` are those of its layers."""

    def __init__(self, widths: Widths | None = None) -> None:
        super().__init__()
        w = self.widths = widths or Widths()
        self.reduce_layers = PatchMixer(w.feature, w.gate)
        self.patch_encoder = Perceptron((w.feature, w.hidden, w.embedding), DROPOUT)
        self.patch_gcn = GridNetwork(w.embedding)
        self.sg_encoder = ObjectEncoder(w)
        joined = 4 * w.modality + w.view
        self.obj_embedding_encoder = Perceptron((joined, w.hidden, w.hidden, w.embedding), DROPOUT)

    def patches(self, features: Tensor) -> Tensor:
        """Vectors (B, H, W, E), not negative, of image features (B, H, W, F)."""
        mixed = self.patch_encoder(self.reduce_layers(features))
        out: Tensor = self.patch_gcn(mixed)
        return out

    def objects(self, objects: Objects) -> Tensor:
        """Vectors (N, E) of objects."""
        out: Tensor = self.obj_embedding_encoder(self.sg_encoder(objects))
        return out


def unit(vectors: Tensor) -> Tensor:
    """Vectors (..., E) of length 1; what is shorter than 1e-12 stays as short."""
    return nn.functional.normalize(vectors, dim=-1, eps=1e-12)
