"""The map files of a folder, by name: opened when they are first asked for, and kept."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Generic, TypeVar

from placegraph.errors import OptionError

Map = TypeVar("Map")


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
