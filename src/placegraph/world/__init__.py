"""Cities and rooms together: one question, all that is known, and one answer.

`open_world` opens the maps of a folder; `World.locate` says where in all of them a sentence was
spoken and frames were taken.
"""

from __future__ import annotations

from placegraph.world.estimate import WorldEstimate, WorldMode
from placegraph.world.world import World, open_world

__all__ = ["World", "WorldEstimate", "WorldMode", "open_world"]
