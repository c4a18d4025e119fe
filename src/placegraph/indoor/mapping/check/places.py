"""Checks of where a camera can be in a scene map (holes, flipped normals), and the map on Earth."""

from __future__ import annotations

from collections.abc import Iterator
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from placegraph.indoor.likelihood.visibility import visibility
from placegraph.indoor.map.panoramas import DIRECTIONS
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.mapping.check.finding import Found
from placegraph.indoor.mapping.check.space import height_of_rooms
from placegraph.indoor.options import FilterOptions

_PLACES = 24
"""Places from which holes are looked for."""
_SKY, _OPEN = 0.03, 0.3
"""Share of the rays from inside that leave the map: told, and much."""
_LEVEL_RAY = 0.2
"""Rays that rise or fall more steeply than this may pass over low walls, and under none."""
_BACK = 0.3
"""Share of the rays from inside that meet the back of a triangle."""


def places(scene: Scene, options: FilterOptions | None) -> Iterator[Found]:
    """Is there a place for a camera, and is the map closed around it? Are its normals flipped."""
    options = options or FilterOptions()
    table = visibility(scene, options)
    said = " to ".join(f"{h:g}" for h in sorted({min(options.heights), max(options.heights)}))
    over = float(scene.floors.min()) + min(options.heights) >= float(scene.bounds[1, 2])
    if not len(table) or over:
        rooms = height_of_rooms(scene)
        yield (
            "error",
            (
                f"At camera heights of {said} m above the floor ({scene.floors[0]:.2f} m) no place is "
                "free: no particle can start, and nothing is localized."
            ),
            [],
            (
                "--floor H, if the floor lies elsewhere; --scale N, if the map is in another unit; or "
                f"`scene localize --height {max(0.3, min(0.6 * rooms, 1.0)):.1f}`."
            ),
        )
        return
    below = scene.caster.cast(table.positions, np.tile([0.0, 0.0, -1.0], (len(table), 1)))
    # inside: with a floor below, where there is one
    inside = (
        np.flatnonzero(below.triangle >= 0)
        if (below.triangle >= 0).any()
        else np.arange(len(table))
    )
    chosen = inside[np.linspace(0, len(inside) - 1, min(_PLACES, len(inside))).round().astype(int)]
    origins = np.repeat(table.positions[chosen], len(DIRECTIONS) * 2, axis=0)
    rays = np.concatenate([DIRECTIONS, _steep()])
    hits = scene.caster.cast(origins, np.tile(rays, (len(chosen), 1)))
    missed = (hits.triangle < 0).reshape(len(chosen), -1)
    yield from _holes(missed, rays)
    yield from _inside_out(scene, hits.triangle, np.tile(rays, (len(chosen), 1)))


def _holes(missed: NDArray[np.bool_], rays: NDArray[np.float32]) -> Iterator[Found]:
    share = float(missed.mean())
    if share <= _SKY:
        return
    up, down = rays[:, 2] > _LEVEL_RAY, rays[:, 2] < -_LEVEL_RAY
    parts = {"above": up, "below": down, "around": ~(up | down)}
    shares = {where: float(missed[:, which].mean()) for where, which in parts.items()}
    listed = ", ".join(f"{s:.0%} {where}" for where, s in shares.items() if s > _SKY)
    only_up = shares["above"] > _SKY and shares["below"] <= _SKY and shares["around"] <= _SKY
    yield (
        "note" if only_up or share < _OPEN else "warning",
        f"From inside, {share:.0%} of all rays leave the map ({listed}): "
        + ("it has no ceiling." if only_up else "walls or floors have holes, or are missing."),
        [],
        (
            "Nothing can be compared there. Keep ceiling and walls when the file is exported, or scan "
            "what is missing."
        ),
    )


def _inside_out(
    scene: Scene, triangle: NDArray[np.int32], rays: NDArray[np.float32]
) -> Iterator[Found]:
    hit = triangle >= 0
    rows = triangle[hit]
    back = np.einsum("nk,nk->n", scene.normals[rows], rays[hit]) > 0.05
    share = float(back.mean()) if len(back) else 0.0
    if share <= _BACK:
        return
    own = scene.mesh.object_of[rows]
    seen = np.bincount(own, minlength=len(scene))
    turned = np.bincount(own, back, len(scene))
    worst = np.argsort(-turned)[: int((turned > 0.5 * np.maximum(seen, 1)).sum())]
    yield (
        "note",
        f"{share:.0%} of what one sees from inside are backs of triangles: normals are flipped.",
        [scene.graph.ids[i] for i in worst.tolist() if turned[i] > 0.5 * seen[i]],
        "Placegraph sees both sides; recalculate normals in the file if other programs shall, too.",
    )


def _steep() -> NDArray[np.float32]:
    """As many rays up and down as `DIRECTIONS` has, which end 50 degrees from the horizon."""
    count = len(DIRECTIONS)
    z = np.linspace(0.77, 1.0, count // 2 + count % 2)
    turn = np.arange(len(z)) * 2.399963  # golden angle
    flat = np.sqrt(1.0 - z**2)
    up = np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)
    both = np.concatenate([up, (up * (1.0, 1.0, -1.0))[: count // 2]])
    return both.astype(np.float32)


_SURE = 0.9
"""Probability from which on a candidate is the one."""
_FAR, _FARTHEST = 1.0, 3.0
"""What may be left of what was fitted, on the whole and at worst [m]."""
_NO_HEIGHT = 50.0
"""A height with a larger standard deviation is unknown [m]."""
_AGAIN = "Anchor it again with `placegraph scene anchor`"


def anchors(scene: Scene) -> Iterator[Found]:
    """Does it stand in one place, as well as was measured; does anybody know how well."""
    for name in scene.scenes:
        found = scene.anchors_of(name)
        if not found:
            continue
        of = f" of {name}" if len(scene.scenes) > 1 else ""
        best = found[0]
        if best.probability < _SURE:
            yield (
                "warning",
                (
                    f"The place{of} on Earth is ambiguous: the likeliest of {len(found)} candidates has "
                    f"{best.probability:.0%}."
                ),
                [],
                f"{_AGAIN} by point pairs, or keep the right candidate alone.",
            )
        left = sqrt(sum(r * r for r in best.residuals) / max(1, len(best.residuals)))
        worst = max(best.residuals, default=0.0)
        if left > _FAR or worst > _FARTHEST:
            yield (
                "warning",
                (
                    f"What the place{of} on Earth was fitted to is off by {left:.1f} m on the whole, "
                    f"{worst:.1f} m at worst."
                ),
                [],
                f"{_AGAIN}; a pair may be wrong, or the building another.",
            )
        if not best.known:
            yield (
                "note",
                f"Nobody said how well the place{of} on Earth is known: poses there look exact.",
                [],
                "Give the anchor a covariance.",
            )
        elif best.covariance[2, 2] > _NO_HEIGHT**2:
            yield (
                "note",
                f"The height{of} on Earth is unknown; GeoPoses have it wrong.",
                [],
                f"{_AGAIN} and --height.",
            )
