"""What a library keeps of a scene to know it again: kilobytes, without meshes and images.

Its graph without geometry, a vector an object and encoder, and *panoramas*: which object lies in
which direction, seen from some places of its floor. They say how much of what is seen an object
takes up, what is seen together, and how that changes along a way.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from placegraph.core.graph import SceneGraph
from placegraph.errors import OptionError
from placegraph.indoor.encode import Encoder, vectors_of
from placegraph.indoor.language.appearance import with_colours
from placegraph.indoor.language.index import Described, units
from placegraph.indoor.likelihood.visibility import build_table
from placegraph.indoor.map.free_space import HIGHEST
from placegraph.indoor.map.map_kernels import AZIMUTHS, ELEVATIONS
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.options import STANDING, FilterOptions
from placegraph.io.capture.capture import Capture

PLACES = 160
"""Panoramas of a scene, or of a merged map's part, at most,"""
APART = 0.75
"""and how far they are from each other at least [m]."""
TURNS = 24
"""Bins of azimuth of a panorama: 15 degrees."""
BANDS = 4
"""Bins of elevation, from `REACH` below the horizon to as much above it: 25 degrees."""
REACH = HIGHEST
"""Elevation at which panoramas end [rad]."""
MOST = 20_000
"""Objects of a scene at most."""
_SPACING = 0.5  # of the grid that places are chosen from [m]


@dataclass(frozen=True, eq=False)
class Signature:
    """What is known of one scene of N objects without opening its map."""

    graph: SceneGraph
    """Without embeddings."""
    attributes: tuple[dict[str, str], ...]
    """(N,) as of the map, and the colours of the objects (`language.colours`)."""
    vectors: Mapping[str, NDArray[np.float32]]
    """(N, d) unit vectors, or zero, by the key of their encoder."""
    share: NDArray[np.float32]
    """(N,) of what is seen from its places, adding up to 1."""
    places: NDArray[np.float32]
    """(P, 2) x, y [m, map] of the panoramas."""
    panoramas: NDArray[np.uint16]
    """(P, BANDS, TURNS) row of the object, N where the map ends; azimuth bins are centred on
    multiples of 2 pi / TURNS."""
    part: NDArray[np.int32]
    """(N,) merged scene of each object, from 0 on: a camera is in one of them."""
    place_part: NDArray[np.int32]
    """(P,) merged scene of each place."""

    def __len__(self) -> int:
        return len(self.graph)

    @property
    def rooms(self) -> tuple[str, ...]:
        """Names of its rooms, as far as the map names them."""
        named = dict.fromkeys(a.get("room", "") for a in self.attributes)
        return tuple(name for name in named if name)

    @cached_property
    def described(self) -> list[Described]:
        """What may be described of it; worked out once."""
        rooms = [a.get("room", "") for a in self.attributes]
        return units(self.graph, rooms, self.attributes)


def signature_of(
    scene: Scene,
    encoders: Sequence[Encoder],
    captures: Sequence[Capture] = (),
    height: float | None = None,
) -> Signature:
    """Signature of a map.

    Parameters
    ----------
    encoders
        Whose vectors are kept: the map's own where they are of this encoder, else made anew.
    captures
        Images of the map, for encoders that need some; their odometry is map_from_camera.
    height
        Of the camera above the floor [m]; as `FilterOptions` has it if not given.

    Raises
    ------
    OptionError
        No object says anything to any encoder; no place of it is free; it has too many objects.
    MapError
        Its vectors are of another encoder.

    """
    if len(scene) > MOST:
        raise OptionError(
            f"{scene.source or 'The map'} has {len(scene):,} objects; a scene of a library has up to "
            f"{MOST:,}. Split it by rooms."
        )
    vectors = {e.key: vectors_of(e, scene, captures) for e in encoders}
    if not any(v.any() for v in vectors.values()):
        raise OptionError(
            f"{scene.source or 'The map'}: none of its {len(scene)} objects says anything to "
            f"{', '.join(e.name for e in encoders)}; give labels to its objects, or colours."
        )
    heights = STANDING if height is None else (height,)
    table = build_table(scene, FilterOptions(heights=(float(np.mean(heights)),), spacing=_SPACING))
    if not len(table):
        raise OptionError(
            f"{scene.source or 'The map'} has no free place {np.mean(heights):.1f} m above its floor "
            "to look around from; give the camera's height."
        )
    at = np.array([scene.scene_at(p[:2]) for p in table.positions], np.int32)
    parts = [np.flatnonzero(at == part) for part in np.unique(at)]
    chosen = np.concatenate([r[far_apart(table.positions[r, :2], PLACES)] for r in parts])
    panoramas = coarse(table.panoramas.objects[chosen], len(scene))
    seen = table.panoramas.objects.ravel()
    counts = np.bincount(seen, minlength=len(scene) + 1)[: len(scene)] + 0.5
    return Signature(
        graph=replace(scene.graph, embeddings=None),
        attributes=with_colours(scene),
        vectors=vectors,
        share=(counts / counts.sum()).astype(np.float32),
        places=table.positions[chosen, :2].astype(np.float32),
        panoramas=panoramas,
        part=scene.scene_of,
        place_part=at[chosen],
    )


def far_apart(points: NDArray[np.float64], most: int) -> NDArray[np.int64]:
    """Rows of at most `most` of points (K, 2): the most central first, then ever the farthest.

    None nearer to another than `APART`.
    """
    first = int(np.linalg.norm(points - np.median(points, axis=0), axis=1).argmin())
    rows = [first]
    away = np.linalg.norm(points - points[first], axis=1)
    while len(rows) < min(most, len(points)):
        row = int(away.argmax())
        if away[row] < APART:
            break
        rows.append(row)
        away = np.minimum(away, np.linalg.norm(points - points[row], axis=1))
    return np.array(rows)


def coarse(objects: NDArray[np.uint16], count: int) -> NDArray[np.uint16]:
    """Panoramas (P, BANDS, TURNS) by the object that most rays (P, E, A) of a bin hit."""
    places = len(objects)
    wide, high = AZIMUTHS // TURNS, ELEVATIONS // BANDS
    # bins are centred on multiples of their width, of the fine as of the coarse
    turned = np.roll(objects, wide // 2, axis=2)
    rays = turned.reshape(places, BANDS, high, TURNS, wide).swapaxes(2, 3)
    rays = rays.reshape(places * BANDS * TURNS, high * wide)
    ordered = np.sort(rays, axis=1)
    # the longest run of equal numbers
    best, most = ordered[:, 0].copy(), np.zeros(len(ordered), np.int64)
    run = np.ones(len(ordered), np.int64)
    for k in range(1, ordered.shape[1] + 1):
        ends = np.ones(len(ordered), np.bool_)
        if k < ordered.shape[1]:
            ends = ordered[:, k] != ordered[:, k - 1]
        longer = ends & (run > most)
        best[longer], most[longer] = ordered[longer, k - 1], run[longer]
        run = np.where(ends, 1, run + 1)
    return np.minimum(best, count).astype(np.uint16).reshape(places, BANDS, TURNS)
