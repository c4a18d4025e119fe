"""Marks on a plan where camera frames agree with the map, and where they do not.

Under a right pose nearly all of a frame agrees in depth and colour; at a wrong place, even in a corridor
whose walls look alike everywhere, much of it does not.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from placegraph.core.geometry import Floats
from placegraph.view.draw.canvas import Disc

if TYPE_CHECKING:
    from placegraph.indoor.scene_map import SceneMap
    from placegraph.io.capture.frame import Frame

SIZE, STEP = 160, 8
"""Longer side of the pictures that are compared, and way between their marks [px]."""
BLUR = 5
"""Side of the squares whose mean colours are compared [px]: poses are right to a few."""
HIGHEST = 1.9
"""Height above the floor of the highest mark [m]: ceilings would hide the room."""
ON_MAP = (0.08, 0.02)
"""A depth reading lies on the map if this near to its surface [m], and this share of its depth."""
LIKE, LIT = 25.0, 60.0
"""Colours agree if no channel differs by more from the mean of the three, and the mean by no more, which
shadows change [of 255], once the frame's exposure is the map's."""
DARKEST = 8.0


def mark_agreement(
    scene: SceneMap, floor: float, frame: Frame, map_from_camera: Floats
) -> list[Disc]:
    """Return dots, coloured ``for`` or ``against``, where a frame shows the map from a pose (4, 4).

    A dot agrees if the depth reading lies on the map's surface and the colour is that of the map, as
    far as frame and map have depth and colours. `floor`: its height [m].
    """
    from placegraph.indoor.refine.correspondences import shrink_camera  # compiled: not for cities
    from placegraph.indoor.render import Renderer
    from placegraph.io.capture.images import resize_image

    camera = shrink_camera(frame.camera, SIZE)
    drawn = Renderer(scene).render(map_from_camera, camera, samples=1)
    v, u = np.mgrid[STEP // 2 : camera.height : STEP, STEP // 2 : camera.width : STEP]
    v, u = v[drawn.mask[v, u]], u[drawn.mask[v, u]]
    if not v.size:
        return []
    rays = camera.directions(np.stack([u, v], axis=-1) + 0.5)
    points, agrees = drawn.points[v, u].astype(np.float64), np.ones(len(v), np.bool_)
    depth = frame.depth()
    if depth is not None:
        at = np.floor((frame.depth_camera or frame.camera).project(rays))
        inside = np.asarray(((at >= 0) & (at < depth.shape[::-1])).all(axis=1))
        column, row = np.where(inside[:, None], at, 0.0).astype(np.int64).T
        read = np.where(inside, depth[row, column], np.nan)
        has_depth = np.isfinite(read) & (read > 0)
        normals = drawn.normals(scene.mesh, map_from_camera)[v, u]
        turned = rays @ map_from_camera[:3, :3].T
        off = np.abs(np.einsum("nk,nk->n", normals, turned) * (read - drawn.depth[v, u]))
        agrees &= ~has_depth | (off < ON_MAP[0] + ON_MAP[1] * read)
        seen = map_from_camera[:3, 3] + turned * read[:, None]
        points = np.where(has_depth[:, None], seen, points)
    if scene.has_colours and frame.has_colour:
        shown = resize_image(frame.rgb(), camera.width, camera.height).astype(np.float64)
        pairs = [
            picture[np.clip(v + y, 0, camera.height - 1), np.clip(u + x, 0, camera.width - 1)]
            for picture in (shown, drawn.colour.astype(np.float64))
            for y, x in np.ndindex(BLUR, BLUR)
        ]
        ours, of_map = np.stack(pairs).reshape(2, BLUR * BLUR, len(v), 3).mean(axis=1)
        exposure = np.median(of_map / np.maximum(ours, DARKEST), axis=0)
        differs = ours * exposure - of_map
        lit = differs.mean(axis=1, keepdims=True)
        agrees &= (np.abs(differs - lit) < LIKE).all(axis=1) & (np.abs(lit[:, 0]) < LIT)
    low = points[:, 2] < floor + HIGHEST
    return [
        Disc(point, 1.0, verdict, rim=verdict)
        for point, verdict in zip(
            points[low, :2], np.where(agrees, "for", "against")[low].tolist(), strict=True
        )
    ]
