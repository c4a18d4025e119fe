"""Cities and rooms together: one question, all that is known, and one answer.

`open_world` opens the maps of a folder; `World.locate` says where in all of them a sentence was
spoken and frames were taken. `fit_points`, `fit_building` and `fit_capture` say where a scene map stands.
"""

from __future__ import annotations

from placegraph.world.anchor_building import fit_building
from placegraph.world.anchor_points import AnchorFit, fit_capture, fit_points
from placegraph.world.estimate import WorldEstimate, WorldMode
from placegraph.world.world import World, open_world

__all__ = [
    "AnchorFit",
    "World",
    "WorldEstimate",
    "WorldMode",
    "fit_building",
    "fit_capture",
    "fit_points",
    "open_world",
]
