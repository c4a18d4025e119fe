"""Rays at a triangle mesh on the CPU, by Embree or by a bounding volume hierarchy."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.core.threads import count_processors
from placegraph.errors import OptionError
from placegraph.indoor.rays import embree
from placegraph.indoor.rays import trace_kernels as trace


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


def build_tree(vertices: NDArray[np.float32], triangles: NDArray[np.int32]) -> Bvh:
    """Build tree over triangles (T, 3), rows of vertices (V, 3) [m]; T >= 1, every number finite."""
    boxes = trace.compute_boxes(vertices, triangles)
    nodes = np.zeros(16 * max(1, len(triangles) - 1), np.float32)
    order = np.arange(len(triangles), dtype=np.int32)
    used = trace.split_nodes(boxes, order, nodes, nodes.view(np.int32))
    nodes = nodes[: 16 * used].copy()
    corners = np.zeros(12 * len(triangles), np.float32)
    trace.fill_corners(vertices, triangles, order, corners, corners.view(np.int32))
    return Bvh(nodes, nodes.view(np.int32), corners, corners.view(np.int32))


Backend = Literal["auto", "embree", "bvh"]

_FEW = 4096  # So few rays are not worth a second thread


@dataclass(frozen=True, eq=False)
class Hits:
    """Closest hits of N rays."""

    triangle: NDArray[np.int32]  # (N,) row of the triangle, -1: none
    distance: NDArray[np.float32]
    """(N,) along the ray, in units of its direction's length; inf: no hit."""
    u: NDArray[np.float32]  # (N,) barycentric weight of the triangle's corner 1; 0: no hit
    v: NDArray[np.float32]  # (N,) barycentric weight of its corner 2; corner 0 has 1 - u - v


class RayCaster:
    """Closest hits with a triangle mesh, ready to be asked by any number of threads.

    Raises `OptionError`: the mesh has no triangle, or `backend` is unknown; `MissingExtraError`:
    embree is asked for and cannot serve.

    `vertices`: (V, 3) [m], finite; kept as float32.
    `triangles`: (T, 3) rows of vertices. Triangles without area are never hit.
    `backend`: ``embree`` (needs the wheel ``embreex``), ``bvh``, or ``auto``: Embree where it is
        there and proves itself (`embree.explain_unavailable`), else the tree.
    """

    def __init__(
        self, vertices: ArrayLike, triangles: ArrayLike, *, backend: Backend = "auto"
    ) -> None:
        if backend not in get_args(Backend):
            raise OptionError(f"backend is {backend!r}; choose one of {get_args(Backend)}.")
        corners = np.ascontiguousarray(vertices, np.float32)
        rows = np.ascontiguousarray(triangles, np.int32)
        if not len(rows):
            raise OptionError("triangles is empty; a mesh needs at least one triangle.")
        self.backend: str = backend
        """``embree`` or ``bvh``."""
        self.backend_note = ""
        """Why the choice of ``auto`` was not Embree; empty otherwise."""
        if backend == "auto":
            self.backend_note = embree.explain_unavailable()
            self.backend = "bvh" if self.backend_note else "embree"
        self.tracer = (
            embree.make_embree_tracer(corners, rows)
            if self.backend == "embree"
            else trace.Tracer(0, 0, 0, *build_tree(corners, rows))
        )
        """For compiled code (`trace_kernels.trace16`); it keeps what it needs alive."""

    def cast(self, origins: ArrayLike, directions: ArrayLike) -> Hits:
        """Return closest hits of rays from `origins` (N, 3) or (3,) [m] along `directions` (N, 3).

        Directions may have any length, and distances are in units of it. A ray that is not finite
        or has no direction hits nothing. Neighbouring rays are fastest where they are alike.
        """
        with np.errstate(over="ignore"):
            # writeable copies: kernels are compiled anew for read-only arrays
            along = np.array(directions, np.float32, order="C")
            start = np.array(np.broadcast_to(origins, along.shape), np.float32, order="C")
        count = len(along)
        hits = Hits(
            np.full(count, trace.NONE, np.int32), np.full(count, np.inf, np.float32),
            *np.zeros((2, count), np.float32),
        )  # fmt: skip
        columns = hits.triangle, hits.distance, hits.u, hits.v
        threads = count_processors() if len(along) > _FEW else 1
        if threads == 1:
            trace.cast_rays(self.tracer, start, along, (0, len(along)), columns)
            return hits
        # more parts than threads, since some rays are quicker than others
        parts = min(8 * threads, len(along) // trace.LANES)
        ends = [len(along) // trace.LANES * part // parts * trace.LANES for part in range(parts)]
        with ThreadPoolExecutor(threads) as pool:
            jobs = [
                pool.submit(trace.cast_rays, self.tracer, start, along, part, columns)
                for part in zip(ends, [*ends[1:], count], strict=True)
            ]
        for job in jobs:
            job.result()
        return hits
