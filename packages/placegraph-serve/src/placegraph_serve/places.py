"""The maps of a server by name: opened when asked for, and again when their file is replaced."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from placegraph.core import mapfile as store
from placegraph.core.geometry import LocalPlane
from placegraph.errors import OptionError, PlacegraphError, RequestError
from placegraph.indoor.library import SceneLibrary
from placegraph.indoor.scene_map import SceneMap
from placegraph.maps import SHARDS, WORLD, check_map_files, find_map_files, folder_kind, is_world
from placegraph.world import World, open_world
from placegraph.world.world import open_map_or_world
from placegraph_serve.options import ServeOptions

if TYPE_CHECKING:
    from placegraph.outdoor.city import CityMap
    from placegraph_serve.photon import Gazetteer

ANCHOR = ("longitude", "latitude", "building", "osm", "level", "scene", "probability")
"""Listed properties of a scene's anchor."""

State = tuple[int, int, int]


@dataclass(frozen=True, slots=True)
class Entry:
    """A map of a server, by its file."""

    name: str
    kind: str
    """``city``, ``scene`` or ``library``; ``shards`` of one in shards, a folder;
    ``world`` of one of cities in shards, a folder, too."""
    path: Path


class Places:
    """Maps by name.

    Parameters
    ----------
    paths
        Map files, and folders of them, which are looked into anew when they are listed; worlds in
        shards, with what else lies in their folders.
    scheduler
        Address of a Dask scheduler whose workers search worlds in shards; this process if not given.
    memory
        Memory of this process for open shards, as in `open_world`.

    Raises
    ------
    InputError
        A path does not exist, or there is no map.
    MapError
        A file is no map.
    OptionError
        A scheduler or a memory is given, and there is no world in shards.

    """

    def __init__(
        self,
        paths: Sequence[str | PathLike[str]],
        scheduler: str | None = None,
        memory: str | None = None,
    ) -> None:
        self.paths = tuple(Path(path) for path in paths)
        self.options = {"scheduler": scheduler, "memory": memory}
        self._cached: dict[Path, tuple[State, Any]] = {}
        self._worlds: dict[str | None, tuple[dict[Path, State], World]] = {}
        worlds = check_map_files(self.paths).paths["world"]
        for option, value in self.options.items():
            if value is not None and not worlds:
                raise OptionError(
                    f"{option}: it applies only to worlds in shards, but none is served; remove "
                    "it, or serve a world built with `placegraph world build`."
                )
        self._entries = self._find_entries()

    def entries(self) -> tuple[Entry, ...]:
        """All maps that are there now."""
        self._entries = self._find_entries()
        return tuple(self._entries.values())

    def entry(self, name: str) -> Entry:
        """Map of a name; `RequestError` (404) where there is none."""
        entries = self._entries  # others may replace it meanwhile
        if name not in entries:
            entries = self._entries = self._find_entries()
        if name not in entries:
            known = ", ".join(entries) or "none"
            raise RequestError(
                f"There is no map {name[:80]!r}; the maps are: {known}.",
                status=404,
                code="map_unknown",
            )
        return entries[name]

    def open(self, name: str) -> CityMap | SceneMap | SceneLibrary:
        """A map, as its file is now; raises as `open_map`, and `RequestError` where it is gone."""
        found: CityMap | SceneMap | SceneLibrary = self._open_cached(self.entry(name).path)
        return found

    def _open_cached(self, path: Path) -> Any:  # noqa: ANN401  # any map
        state = state_of(path)
        cached = self._cached.get(path)
        if cached is None or cached[0] != state:
            try:
                cached = self._cached[path] = state, open_map_or_world(path, **self.options)
            except PlacegraphError as error:
                raise type(error)(without_folder(error, path)) from error
        return cached[1]

    def city(self, name: str) -> CityMap:
        """A map that must be a city; `RequestError` where it is none."""
        found: CityMap = self._of_kind(name, "city", "sentences about streets")
        return found

    def scene(self, name: str) -> SceneMap:
        """A map that must be a scene; `RequestError` where it is none."""
        found: SceneMap = self._of_kind(name, "scene", "images")
        return found

    def _of_kind(self, name: str, kind: str, what: str) -> Any:  # noqa: ANN401  # of that kind
        entry = self.entry(name)
        if entry.kind != kind:
            named = [e.name for e in self._entries.values() if e.kind == kind]
            raise RequestError(
                f"Map {name!r} is a {entry.kind}, and {what} need a {kind}; name one of: "
                f"{', '.join(named) or 'none here'}.",
                status=422,
                code="map_kind",
            )
        return self.open(name)

    @property
    def only(self) -> str | None:
        """Name of the only map that is there now; None where there are several."""
        there = self.entries()
        return there[0].name if len(there) == 1 else None

    def world(self, name: str | None = None) -> World:
        """All maps as one world, or one of them alone; made anew where a file was replaced.

        A world in shards is it with what else lies in its folder.
        """
        entries = self.entries() if name is None else (self.entry(name),)
        kinds = find_map_files([entry.path for entry in entries]).paths.values()
        states = {path: state_of(path) for paths in kinds for path in paths.values()}
        cached = self._worlds.get(name)
        if cached is None or cached[0] != states:
            cached = self._worlds[name] = states, open_world(list(states), opener=self._open_cached)
        return cached[1]

    def describe_maps(self) -> list[dict[str, Any]]:
        """Return the entries of `GET /v1/maps`; of a map that cannot be opened the reason."""
        return [self._facts(entry) for entry in self.entries()]

    def _facts(self, entry: Entry) -> dict[str, Any]:
        facts: dict[str, Any] = {
            "name": entry.name, "kind": entry.kind, "objects": 0, "bounds": None,
            "anchored": entry.kind in ("city", "world"), "bytes": 0,
        }  # fmt: skip
        if entry.kind == "world":
            return facts | _of_shards(entry.path)
        file = entry.path / SHARDS if entry.kind == "shards" else entry.path
        try:
            header = store.read_header(file)
        except PlacegraphError as error:
            return facts | {"problem": without_folder(error, entry.path)}
        facts["bytes"] = header.file_size
        rows = {block.name: block.shape[0] for block in header.blocks}
        if entry.kind == "shards":
            size = sum(f.stat().st_size for f in entry.path.glob("*.shard"))
            count = sum(int(s["scenes"]) for s in header.meta["shards"])
            return facts | {"objects": count, "bytes": size}
        if entry.kind == "library":
            return facts | {"objects": len(header.meta["digests"])}
        if entry.kind == "city":
            return facts | {"objects": rows["kind"], "bounds": bounds_of(header.meta)}
        anchors = header.meta.get("anchors", [])
        return facts | {
            "objects": rows["positions"],
            "anchored": bool(anchors),
            "anchors": [{key: anchor.get(key) for key in ANCHOR} for anchor in anchors],
        }

    def _find_entries(self) -> dict[str, Entry]:
        """Entries by name, which is the stem of the file, or all of its name where two share one."""
        found = find_map_files(self.paths).paths
        stems = Counter(itertools.chain.from_iterable(found.values()))
        named = (
            Entry(name if stems[name] == 1 else path.resolve().name, kind, path)
            for kind, paths in found.items()
            for name, path in paths.items()
        )
        return {entry.name: entry for entry in named}


