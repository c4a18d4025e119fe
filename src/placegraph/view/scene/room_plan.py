"""Plan of the rooms of a scene map, seen from above: its parts, their looks, and how they are painted."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageColor, ImageDraw, ImageFilter

from placegraph.core.geometry import Floats
from placegraph.indoor.map.floor import is_floor
from placegraph.view.draw.canvas import Bounds, Face, Frame, Picture, Text
from placegraph.view.draw.lettering import OccupiedPlaces, covering_discs
from placegraph.view.draw.painter import SUPERSAMPLE
from placegraph.view.draw.style import PALETTE
from placegraph.view.scene.top_view_kernels import _draw

if TYPE_CHECKING:
    from placegraph.indoor.scene_map import SceneMap


@dataclass(frozen=True, eq=False)
class TopView:
    """Uppermost surface in each pixel of a frame."""

    triangle: NDArray[np.int32]
    """(rows, columns), row of the triangle, -1 where there is none."""
    height: NDArray[np.float32]
    """(rows, columns) [m], of the surface there; -inf where there is none."""


def render_top_view(
    vertices: NDArray[np.float32],
    triangles: NDArray[np.int32],
    lift: NDArray[np.float32],
    frame: Frame,
) -> TopView:
    """Draw triangles from above, the highest on top, one sample at each pixel's centre.

    Vertical triangles, which have no footprint, are drawn as lines: the walls of a scan are nothing
    else.

    `vertices`: (V, 3) float32, x, y, z [m].
    `triangles`: (T, 3) int32, rows of vertices.
    `lift`: (T,) float32 [m], added to a triangle's height when it is decided what is on top (paper
        before furniture before walls); -inf leaves it out.
    `frame`: what is looked at, and how many pixels show it.
    """
    corners = np.empty(vertices.shape, np.float32)
    corners[:, :2] = frame.to_px(vertices[:, :2].astype(np.float64))
    corners[:, 2] = vertices[:, 2]
    shape = (frame.height, frame.width)
    triangle, level = np.full(shape, -1, np.int32), np.full(shape, -np.inf, np.float32)
    _draw(corners, triangles, lift, triangle, level)
    seen = triangle >= 0
    height = np.full(shape, -np.inf, np.float32)
    height[seen] = level[seen] - lift[triangle[seen]]
    return TopView(triangle, height)


def cut_section(
    vertices: NDArray[np.float32], triangles: NDArray[np.int32], height: float
) -> Floats:
    """Cut triangles by a horizontal plane, as on an architect's plan.

    Returns segments (S, 2, 2), x, y [m]; what is solid lies to the left of a segment where the
    triangles face outwards.
    """
    corners = vertices[triangles].astype(np.float64)
    above = corners[..., 2] > height
    count = above.sum(axis=1)
    corners, above, count = (part[(count == 1) | (count == 2)] for part in (corners, above, count))
    # the corner that stands alone on its side of the plane comes first
    first = np.where(count == 1, above.argmax(axis=1), above.argmin(axis=1))
    order = (first[:, None] + np.arange(3)) % 3
    corners = np.take_along_axis(corners, order[..., None], axis=1)
    apex, others = corners[:, :1], corners[:, 1:]
    share = (height - apex[..., 2:]) / (others[..., 2:] - apex[..., 2:])
    segments: Floats = (apex + share * (others - apex))[..., :2]
    # seen from outside corners turn counter-clockwise: below a lone top they run left to right
    segments[count == 2] = segments[count == 2, ::-1]
    return segments


def fill_section(segments: Floats, frame: Frame) -> NDArray[np.bool_]:
    """Return the pixels (rows, columns) inside segments (S, 2, 2), x, y [m], of `cut_section`.

    Enclosed by the winding number along both axes where these end at zero, so that a gap in an
    outline smears nothing; a wall that stands in another leaves no hole, and a room whose walls
    face inwards is not filled.
    """
    px = frame.to_px(segments)
    along = _winding_numbers(px, frame.height, frame.width)
    across = _winding_numbers(px[..., ::-1], frame.width, frame.height).T
    return (along > 0) & (across < 0)


def _winding_numbers(px: Floats, lines: int, length: int) -> NDArray[np.int32]:
    """Return winding numbers (lines, length) of pixel centres, along lines of constant px[1].

    0 all along a line that some outline crosses in one direction only.
    """
    start, end = px[:, 0], px[:, 1]
    low, high = np.minimum(start[:, 1], end[:, 1]), np.maximum(start[:, 1], end[:, 1])
    first = np.clip(np.ceil(low - 0.5), 0, lines).astype(np.int64)
    last = np.clip(np.ceil(high - 0.5), 0, lines).astype(np.int64)
    which = np.repeat(np.arange(len(px)), last - first)
    line = np.arange(len(which)) - np.repeat(np.cumsum(last - first) - last + first, last - first)
    line += first[which]
    share = (line + 0.5 - start[which, 1]) / (end[which, 1] - start[which, 1])
    at = start[which, 0] + share * (end[which, 0] - start[which, 0])
    step = np.clip(np.ceil(at - 0.5), 0, length).astype(np.int64)
    turns = np.zeros((lines, length + 1), np.int32)
    np.add.at(turns, (line, step), np.where(end[which, 1] > start[which, 1], 1, -1))
    winding: NDArray[np.int32] = np.cumsum(turns, axis=1, dtype=np.int32)
    winding[winding[:, -1] != 0] = 0
    return winding[:, :-1]


@dataclass(frozen=True, slots=True)
class RoomPaint:
    """Paint of one class of objects in rooms."""

    role: str
    """``thing``, ``floor`` (lies below all), ``structure`` (cut as on an architect's plan), or
    ``ceiling`` (left out)."""
    light: str
    dark: str
    """Colours on a light and on a dark page."""


ROOM_PAINTS: dict[str, RoomPaint] = {
    "floor": RoomPaint("floor", "#fdfbf6", "#20252c"),
    "ceiling": RoomPaint("ceiling", "", ""),
    "wall": RoomPaint("structure", "#4d4943", "#aeb4bd"),
    "window": RoomPaint("structure", "#8fc1d6", "#4d8aa5"),
    "door": RoomPaint("structure", "#c08a52", "#a87b4c"),
    "curtain": RoomPaint("structure", "#c9b8a6", "#776c61"),
    "carpet": RoomPaint("thing", "#f1e3d8", "#2b2a2d"),
    "seat": RoomPaint("thing", "#b7c9e2", "#3a4d68"),
    "table": RoomPaint("thing", "#e8d2ab", "#5c4e37"),
    "bed": RoomPaint("thing", "#d9c6e0", "#51445b"),
    "storage": RoomPaint("thing", "#d8bc98", "#5d4a37"),
    "appliance": RoomPaint("thing", "#c5cfd6", "#46525c"),
    "bath": RoomPaint("thing", "#bfe1df", "#30514f"),
    "plant": RoomPaint("thing", "#b5d49f", "#35522f"),
    "sport": RoomPaint("thing", "#d3c3bb", "#4c4440"),
    "thing": RoomPaint("thing", "#ddd7cc", "#444a52"),
}
"""Paints by name; structure is laid in this order, the later on top."""

WORDS = {
    "floor": "floor ground parquet tile",
    "ceiling": "ceiling roof beam",
    "wall": "wall pillar column partition",
    "window": "window windowpane glass skylight",
    "door": "door doorframe doorway gate",
    "curtain": "curtain blind shutter drape",
    "carpet": "carpet rug mat doormat runner",
    "seat": "chair armchair sofa couch stool ottoman bench pouf seat beanbag sofachair cushion",
    "table": "table desk coffeetable nightstand nighttable counter countertop island stand",
    "bed": "bed mattress crib cot pillow blanket duvet",
    "storage": "cabinet cupboard wardrobe shelf bookshelf bookcase shelves rack dresser commode "
    "drawer drawers chest closet sideboard locker credenza box basket crate",
    "appliance": "refrigerator fridge freezer oven stove cooker microwave dishwasher machine washer "
    "dryer tv television monitor screen computer laptop printer airconditioner conditioner radiator "
    "heater heating hood rangehood extractor speaker piano boiler projector fireplace cookingbench",
    "bath": "sink basin washbasin washstand bath bathtub tub toilet shower bidet urinal",
    "plant": "plant flower flowers tree bush pot flowerpot",
    "sport": "dumbbell equipment treadmill bicycle bike trainer",
}
"""By paint: words of labels."""

_PAINT_OF_WORD = {word: paint for paint, words in WORDS.items() for word in words.split()}


def plain_words(label: str) -> str:
    """Return the words of a label: ``CoffeeTable_01`` is a coffee table."""
    apart = re.sub(r"(?<=[a-z])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", " ", label)
    return " ".join(word for word in re.split(r"[\W_\d]+", apart.lower()) if word)


MEANINGLESS = {"unknown", "unlabelled", "unlabeled", "unnamed", "object", "thing", "none"}
"""Labels that do not say what a thing is."""


def name_of(label: str) -> str:
    """Return the name that a label gives a thing; empty: none."""
    words = plain_words(label)
    return "" if words in MEANINGLESS else words


@cache
def room_paint(label: str) -> str:
    """Paint of a thing with this label: its last word says what it is; a floor lamp is no floor."""
    words = plain_words(re.split(r"[/(,]", label)[0]).split()
    for word in ("".join(words), *words[-1:]):
        for form in (word, word.removesuffix("s"), word.removesuffix("es")):
            if paint := _PAINT_OF_WORD.get(form):
                return paint
    return "thing"


CUT = 1.4
"""Walls are cut this high above the floor [m]: through windows and doors, above most furniture."""
HANGING = 1.2
"""Height above the floor [m] from which objects are left out: lamps, pictures, shelves."""
LOW_CEILING = 1.9
"""Height above the floor [m] from which objects are left out in scans without labels."""
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
    def triangle_rows(self) -> NDArray[np.int64]:
        """Rows of this scene's triangles (T,)."""
        mesh = self.scene.mesh
        return np.flatnonzero(self.scene.scene_of[mesh.object_of] == self.which)

    @cached_property
    def triangles(self) -> NDArray[np.int32]:
        """(T, 3), rows of the mesh's vertices."""
        return self.scene.mesh.triangles[self.triangle_rows]

    @cached_property
    def object_of(self) -> NDArray[np.int32]:
        """(T,), row of each triangle's object."""
        return self.scene.mesh.object_of[self.triangle_rows]

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

    @cached_property
    def is_bare(self) -> NDArray[np.bool_]:
        """Whether each object of the map (N,) is shown in the map's own colours: labels say nothing.

        So are scans that are one object, things whose labels are `MEANINGLESS`, and the floor where
        no thing has a name.
        """
        scan = np.array([paint == SCAN for paint in self.paints])
        if not self.scene.has_colours:
            return scan
        things = [row for row in self.rows if self.role(row) == "thing"]
        nameless = [row for row in things if not name_of(self.scene.graph.labels[row])]
        scan[nameless] = True
        if nameless and len(nameless) == len(things):
            scan[[row for row in self.rows if self.role(row) == "floor"]] = True
        return scan

    def role(self, row: int) -> str:
        """Return the role of an object in the room style, or ``scan``."""
        paint = self.paints[row]
        return SCAN if paint == SCAN else ROOM_PAINTS[paint].role

    def hangs(self, row: int) -> bool:
        """Return whether an object begins overhead."""
        return bool(self.boxes[row, 0, 2] > self.floor + HANGING)

    def middle(self, row: int) -> Floats:
        """Return the middle (2,) of an object's footprint [m]."""
        middle: Floats = self.boxes[row, :, :2].mean(axis=0)
        return middle

    def colours(self, triangles: NDArray[np.int64], at: Floats) -> NDArray[np.float32]:
        """Return colours (M, 3), 0 to 255, of triangles (rows) at points (M, 2) [m] seen from above."""
        mesh, rows = self.scene.mesh, self.triangle_rows[triangles]
        first, *ends = np.moveaxis(mesh.vertices[mesh.triangles[rows], :2].astype(np.float64), 1, 0)
        (ax, ay), (bx, by), (px, py) = ((p - first).T for p in (*ends, at))
        area = ax * by - ay * bx
        upright = np.abs(area) < 1e-9  # has no inside from above: the middle stands for all of it
        area = np.where(upright, 1.0, area)
        u = np.where(upright, 1.0 / 3.0, np.clip((px * by - py * bx) / area, 0.0, 1.0))
        v = np.where(upright, 1.0 / 3.0, np.clip((ax * py - ay * px) / area, 0.0, 1.0 - u))
        colours = mesh.colour_at(rows.astype(np.int32), u.astype(np.float32), v.astype(np.float32))
        return colours.astype(np.float32)

    def point_in_view(self, row: int, pose: Floats, opening: float) -> tuple[Floats, str]:
        """Return the point (2,) [m] of an object amid what a camera sees of it, and its colour there.

        `pose`: (4,) of the camera; `opening`: its field of view [rad]. Of an object beyond the view,
        amid all of it.
        """
        own = np.flatnonzero(self.object_of == row)
        if not own.size:
            return self.middle(row), "soft-ink"
        middles = self.scene.mesh.vertices[self.triangles[own], :2].mean(axis=1, dtype=np.float64)
        way = middles - pose[:2]
        aside = np.arctan2(way[:, 1], way[:, 0]) - pose[3]
        ahead = np.abs((aside + np.pi) % (2.0 * np.pi) - np.pi) < opening / 2
        if ahead.any():
            own, middles = own[ahead], middles[ahead]
        nearest = int(np.linalg.norm(middles - np.median(middles, axis=0), axis=1).argmin())
        shown = self.colours(own, middles).mean(axis=0).round().astype(int).tolist()
        return middles[nearest], "#{:02x}{:02x}{:02x}".format(*shown)

    @cached_property
    def cuts(self) -> dict[str, Floats]:
        """Return the segments (S, 2, 2) [m] of cut objects, by paint, in painting order."""
        cuts = {}
        paints = np.array(self.paints, dtype=np.str_)
        structure = (name for name, look in ROOM_PAINTS.items() if look.role == "structure")
        for paint in (*structure, SCAN):
            chosen = (paints == paint)[self.object_of]
            if chosen.any():
                cuts[paint] = cut_section(
                    self.scene.mesh.vertices, self.triangles[chosen], self.floor + CUT
                )
        return cuts

    def lifts(self) -> NDArray[np.float32]:
        """Return offsets (T,) [m] to the triangles' heights before the uppermost is drawn.

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

    def view_range(self, at: Floats, angles: Floats, reach: float) -> Floats:
        """Return the range of view (A,) [m] from `at` (2,) at angles (A,) [rad]: to a wall, or to `reach`.

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
        occupied: OccupiedPlaces,
        marked: Mapping[int, str] | None = None,
        *,
        small: bool = False,
    ) -> list[Text]:
        """Return names of the larger objects, in the middle of their footprints where they fit.

        What is `marked`, by row, is named first and in that ink, whatever its size. `small`: what
        is small is named, too, beside its footprint.
        """
        marked, texts = marked or {}, self._rooms(frame, face, occupied) if small else []
        extents = np.ptp(self.boxes, axis=1)[:, :2]
        areas = np.prod(extents, axis=1)
        for row in sorted(self.rows, key=lambda row: (row not in marked, -areas[row])):
            if self.role(row) != "thing" or (self.hangs(row) and row not in marked):
                continue
            words = face.drawable(name_of(self.scene.graph.labels[row]))
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
                tries += [(SMALL, s) for s in _name_offsets(extents[row] * frame.scale, narrow)]
            for height, shift in tries:
                text = Text(self.middle(row), words, height, ink, shift=shift)
                wide = width * height / size + 4.0
                if _fits_width(text, wide, frame) and occupied.claim(
                    covering_discs(text, wide, frame.scale)
                ):
                    texts.append(text)
                    break
        return texts

    def _rooms(self, frame: Frame, face: Face, occupied: OccupiedPlaces) -> list[Text]:
        """Return names of the rooms, each in the middle of its floor."""
        texts = []
        for row in self.rows:
            room = self.scene.attributes[row].get("room", "")
            words = face.drawable(room)
            if self.role(row) != "floor" or not is_floor(self.scene.graph.labels[row]):
                continue
            if not words or room.isdecimal():
                continue
            text, wide = Text(self.middle(row), words, 13.0, "ink"), face.width(words, 13.0) + 4.0
            if _fits_width(text, wide, frame) and occupied.claim(
                covering_discs(text, wide, frame.scale)
            ):
                texts.append(text)
        return texts


