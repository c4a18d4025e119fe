"""Opening maps of any kind, and finding map files in folders."""

from __future__ import annotations

import itertools
import os
from collections.abc import Sequence
from dataclasses import dataclass
from os.path import realpath
from pathlib import Path
from typing import TYPE_CHECKING, Any

from placegraph.core.mapfile import read_header
from placegraph.core.plugins import MAPS, load_plugin
from placegraph.errors import InputError, MapError, PlacegraphError

if TYPE_CHECKING:
    from placegraph.indoor.library import SceneLibrary
    from placegraph.indoor.library.search import SceneCollection
    from placegraph.indoor.scene_map import SceneMap
    from placegraph.outdoor.city import CityMap

KINDS = {".city": "city", ".scene": "scene", ".library": "library"}
"""Kind of map by ending of the file name."""
SHARDS = "usual.shard"
"""File of a sharded library that is written last."""
WORLD, PARTS = "world.json", frozenset(("world.json", "words.table", "shards", ".build"))
"""File of a sharded world that is written last; and all files that belong to the world."""
FOLDERS = {SHARDS: "library-shards", WORLD: "world-shards"}
"""Entry point of each kind of map in a folder, by the file that is written last."""


def open_map(path: str | os.PathLike[str]) -> CityMap | SceneMap | SceneCollection:
    """Open a map file of any kind, or a folder of scene maps as a library.

    A folder that `placegraph library shard` wrote is a library with memory-mapped columns. A scene
    graph of Hydra, Khronos or Clio (Spark-DSG's JSON) or of ConceptGraphs is built by `build_scene`
    each time.

    Raises
    ------
    InputError
        The file is missing, empty, or may not be read; a folder holds no scene map; a scene graph
        cannot be built without an option, which the message names.
    MapError
        The file is foreign, truncated, damaged, of a newer version, or of an unknown kind.
    MissingExtraError
        The map is a sharded library, and placegraph-scale is not installed.

    """
    if _is_scene_graph(Path(path)):
        return open_scene(path)
    if is_shards(path):
        library: SceneCollection = open_folder(path)
        return library
    if is_world(path):
        raise MapError(f"{path} is a world in shards, not a single map; open it with `open_world`.")
    if Path(path).is_dir():
        from placegraph.indoor.library import SceneLibrary

        return SceneLibrary.open(path)
    kind = read_header(path).kind
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
            f"{path} contains the vectors of a city's cells, not a map; open the map, and "
            "pass this file as its `store`."
        )
    if kind == "shard":
        raise MapError(f"{path} is a part of a library in shards; open its folder.")
    raise MapError(
        f"{path} is a {kind} map, which this version of placegraph does not support; update "
        "placegraph."
    )


def folder_kind(path: str | os.PathLike[str]) -> Any:  # noqa: ANN401  # what the plugin brings
    """Return the plugin that opens a sharded library or world.

    Raises `MissingExtraError`, naming the extra, where it is not installed.
    """
    return load_plugin(MAPS, FOLDERS[WORLD if is_world(path) else SHARDS], "scale")


def open_folder(path: str | os.PathLike[str], **options: Any) -> Any:  # noqa: ANN401  # of the plugin
    """Open a sharded library (option `encoders`) or world (`scheduler`, `memory`) by its plugin."""
    return folder_kind(path).open(path, **options)


def is_shards(path: str | os.PathLike[str]) -> bool:
    """Return whether a folder is a complete sharded library."""
    return _holds(path, SHARDS)


def is_world(path: str | os.PathLike[str]) -> bool:
    """Return whether a folder is a complete sharded world."""
    return _holds(path, WORLD)


def _holds(folder: str | os.PathLike[str], name: str) -> bool:
    try:
        return (Path(folder) / name).is_file()
    except (OSError, ValueError):
        return False


