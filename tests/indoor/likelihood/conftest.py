"""Views that show no scene at all."""

import numpy as np

from placegraph.core.geometry import Camera, level_from_camera
from placegraph.indoor.likelihood.observe import View


def draw_view(
    rng, objects, *, stride=8, terms=(True, True, True), gravity=(0.1, 1, 0.2), gaussian=False
):
    """Draw patches, depths and colours at random."""
    camera = Camera(160, 90, 100.0, 100.0, 80.0, 45.0)
    columns, rows = 160 // stride, 90 // stride
    across, down = -(-columns // 4), -(-rows // 4)
    y, x = np.mgrid[: 4 * down, : 4 * across]
    y, x = (a.reshape(down, 4, across, 4).swapaxes(1, 2).ravel() for a in (y, x))
    inside = (x < columns) & (y < rows)
    uv = np.column_stack([(x + 0.5) * 160 / columns, (y + 0.5) * 90 / rows])
    directions = camera.directions(uv) @ level_from_camera(gravity).T
    grid = 6
    patch = (y * grid // (4 * down)) * grid + x * grid // (4 * across)
    depth = rng.uniform(0.5, 5, len(x)) * (rng.random(len(x)) < 0.8)
    return View(
        directions=directions.astype(np.float32),
        patch=np.where(inside, patch, -1).astype(np.int32),
        semantic=rng.uniform(0.2, 2.0, (grid * grid + 1, objects + 1)).astype(np.float32),
        weight=(rng.random(grid * grid + 1) * (rng.random(grid * grid + 1) < 0.7)).astype("f4"),
        depth=depth.astype(np.float32),
        background_depth=(rng.normal(0, 0.5, len(x)) * (not gaussian)).astype(np.float32),
        colour=(rng.random((len(x), 3)) * (3, 1, 1) - (0, 0.5, 0.5)).astype(np.float32),
        footprint=1 / 100 * 160 / columns,
        terms=np.array(terms),
    )
