"""Localization on maps that are graphs of objects, outdoors by text, indoors by images or text.

Public names are imported when they are first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from placegraph import errors

if TYPE_CHECKING:
    from placegraph.core.estimate import Estimate, Refinement, Status
    from placegraph.core.geo import Anchor
    from placegraph.core.graph import SceneGraph
    from placegraph.indoor.build import build_scene
    from placegraph.indoor.encode import encoder
    from placegraph.indoor.language import rank_scenes
    from placegraph.indoor.library import SceneLibrary, SearchOptions
    from placegraph.indoor.mapping.merge import merge_scenes
    from placegraph.indoor.options import FilterOptions, PoseSearchOptions
    from placegraph.indoor.pose.prior import Prior
    from placegraph.indoor.refine import RefineOptions
    from placegraph.indoor.refine.matching import matcher
    from placegraph.indoor.scene_map import SceneMap
    from placegraph.io.capture.capture import Capture, Frame, open_capture
    from placegraph.maps import open_map
    from placegraph.outdoor.city import CityMap, build_city
    from placegraph.outdoor.language import describe
    from placegraph.vectors import Region, open_store
    from placegraph.world import World, open_world

__version__ = "0.2.0"

_HOME = {
    "Anchor": "placegraph.core.geo",
    "Capture": "placegraph.io.capture.capture",
    "CityMap": "placegraph.outdoor.city",
    "Estimate": "placegraph.core.estimate",
    "FilterOptions": "placegraph.indoor.options",
    "PoseSearchOptions": "placegraph.indoor.options",
    "Frame": "placegraph.io.capture.capture",
    "Prior": "placegraph.indoor.pose.prior",
    "RefineOptions": "placegraph.indoor.refine",
    "Refinement": "placegraph.core.estimate",
    "Region": "placegraph.vectors",
    "SceneGraph": "placegraph.core.graph",
    "SceneLibrary": "placegraph.indoor.library",
    "SceneMap": "placegraph.indoor.scene_map",
    "SearchOptions": "placegraph.indoor.library",
    "Status": "placegraph.core.estimate",
    "World": "placegraph.world",
    "build_city": "placegraph.outdoor.city",
    "build_scene": "placegraph.indoor.build",
    "describe": "placegraph.outdoor.language",
    "encoder": "placegraph.indoor.encode",
    "matcher": "placegraph.indoor.refine.matching",
    "merge_scenes": "placegraph.indoor.mapping.merge",
    "open_capture": "placegraph.io.capture.capture",
    "open_map": "placegraph.maps",
    "open_store": "placegraph.vectors",
    "open_world": "placegraph.world",
    "rank_scenes": "placegraph.indoor.language",
}

__all__ = [
    "Anchor",
    "Capture",
    "CityMap",
    "Estimate",
    "FilterOptions",
    "Frame",
    "PoseSearchOptions",
    "Prior",
    "RefineOptions",
    "Refinement",
    "Region",
    "SceneGraph",
    "SceneLibrary",
    "SceneMap",
    "SearchOptions",
    "Status",
    "World",
    "__version__",
    "build_city",
    "build_scene",
    "describe",
    "encoder",
    "errors",
    "matcher",
    "merge_scenes",
    "open_capture",
    "open_map",
    "open_store",
    "open_world",
    "rank_scenes",
]


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
