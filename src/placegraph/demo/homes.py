"""The demo's town with insides: rooms stand in its buildings, and one question goes to all of it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from placegraph.demo.world import FLAT, TOWN, TOWNS
from placegraph.earth import Anchor

if TYPE_CHECKING:
    from placegraph.formats.capture.capture import Capture
    from placegraph.indoor.scene_map import SceneMap
    from placegraph.world import World

TWIN = f"{FLAT}_twin"
"""A flat as the first, in another house."""
STANDS = {
    FLAT: (TOWN, "Hotel Hansa", "2", 0.0),
    TWIN: (TOWN, "Bücherhalle", "1", np.pi),
    "home1": (TOWN, "Die Kajüte", "0", np.pi),
    "home2": (TOWN, "Stadtbibliothek", "2", 0.0),
    "home3": (TOWNS[1], "Stadtbücherei", "1", np.pi / 2),
    "home4": (TOWN, "Zum Anker", "0", 0.0),
}
"""Town, building, level and heading [rad] of each scene; buildings are tagged as insides need it."""
STOREY = 3.2
"""Height of a storey [m]."""
PRECISION = np.diag([0.5, 0.5, 0.5, 0.02]) ** 2
WINDOW = "I am in the library on Lange Straße, by the window"
QUESTIONS = (
    (WINDOW, False),
    ("I am in the dining room of Zum Anker", False),
    (None, True),
    (WINDOW, True),
    ("I am in the hotel", True),
)
"""Text, and whether three frames are shown."""


def lost_in_the_world(world: Path, out: Path, say: Callable[[str], None]) -> list[str]:
    """Place rooms in the buildings of two towns, and ask for place, room and pose at once.

    Returns the commands that do the same.
    """
    from placegraph.formats.capture.capture import open_capture
    from placegraph.indoor.library import SceneLibrary
    from placegraph.outdoor.city import build_city
    from placegraph.world import open_world

    for town in TOWNS:
        build_city(world / f"{town}.osm", world / f"{town}.city")
    furnish(world, out / f"{FLAT}.scene")
    library = SceneLibrary()
    for name in STANDS:
        library.add(name, world / f"{name}.scene")
    library.save(world / "homes.library")
    opened = open_world(world)
    say(f"\n{opened} in {world}: rooms stand in buildings, two flats are the same.")
    frames = open_capture(world / "window")
    for text, shown in QUESTIONS:
        _ask(opened, text, frames if shown else None, say)
    return [
        f'locate {world} "{WINDOW}"',
        f'locate {world} "{WINDOW}" --capture {world / "window"}',
    ]


def furnish(world: Path, flat: Path) -> None:
    """Write the flat, its twin and the homes into a folder, each where it stands on Earth."""
    from placegraph.indoor.scene_map import SceneMap

    for name, (town, building, level, heading) in STANDS.items():
        scene = SceneMap.open(flat if name in (FLAT, TWIN) else world / f"{name}.scene")
        placed = standing(scene, world / f"{town}.osm", building, level, heading)
        placed.save(world / f"{name}.scene")


def standing(scene: SceneMap, town: Path, building: str, level: str, heading: float) -> SceneMap:
    """The scene in the middle of the building that has, or holds, what has a name in a town."""
    from placegraph.world.footprints import footprints

    outline = footprints(town, building)[0]
    ring = outline.rings[0]
    middle = np.append((ring.min(axis=0) + ring.max(axis=0)) / 2.0, 0.0)
    longitude, latitude, _ = outline.base.to_earth(middle).tolist()
    there = Anchor(
        longitude, latitude, STOREY * float(level), heading, PRECISION, building=building,
        osm=outline.osm, level=level, method="pose",
    )  # fmt: skip
    return scene.anchored(there.shifted(scene.bounds.mean(axis=0) * (1.0, 1.0, 0.0)))


def _ask(
    world: World, text: str | None, frames: Capture | None, say: Callable[[str], None]
) -> None:
    """Ask with a text, with frames or with both, and say what was found."""
    estimate = world.locate(text, frames)
    asked = [f"“{text}”"] * (text is not None) + ["three frames"] * (frames is not None)
    say(f"  {' and '.join(asked)}\n    {estimate.status.name}: {estimate.reason}")
    if estimate.best is not None and estimate.best.earth is not None:
        earth = estimate.best.earth
        say(
            f"    {earth.latitude:.6f}, {earth.longitude:.6f}, {earth.height:.1f} m, level {earth.level}"
        )
