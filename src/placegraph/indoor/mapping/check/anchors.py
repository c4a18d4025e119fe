"""Checks of where a scene map stands on Earth."""

from __future__ import annotations

from collections.abc import Iterator
from math import sqrt
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from placegraph.indoor.map.scene import Scene
    from placegraph.indoor.mapping.check.finding import Found

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
