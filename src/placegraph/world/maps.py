"""The map files of a folder, by name: opened when they are first asked for, and kept."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Generic, TypeVar

from placegraph import store
from placegraph.errors import InputError, MapError, OptionError, PlacegraphError

if TYPE_CHECKING:
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
    """Files of a world."""

    paths: dict[str, dict[str, Path]]
    """Of each kind of map its files by name."""
    ignored: tuple[tuple[Path, str], ...]
    """Files and folders left alone, and why."""


@dataclass
class _Sorted:
    paths: dict[str, dict[str, Path]] = field(
        default_factory=lambda: {k: {} for k in KINDS.values()}
    )
    ignored: list[tuple[Path, str]] = field(default_factory=list)
    bad: list[str] = field(default_factory=list)

    def take(self, path: Path) -> None:
        """Sort a file in."""
        kind = KINDS.get(path.suffix)
        if path.is_dir():
            self.ignored.append((path, "a folder"))
            return
        if kind is None:
            self.ignored.append((path, f"no map: its name ends in none of {', '.join(KINDS)}"))
            return
        try:
            held = store.read_header(path).kind
        except PlacegraphError as error:
            self.bad.append(str(error))
            return
        if held != kind:
            self.bad.append(f"{path} holds a {held} map; call it {path.stem}.{held}.")
            return
        known = self.paths[kind].setdefault(path.stem, path)
        if known.resolve() != path.resolve():
            self.bad.append(f"{known} and {path} have one name; rename one of them.")


def find(places: list[Path]) -> Found:
    """Map files of folders and files, sorted by kind.

    Raises
    ------
    InputError
        A place is missing, or there is no map in any.
    MapError
        Map files are damaged, or are called what they are not: all of them, each with its mend.

    """
    found = _Sorted()
    for place in places:
        if not place.exists():
            raise InputError(f"{place} is not there; name a folder with maps, or map files.")
        for path in sorted(place.iterdir()) if place.is_dir() else [place]:
            found.take(path)
    if found.bad:
        raise MapError(" ".join(found.bad))
    if not any(found.paths.values()):
        said = ", ".join(map(str, places))
        raise InputError(
            f"{said} holds no map ({', '.join(KINDS)}); build some with `placegraph city build` and "
            "`placegraph scene build`."
        )
    return Found(found.paths, tuple(found.ignored))
