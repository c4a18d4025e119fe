"""The city map: objects stored once, cells and cell graphs derived from them."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from placegraph.geometry import LocalPlane

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from placegraph.estimate import Estimate
    from placegraph.graph import SceneGraph

POINT, LINE, AREA = 0, 1, 2
"""Kinds of geometry."""


@dataclass(frozen=True)
class CityObjects:
    """Columns of the objects of a city; row i of every column is one object.

    CSR columns come as pairs: the entries of row i are ``values[starts[i]:starts[i + 1]]``.
    """

    osm_type: NDArray[np.uint8]
    """(N,) 0 node, 1 way, 2 relation."""
    osm_id: NDArray[np.int64]
    """(N,)"""
    kind: NDArray[np.uint8]
    """(N,) POINT, LINE or AREA."""
    label_starts: NDArray[np.int32]
    """(N + 1,)"""
    label_values: NDArray[np.int32]
    """Indices into `labels`, most specific first."""
    name_starts: NDArray[np.int32]
    """(N + 1,)"""
    name_values: NDArray[np.int32]
    """Indices into `names`, the name proper first, then other names."""
    part_starts: NDArray[np.int32]
    """(N + 1,) parts (lines, or outer and inner rings) of an object."""
    point_starts: NDArray[np.int32]
    """(P + 1,) points of a part."""
    points: NDArray[np.float32]
    """(V, 2) east, north [m]. Rings are closed: the first point is the last."""
    center: NDArray[np.float32]
    """(N, 2) east, north [m]: the point, the middle of the line, the centroid of the area."""
    labels: tuple[str, ...]
    """``key=value``, sorted."""
    names: tuple[str, ...]
    """Names as written, sorted."""

    def __len__(self) -> int:
        return len(self.osm_id)

    def osm(self, i: int) -> str:
        """OpenStreetMap's own id of object i: ``node/1``, ``way/2``, ``relation/3``."""
        return f"{('node', 'way', 'relation')[self.osm_type[i]]}/{self.osm_id[i]}"

    def label(self, i: int) -> str:
        """Most specific label of object i."""
        return self.labels[self.label_values[self.label_starts[i]]]

    def name(self, i: int) -> str:
        """Name of object i, or an empty string."""
        start = self.name_starts[i]
        return self.names[self.name_values[start]] if start < self.name_starts[i + 1] else ""

    def parts(self, i: int) -> list[NDArray[np.float32]]:
        """Lines or rings of object i, each (n, 2) east, north [m]."""
        bounds = self.point_starts[self.part_starts[i] : self.part_starts[i + 1] + 1]
        return [self.points[a:b] for a, b in zip(bounds[:-1], bounds[1:], strict=True)]