def open_scenes(path: str | os.PathLike[str]) -> SceneMap | SceneLibrary:
    """Open a scene map or a library; raises as `open_map`, and `MapError` for a city."""
    from placegraph.indoor.library import SceneLibrary
    from placegraph.indoor.scene_map import SceneMap

    if is_shards(path):
        raise MapError(
            f"{path} is a library in shards; open it with `open_map`, or use `placegraph "
            "library localize`."
        )
    opened = open_map(path)
    if not isinstance(opened, SceneMap | SceneLibrary):
        raise MapError(f"{path} is the map of a city; give a scene map, or a library of several.")
    return opened


def open_scene(path: str | os.PathLike[str]) -> SceneMap:
    """Open a scene map, or build one from another program's scene graph; raises as `open_map`."""
    from placegraph.indoor.scene_map import SceneMap

    if _is_scene_graph(Path(path)):
        from placegraph.indoor.build import build_scene

        return build_scene(path, None)
    return SceneMap.open(Path(path))


def _is_scene_graph(path: Path) -> bool:
    if path.suffix.lower() != ".json" and not path.is_dir():
        return False
    from placegraph.indoor.mapping.sources import is_scene_graph

    return is_scene_graph(path)


@dataclass(frozen=True)
class MapFiles:
    """Map files and sharded maps of a world."""

    paths: dict[str, dict[str, Path]]
    """Paths by name, by kind of map; the kinds `shards` (of scenes) and `world` are folders."""
    ignored: tuple[tuple[Path, str], ...]
    """Files and folders that are no maps, each with the reason."""
    conflicts: tuple[str, ...]
    """Messages about maps of the same name."""

    def check(self) -> None:
        """Read all headers; `MapError` where a file is no map, or another than its name says."""
        faults = list(self.conflicts)
        for kind in KINDS.values():
            for path in self.paths[kind].values():
                try:
                    actual = read_header(path).kind
                except PlacegraphError as error:
                    faults.append(str(error))
                    continue
                if actual != kind:
                    faults.append(
                        f"{path} contains a {actual} map; rename it to {path.stem}.{actual}."
                    )
        if faults:
            raise MapError(" ".join(faults))


def find_map_files(places: Sequence[Path]) -> MapFiles:
    """Find map files among paths and in folders, by their names."""
    paths: dict[str, dict[str, Path]] = {k: {} for k in (*KINDS.values(), "shards", "world")}
    ignored, pairs = [], []
    for path in itertools.chain.from_iterable(map(_list_files, places)):
        kind = "shards" if is_shards(path) else "world" if is_world(path) else None
        name = path.resolve().name if is_world(path) else path.stem
        if kind is None and path.is_dir():
            ignored.append((path, "a folder"))
        elif (kind := kind or KINDS.get(path.suffix)) is None:
            ignored.append((path, f"it is not a map; known endings are {', '.join(KINDS)}"))
        elif realpath(first := paths[kind].setdefault(name, path)) != realpath(path):
            pairs.append((first, path))
    both = paths["world"].keys() & paths["city"].keys()
    pairs += [(paths["world"][name], paths["city"][name]) for name in both]
    conflicts = (f"{a} and {b} have the same name; rename one of them." for a, b in pairs)
    return MapFiles(paths, tuple(ignored), tuple(conflicts))


def check_map_files(places: Sequence[Path]) -> MapFiles:
    """Find map files and check their headers.

    Raises `InputError`: a path is missing, or there is no map; `MapError`: map files are damaged or
    misnamed; the message lists all, each with its remedy.
    """
    for place in places:
        if not place.exists():
            raise InputError(f"{place} does not exist; name a folder with maps, or map files.")
    files = find_map_files(places)
    files.check()
    if not any(files.paths.values()):
        names = ", ".join(map(str, places)) or "nothing"
        raise InputError(
            f"{names} contains no map ({', '.join(KINDS)}); build some with `placegraph city "
            "build` and `placegraph scene build`."
        )
    return files


def _list_files(place: Path) -> list[Path]:
    """Return a path, or the paths in a folder; a sharded world counts and so do its other files."""
    if is_shards(place):
        return [place]
    try:
        inside = sorted(place.iterdir())
    except OSError:  # a file, or gone by now
        return [place]
    if is_world(place):
        return [place, *(path for path in inside if path.name not in PARTS)]
    return [p for path in inside for p in (_list_files(path) if is_world(path) else [path])]
