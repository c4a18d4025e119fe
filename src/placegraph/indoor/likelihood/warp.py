"""Scores on a CUDA GPU, by NVIDIA Warp (extra ``gpu``)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.indoor.likelihood.view import Noise, View
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.rays.layout import LANES
from placegraph.indoor.rays.warp import WarpArray, WarpCaster, quietly

BATCH = 4_000_000
"""So many rays are scored at once; more poses take several batches, not more memory."""


class WarpScorer:
    """Scores of poses on a device, as `score_kernels.score_poses` gives them.

    Parameters
    ----------
    scene
        Its mesh and surface are copied to the device.
    device
        As for `WarpCaster`.

    Raises
    ------
    OptionError
        There is no such device.
    MissingExtraError
        Warp is not installed.
    """

    def __init__(self, scene: Scene, device: str = "cuda") -> None:
        self._caster = WarpCaster(scene.mesh.vertices, scene.mesh.triangles, device=device)
        from placegraph.indoor.likelihood import warp_kernels
        from placegraph.indoor.rays.warp_kernels import Surface

        self._kernels = warp_kernels
        with quietly(self._caster.warp):
            self._caster.warp.load_module(warp_kernels, device=self._caster.device)
        self._surface = Surface()
        for name in scene.surface._fields:
            setattr(self._surface, name, self._caster.array(getattr(scene.surface, name)))
        self._last: tuple[View, Any] | None = None

    def score(self, poses: Floats, view: View, noise: Noise) -> NDArray[np.float32]:
        """Scores (N, 4) of poses (N, 4) x, y, z [m], yaw [rad], a column a term."""
        scores = np.zeros((len(poses), 4), np.float32)
        if self._last is None or self._last[0] is not view:
            self._last = view, self._upload(view)
        seen, model = self._last[1], self._kernels.Noise()
        for name in noise._fields:
            setattr(model, name, getattr(noise, name))
        batch = max(1, BATCH // len(view.directions))
        for first in range(0, len(poses), batch):
            part = poses[first : first + batch]
            scores[first : first + batch] = self._score(part, view, seen, model)
        return scores

    def _score(
        self, poses: Floats, view: View, seen: WarpArray, model: WarpArray
    ) -> NDArray[np.float32]:
        caster, kernels = self._caster, self._kernels
        wp, device = caster.warp, caster.device
        n, rays, patches = len(poses), len(view.directions), len(view.weight)
        turns = np.stack([np.cos(poses[:, 3]), np.sin(poses[:, 3])], axis=1).astype(np.float32)
        semantic = wp.empty((n, rays), dtype=wp.float32, device=device)
        depth = wp.empty((n, rays), dtype=wp.float32, device=device)
        colour = wp.empty((n, rays), dtype=wp.vec3, device=device)
        sums = wp.empty((n, rays // LANES, kernels.SUMS), dtype=wp.float32, device=device)
        said = wp.empty((n, patches), dtype=wp.float32, device=device)
        scores = wp.empty((n, 4), dtype=wp.float32, device=device)
        places = caster.vectors(poses[:, :3]), wp.array(turns, dtype=wp.vec2, device=device)
        for kernel, shape, arguments in (
            (
                kernels.shade,
                (n, rays),
                [caster.mesh.id, *places, self._surface, seen, model, semantic, depth, colour],
            ),
            (kernels.sum_tiles, (n, rays // LANES), [seen, depth, colour, sums]),
            (kernels.sum_patches, (n, patches), [seen, model, semantic, said]),
            (kernels.finish, n, [seen, model, sums, said, scores]),
        ):
            wp.launch(kernel, shape, arguments, device=device)
        return np.asarray(scores.numpy())

    def _upload(self, view: View) -> WarpArray:
        """A view on the device, its samples sorted by patch."""
        caster, seen = self._caster, self._kernels.View()
        for name in ("patch", "semantic", "weight", "depth", "usual_depth"):
            setattr(seen, name, caster.array(getattr(view, name)))
        for name in ("directions", "colour"):
            setattr(seen, name, caster.vectors(getattr(view, name)))
        seen.footprint = float(view.footprint)
        seen.has_semantic, seen.has_depth, seen.has_colour = (int(term) for term in view.terms)
        inside = np.flatnonzero(view.patch >= 0)
        counts = np.bincount(view.patch[inside], minlength=len(view.weight))
        order = inside[np.argsort(view.patch[inside], kind="stable")]
        seen.samples = caster.array(order.astype(np.int32))
        seen.starts = caster.array(np.append(0, np.cumsum(counts)).astype(np.int32))
        seen.number = float(len(inside))
        seen.readings = float((view.depth[inside] > 0).sum() if view.terms[1] else 0)
        seen.patches = float(((counts > 0) & (view.weight > 0)).sum())
        return seen
