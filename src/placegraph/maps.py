"""Open a map of any kind, and find those of folders."""

from __future__ import annotations

import itertools
import os
from collections.abc import Sequence
from dataclasses import dataclass
from os.path import realpath
from pathlib import Path
from typing import TYPE_CHECKING, Any

from placegraph.core import mapfile as store
from placegraph.core.plugins import MAPS, load_plugin
from placegraph.errors import InputError, MapError, PlacegraphError

if TYPE_CHECKING:
    from placegraph.indoor.library import SceneLibrary
    from placegraph.indoor.library.search import SceneCollection
    from placegraph.indoor.scene_map import SceneMap
    from placegraph.outdoor.city import CityMap

KINDS = {".city": "city", ".scene": "scene", ".library": "library"}
"""Kind of map that a file of each name holds."""
SHARDS = "usual.shard"
"""File of a library in shards that is written last."""
WORLD, PARTS = "world.json", frozenset(("world.json", "words.table", "shards", ".build"))
"""File of a world in shards that is written last; and what is such a world's own in its folder."""
FOLDERS = {SHARDS: "library-shards", WORLD: "world-shards"}
"""Entry point of the kind of map that a folder holds, by the file that is written last."""


def open_map(path: str | os.PathLike[str]) -> CityMap | SceneMap | SceneCollection:
    """Open a map file; what it holds is read from its header. A folder of scene maps is a library.

    A folder that `placegraph library shard` wrote is a library whose columns are mapped.

    A scene graph of Hydra, Khronos or Clio (Spark-DSG's JSON) or of ConceptGraphs opens as the scene
    map that `build_scene` makes of it, each time anew.

    Raises
    ------
    InputError
        The file is missing, empty, or may not be read; a folder holds no scene map; a scene graph
        cannot be built without an option, which the message names.
    MapError
        It is foreign, truncated, damaged, of a newer version, or of a kind not known here.
    MissingExtraError
        It is a library in shards, and placegraph-scale is not installed.

    """
    if _is_scene_graph(Path(path)):
        return open_scene(path)
    if is_shards(path):
        library: SceneCollection = open_folder(path)
        return library
    if is_world(path):
        raise MapError(f"{path} is a world in shards and no single map; open it by `open_world`.")
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
    if kind == "shard":
        raise MapError(f"{path} is a part of a library in shards; open its folder.")
    raise MapError(
        f"{path} is a {kind} map, which this placegraph does not know; update placegraph."
    )


def folder_kind(path: str | os.PathLike[str]) -> Any:  # noqa: ANN401  # what the plugin brings
    """Return the plugin that opens a library or a world in shards.

    Raises `MissingExtraError`, naming the extra, where it is not installed.
    """
    return load_plugin(MAPS, FOLDERS[WORLD if is_world(path) else SHARDS], "scale")


def open_folder(path: str | os.PathLike[str], **options: Any) -> Any:  # noqa: ANN401  # of the plugin
    """Open a library in shards (`encoders`) or a world in shards (`scheduler`) by its plugin."""
    return folder_kind(path).open(path, **options)


def is_shards(path: str | os.PathLike[str]) -> bool:
    """Return whether a folder is a library in shards, by the name of the file that is written last."""
    return _holds(path, SHARDS)


def is_world(path: str | os.PathLike[str]) -> bool:
    """Return whether a folder is a world in shards, by the name of the file that is written last."""
    return _holds(path, WORLD)


def _holds(folder: str | os.PathLike[str], name: str) -> bool:
    try:
        return (Path(folder) / name).is_file()
    except (OSError, ValueError):
        return False


def open_scenes(path: str | os.PathLike[str]) -> SceneMap | SceneLibrary:
    """Open a scene map or a library; raises as `open_map`, and `MapError` where it is a city's."""
    from placegraph.indoor.library import SceneLibrary
    from placegraph.indoor.scene_map import SceneMap

    if is_shards(path):
        raise MapError(
            f"{path} is a library in shards; ask it by `open_map`, or `placegraph library localize`."
        )
    found = open_map(path)
    if not isinstance(found, SceneMap | SceneLibrary):
        raise MapError(f"{path} is the map of a city; give a scene map, or a library of several.")
    return found


def open_scene(path: str | os.PathLike[str]) -> SceneMap:
    """Open a scene map, or another program's scene graph as one; errors as of `open_map`."""
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
    """Files of a world, by name; none was opened."""

    paths: dict[str, dict[str, Path]]
    """Of each kind of map its files by name; folders of `shards` (of scenes), and of each `world`."""
    ignored: tuple[tuple[Path, str], ...]
    """Files and folders left alone, and why."""
    twins: tuple[str, ...]
    """Faults of their names."""

    def check(self) -> None:
        """Read the head of each; `MapError` where some are no maps, or others than they are called."""
        bad = list(self.twins)
        for kind, paths in self.paths.items():
            for path in paths.values():
                if kind in ("shards", "world"):
                    continue
                try:
                    held = store.read_header(path).kind
                except PlacegraphError as error:
                    bad.append(str(error))
                    continue
                if held != kind:
                    bad.append(f"{path} holds a {held} map; call it {path.stem}.{held}.")
        if bad:
            raise MapError(" ".join(bad))


def find_map_files(places: Sequence[Path]) -> MapFiles:
    """Find map files among places and in their folders, by name."""
    paths: dict[str, dict[str, Path]] = {k: {} for k in (*KINDS.values(), "shards", "world")}
    ignored, twins = [], []
    for path in itertools.chain.from_iterable(map(_files, places)):
        kind = "shards" if is_shards(path) else "world" if is_world(path) else None
        if kind is None and path.is_dir():
            ignored.append((path, "a folder"))
        elif (kind := kind or KINDS.get(path.suffix)) is None:
            ignored.append((path, f"no map: its name ends in none of {', '.join(KINDS)}"))
        elif realpath(known := paths[kind].setdefault(_name(path), path)) != realpath(path):
            twins.append(f"{known} and {path} have one name; rename one of them.")
    towns = paths["world"].keys() & paths["city"].keys()
    twins += [
        f"{paths['world'][n]} and {paths['city'][n]} have one name; rename one of them."
        for n in towns
    ]
    return MapFiles(paths, tuple(ignored), tuple(twins))


def check_map_files(places: Sequence[Path]) -> MapFiles:
    """Find map files as `find_map_files` does, and check the heads of files.

    Raises
    ------
    InputError
        A place is missing, or there is no map in any.
    MapError
        Map files are damaged, or are called what they are not: all of them, each with its mend.

    """
    for place in places:
        if not place.exists():
            raise InputError(f"{place} does not exist; name a folder with maps, or map files.")
    found = find_map_files(places)
    found.check()
    if not any(found.paths.values()):
        said = ", ".join(map(str, places)) or "nothing"
        raise InputError(
            f"{said} holds no map ({', '.join(KINDS)}); build some with `placegraph city build` and "
            "`placegraph scene build`."
        )
    return found


def _name(path: Path) -> str:
    return path.resolve().name if is_world(path) else path.stem


def _files(place: Path) -> list[Path]:
    """Return the maps that a place is, or holds: a world in shards, and what lies in its folder, too."""
    if is_shards(place):
        return [place]
    try:
        inside = sorted(place.iterdir())
    except OSError:  # a file, or gone by now
        return [place]
    if is_world(place):
        return [place, *(path for path in inside if path.name not in PARTS)]
    return [p for path in inside for p in (_files(path) if is_world(path) else [path])]
