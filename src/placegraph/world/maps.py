"""The map files of a folder, by name: opened when they are first asked for, and kept."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, TypeVar

from placegraph import store
from placegraph.errors import InputError, MapError, OptionError, PlacegraphError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

Map = TypeVar("Map")

KINDS = {".city": "city", ".scene": "scene", ".library": "library"}
"""Kind of map that a file of each name holds."""


class Maps(Mapping[str, Map], Generic[Map]):
    """Maps by name, each opened on first use; `OptionError` where there is none of a name."""

    def __init__(self, paths: Mapping[str, Path], opener: Callable[[Path], Map]) -> None:
        self.paths = dict(paths)
        self._opener = opener
        self._opened: dict[str, Map] = {}

    def __getitem__(self, name: str) -> Map:
        if name not in self.paths:
            known = ", ".join(sorted(self.paths)[:5]) or "none at all"
            raise OptionError(f"{name!r} is no map of this world; it has {known}.")
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


@dataclass(frozen=True)
class Found:
    """Files of a world, as they are called; none was looked into."""

    paths: dict[str, dict[str, Path]]
    """Of each kind of map its files by name."""
    ignored: tuple[tuple[Path, str], ...]
    """Files and folders left alone, and why."""
    twins: tuple[str, ...]
    """What is wrong with their names."""

    def check(self) -> None:
        """Read the head of each; `MapError` where some are no maps, or others than they are called."""
        bad = list(self.twins)
        for kind, paths in self.paths.items():
            for path in paths.values():
                try:
                    held = store.read_header(path).kind
                except PlacegraphError as error:
                    bad.append(str(error))
                    continue
                if held != kind:
                    bad.append(f"{path} holds a {held} map; call it {path.stem}.{held}.")
        if bad:
            raise MapError(" ".join(bad))


def find(places: Sequence[Path]) -> Found:
    """Map files that are named, or lie in folders that are named, by what they are called."""
    paths: dict[str, dict[str, Path]] = {kind: {} for kind in KINDS.values()}
    ignored, twins = [], []
    for path in itertools.chain.from_iterable(map(_files, places)):
        kind = KINDS.get(path.suffix)
        if path.is_dir():
            ignored.append((path, "a folder"))
        elif kind is None:
            ignored.append((path, f"no map: its name ends in none of {', '.join(KINDS)}"))
        elif (known := paths[kind].setdefault(path.stem, path)).resolve() != path.resolve():
            twins.append(f"{known} and {path} have one name; rename one of them.")
    return Found(paths, tuple(ignored), tuple(twins))


def checked(places: Sequence[Path]) -> Found:
    """What `find` finds, which is something, and sound as far as the heads of files tell.

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
    found = find(places)
    found.check()
    if not any(found.paths.values()):
        said = ", ".join(map(str, places)) or "nothing"
        raise InputError(
            f"{said} holds no map ({', '.join(KINDS)}); build some with `placegraph city build` and "
            "`placegraph scene build`."
        )
    return found


def _files(place: Path) -> list[Path]:
    try:
        return sorted(place.iterdir())
    except OSError:  # a file, or gone by now
        return [place]
