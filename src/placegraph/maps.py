"""Open a map of any kind."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from placegraph import store
from placegraph.errors import MapError

if TYPE_CHECKING:
    import os

    from placegraph.indoor.library import SceneLibrary
    from placegraph.indoor.scene_map import SceneMap
    from placegraph.outdoor.city import CityMap


def open_map(path: str | os.PathLike[str]) -> CityMap | SceneMap | SceneLibrary:
    """Open a map file; what it holds is read from its header. A folder of scene maps is a library.

    Raises
    ------
    InputError
        The file is missing, empty, or may not be read; a folder holds no scene map.
    MapError
        It is foreign, truncated, damaged, of a newer version, or of a kind not known here.

    """
    if Path(path).is_dir():
        from placegraph.indoor.library import SceneLibrary

        return SceneLibrary.open(path)
    kind = store.read_header(path).kind
    if kind == "city":
        from placegraph.outdoor.city import CityMap

        return CityMap.open(Path(path))
    if kind == "scene":
        from placegraph.indoor.scene_map import SceneMap

        return SceneMap.open(Path(path))
    if kind == "library":
        from placegraph.indoor.library import SceneLibrary

        return SceneLibrary.open(path)
    if kind == "vectors":
        raise MapError(
            f"{path} holds vectors of a city's cells and is no map; open the map, and give it this "
            "file as its `store`."
        )
    raise MapError(
        f"{path} is a {kind} map, which this placegraph does not know; update placegraph."
    )
