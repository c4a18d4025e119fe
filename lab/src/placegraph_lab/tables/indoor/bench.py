"""Maps and windows of the indoor benchmarks, made when they are first needed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from placegraph.indoor.scene_map import SceneMap
from placegraph_lab.tables.indoor import maps as indoor_maps
from placegraph_lab.tables.indoor.windows import (
    HALVES,
    Window,
    covered,
    house_windows,
    office_windows,
)

if TYPE_CHECKING:
    from placegraph_lab.tables.runner import Run


class Asker:
    """Asks about windows that nobody asked about yet, with a bar; a context manager.

    Answers are written down at once, so that a run that is cut goes on where it was.
    """

    def __init__(self, run: Run, *, fresh: bool) -> None:
        self._journal = run.journal(fresh=fresh)
        self._bar = run.progress()

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def answers(
        self,
        title: str,
        windows: Sequence[Window],
        keys: Sequence[str],
        once: Callable[[Window, int], dict[str, Any]],
        seed: int,
    ) -> list[dict[str, Any]]:
        """Answers of all windows, by their keys; before the first, one is asked to compile."""
        task = self._bar.add_task(title, total=len(self._journal.missing(keys)))
        rows = self._journal.filled(
            keys,
            lambda i: once(windows[i], seed),
            warm=lambda: once(windows[0], seed + 1),
            tick=lambda: self._bar.advance(task),
        )
        self._bar.remove_task(task)
        return rows


class Bench:
    """Maps and windows by name; of the maps only the last is kept.

    Parameters
    ----------
    data
        Folder with `house` and `office`.
    cache
        Folder for maps.
    every, office_every
        Frames from the start of a window to the next, in the house and in the office.

    """

    def __init__(self, data: Path, cache: Path, every: int, office_every: int) -> None:
        self.data = data
        self.cache = cache
        self.every = every
        self.office_every = office_every
        self._maps: dict[str, SceneMap] = {}
        self._windows: dict[tuple[str, int], list[Window]] = {}

    def scene(self, name: str) -> SceneMap:
        """Map `house`, `coarse`, or one of a key of `HALVES`."""
        if name not in self._maps:
            self._maps.clear()
            if name in HALVES:
                made = indoor_maps.office(self.data, self.cache, name)
            elif name == "coarse":
                made = indoor_maps.coarse_house(self.data, self.cache)
            else:
                made = indoor_maps.house(self.data, self.cache)
            self._maps[name] = made
        return self._maps[name]

    def windows(self, place: str, length: int) -> list[Window]:
        """Windows of a length of the house, or of the half of the office that a key of `HALVES` asks.

        Of the office it is measured how much of them the map covers.
        """
        place = place if place in HALVES else "house"
        if (place, length) not in self._windows:
            if place in HALVES:
                folder = self.data / "office"
                made = office_windows(folder, place, length=length, every=self.office_every)
                made = [covered(self.scene(place), w) for w in made]
            else:
                made = house_windows(self.data / "house", length, every=self.every)
            self._windows[place, length] = made
        return self._windows[place, length]
