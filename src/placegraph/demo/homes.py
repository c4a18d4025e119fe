"""The demo's town with insides: rooms stand in its buildings, and one question goes to all of it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from placegraph.demo.world import FLAT, TOWN
from placegraph.earth import Anchor

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from placegraph.formats.capture.capture import Capture
    from placegraph.indoor.scene_map import SceneMap
    from placegraph.outdoor.city import CityMap
    from placegraph.world import World

TWIN = f"{FLAT}_twin"
"""A flat as the first, in another house."""
STANDS = {
    FLAT: ("Hotel Hansa", "2", 0.3),
    TWIN: ("Stadtbibliothek", "1", 1.2),
    "home1": ("Café am Rathaus", "0", 0.0),
    "home2": ("Postamt", "1", 0.0),
    "home3": ("Speichermuseum", "1", 0.5),
    "home4": ("Zum Anker", "0", 0.0),
}
"""Building, level and heading [rad] of each scene."""
STOREY = 3.2
"""Height of a storey [m]."""
PRECISION = np.diag([0.5, 0.5, 0.5, 0.02]) ** 2
QUESTIONS = (
    ("I am in the library on Brückenstraße", False),
    ("I am in the dining room of Zum Anker", False),
    (None, True),
    ("I am in the library on Brückenstraße", True),
    ("I am in the hotel", True),
)
"""Text, and whether three frames are shown."""


def lost_in_the_world(world: Path, out: Path, say: Callable[[str], None]) -> list[str]:
    """Place rooms in the town's buildings, and ask for place, room and pose at once.

    Returns the commands that do the same.
    """
    from placegraph.formats.capture.capture import open_capture
    from placegraph.indoor.library import SceneLibrary
    from placegraph.outdoor.city import CityMap
    from placegraph.world import open_world

    (world / f"{TOWN}.city").write_bytes((out / f"{TOWN}.city").read_bytes())
    furnish(world, CityMap.open(world / f"{TOWN}.city"), out / f"{FLAT}.scene")
    library = SceneLibrary()
    for name in STANDS:
        library.add(name, world / f"{name}.scene")
    library.save(world / "homes.library")
    opened = open_world(world)
    say(f"\n{opened} in {world}: rooms stand in buildings, two flats are the same.")
    frames = open_capture(world / "walk")[:3]
    for text, shown in QUESTIONS:
        _ask(opened, text, frames if shown else None, say)
    walk = world / "walk"
    return [
        f'locate {world} "{QUESTIONS[0][0]}"',
        f'locate {world} "{QUESTIONS[0][0]}" --capture {walk} --frames :3',
    ]


def furnish(world: Path, city: CityMap, flat: Path) -> None:
    """Write the flat, its twin and the homes into a folder, each where it stands on Earth."""
    from placegraph.indoor.scene_map import SceneMap

    for name, (building, level, heading) in STANDS.items():
        scene = SceneMap.open(flat if name in (FLAT, TWIN) else world / f"{name}.scene")
        placed = standing(scene, city, building, level, heading)
        placed.save(world / f"{name}.scene")


def standing(scene: SceneMap, city: CityMap, building: str, level: str, heading: float) -> SceneMap:
    """The scene with its middle in the middle of what has a name in a city."""
    o = city.objects
    row = next(i for i in range(len(o)) if o.name(i) == building)
    longitude, latitude = city.plane.to_lonlat(o.center[row].astype(np.float64))
    middle = scene.bounds.mean(axis=0) * (1.0, 1.0, 0.0)
    there = Anchor(
        longitude, latitude, STOREY * float(level), heading, PRECISION, building=building,
        osm=o.osm(row), level=level, method="pose",
    )  # fmt: skip
    return scene.anchored(there.shifted(middle))


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
