"""A world: the cities, scenes and libraries of a folder, asked as one."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from placegraph.core.files import resolve_path
from placegraph.core.options import reject_unknown
from placegraph.core.pickling import HtmlRepr
from placegraph.core.plugins import load_module
from placegraph.errors import InputError, OptionError
from placegraph.indoor.library import SceneLibrary
from placegraph.indoor.library.library import hash_file
from placegraph.io.osm.urls import is_url
from placegraph.maps import check_map_files, is_world, open_folder, open_map
from placegraph.world.towns import CityTown, Town

if TYPE_CHECKING:
    from placegraph.indoor.library.search import SceneCollection
    from placegraph.indoor.scene_map import SceneMap
    from placegraph.io.capture.capture import Capture
    from placegraph.io.capture.frame import Frame
    from placegraph.outdoor.city import CityMap
    from placegraph.world.estimate import WorldEstimate, WorldQuery
    from placegraph.world.evidence import OutdoorSearch, RemainingScenes

Map = TypeVar("Map")


class Maps(Mapping[str, Map]):
    """Maps by name, each opened on first use; `OptionError` where there is none of a name."""

    def __init__(self, paths: Mapping[str, Path], opener: Callable[[Path], Map]) -> None:
        self.paths = dict(paths)
        self._opener = opener
        self._opened: dict[str, Map] = {}

    def __getitem__(self, name: str) -> Map:
        if name not in self.paths:
            known = ", ".join(sorted(self.paths)[:5]) or "none at all"
            raise OptionError(f"{name!r} is not a map of this world; its maps are {known}.")
        if name not in self._opened:
            self._opened[name] = self._opener(self.paths[name])
        return self._opened[name]

    def __contains__(self, name: object) -> bool:
        return name in self.paths

    def __iter__(self) -> Iterator[str]:
        return iter(self.paths)

    def __len__(self) -> int:
        return len(self.paths)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(self.paths)})"


class TownShards(Town, Protocol):
    """A world in shards: one town of the world that it is part of."""

    def close(self) -> None:
        """Close the shards, and leave the cluster that searches them."""


class SceneCandidates(Protocol):
    """All scenes of a world that has libraries in shards, of which a question looks into few."""

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of all objects, and names of their rooms."""

    def find_names(self, text: str) -> set[str]:
        """Find the names of scenes and buildings in a text."""

    def select(self, world: World, query: WorldQuery, text: OutdoorSearch) -> World:
        """Select the scenes that a query may be about; return a world of these."""


class World(HtmlRepr):
    """Maps by name, opened on first use; locating never changes them.

    Made by `open_world`, or of maps in memory.

    Parameters
    ----------
    cities, scenes, libraries
        Maps by name. Scenes of a library whose map files are there are scenes of the world.
    shards
        Libraries in shards, by name: a question looks into few of their scenes.
    planets
        Worlds in shards, by name: a question looks into few of their cities.
    ignored
        Files left alone, and why.

    """

    remaining: RemainingScenes | None = None
    """Weight of the scenes that a question does not look into, where there are shards."""

    def __init__(
        self,
        cities: Mapping[str, CityMap] | None = None,
        scenes: Mapping[str, SceneMap] | None = None,
        libraries: Mapping[str, SceneLibrary] | None = None,
        shards: Mapping[str, SceneCollection] | None = None,
        *,
        planets: Mapping[str, TownShards] | None = None,
        ignored: Sequence[tuple[Path, str]] = (),
    ) -> None:
        self.cities, self.scenes, self.libraries = cities or {}, scenes or {}, libraries or {}
        self.shards, self.planets, self.ignored = shards or {}, planets or {}, tuple(ignored)

    @cached_property
    def towns(self) -> Mapping[str, Town]:
        """Cities, and worlds in shards, by name."""
        cities = {name: CityTown(name, city) for name, city in self.cities.items()}
        return {**cities, **self.planets}

    @cached_property
    def candidates(self) -> SceneCandidates | None:
        """All scenes of shards and beside them, where there are shards; mapped once."""
        if not self.shards:
            return None
        module = load_module("placegraph_scale.library.candidates", "scale")
        made: SceneCandidates = module.CandidateScenes.of(self.shards.values(), self.library)
        return made

    @cached_property
    def library(self) -> SceneLibrary:
        """All scenes side by side, to be searched; made once.

        Entries of library files are reused where they are of the map as it is now.
        """
        library = SceneLibrary()
        keys = [e.key for e in library.encoders]
        known = {
            resolve_path(entry.path): entry
            for made in self.libraries.values()
            if [e.key for e in made.encoders] == keys
            for entry in map(made.entry, made)
            if entry.path is not None
        }
        paths = self.scenes.paths if isinstance(self.scenes, Maps) else {}
        for name in self.scenes:
            path = paths.get(name)
            entry = None if path is None else known.get(resolve_path(path))
            if path is not None and entry is not None and entry.digest == hash_file(path):
                library.insert(name, entry)
            else:
                library.add(name, self.scenes[name])
        return library

    def locate(
        self,
        text: str | None = None,
        capture: Capture | Sequence[Frame] | None = None,
        *,
        frames: slice | Sequence[int] | None = None,
        near: Sequence[float] | None = None,
        radius: float = 1000.0,
        heading: float | None = None,
        seed: int = 0,
        **options: Any,  # noqa: ANN401  # of `WorldQuery`
    ) -> WorldEstimate:
        """Locate place, room and pose in all maps, from all evidence.

        Parameters
        ----------
        text
            Description of the place, outside or inside: "in the library on Lange Straße, by the
            window". Rooms and objects are known in English and five other languages.
        capture, frames
            A capture, or frames in order of time, and which of them; all if not given.
        near, radius
            Longitude and latitude [deg] of a fix, and its radius [m]: a Gaussian of which half lies
            within.
        heading
            Where the speaker, and the camera of the last frame, looks [rad], clockwise from north.
        seed
            Of all randomness.
        options
            `top`: modes at most (5); `most`: scenes in which a pose is sought, at most (8);
            `refine`, `device`, `progress`: as of `SceneMap.localize`; `answers` to questions, and the
            `language` of the text: as of `CityMap.locate`; `budget` [s] ends the search of a world in
            shards early: the best so far is `AMBIGUOUS`, and the reason tells what share was not.
            What frames show is sought as long as it takes.

        Returns
        -------
        WorldEstimate
            `OK` only where one place, room and pose hold most of the probability and nothing that is
            known contradicts them.

        Raises
        ------
        OptionError
            Nothing is asked; an option is out of its range; frames show nothing to be compared.
        DescriptionError
            The text is empty, too long, or no text.
        InputError, MapError
            An image is broken; a map is damaged, gone, or another one than its library has.
        ServiceError
            The scheduler of a world in shards went away.

        """
        from placegraph.world.estimate import WorldQuery
        from placegraph.world.locate import locate

        reject_unknown(options, (f.name for f in fields(WorldQuery)), "World.locate")
        return locate(
            self, WorldQuery(text, capture, frames, near, radius, heading, seed, **options)
        )

    def close(self) -> None:
        """Close worlds in shards, and leave the cluster that searches them."""
        for planet in self.planets.values():
            planet.close()

    def __repr__(self) -> str:
        shards = f", {len(self.shards)} in shards" if self.shards else ""
        planets = "".join(f", {planet}" for planet in self.planets.values())
        return f"World({len(self.cities)} cities, {len(self.scenes)} scenes{shards}{planets})"