def _name_offsets(extent: Floats, width: float) -> list[tuple[float, float]]:
    """Return offsets of a name [px]: below, above, right, left of a footprint of this size, or on it."""
    aside, below = (extent[0] + width) / 2 + 4.0, extent[1] / 2 + 0.7 * SMALL
    return [(0.0, below), (0.0, -below), (aside, 0.0), (-aside, 0.0), (0.0, 0.0)]


def _fits_width(text: Text, width: float, frame: Frame) -> bool:
    """Return whether a text of this width [px] ends within the picture."""
    x, y = frame.to_px(np.asarray(text.at, np.float64)) + text.shift
    half = 0.6 * text.size
    return bool(width / 2 <= x <= frame.width - width / 2 and half <= y <= frame.height - half)


WALL = 0.07
"""Surfaces that are cut and enclose nothing, as in a scan, are drawn this thick [m]."""
VIVID = 0.7
"""Share of a map's own colours; the rest is paper, so that marks stand out."""
BAND = 256
"""Rows that are coloured at a time: as floats, all of them would take most of the memory."""


def paint_room(plan: RoomPlan, frame: Frame, *, dark: bool = False) -> Picture:
    """Paint a plan as a picture that fills a frame, for `painter` to lay under the marks."""
    frame = Frame(
        frame.center,
        frame.scale * SUPERSAMPLE,
        frame.width * SUPERSAMPLE,
        frame.height * SUPERSAMPLE,
    )
    view = render_top_view(plan.scene.mesh.vertices, plan.triangles, plan.lifts(), frame)
    seen = view.triangle >= 0
    owner = np.where(seen, plan.object_of[view.triangle], -1) if seen.any() else view.triangle
    height = np.where(seen, np.clip(view.height - np.float32(plan.floor), 0.0, CUT), 0.0)
    masks = {paint: _section_mask(segments, frame, paint) for paint, segments in plan.cuts.items()}
    for paint, mask in masks.items():
        if paint != "curtain":
            height[mask] = CUT
    light = _shade(height.astype(np.float32), owner, frame.scale)
    fills = _object_colours(plan, dark=dark)
    scanned = np.append(plan.is_bare, False)
    picture = np.empty((*owner.shape, 3), np.uint8)
    for top in range(0, len(owner), BAND):
        rows = slice(top, top + BAND)
        pixels, bare = fills[owner[rows]], scanned[owner[rows]]
        if bare.any():
            at = frame.to_map(np.argwhere(bare)[:, ::-1] + (0.5, top + 0.5))
            own = plan.colours(view.triangle[rows][bare].astype(np.int64), at)
            pixels[bare] = VIVID * own + (1.0 - VIVID) * pixels[bare]
        pixels *= light[rows, :, None]
        picture[rows] = np.clip(pixels, 0.0, 255.0, out=pixels)
    for paint, mask in masks.items():
        picture[mask] = _color(paint, dark=dark)
    return Picture(picture, frame.bounds)