def _of_shards(folder: Path) -> dict[str, Any]:
    """Describe a world in shards; if it cannot be opened, the reason."""
    try:
        found: dict[str, Any] = folder_kind(folder).summarize(folder)
    except PlacegraphError as error:
        return {"problem": without_folder(error, folder / WORLD)}
    return found


def without_folder(error: PlacegraphError, path: Path) -> str:
    """Return the message of an error without the folder of the file."""
    return str(error).replace(f"{path.parent}/", "")


def state_of(path: Path) -> State:
    """Return the time, size and inode of a file; raise `RequestError` if it is gone."""
    try:
        stat = (path / WORLD if is_world(path) else path).stat()
    except OSError:
        raise RequestError(
            f"The file of map {path.stem!r} is missing on the server; use another map, or "
            "restore the file.",
            status=503,
            code="map_gone",
        ) from None
    return stat.st_mtime_ns, stat.st_size, stat.st_ino


def bounds_of(meta: dict[str, Any]) -> list[float]:
    """West, south, east, north [deg] of the cells of a city, by the metadata of its file."""
    east, north, stride, columns, rows = meta["grid"]
    corners = [[east, north], [east + stride * columns, north + stride * rows]]
    bounds: list[float] = LocalPlane(*meta["origin"]).to_lonlat(corners).ravel().tolist()
    return bounds


@dataclass(frozen=True, slots=True, eq=False)
class Dispatcher:
    """Maps, limits, and the trackers of the sessions that this process holds."""

    places: Places
    options: ServeOptions
    trackers: dict[str, Any] = field(default_factory=dict)
    """`CityTracker` or `Tracker` by session, with the name of its map: ``(name, tracker)``."""
    gazetteers: dict[str, Gazetteer] = field(default_factory=dict)
    """Addresses of the cities by name."""
