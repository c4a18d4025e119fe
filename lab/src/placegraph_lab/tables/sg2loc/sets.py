"""Where the tables of SG2Loc are measured: maps, recordings asked about in them, and the truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from zlib import crc32

import numpy as np

from placegraph.core.geometry import Floats
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.capture import Capture
from placegraph_lab.tables.indoor.windows import DRIFT, Window, drifting_windows

LAYOUT = """DIR/3RScan has 3RScan.json and a folder a scan (or scenes/SCAN), with its mesh, semseg.v2.json
and sequence/ or sequence.zip; where SceneGraphLoc's lists lie in DIR/3RScan/files, they part the rooms.
DIR/ScanNet has scans/sceneNNNN_NN (or sceneNNNN_NN), each with its mesh, annotation and .sens or
exported frames; beside them pairs.txt, if pairs and their alignment are known, and
SceneGraphFusion/sceneNNNN_NN, if scene graphs are to be predicted ones. A folder with data/house,
data/office and data/freiburg1_rpy is asked about these; homes are drawn."""


@dataclass(frozen=True, eq=False)
class Walk:
    """A recording that is asked about in a map."""

    name: str
    map: str
    open: Callable[[], tuple[Capture, Floats]] = field(repr=False)
    """Its frames, and their true map_from_camera (T, 4, 4)."""
    changed: bool | None = None
    """Whether things were moved since the map was made; None where nobody knows."""


@dataclass(frozen=True, eq=False)
class Set:
    """Recordings of one kind, and their maps."""

    name: str
    walks: tuple[Walk, ...]
    scene: Callable[[str], SceneMap]
    rooms: dict[str, str]
    """Which room each map shows: maps of one room are not to be told apart."""
    rate: float
    """Frames a second of a recording."""
    own_ids: bool = False
    """Instances of its label images are ids of the map's objects."""
    frames: int = 0
    """Of a walk, where that is known before one is opened."""

    @cached_property
    def longest(self) -> int:
        """Frames of the longest walk."""
        return self.frames or max((len(walk.open()[0]) for walk in self.walks), default=0)

    def windows(
        self, length: int, frames: int, seed: int, drift: tuple[float, float] = DRIFT
    ) -> list[tuple[Walk, Window]]:
        """Windows that do not overlap, of at most so many frames in all by state; 0: all of them."""
        found: dict[bool | None, list[tuple[Walk, Window]]] = {}
        for walk in self.walks:
            capture, truth = walk.open()
            rng = np.random.default_rng([seed, crc32(walk.name.encode())])
            made = drifting_windows(
                walk.name, capture, truth, length, rng, changed=walk.changed, drift=drift
            )
            found.setdefault(walk.changed, []).extend((walk, window) for window in made)
        return [pair for of_state in found.values() for pair in _thinned(of_state, frames, length)]


def _thinned(
    pairs: list[tuple[Walk, Window]], frames: int, length: int
) -> list[tuple[Walk, Window]]:
    """As many windows as are asked for, drawn; those of fewer are among those of more."""
    most = max(1, frames // length) if frames else len(pairs)
    drawn = np.random.default_rng(0).permutation(len(pairs))[:most]
    return [pairs[i] for i in sorted(drawn.tolist())]


def kept(scene: Callable[[str], SceneMap]) -> Callable[[str], SceneMap]:
    """The same, the last dozen maps kept in memory."""
    return lru_cache(maxsize=12)(scene)
