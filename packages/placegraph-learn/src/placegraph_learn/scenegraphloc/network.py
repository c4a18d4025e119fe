"""Network of SceneGraphLoc and the sizes of its layers; the defaults are those of the published one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import log

import torch
from torch import Tensor, nn

from placegraph.errors import OptionError

RELATIONS, ATTRIBUTES, POSE = 41, 164, 7


@dataclass(frozen=True)
class Widths:
    """Widths of the network's layers, as `state_dict` shapes tell them.

    Raises `OptionError`: a width is not positive, or no multiple of the heads that share it.
    """

    feature: int = 1536
    """Numbers of an image feature."""
    embedding: int = 400
    """Numbers of what patches and objects are compared by."""
    hidden: int = 512
    """Width of the perceptrons."""
    gate: int = 384
    """Width of the waist of the channel gate."""
    modality: int = 100
    """Width of each object modality but the views."""
    points: tuple[int, int, int] = (64, 128, 256)
    """Widths of the three layers over points."""
    graph: int = 256
    """Width of the graph attention, all heads together."""
    graph_heads: int = 2
    view: int = 256
    """Width of a view of an object."""
    view_heads: int = 4
    pose_hidden: int = 128
    relations: int = RELATIONS
    """Words of relations that are counted."""
    attributes: int = ATTRIBUTES
    """Words of attributes that are counted."""

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if min(value if isinstance(value, tuple) else (value,)) < 1:
                raise OptionError(f"{name} is {value}; it must be at least 1.")
        for whole, heads in (("graph", "graph_heads"), ("view", "view_heads")):
            if getattr(self, whole) % getattr(self, heads):
                raise OptionError(
                    f"{whole} is {getattr(self, whole)}; it must be a multiple of {heads}, "
                    f"{getattr(self, heads)}."
                )

    @classmethod
    def small(cls, feature: int, attributes: int = ATTRIBUTES) -> Widths:
        """Return widths for features of `feature` numbers, of a network that a processor trains."""
        return cls(
            feature=feature, embedding=64, hidden=128, gate=max(4, feature // 4), modality=32,
            points=(32, 64, 64), graph=32, view=64, pose_hidden=32,
            attributes=attributes,
        )  # fmt: skip

    @classmethod
    def of(cls, shapes: Mapping[str, tuple[int, ...]]) -> Widths:
        """Return widths of the network whose weights have these shapes, by key.

        Keys that are missing, or of a shape that says nothing, leave the published width: whoever
        compares all shapes afterwards finds them. Raises `OptionError` as the class does.
        """
        published = cls()

        def size(key: str, axis: int, otherwise: int) -> int:
            shape = shapes.get(key, ())
            return shape[axis] if axis < len(shape) else otherwise

        sg = "sg_encoder"
        points = [
            size(f"{sg}.object_encoder.conv{i + 1}.weight", 0, n)
            for i, n in enumerate(published.points)
        ]
        heads = f"{sg}.multiview_encoder.transformer_encoder.self_attn.logit_scale"
        return cls(
            feature=size("reduce_layers.norm1.weight", 0, published.feature),
            embedding=size("patch_encoder.mlp_layers.3.weight", 0, published.embedding),
            hidden=size("patch_encoder.mlp_layers.0.weight", 0, published.hidden),
            gate=size("reduce_layers.conv.2.fc.0.weight", 0, published.gate),
            modality=size(f"{sg}.object_embedding.weight", 0, published.modality),
            points=(points[0], points[1], points[2]),
            graph=size(f"{sg}.structure_encoder.layer_stack.0.bias", 0, published.graph),
            graph_heads=size(
                f"{sg}.structure_encoder.layer_stack.0.att_src", 1, published.graph_heads
            ),
            view=size(f"{sg}.img_patch_embedding.weight", 0, published.view),
            view_heads=size(heads, 0, published.view_heads),
            pose_hidden=size(f"{sg}.pose_encoder.mlp_layers.0.weight", 0, published.pose_hidden),
            relations=size(f"{sg}.meta_embedding_rel.weight", 1, published.relations),
            attributes=size(f"{sg}.meta_embedding_attr.weight", 1, published.attributes),
        )


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
        """Map (n, before) of a room's objects to (n, after); messages go along edges (E, 2)."""
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
        """Map (N, before) of the objects of rooms of these sizes, with edges of each, to (N, width)."""
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
        """Map (N, K, C) to the same, among those of each row that are `there` (N, K)."""
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
    """Attention among the views of an object."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.self_attn = CosineAttention(width, heads)
        self.norm = nn.LayerNorm(width)

    def forward(self, x: Tensor, owner: Tensor) -> Tensor:
        """Return views (V, C), and the object (V,) of each, ascending, to the same."""
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
        """See `ViewLayer`."""
        out: Tensor = self.transformer_encoder(x, owner)
        return out


MODALITIES = ("point", "gat", "rel", "attr", "img_patch")
"""Modalities of an object, in the order in which the network joins them."""
DROPOUT = 0.1


@dataclass(frozen=True, eq=False)
class Objects:
    """Network inputs for the N objects of several rooms."""

    points: Tensor
    """(N, P, 3) points of the surface, less the room's mean [m]."""
    offsets: Tensor
    """(N, 3) barycentre of the room's root less the object's [m]."""
    edges: tuple[Tensor, ...]
    """Edges of each room (E, 2): rows of source and target within the room."""
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
        """Map (..., first) to (..., last)."""
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
        """Map (B, C, H, W) to the same."""
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
        """Map (B, H, W, C) to the same; what is added to is normalised already."""
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
        """Map (B, C, H, W) to the same, nowhere negative."""
        y = torch.relu(self.bn1(self.conv1(x)))
        return torch.relu(self.bn2(self.conv2(y)) + x)


class GridNetwork(nn.Module):
    """Blocks over the grid of patches."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.blocks = nn.ModuleList([GridBlock(width)])

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, H, W, C) to the same."""
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
        """Map (N, P, 3) to (N, C)."""
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
        """Return vectors (N, ...) of each modality to one (N, sum); the norm of each is its share."""
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
        """Return all that is known of objects, (N, 4 modality + view)."""
        graph = self.structure_encoder(objects.offsets, objects.edges, objects.sizes)
        out: Tensor = self.fusion([
            self.object_embedding(self.object_encoder(objects.points)),
            self.structure_embedding(graph),
            self.meta_embedding_rel(objects.relations),
            self.meta_embedding_attr(objects.attributes),
            self.img_patch_embedding(self._encode_views(objects)),
        ])  # fmt: skip
        return out

    def _encode_views(self, objects: Objects) -> Tensor:
        """Return views of each object, joined (N, view)."""
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
        """Return vectors (B, H, W, E), not negative, of image features (B, H, W, F)."""
        mixed = self.patch_encoder(self.reduce_layers(features))
        out: Tensor = self.patch_gcn(mixed)
        return out

    def objects(self, objects: Objects) -> Tensor:
        """Return vectors (N, E) of objects."""
        out: Tensor = self.obj_embedding_encoder(self.sg_encoder(objects))
        return out


def unit(vectors: Tensor) -> Tensor:
    """Return vectors (..., E) of length 1; what is shorter than 1e-12 stays as short."""
    return nn.functional.normalize(vectors, dim=-1, eps=1e-12)
