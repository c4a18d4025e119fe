"""Closest hits without any wheel: a bounding volume hierarchy built and walked by compiled Python.

The tree is binary; a split minimises the surface area heuristic over bins of centroids. Sixteen rays
walk it together, since the rays of one tile of pixels meet the same boxes; where only a few of them
want a subtree, each of these walks it alone. Triangles are met by the signs of Pluecker products,
which two triangles that share an edge compute alike, so that no ray slips between them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.indoor.rays.bvh_kernels import _boxes, _fill, _split_all


class Bvh(NamedTuple):
    """Tree and triangles, laid out for walking.

    A reference to a child is the row of a node, or ``~(first * 8 + number - 1)``: a leaf of `number`
    triangles from `first` on.
    """

    nodes: NDArray[np.float32]
    """(16 M,) a node: low x y z and high x y z of the left child, of the right child, 4 integers."""
    links: NDArray[np.int32]
    """(16 M,) the same memory: integers 12 and 13 of a node refer to its children."""
    corners: NDArray[np.float32]
    """(12 T,) a triangle, in the order of the leaves: its three corners, 3 integers."""
    rows: NDArray[np.int32]
    """(12 T,) the same memory: integer 9 of a triangle is its row in the mesh."""


def build(vertices: NDArray[np.float32], triangles: NDArray[np.int32]) -> Bvh:
    """Tree over triangles (T, 3), rows of vertices (V, 3) [m]; T >= 1, every number finite."""
    boxes = _boxes(vertices, triangles)
    nodes = np.zeros(16 * max(1, len(triangles) - 1), np.float32)
    order = np.arange(len(triangles), dtype=np.int32)
    used = _split_all(boxes, order, nodes, nodes.view(np.int32))
    nodes = nodes[: 16 * used].copy()
    corners = np.zeros(12 * len(triangles), np.float32)
    _fill(vertices, triangles, order, corners, corners.view(np.int32))
    return Bvh(nodes, nodes.view(np.int32), corners, corners.view(np.int32))
