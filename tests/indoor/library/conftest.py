from dataclasses import dataclass, field
from functools import cache

import numpy as np
import pytest

from placegraph.core.geometry import Camera
from placegraph.indoor.library import library, make_library
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
    flat: Flat
    interior: Interior
    scene: SceneMap
    films: dict = field(default_factory=dict, init=False)

    def walk(self, seed: int, frames: int = 6, **options: float) -> Walk:
        return stroll(self.flat, np.random.default_rng(seed), frames=frames, rate=2.0, **options)

    def film(self, seed: int, frames: int = 6, **options) -> Capture:
        options.setdefault("camera", SMALL)
        key = (seed, frames, repr(sorted(options.items())))
        if key not in self.films:
            rng = np.random.default_rng(seed + 1)
            self.films[key] = record(self.interior, self.walk(seed, frames), rng, **options)
        return self.films[key]


@cache
def make_rooms():
    made = {}
    for i, (name, drawing) in enumerate(DRAWINGS.items()):
        legend = LEGEND.format(room=name, walls=WALLS[name])
        flat = Flat.parse(f"[flat]\nname = {name}\nheight = 2.6\n[drawing]{drawing}\n{legend}")
        interior = flat.furnish(np.random.default_rng(i))
        made[name] = Room(flat, interior, scene_of(interior, name=name))
    return made


@pytest.fixture(scope="session")
def rooms():
    return make_rooms()


@pytest.fixture(scope="session", autouse=True)
def signatures_once():
    known, real = {}, library.compute_signature

    def signature_of(scene, encoders, captures=(), height=None):
        arrays = (scene.graph.positions, scene.graph.embeddings, scene.mesh.vertices)
        key = (
            *(b"" if a is None else np.asarray(a).tobytes() for a in arrays), height, scene.source,
            scene.graph.labels, scene.graph.names, scene.graph.relations, repr(scene.attributes),
            scene.scenes, scene.encoder, tuple(e.key for e in encoders),
        )  # fmt: skip
        if captures or key not in known:
            known[key] = real(scene, encoders, captures, height)
        return known[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(library, "compute_signature", signature_of)
        yield


@pytest.fixture(scope="session")
def maps(rooms):
    return {name: room.scene for name, room in rooms.items()}


@pytest.fixture(scope="session")
def by_labels(maps):
    return make_library(maps, encoders="labels")
