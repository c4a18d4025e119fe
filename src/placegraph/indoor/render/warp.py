"""Renders a map on a CUDA GPU, by NVIDIA Warp (extra ``gpu``)."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.indoor.map.scene import Scene
from placegraph.indoor.rays.warp import WarpCaster, quietly
from placegraph.indoor.render.render_kernels import Eye
from placegraph.indoor.render.renderer import Rendering


class WarpRenderer:
    """What `render_kernels` draws, drawn on a device; the map is copied there once.

    Parameters
    ----------
    device
        ``cuda`` (the first), ``cuda:N``, or ``cpu``: one thread, meant for tests.

    Raises
    ------
    OptionError
        There is no such device.
    MissingExtraError
        Warp is not installed.
    """

    def __init__(self, scene: Scene, device: str = "cuda") -> None:
        mesh = scene.mesh
        self._caster = WarpCaster(mesh.vertices, mesh.triangles, device=device)
        from placegraph.indoor.rays.warp_kernels import Surface
        from placegraph.indoor.render import warp_kernels

        self._kernels = warp_kernels
        with quietly(self._caster.warp):
            self._caster.warp.load_module(warp_kernels, device=self._caster.device)
        surface = Surface()
        for name in scene.surface._fields:
            setattr(surface, name, self._caster.array(getattr(scene.surface, name)))
        self._world = warp_kernels.World()
        self._world.mesh = self._caster.mesh.id
        self._world.surface = surface
        self._world.vertices = self._caster.mesh.points
        self._world.coloured = int((mesh.colours != 255).any())

    def draw(self, eye: Eye, drawn: Rendering, offsets: NDArray[np.float32]) -> Rendering:
        """Fill an empty rendering; `offsets` (S, 2) as for `render_kernels.smooth`."""
        caster, kernels = self._caster, self._kernels
        wp, device = caster.warp, caster.device
        seen, picture = kernels.Eye(), kernels.Picture()
        seen.rays = wp.array(eye.rays, dtype=wp.vec2, device=device)
        seen.turn = wp.mat33(*eye.turn.ravel().tolist())
        seen.origin = wp.vec3(*eye.origin.tolist())
        for name in ("colour", "depth", "objects", "triangles"):
            setattr(picture, name, caster.array(getattr(drawn, name)))
        picture.points = wp.array(drawn.points, dtype=wp.vec3, device=device)
        shape = drawn.depth.shape
        wp.launch(kernels.draw, shape, [self._world, seen, picture], device=device)
        columns: dict[str, Any] = {f.name: getattr(picture, f.name) for f in fields(drawn)}
        if len(offsets) > 1:
            columns["colour"] = wp.clone(picture.colour)
            places = wp.array(offsets, dtype=wp.vec2, device=device)
            inputs = [self._world, seen, picture, places, columns["colour"]]
            wp.launch(kernels.smooth, shape, inputs, device=device)
        return type(drawn)(**{name: np.asarray(a.numpy()) for name, a in columns.items()})
