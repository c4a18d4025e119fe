"""A world too large for one map: a folder of shards, which are cities, and a table of their words.

`finish` ends the build of such a folder; `placegraph.open_world` opens it.
"""

from __future__ import annotations

from placegraph_scale.folder import WorldFile
from placegraph_scale.shards.words import finish

__all__ = ["WorldFile", "finish"]
