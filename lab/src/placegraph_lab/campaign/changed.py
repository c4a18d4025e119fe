"""Files that are replaced, cut short, overwritten or deleted while what was read of them is used."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator

from placegraph.errors import PlacegraphError

TYPED, UNTYPED = 20, 21  # exit codes of a trial
CHANGES = ("cut short", "deleted", "replaced", "overwritten", "older")
SENTENCE = "A bakery is north of me. A church is south of me."


def change(path: Path, how: str, rng: Generator) -> None:
    """Do it to a file; `older` is another file, last changed long before: a clock was set back."""
    content = path.read_bytes()
    if how == "cut short":
        os.truncate(path, int(rng.integers(len(content))))
    elif how == "deleted":
        path.unlink()
    elif how == "replaced":
        other = path.with_name(f"{path.name}.new")
        other.write_bytes(content[: len(content) // 2])
        other.replace(path)
    elif how == "overwritten":
        with path.open("r+b") as file:
            file.seek(int(rng.integers(len(content))))
            file.write(rng.bytes(len(content) // 2))
    else:
        os.utime(path, (0, 0))


def city(path: Path) -> Callable[[], Any]:
    """A city's map, and a sentence in it; one with an index is mapped, as a large one is."""
    from placegraph.outdoor.city import CityMap

    found = CityMap.open(path, shard=True)
    return lambda: found.locate(SENTENCE)


def scene(path: Path) -> Callable[[], Any]:
    """A scene's map, and a window of frames in it."""
    from placegraph.io.capture.capture import open_capture
    from placegraph.maps import open_scene

    found, frames = open_scene(path), open_capture(path.parent / "window")
    return lambda: found.localize(frames, seed=0)


def library(path: Path) -> Callable[[], Any]:
    """A library, one of whose maps is looked into."""
    from placegraph.indoor.library import SceneLibrary

    found = SceneLibrary.open(path.with_name("homes.library"))
    return lambda: len(found.scene("home1"))


def vectors(path: Path) -> Callable[[], Any]:
    """Vectors of a city, and those nearest to one of them."""
    from placegraph.vectors import EmbeddedStore

    found = EmbeddedStore.open(path)
    return lambda: found.search(np.ones((1, found.dimension), np.float32), 3)


def capture(path: Path) -> Callable[[], Any]:
    """A folder of frames, one of whose images is asked for."""
    from placegraph.io.capture.capture import open_capture

    found = open_capture(path.parent.parent)
    return lambda: [frame.rgb() for frame in found]


def bag(path: Path) -> Callable[[], Any]:
    """A bag whose images are asked for."""
    from placegraph.io.capture.capture import open_capture

    found = open_capture(path)
    return lambda: [frame.rgb() for frame in found]


def weights(path: Path) -> Callable[[], Any]:
    """Weights of PyTorch, which are computed with."""
    import torch

    from placegraph.core.networks import read_state

    found = read_state(torch, path, "test")
    return lambda: float(sum(tensor.sum() for tensor in found.values()))


USES: dict[str, tuple[str, Callable[[Path], Callable[[], Any]]]] = {
    "a city's map": ("town.city", city),
    "a city's map that is mapped": ("indexed.city", city),
    "a scene's map": ("flat.scene", scene),
    "a map of a library": ("home1.scene", library),
    "vectors": ("town.vectors", vectors),
    "an image of a capture": ("window/rgb/*", capture),
    "a bag": ("walk.mcap", bag),
    "weights": ("any.pt", weights),
}
"""What is opened: its file among the inputs, and how it is used."""


def used(what: str, how: str, folder: Path, seed: int) -> None:
    """Open, let something happen to the file, and use what was opened; ends the process."""
    pattern, use = USES[what]
    path = max(folder.glob(pattern))
    code = 0
    try:
        ask = use(path)
        change(path, how, np.random.default_rng(seed))
        ask()
    except PlacegraphError:
        code = TYPED
    except BaseException as error:  # noqa: BLE001  # it is counted
        (folder / "said.txt").write_text(f"{type(error).__name__}: {error}")
        code = UNTYPED
    os._exit(code)


def served_anew(folder: Path) -> bool:
    """Whether a server's maps are opened anew where another takes a map's place, of any time."""
    from placegraph_serve.places import Places

    places, path = Places([folder]), folder / "town.city"
    first: Any = places.city("town")
    other = replace(first, source="another")
    for when in (0.0, 4e9):
        other.save(path)
        os.utime(path, (when, when))
        if places.city("town").source != "another":
            return False
        first.save(path)
        if places.city("town").source != first.source:
            return False
    return True
