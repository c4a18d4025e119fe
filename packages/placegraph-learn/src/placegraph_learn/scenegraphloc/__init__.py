"""SceneGraphLoc (Miao et al., ECCV 2024): patches and objects compared by a learned network.

Numerically equal to the published one and able to read its checkpoints; trained anew, also on
other image features, by `placegraph scene train`.
"""

from placegraph_learn.scenegraphloc.encoder import SceneGraphLocEncoder

__all__ = ["SceneGraphLocEncoder"]
