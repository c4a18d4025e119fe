"""A scene map seen from above, as an architect draws it: walls cut, furniture from above."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.indoor.map.floor import is_floor
from placegraph.view.draw.canvas import Bounds, Frame, Text
from placegraph.view.draw.fonts import Face
from placegraph.view.draw.lettering import Taken, covering
from placegraph.view.scene.room_style import ROOM_PAINTS, plain_words, room_paint
from placegraph.view.scene.top_view import section

if TYPE_CHECKING:
    from placegraph.indoor.scene_map import SceneMap

CUT = 1.4
"""Walls are cut this high above the floor [m]: through windows and doors, above most furniture."""
HANGING = 1.2
"""What begins higher above the floor than this is left out: lamps, pictures, shelves [m]."""
LOW_CEILING = 1.9
"""Of a scan without labels, what begins higher above the floor than this is left out [m]."""
NAMED = 0.35
"""Footprint of the smallest thing with a name on the plan [m2]."""
SMALL = 9.5
"""Size of the names of small things [px]."""
MARGIN = 0.35
"""Paper around a scene [m]."""
SCAN = "scan"
"""Paint of an object that is all the scene and whose label says nothing."""


@dataclass(frozen=True, eq=False)
class RoomPlan:
    """One scene of a map, ready to be drawn in frames of any size."""

    scene: SceneMap
    which: int = 0
    """Number of the scene in a merged map."""

    @cached_property
    def rows(self) -> list[int]:
        """Rows of this scene's objects."""
        rows: list[int] = np.flatnonzero(self.scene.scene_of == self.which).tolist()
        return rows

    @cached_property
    def kept(self) -> NDArray[np.int64]:
        """Rows of this scene's triangles (T,)."""
        mesh = self.scene.mesh
        return np.flatnonzero(self.scene.scene_of[mesh.object_of] == self.which)

    @cached_property
    def triangles(self) -> NDArray[np.int32]:
        """(T, 3), rows of the mesh's vertices."""
        return self.scene.mesh.triangles[self.kept]

    @cached_property
    def object_of(self) -> NDArray[np.int32]:
        """(T,), row of each triangle's object."""
        return self.scene.mesh.object_of[self.kept]

    @cached_property
    def boxes(self) -> Floats:
        """(N, 2, 3) [m], lower and upper corners of all objects of the map."""
        graph = self.scene.graph
        half = np.zeros_like(graph.positions) if graph.extents is None else graph.extents / 2
        return np.stack([graph.positions - half, graph.positions + half], axis=1)

    @property
    def floor(self) -> float:
        """Height of the floor [m]."""
        return float(self.scene.floors[self.which])

    @cached_property
    def bounds(self) -> Bounds:
        """Rectangle that holds the scene and a margin: low x, low y, high x, high y [m]."""
        if not self.rows:
            return -1.0, -1.0, 1.0, 1.0
        own = self.boxes[self.rows, :, :2]
        west, south = (own[:, 0].min(axis=0) - MARGIN).tolist()
        east, north = (own[:, 1].max(axis=0) + MARGIN).tolist()
        return west, south, east, north

    @cached_property
    def paints(self) -> tuple[str, ...]:
        """Paint of each object of the map (N,)."""
        paints = [room_paint(label) for label in self.scene.graph.labels]
        west, south, east, north = self.bounds
        for row in self.rows:
            wide, deep = np.ptp(self.boxes[row], axis=0)[:2]
            is_all = wide > 0.6 * (east - west) and deep > 0.6 * (north - south)
            if paints[row] == "thing" and is_all:
                paints[row] = SCAN
        return tuple(paints)

    def role(self, row: int) -> str:
        """How an object is drawn: ``scan``, or a role of the room style."""
        paint = self.paints[row]
        return SCAN if paint == SCAN else ROOM_PAINTS[paint].role

    def hangs(self, row: int) -> bool:
        """Whether an object begins overhead."""
        return bool(self.boxes[row, 0, 2] > self.floor + HANGING)

    def middle(self, row: int) -> Floats:
        """Middle (2,) of an object's footprint [m]."""
        middle: Floats = self.boxes[row, :, :2].mean(axis=0)
        return middle

    def colours(self, triangles: NDArray[np.int64]) -> NDArray[np.float32]:
        """Colours (M, 3), 0 to 255, of triangles (rows of `triangles`): texture's mean and corners."""
        mesh = self.scene.mesh
        tints = np.array([texture.reshape(-1, 3).mean(axis=0) for texture in mesh.textures])
        rows = self.kept[triangles]
        corners = mesh.colours[mesh.triangles[rows]].astype(np.float32).mean(axis=1)
        colours: NDArray[np.float32] = corners * (tints[mesh.texture_of[rows]] / 255.0)
        return colours.astype(np.float32)

    @cached_property
    def cuts(self) -> dict[str, Floats]:
        """What stands and is cut: by paint, in the order of drawing, segments (S, 2, 2) [m]."""
        cuts = {}
        paints = np.array(self.paints, dtype=np.str_)
        structure = (name for name, look in ROOM_PAINTS.items() if look.role == "structure")
        for paint in (*structure, SCAN):
            chosen = (paints == paint)[self.object_of]
            if chosen.any():
                cuts[paint] = section(
                    self.scene.mesh.vertices, self.triangles[chosen], self.floor + CUT
                )
        return cuts

    def lifts(self) -> NDArray[np.float32]:
        """What to add to each triangle's height (T,) before the uppermost is drawn [m].

        -inf leaves a triangle out: ceilings, what hangs, and of what is cut all above the cut.
        """
        lift = np.zeros(len(self.scene), np.float32)
        least, most = np.full((2, len(self.scene)), np.inf)
        for row in self.rows:
            role = self.role(row)
            if role == "ceiling" or (role == "thing" and self.hangs(row)):
                lift[row] = -np.inf
            elif role == "floor":
                lift[row] = -0.02  # a carpet lies on it, at the same height
            elif role == "structure":
                most[row] = self.floor + CUT
            elif role == SCAN:
                least[row] = self.floor + LOW_CEILING
        heights = self.scene.mesh.vertices[self.triangles, 2]
        lifts: NDArray[np.float32] = lift[self.object_of]
        lifts[heights.max(axis=1, initial=-np.inf) > most[self.object_of]] = -np.inf
        lifts[heights.min(axis=1, initial=np.inf) > least[self.object_of]] = -np.inf
        return lifts

    def sight(self, at: Floats, angles: Floats, reach: float) -> Floats:
        """How far (A,) [m] one sees from `at` (2,) at angles (A,) [rad]: to a wall, or to `reach`.

        Seen on the plan: walls and closed doors stop a view, windows end the map, furniture is low.
        """
        walls = [segments for paint, segments in self.cuts.items() if paint != "curtain"]
        if not walls:
            return np.full(len(angles), reach)
        segments = np.concatenate(walls)
        near = np.abs(segments - at).min(axis=1).max(axis=1) <= reach * 1.5
        near |= np.abs(np.diff(segments, axis=1)[:, 0]).max(axis=1) > reach
        start, along = segments[near, 0] - at, (segments[near, 1] - segments[near, 0])
        look = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        # at + t look = start + s along, by Cramer's rule
        cross = look[:, None, 0] * along[:, 1] - look[:, None, 1] * along[:, 0]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            far = (start[:, 0] * along[:, 1] - start[:, 1] * along[:, 0]) / cross
            share = (start[:, 0] * look[:, None, 1] - start[:, 1] * look[:, None, 0]) / cross
        hit = (far > 0.0) & (share >= 0.0) & (share <= 1.0)
        distances: Floats = np.where(hit, far, reach).min(axis=1, initial=reach)
        return distances

    def names(
        self,
        frame: Frame,
        face: Face,
        taken: Taken,
        marked: Mapping[int, str] | None = None,
        *,
        small: bool = False,
    ) -> list[Text]:
        """Names of the larger things, each in the middle of its footprint where there is room.

        What is `marked`, by row, is named first and in that ink, whatever its size. `small`: what
        is small is named, too, beside its footprint.
        """
        marked, texts = marked or {}, self._rooms(frame, face, taken) if small else []
        extents = np.ptp(self.boxes, axis=1)[:, :2]
        areas = np.prod(extents, axis=1)
        for row in sorted(self.rows, key=lambda row: (row not in marked, -areas[row])):
            if self.role(row) != "thing" or (self.hangs(row) and row not in marked):
                continue
            words = face.drawable(plain_words(self.scene.graph.labels[row]))
            if not words:
                continue
            ink = marked.get(row, "soft-ink")
            size = 12.0 if row in marked else 11.0
            width = face.width(words, size)
            fits = areas[row] >= NAMED and width <= 1.6 * extents[row, 0] * frame.scale
            shifts = [(0.0, 0.0), (0.0, 12.0)] if fits else []
            if row in marked:
                shifts = [(0.0, 13.0), (0.0, -13.0)]
            tries = [(size, shift) for shift in shifts]
            if small and row not in marked:
                narrow = width * SMALL / size
                tries += [(SMALL, s) for s in _beside(extents[row] * frame.scale, narrow)]
            for height, shift in tries:
                text = Text(self.middle(row), words, height, ink, shift=shift)
                wide = width * height / size + 4.0
                if _inside(text, wide, frame) and taken.claim(covering(text, wide, frame.scale)):
                    texts.append(text)
                    break
        return texts

    def _rooms(self, frame: Frame, face: Face, taken: Taken) -> list[Text]:
        """Names of the rooms whose floors bear one, each in the middle of its floor."""
        texts = []
        for row in self.rows:
            room = self.scene.attributes[row].get("room", "")
            words = face.drawable(room)
            if self.role(row) != "floor" or not is_floor(self.scene.graph.labels[row]):
                continue
            if not words or room.isdecimal():
                continue
            text, wide = Text(self.middle(row), words, 13.0, "ink"), face.width(words, 13.0) + 4.0
            if _inside(text, wide, frame) and taken.claim(covering(text, wide, frame.scale)):
                texts.append(text)
        return texts


def _beside(extent: Floats, width: float) -> list[tuple[float, float]]:
    """Where a name may stand [px]: below, above, right, left of a footprint so large, or on it."""
    aside, below = (extent[0] + width) / 2 + 4.0, extent[1] / 2 + 0.7 * SMALL
    return [(0.0, below), (0.0, -below), (aside, 0.0), (-aside, 0.0), (0.0, 0.0)]


def _inside(text: Text, width: float, frame: Frame) -> bool:
    """Whether a text, so wide [px], ends within the picture."""
    x, y = frame.to_px(np.asarray(text.at, np.float64)) + text.shift
    half = 0.6 * text.size
    return bool(width / 2 <= x <= frame.width - width / 2 and half <= y <= frame.height - half)