def open_world(
    places: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    *,
    opener: Callable[[Path], Any] | None = None,
    scheduler: str | None = None,
    keep: str | os.PathLike[str] | None = None,
    memory: str | float | None = None,
) -> World:
    """Open the maps of a folder, or of several folders and files, as one world.

    Maps are only listed now, and opened when they are needed; of a world in shards the table of words
    is opened. Other files are left alone, and named in `World.ignored`. A scene's place on Earth stands
    in its own file.

    Parameters
    ----------
    places
        A folder with ``.city``, ``.scene`` and ``.library`` files, folders of library shards and worlds
        in shards; such a world itself, with what else lies in its folder; or a list of all these.
    opener
        Opens one of them, where that is to be done once for several worlds.
    scheduler
        Address of a Dask scheduler whose workers search worlds in shards; this process if not given.
    keep
        Folder of this machine for the world in shards that lies at a URL (``s3://...``): what it does
        not hold yet is fetched into it first.
    memory
        Memory that open shards take in this process, such as ``"4GB"``: those not used for longest are
        closed; 2 GB if not given.

    Raises
    ------
    InputError
        A place is missing, or holds no map.
    MapError
        Map files are damaged or have one name: the message names all, each with its mend.
    OptionError
        A place is a URL and `keep` is not given, or several are; `keep`, `scheduler` or `memory` is given,
        and nothing is there that takes it; `memory` is no size.
    MissingExtraError, ServiceError
        The scheduler takes Dask, which is not installed; or it does not answer.

    """
    given = [places] if isinstance(places, str | os.PathLike) else list(places)
    if not given:
        raise InputError("No maps are given; name a folder, or map files.")
    if keep is not None or any(map(is_url, given)):
        given = load_module("placegraph_scale.folder", "scale").fetch_places(given, keep)
    found = check_map_files([Path(place) for place in given])
    for option, value in (("scheduler", scheduler), ("memory", memory)):
        if value is not None and not found.paths["world"]:
            raise OptionError(
                f"{option}: it applies only to worlds in shards, but {given[0]} contains none; "
                "remove it, or build one with `placegraph world build`."
            )
    opener = opener or partial(open_map_or_world, scheduler=scheduler, memory=memory)
    libraries: Maps[SceneLibrary] = Maps(found.paths["library"], opener)
    scenes, ignored = dict(found.paths["scene"]), list(found.ignored)
    for library in libraries.values():
        here = {resolve_path(path) for path in scenes.values()}
        for name in library:
            path = library.entry(name).path
            if path is None or resolve_path(path) in here:
                continue
            if not path.exists():
                ignored.append((path, f"the map of {name!r} is missing; restore it"))
            elif name in scenes:
                ignored.append((path, f"another scene is called {name!r}"))
            else:
                scenes[name] = path
    return World(
        Maps(found.paths["city"], opener), Maps(scenes, opener), libraries,
        Maps(found.paths["shards"], opener), ignored=ignored,
        planets={name: opener(path) for name, path in found.paths["world"].items()},
    )  # fmt: skip


def open_map_or_world(path: Path, **options: Any) -> Any:  # noqa: ANN401  # any map, or a planet
    """Open a file or folder of `maps.find_map_files`; raises as `open_map` and `open_world`.

    `options` are the `scheduler` and the `memory` of a world in shards.
    """
    return open_folder(path, **options) if is_world(path) else open_map(path)
