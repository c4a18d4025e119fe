"""How wide the layers of the network are; the defaults are those of the published one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from placegraph.errors import OptionError

RELATIONS, ATTRIBUTES, POSE = 41, 164, 7


@dataclass(frozen=True)
class Widths:
    """Widths of the network's layers, as `state_dict` shapes tell them.

    Raises
    ------
    OptionError
        A width is not positive, or no multiple of the heads that share it.

    """

    feature: int = 1536
    """Numbers of an image feature."""
    embedding: int = 400
    """Numbers of what patches and objects are compared by."""
    hidden: int = 512
    """Of the perceptrons."""
    gate: int = 384
    """Of the channel gate's waist."""
    modality: int = 100
    """Of each object modality but the views."""
    points: tuple[int, int, int] = (64, 128, 256)
    """Of the three layers that look at points."""
    graph: int = 256
    """Of the graph attention, heads side by side."""
    graph_heads: int = 2
    view: int = 256
    """Of what is known of a view of an object."""
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
                raise OptionError(f"{name} is {value}; a width is at least 1.")
        for whole, heads in (("graph", "graph_heads"), ("view", "view_heads")):
            if getattr(self, whole) % getattr(self, heads):
                raise OptionError(
                    f"{whole} is {getattr(self, whole)}; it must be a multiple of {heads}, "
                    f"{getattr(self, heads)}."
                )

    @classmethod
    def small(cls, feature: int, attributes: int = ATTRIBUTES) -> Widths:
        """Widths for features of `feature` numbers, of a network that a processor trains."""
        return cls(
            feature=feature, embedding=64, hidden=128, gate=max(4, feature // 4), modality=32,
            points=(32, 64, 64), graph=32, view=64, pose_hidden=32,
            attributes=attributes,
        )  # fmt: skip

    @classmethod
    def of(cls, shapes: Mapping[str, tuple[int, ...]]) -> Widths:
        """Widths of the network whose weights have these shapes, by key.

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
