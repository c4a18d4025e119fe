"""What the golden answers need that has no public name: the only imports to change when code moves."""

from types import SimpleNamespace

import numpy as np


def private() -> SimpleNamespace:
    """Options without public names, and drawn worlds: a town's OpenStreetMap file, a home's scene map."""
    from placegraph.indoor.mapping.from_capture import FromCapture
    from placegraph.indoor.options import FilterOptions, PoseSearchOptions
    from placegraph.indoor.pose.prior import Prior
    from placegraph_lab.worlds.home.home import home, scene_of
    from placegraph_lab.worlds.town.town import Town

    def home_scene(seed):
        rng = np.random.default_rng(seed)
        return scene_of(home(rng).furnish(rng))

    return SimpleNamespace(
        FilterOptions=FilterOptions,
        PoseSearchOptions=PoseSearchOptions,
        FromCapture=FromCapture,
        Prior=Prior,
        town_osm=Town.load("hafenstadt").write_osm,
        home_scene=home_scene,
    )
