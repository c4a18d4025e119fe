"""Program that builds a few maps, queries them, and prints the answers as JSON.

It runs as a file, also where only placegraph is installed. Two processes that agree print the same bytes.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.abc
import importlib.metadata
import json
import locale
import resource
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import Any

TEXTS = (
    "I am on Speicherweg, and the museum is south of me.",
    "I AM ON LİMAN CADDESİ. A BAKERY IS NORTH OF ME.",
    "I am standing on a square. There is a fountain north of me and a café to my east.",
    "Fırının kuzeyindeyim. Doğuda bir kilise var.",
    "Ich stehe auf der Hafenstraße, südlich der Kneipe.",
)


class _Hidden(importlib.abc.MetaPathFinder):
    """Import hook that hides packages."""

    def __init__(self, names: Sequence[str]) -> None:
        self.names = names
        self._known = importlib.metadata.distribution
        importlib.metadata.distribution = self.distribution  # type: ignore[assignment]

    def find_spec(self, name: str, path: object = None, target: ModuleType | None = None) -> None:  # noqa: ARG002
        """Raise `ImportError` for a hidden package."""
        if name.partition(".")[0] in self.names:
            raise ImportError(f"{name} is hidden", name=name)

    def distribution(self, name: str) -> importlib.metadata.Distribution:
        """Raise `PackageNotFoundError` for a hidden package."""
        if name in self.names:
            raise importlib.metadata.PackageNotFoundError(name)
        return self._known(name)


def drop_durations(answer: Any) -> Any:  # noqa: ANN401  # JSON
    """Return an answer without its durations."""
    if isinstance(answer, dict):
        return {k: drop_durations(v) for k, v in answer.items() if "seconds" not in k}
    return [drop_durations(v) for v in answer] if isinstance(answer, list) else answer


def answers(folder: Path, *, threads: int | None, frames: int) -> dict[str, Any]:
    """Build maps of the demo's files; return their digests and answers."""
    import placegraph as pg
    from placegraph.core.threads import count_processors, limit_threads
    from placegraph.demo.town import FLAT, TOWN, unpack

    world = unpack(folder)
    with limit_threads(threads or count_processors()):
        city = pg.build_city(world / f"{TOWN}.osm", world / "town.city")
        found: dict[str, Any] = {
            "city": _digest(world / "town.city"),
            "texts": [_locate(city, text) for text in TEXTS],
        }
        if frames:
            scene = pg.build_scene(world / f"{FLAT}.glb", world / "flat.scene")
            found["scene"] = _digest(world / "flat.scene")
            walk = pg.open_capture(world / "walk")[:frames]
            found["pose"] = scene.localize(walk, seed=3).to_dict()
    stable: dict[str, Any] = drop_durations(found)
    return stable


def _locate(city: Any, text: str) -> Any:  # noqa: ANN401  # a CityMap, imported late
    from placegraph.errors import PlacegraphError

    try:
        return city.locate(text).to_dict()
    except PlacegraphError as error:
        return str(error)


def _digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


def main() -> None:
    """Answer under the conditions that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hide", nargs="*", default=[], help="packages that seem not to be there")
    parser.add_argument("--locale", help="what the process sets before it begins")
    parser.add_argument("--memory", type=int, help="bound of the address space [MiB]")
    parser.add_argument("--threads", type=int)
    parser.add_argument("--frames", type=int, default=0, help="how many are localized")
    parser.add_argument("--compiled", help="folder of compiled code")
    given = parser.parse_args()
    if given.hide:
        sys.meta_path.insert(0, _Hidden(given.hide))
    if given.locale:
        locale.setlocale(locale.LC_ALL, given.locale)
    if given.memory:
        resource.setrlimit(resource.RLIMIT_AS, (given.memory << 20, given.memory << 20))
    if given.compiled:
        from placegraph.core import cache

        cache.FOLDERS.choose(given.compiled)
    with TemporaryDirectory() as folder:
        found = answers(Path(folder), threads=given.threads, frames=given.frames)
    sys.stdout.write(json.dumps(found, sort_keys=True) + "\n")


if __name__ == "__main__":
    main()
