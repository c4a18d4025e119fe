"""What is wrong with a scene map, how badly, and which option of `scene build` mends it.

Nothing here is needed to localize: a map may be odd and still serve. An ``error`` makes localizing
fail or lie, a ``warning`` makes it worse, a ``note`` is good to know.
"""

from __future__ import annotations

from placegraph.indoor.map.scene import Scene
from placegraph.indoor.mapping.check import objects, space
from placegraph.indoor.mapping.check.finding import SEVERITIES, Finding
from placegraph.indoor.mapping.check.mesh import mesh_findings
from placegraph.indoor.mapping.check.places import anchors, places
from placegraph.indoor.options import FilterOptions

__all__ = ["SEVERITIES", "Finding", "check"]

_SHOWN = 20
"""Most objects a finding names."""


def check(
    scene: Scene,
    *,
    options: FilterOptions | None = None,
    size: int | None = None,
    seconds: float | None = None,
) -> list[Finding]:
    """What is odd about a map, worst first; empty where nothing is.

    Parameters
    ----------
    scene
        The map; it is only read.
    options
        Localizing's options: at their camera heights places are looked for.
    size, seconds
        Of the map file [bytes], and what opening it took [s], where they are known.

    """
    found: list[Finding] = []
    for checks in (
        space.units(scene), space.up_axis(scene), space.floors(scene), places(scene, options),
        mesh_findings(scene), objects.giant(scene), objects.twins(scene), objects.far(scene),
        objects.words(scene), objects.relations(scene), objects.costs(scene, size, seconds),
        anchors(scene),
    ):  # fmt: skip
        found += [Finding(*f[:2], tuple(f[2])[:_SHOWN], f[3]) for f in checks]
    return sorted(found, key=lambda f: SEVERITIES.index(f.severity))
