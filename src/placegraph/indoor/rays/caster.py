"""Rays at a triangle mesh on the CPU, by Embree or by a bounding volume hierarchy."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.core.threads import count_processors
from placegraph.errors import OptionError
from placegraph.indoor.rays import embree
from placegraph.indoor.rays.trace_kernels import (
    LANES,
    NONE,
    Tracer,
    _compute_boxes,
    _fill_corners,
    _split_all,
    cast_rays,
)


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
    """Tree over triangles (T, 3), rows of vertices (V, 3) [m]; T >= 1, every number finite."""
    boxes = _compute_boxes(vertices, triangles)
    nodes = np.zeros(16 * max(1, len(triangles) - 1), np.float32)
    order = np.arange(len(triangles), dtype=np.int32)
    used = _split_all(boxes, order, nodes, nodes.view(np.int32))
    nodes = nodes[: 16 * used].copy()
    corners = np.zeros(12 * len(triangles), np.float32)
    _fill_corners(vertices, triangles, order, corners, corners.view(np.int32))
    return Bvh(nodes, nodes.view(np.int32), corners, corners.view(np.int32))


Backend = Literal["auto", "embree", "bvh"]

FARTHEST = 1e12
"""Coordinates beyond this [m] would leave what four bytes can multiply."""
_FEW = 4096
"""So few rays are not worth a second thread."""


@dataclass(frozen=True, eq=False)
class Hits:
    """Closest hits of N rays."""

    triangle: NDArray[np.int32]
    """(N,) row of the triangle, -1: none."""
    distance: NDArray[np.float32]
    """(N,) along the ray, in units of its direction's length; inf: no hit."""
    u: NDArray[np.float32]
    """(N,) barycentric weight of the triangle's corner 1; 0: no hit."""
    v: NDArray[np.float32]
    """(N,) barycentric weight of its corner 2; corner 0 has 1 - u - v."""

    @classmethod
    def empty(cls, number: int) -> Hits:
        """Room for `number` rays, none of which hits."""
        return cls(
            np.full(number, NONE, np.int32),
            np.full(number, np.inf, np.float32),
            np.zeros(number, np.float32),
            np.zeros(number, np.float32),
        )


class RayCaster:
    """Closest hits with a triangle mesh, ready to be asked by any number of threads.

    Parameters
    ----------
    vertices
        (V, 3) [m], finite; kept as float32.
    triangles
        (T, 3) rows of vertices. Triangles without area are never hit.
    backend
        ``embree`` (needs the wheel ``embreex``), ``bvh``, or ``auto``: Embree where it is there and
        proves itself (`embree.explain_unavailable`), else the tree.

    Raises
    ------
    OptionError
        The mesh is empty, not finite, refers to vertices it does not have, or `backend` is unknown.
    MissingExtraError
        Embree is asked for and cannot serve.
    """

    def __init__(
        self, vertices: ArrayLike, triangles: ArrayLike, *, backend: Backend = "auto"
    ) -> None:
        if backend not in get_args(Backend):
            raise OptionError(f"backend is {backend!r}; choose one of {get_args(Backend)}.")
        corners, rows = check_mesh(vertices, triangles)
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
            else Tracer(0, 0, 0, *build_tree(corners, rows))
        )
        """For compiled code (`trace_kernels.trace16`); it keeps what it needs alive."""

    def cast(self, origins: ArrayLike, directions: ArrayLike) -> Hits:
        """Closest hits of rays from `origins` (N, 3) or (3,) [m] along `directions` (N, 3).

        Directions may have any length, and distances are in units of it. A ray that is not finite
        or has no direction hits nothing. Neighbouring rays are fastest where they are alike.
        """
        start, along = check_rays(origins, directions)
        hits = Hits.empty(len(along))
        columns = hits.triangle, hits.distance, hits.u, hits.v
        threads = count_processors() if len(along) > _FEW else 1
        if threads == 1:
            cast_rays(self.tracer, start, along, (0, len(along)), columns)
            return hits
        # more parts than threads, since some rays are quicker than others
        parts = min(8 * threads, len(along) // LANES)
        ends = [len(along) // LANES * part // parts * LANES for part in range(parts)]
        with ThreadPoolExecutor(threads) as pool:
            jobs = [
                pool.submit(cast_rays, self.tracer, start, along, part, columns)
                for part in zip(ends, [*ends[1:], len(along)], strict=True)
            ]
        for job in jobs:
            job.result()
        return hits


def check_mesh(
    vertices: ArrayLike, triangles: ArrayLike
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Vertices (V, 3) and triangles (T, 3) as casters take them, or OptionError."""
    corners, rows = _check_numbers(vertices, "vertices"), np.asarray(triangles)
    if rows.ndim != 2 or rows.shape[1] != 3 or rows.dtype.kind not in "iu":
        raise OptionError(
            f"triangles is {rows.dtype} of shape {rows.shape}; give whole numbers (T, 3)."
        )
    if not len(rows):
        raise OptionError("triangles is empty; a mesh needs one triangle at least.")
    if int(rows.min()) < 0 or int(rows.max()) >= len(corners):
        raise OptionError(
            f"triangles refers to vertices {rows.min()} to {rows.max()}, but there are "
            f"{len(corners)}; give rows of vertices."
        )
    with np.errstate(over="ignore"):
        corners = np.ascontiguousarray(corners, np.float32)
    if not (bad := np.abs(corners).max(axis=1)).max() <= FARTHEST:
        row = int(np.flatnonzero(~(bad <= FARTHEST))[0])
        raise OptionError(
            f"vertices holds {corners[row].tolist()} in row {row}; every coordinate must be a "
            f"number within {FARTHEST:.0e} m."
        )
    return corners, np.ascontiguousarray(rows, np.int32)


def check_rays(
    origins: ArrayLike, directions: ArrayLike
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Origins and directions, both (N, 3) float32 in rows, or OptionError."""
    start, along = (
        _check_numbers(origins, "origins", single=True),
        _check_numbers(directions, "directions"),
    )
    if start.ndim == 2 and len(start) != len(along):
        raise OptionError(
            f"There are {len(start)} origins and {len(along)} directions; give as many."
        )
    with np.errstate(over="ignore"):
        return (
            np.ascontiguousarray(np.broadcast_to(start, along.shape), np.float32),
            np.ascontiguousarray(along, np.float32),
        )


def _check_numbers(values: ArrayLike, name: str, *, single: bool = False) -> NDArray[Any]:
    """An array (N, 3) of real numbers, or (3,) where `single`."""
    try:
        array = np.asarray(values)
    except ValueError as error:
        raise OptionError(f"{name} is no array: {error}.") from error
    if (
        array.shape[-1:] != (3,)
        or array.ndim not in {2, 2 - single}
        or array.dtype.kind not in "iuf"
    ):
        raise OptionError(f"{name} is {array.dtype} of shape {array.shape}; give numbers (N, 3).")
    return array