def _color(paint: str, *, dark: bool) -> tuple[int, ...]:
    look = ROOM_PAINTS["wall" if paint == SCAN else paint]
    return ImageColor.getrgb(look.dark if dark else look.light)


def _object_colours(plan: RoomPlan, *, dark: bool) -> NDArray[np.float32]:
    """Return the colour (N + 1, 3) of each object seen from above; the last row is the paper's."""
    fills = np.zeros((len(plan.scene) + 1, 3), np.float32)
    for row in plan.rows:
        flat = plan.role(row) in ("thing", "floor")
        fills[row] = _color(plan.paints[row] if flat else "thing", dark=dark)
    fills[-1] = ImageColor.getrgb(PALETTE["land"][dark])
    return fills


def _section_mask(segments: Floats, frame: Frame, paint: str) -> NDArray[np.bool_]:
    """Return the pixels (rows, columns) of a section: its inside, or, for open surfaces, a line."""
    inside = np.zeros((frame.height, frame.width), np.bool_)
    if paint != SCAN:
        inside = fill_section(segments, frame)
    px = frame.to_px(segments)
    length = np.hypot(*(px[:, 1] - px[:, 0]).T).sum()
    is_closed = inside.sum() > length
    width = SUPERSAMPLE if is_closed else max(SUPERSAMPLE, round(WALL * frame.scale))
    image = Image.fromarray(inside.astype(np.uint8) * 255)
    draw = ImageDraw.Draw(image)
    for line in px.reshape(-1, 4).tolist():
        draw.line(line, 255, width)
    return np.asarray(image) > 127


def _shade(
    height: NDArray[np.float32], owner: NDArray[np.int32], scale: float
) -> NDArray[np.float32]:
    """Return brightness (rows, columns): lit slopes, shadows around objects, outlines."""
    down, right = np.gradient(height * np.float32(scale))
    down += right
    down *= 0.06
    light: NDArray[np.float32] = 1.0 + np.clip(down, -0.10, 0.06, out=down)
    foot = Image.fromarray((height * (255.0 / CUT)).astype(np.uint8))
    around = np.asarray(foot.filter(ImageFilter.GaussianBlur(0.16 * scale))) * np.float32(CUT / 255)
    around -= height
    around *= 0.30
    light -= np.clip(around, 0.0, 0.22, out=around)
    outline = np.zeros(height.shape, np.bool_)
    outline[1:] |= owner[1:] != owner[:-1]
    outline[:, 1:] |= owner[:, 1:] != owner[:, :-1]
    light[outline] *= 0.72
    return light
