"""Three rooms drawn in ASCII, their maps and walks through them: one small library."""

from dataclasses import dataclass

import numpy as np
import pytest

from placegraph.core.geometry import Camera
from placegraph.indoor.library import library_of
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.capture import Capture
from placegraph_lab.worlds.flat.flat import Flat
from placegraph_lab.worlds.flat.interior import Interior
from placegraph_lab.worlds.flat.walks import Walk, stroll
from placegraph_lab.worlds.home.home import scene_of
from placegraph_lab.worlds.home.visit import record

LEGEND = """
[legend]
1 room: label={room} walls=plaster {walls} floor=parquet sienna
S sofa: look=fabric darkred
B shelf: label=bookcase height=2.1
T table: label=desk look=wood burlywood
h chair: look=plain teal
C cabinet: label=sideboard height=0.8 look=wood peru
E bed: look=fabric royalblue
W cabinet: label=wardrobe height=2.0 look=wood saddlebrown
p picture:
* plant:
"""
DRAWINGS = {
    "parlour": """
########====########
#SSS         pp  BB#
#SSS             BB#
#SSS          1  BB#
#                BB#
#                  #
#*                 #
#CCCCCC    pp     *#
####################""",
    "study": """
####################
#TTTTTT      pp  BB#
#TTTTTT          BB#
#  hh         1  BB#
#                BB#
=                  #
=                  #
#CCCCCC    TTTTT  *#
####################""",
    "bedroom": """
########====########
#EEEEEEEE        WW#
#EEEEEEEE        WW#
#EEEEEEEE     1  WW#
#EEEEEEEE        WW#
#                  #
#                  #
#    CCCCCC pp    *#
####################""",
}
WALLS = {"parlour": "palegoldenrod", "study": "lightblue", "bedroom": "mistyrose"}
SMALL = Camera(96, 72, 70.0, 70.0, 48.0, 36.0)


@dataclass(frozen=True)
class Room:
    """A room as it was drawn, furnished and mapped."""

    flat: Flat
    interior: Interior
    scene: SceneMap

    def walk(self, seed: int, frames: int = 6, **options: float) -> Walk:
        return stroll(self.flat, np.random.default_rng(seed), frames=frames, rate=2.0, **options)

    def film(self, seed: int, frames: int = 6, **options) -> Capture:
        """Capture of a walk."""
        rng = np.random.default_rng(seed + 1)
        options.setdefault("camera", SMALL)
        return record(self.interior, self.walk(seed, frames), rng, **options)


@pytest.fixture(scope="session")
def rooms():
    """Rooms by name."""
    made = {}
    for i, (name, drawing) in enumerate(DRAWINGS.items()):
        legend = LEGEND.format(room=name, walls=WALLS[name])
        flat = Flat.parse(f"[flat]\nname = {name}\nheight = 2.6\n[drawing]{drawing}\n{legend}")
        interior = flat.furnish(np.random.default_rng(i))
        made[name] = Room(flat, interior, scene_of(interior, name=name))
    return made


@pytest.fixture(scope="session")
def maps(rooms):
    return {name: room.scene for name, room in rooms.items()}


@pytest.fixture(scope="session")
def by_labels(maps):
    """Library that is only asked."""
    return library_of(maps, encoders="labels")
