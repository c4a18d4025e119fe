"""What is left of a map without what is suspected to be gone, and which readings it leaves over."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from placegraph.indoor.mapping.change.capture.tally import around, summed, tolerance
from placegraph.indoor.rays import RayCaster

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from placegraph.indoor.map.scene import Scene
    from placegraph.indoor.mapping.change.capture.looks import Look
    from placegraph.indoor.mapping.change.options import DiffOptions


@dataclass(frozen=True, slots=True, eq=False)
class Rest:
    """What is left of the map without all that is suspected to be gone, frame by frame."""

    looks: Sequence[Look]
    depths: Sequence[NDArray[np.float32]]
    """T arrays (H, W) of the depth of what is left [m]; inf: nothing."""
    new: Sequence[NDArray[np.bool_]]
    """T masks (H, W) of readings that end before it: nothing explains them yet."""
    options: DiffOptions


def rest_of(
    scene: Scene, looks: Sequence[Look], suspects: NDArray[np.int64], options: DiffOptions
) -> Rest:
    """The map without the suspects, and what it does not explain."""
    suspected = np.zeros(len(scene) + 1, np.bool_)
    suspected[suspects] = True
    mesh = scene.mesh
    kept = ~suspected[mesh.object_of]
    caster = RayCaster(mesh.vertices, mesh.triangles[kept]) if kept.any() else None
    depths, new = [], []
    for seen in looks:
        depth = seen.front.depth.copy()
        gone = suspected[seen.front.objects]
        if gone.any():
            origin = seen.map_from_camera[:3, 3]
            rays = seen.rays[gone]
            depth[gone] = caster.cast(origin, rays).distance if caster else np.inf
        depths.append(depth)
        new.append(_new(seen, depth, options))
    return Rest(looks, depths, new, options)


def _new(seen: Look, depth: NDArray[np.float32], options: DiffOptions) -> NDArray[np.bool_]:
    """(H, W) readings that end before all surfaces around, and are not alone in it."""
    if seen.depth is None:
        return np.zeros(depth.shape, np.bool_)
    near, _ = around(depth)
    with np.errstate(invalid="ignore"):
        before = seen.depth < near - tolerance(seen.depth, options)
    before &= np.isfinite(depth)  # beyond the map's end nothing is known to be new
    return before & (summed(before, 1) >= 5)


def shown(looks: Sequence[Look], count: int, options: DiffOptions) -> NDArray[np.bool_]:
    """(N,) whether readings that agree with the map end on an object."""
    pixels = np.zeros(count)
    for seen in looks:
        agrees = seen.front.objects >= 0
        if seen.depth is not None:
            with np.errstate(invalid="ignore"):
                off = np.abs(seen.depth - seen.front.depth)
                agrees &= off <= tolerance(seen.depth, options)
        pixels += np.bincount(seen.front.objects[agrees], minlength=count)
    return pixels >= options.least_pixels
