"""Display lists of a city: its objects, its coast, and an estimate on it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from placegraph.core.estimate import CityEstimate, ObjectRef, Place
from placegraph.core.geojson import contains_points
from placegraph.core.geometry import Floats
from placegraph.outdoor.map.geometry_kernels import nearest_on_parts
from placegraph.outdoor.map.objects import CityObjects
from placegraph.view.draw.canvas import (
    Area,
    Bounds,
    Disc,
    Dot,
    HeatLayer,
    Line,
    MapItem,
    Mark,
    Points,
    Stroke,
    clip_line,
    clip_ring,
)
from placegraph.view.draw.style import AREA, LINE, PAINTS, POINT, find_paint

if TYPE_CHECKING:
    from placegraph.outdoor.city import CityMap

COASTLINE = "natural=coastline"


def find_sea(objects: CityObjects, bounds: Bounds) -> list[Floats]:
    """Return rings whose even-odd inside is the sea in a rectangle.

    Empty where there is no sea, or where the coast is too fragmentary to tell.
    """
    chains = _join_coastlines(objects)
    if not chains:
        return []
    low, high = np.percentile(objects.center, (0.5, 99.5), axis=0)
    known = (
        max(bounds[0], float(low[0])),
        max(bounds[1], float(low[1])),
        min(bounds[2], float(high[0])),
        min(bounds[3], float(high[1])),
    )
    for window in (bounds, known):  # beyond what an extract holds, chains may tangle
        if window[0] < window[2] and window[1] < window[3]:
            rings = _trace_sea(chains, window)
            if _matches_coast(rings, chains, window) and not _covers_land(rings, objects):
                return rings
    return []


def _trace_sea(chains: list[Floats], bounds: Bounds) -> list[Floats]:
    islands = [chain for chain in chains if (chain[0] == chain[-1]).all()]
    shores = [_prolong(chain, bounds) for chain in chains if (chain[0] != chain[-1]).any()]
    pieces = [piece for shore in shores for piece in clip_line(shore, bounds)]
    rings = _close_along_border(pieces, bounds)
    if not pieces:
        corner = np.array([bounds[:2]])
        if _is_seaward(chains, bounds[:2]) != contains_points(corner, islands)[0]:
            rings = [_box_corners(bounds)]
    return rings + [ring for island in islands if len(ring := clip_ring(island, bounds)) > 3]


def _matches_coast(rings: list[Floats], chains: list[Floats], bounds: Bounds) -> bool:
    """Return whether rings contain the right-hand side of the coast in a rectangle, not the left."""
    start = np.concatenate([chain[:-1] for chain in chains])
    delta = np.concatenate([np.diff(chain, axis=0) for chain in chains])
    length = np.hypot(*delta.T)
    middle = start + delta / 2
    low, high = np.array(bounds[:2]) + 5.0, np.array(bounds[2:]) - 5.0
    seen = np.flatnonzero(((middle > low) & (middle < high)).all(axis=1) & (length > 4.0))
    seen = seen[:: 1 + len(seen) // 300]
    if not len(seen):
        return True
    right = np.stack([delta[seen, 1], -delta[seen, 0]], axis=1) / length[seen, None]
    wrong = ~contains_points(middle[seen] + right, rings)
    wrong |= contains_points(middle[seen] - right, rings)
    return bool(wrong.mean() < 0.05)


def _covers_land(rings: list[Floats], objects: CityObjects) -> bool:
    """Return whether buildings stand inside the rings: a coast that ends on the map was closed wrongly."""
    built = np.array([label.startswith("building=") for label in objects.labels])
    rows = np.flatnonzero(built[objects.label_values[objects.label_starts[:-1]]])
    at = objects.center[rows[:: 1 + len(rows) // 2000]].astype(np.float64)
    return bool(len(at) and contains_points(at, rings).mean() > 0.02)


def _join_coastlines(objects: CityObjects) -> list[Floats]:
    """Join coastlines (n, 2) where one ends and the next begins."""
    if COASTLINE not in objects.labels:
        return []
    label = objects.labels.index(COASTLINE)
    entries = np.flatnonzero(objects.label_values == label)
    rows = np.searchsorted(objects.label_starts, entries, side="right") - 1
    lines = [
        part.astype(np.float64)
        for row in rows
        if objects.kind[row] != POINT
        for part in objects.parts(int(row))
    ]
    begins = {tuple(line[0]): k for k, line in enumerate(lines)}
    ends = {tuple(line[-1]) for line in lines}
    # first those that nothing leads to, then what is left: closed chains
    order = sorted(range(len(lines)), key=lambda k: tuple(lines[k][0]) in ends)
    chains, used = [], set[int]()
    for first in order:
        if first in used:
            continue
        chain, k = [lines[first]], first
        used.add(k)
        while (following := begins.get(tuple(lines[k][-1]))) is not None and following not in used:
            k = following
            used.add(k)
            chain.append(lines[k][1:])
        chains.append(np.concatenate(chain))
    return chains


def _prolong(chain: Floats, bounds: Bounds) -> Floats:
    """Return a chain whose ends inside the rectangle are led out of it over its nearest side."""
    low, high = np.array(bounds[:2]), np.array(bounds[2:])

    def lead_out(end: Floats) -> list[Floats]:
        gaps = np.concatenate([end - low, high - end])
        side, out = int(gaps.argmin()), end.copy()
        out[side % 2] += (-1.0 if side < 2 else 1.0) * (gaps[side] + 1.0)
        return [out[None]] if gaps[side] >= 0.0 else []

    return np.concatenate([*lead_out(chain[0]), chain, *lead_out(chain[-1])])


def _box_corners(bounds: Bounds) -> Floats:
    """Return the corners (5, 2) of a rectangle, clockwise from its south-west."""
    west, south, east, north = bounds
    return np.array(
        [(west, south), (west, north), (east, north), (east, south), (west, south)], np.float64
    )


def _close_along_border(pieces: list[Floats], bounds: Bounds) -> list[Floats]:
    """Close pieces that run from border to border, going clockwise along the border."""
    corners = _box_corners(bounds)
    side = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))))

    def along(point: Floats) -> float:
        """Return the distance from the south-west corner, clockwise along the border [m]."""
        gaps = [abs(point[k % 2] - corners[k][k % 2]) for k in range(4)]
        k = int(np.argmin(gaps))
        return float(side[k] + np.hypot(*(point - corners[k])))

    starts = [along(piece[0]) for piece in pieces]
    rings, left = [], set(range(len(pieces)))
    while left:
        first = k = min(left)
        ring: list[Floats] = []
        while k in left:
            left.discard(k)
            ring.append(pieces[k])
            here = along(pieces[k][-1])
            ahead = [(start - here) % side[-1] for start in starts]
            k = min(
                (j for j in range(len(pieces)) if j in left or j == first), key=ahead.__getitem__
            )
            turns = [
                (corner, (at - here) % side[-1])
                for corner, at in zip(corners, side[:-1], strict=False)
            ]
            passed = sorted((way, tuple(corner)) for corner, way in turns if way < ahead[k])
            ring.extend(np.array([corner]) for _, corner in passed)
        ring.append(ring[0][:1])
        rings.append(np.concatenate(ring))
    return rings


def _is_seaward(chains: list[Floats], point: tuple[float, float]) -> bool:
    """Return whether a point lies on the right-hand side of the nearest coast."""
    nearest, seaward = np.inf, False
    for chain in chains:
        start, delta = chain[:-1], np.diff(chain, axis=0)
        to = np.array(point) - start
        t = np.clip((to * delta).sum(axis=1) / np.maximum((delta**2).sum(axis=1), 1e-9), 0.0, 1.0)
        away = np.hypot(*(to - t[:, None] * delta).T)
        k = int(np.argmin(away))
        if away[k] < nearest:
            nearest = float(away[k])
            seaward = bool(delta[k][0] * to[k][1] - delta[k][1] * to[k][0] < 0.0)
    return seaward


def list_labels(objects: CityObjects, row: int) -> list[str]:
    """Return the labels of an object, most specific first."""
    start, end = objects.label_starts[row : row + 2]
    return [objects.labels[k] for k in objects.label_values[start:end]]


def label_words(label: str) -> str:
    """Return the words of a label: ``amenity=post_box`` is a post box, ``building=yes`` a building."""
    key, _, value = label.partition("=")
    return (key if value in ("yes", "*", "") else value).replace("_", " ")


def bounding_boxes(objects: CityObjects) -> Floats:
    """Return the bounding boxes (N, 4) of the objects: west, south, east, north [m]."""
    starts = objects.point_starts[objects.part_starts[:-1]]
    if not len(starts):
        return np.zeros((0, 4))
    low = np.minimum.reduceat(objects.points, starts)
    high = np.maximum.reduceat(objects.points, starts)
    return np.concatenate([low, high], axis=1).astype(np.float64)


def city_bounds(objects: CityObjects) -> Bounds:
    """Return the rectangle around all but the outermost hundredth of a city: west, south, east, north."""
    west, south = np.percentile(objects.center, 0.5, axis=0).tolist()
    east, north = np.percentile(objects.center, 99.5, axis=0).tolist()
    margin = 30.0 + 0.02 * max(east - west, north - south)
    return west - margin, south - margin, east + margin, north + margin


def find_rows(objects: CityObjects, bounds: Bounds) -> list[int]:
    """Return rows of the objects whose bounding boxes touch a rectangle, large ones first."""
    boxes = bounding_boxes(objects)
    west, south, east, north = bounds
    hit = (
        (boxes[:, 0] <= east)
        & (boxes[:, 2] >= west)
        & (boxes[:, 1] <= north)
        & (boxes[:, 3] >= south)
    )
    spread = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
    rows = np.flatnonzero(hit)
    return [int(row) for row in rows[np.lexsort((rows, -spread[rows]))]]


def draw_items(city: CityMap, bounds: Bounds, scale: float) -> list[MapItem]:
    """Return objects cut to a rectangle, for a map drawn at `scale` [px/m], large ones first."""
    objects = city.objects
    found = (draw_item(objects, row, bounds) for row in find_rows(objects, bounds))
    items = [item for item in found if item and PAINTS[item.paint].since <= scale]
    water = find_sea(objects, bounds)
    return [Area(water, "sea"), *items] if water else items


def draw_item(
    objects: CityObjects, row: int, bounds: Bounds, paint: str | None = None
) -> MapItem | None:
    """Return one object cut to a rectangle; None where nothing of it is drawn there."""
    kind = int(objects.kind[row])
    paint = find_paint(list_labels(objects, row), kind) if paint is None else paint
    if not paint:
        return None
    if kind == AREA:
        parts = [round_corners(ring) for ring in objects.parts(row) if len(ring) > 2]
        rings = [clip_ring(ring, bounds) for ring in parts]
        rings = [ring for ring in rings if len(ring) > 3]
        return Area(rings, paint, row) if rings else None
    if kind == LINE:
        parts = [p for part in objects.parts(row) for p in clip_line(part, bounds)]
        return Line(parts, paint, row) if parts else None
    west, south, east, north = bounds
    x, y = objects.center[row].tolist()
    if not (west <= x <= east and south <= y <= north):
        return None
    return Dot(objects.center[row], paint, row)


ROUND = 12.0
"""Longest side of a ring that is taken for a simplified circle [m]."""


def round_corners(ring: Points) -> Points:
    """Return a ring of few, short sides and wide angles as the curve (Catmull-Rom) through its corners.

    Maps simplify a round pool to a hexagon; other rings come back unchanged.
    """
    corners = np.asarray(ring[:-1], np.float64)
    sides = np.roll(corners, -1, axis=0) - corners
    if not 5 <= len(corners) <= 10 or np.hypot(*sides.T).max() > ROUND:
        return ring
    after = np.roll(sides, -1, axis=0)
    turns = np.arctan2(
        sides[:, 0] * after[:, 1] - sides[:, 1] * after[:, 0], (sides * after).sum(axis=1)
    )
    if abs(turns.sum()) < 6.0 or not (np.abs(turns) < np.radians(80.0)).all():
        return ring
    if (turns * turns[0] <= 0.0).any():
        return ring
    t = np.linspace(0.0, 1.0, 6, endpoint=False)[None, :, None]
    p, q, r, s = (np.roll(corners, shift, axis=0)[:, None] for shift in (1, 0, -1, -2))
    curve = q + 0.5 * t * (
        r - p + t * (2.0 * p - 5.0 * q + 4.0 * r - s + t * (3.0 * (q - r) + s - p))
    )
    points = curve.reshape(-1, 2)
    return np.concatenate([points, points[:1]])


BANDWIDTH = 9.0
"""Standard deviation of the kernel that makes heat of the posterior's points [m]."""
FAINT = 0.1
"""Probability of one spot that is still painted as hot as can be; below, heat is fainter."""
SIGMAS = 2.0
"""Ellipses hold 86 % of a mode."""
SHOWN = 120.0
"""Distance from the mode [m] up to which long or wide evidence is marked."""
VERDICT_COLOR = {"for": "for", "against": "against"}


@dataclass(frozen=True)
class EvidenceObject:
    """A map object that spoke for or against a mode."""

    ref: ObjectRef
    row: int
    verdict: str
    weight: float
    """Largest weight of the statements it served [nat]."""
    at: Floats
    """Its point nearest to the mode, east, north (2,) [m]."""
    middle: Floats
    """Its centre (2,) [m]."""

    @property
    def words(self) -> str:
        """Name, or what it is."""
        return self.ref.name or label_words(self.ref.label)


def mode_position(city: CityMap, mode: Place) -> Floats:
    """Return east, north (2,) [m] of a mode."""
    return city.plane.to_plane((mode.longitude, mode.latitude))


def find_row(objects: CityObjects, osm: str) -> int:
    """Return the row of the object with OpenStreetMap's id, or -1."""
    kind, _, number = osm.partition("/")
    if kind not in ("node", "way", "relation") or not number.isdecimal() or len(number) > 18:
        return -1
    osm_type = ("node", "way", "relation").index(kind)
    rows = np.flatnonzero((objects.osm_id == int(number)) & (objects.osm_type == osm_type))
    return int(rows[0]) if len(rows) else -1


def evidence_objects(city: CityMap, mode: Place) -> list[EvidenceObject]:
    """Return the objects that support or contradict a mode, each once, by decreasing weight."""
    objects, at = city.objects, mode_position(city, mode)
    found: dict[str, EvidenceObject] = {}
    for evidence in sorted(mode.evidence, key=lambda e: -abs(e.weight)):
        if evidence.verdict not in VERDICT_COLOR:
            continue
        for ref in evidence.objects:
            if ref.id in found:
                continue
            middle = city.plane.to_plane((ref.longitude, ref.latitude))
            row = find_row(objects, ref.id)
            nearest = middle
            if row >= 0:
                east, north, _ = nearest_on_parts(
                    objects.part_starts,
                    objects.point_starts,
                    objects.points,
                    objects.kind[row],
                    row,
                    float(at[0]),
                    float(at[1]),
                )
                nearest = at + np.array([east, north])
            weight = abs(evidence.weight)
            found[ref.id] = EvidenceObject(ref, row, evidence.verdict, weight, nearest, middle)
    return list(found.values())


def posterior_layer(
    city: CityMap, estimate: CityEstimate, bounds: Bounds, pixel: float
) -> HeatLayer | None:
    """Return the posterior in a rectangle on a grid of `pixel` [m]; None where it is empty."""
    support = estimate.support
    if not len(support):
        return None
    at, weight = city.plane.to_plane(support[:, :2]), support[:, 2]
    west, south, east, north = bounds
    reach = 3.5 * BANDWIDTH
    near = (
        (at[:, 0] > west - reach)
        & (at[:, 0] < east + reach)
        & (at[:, 1] > south - reach)
        & (at[:, 1] < north + reach)
    )
    if not near.any():
        return None
    columns = max(2, round((east - west) / pixel))
    rows = max(2, round((north - south) / pixel))
    x = west + (np.arange(columns) + 0.5) * (east - west) / columns
    y = north - (np.arange(rows) + 0.5) * (north - south) / rows
    across = np.exp(-0.5 * ((x[None] - at[near, :1]) / BANDWIDTH) ** 2)
    along = np.exp(-0.5 * ((y[None] - at[near, 1:]) / BANDWIDTH) ** 2)
    density = (along * weight[near, None]).T @ across
    heaviest = np.argsort(-weight, kind="stable")[:256]
    apart = ((at[heaviest, None] - at[None]) ** 2).sum(axis=2)
    peak = float((np.exp(-0.5 * apart / BANDWIDTH**2) @ weight).max())
    return HeatLayer(density / max(peak, FAINT), bounds)


def competing_modes(estimate: CityEstimate, most: int) -> tuple[Place, ...]:
    """Return the modes at least a tenth as probable as the best one."""
    if not estimate.modes:
        return ()
    least = 0.1 * estimate.modes[0].probability
    others = (mode for mode in estimate.modes[1:] if mode.probability >= least)
    return (estimate.modes[0], *others)[:most]


def ellipse(city: CityMap, mode: Place) -> Floats:
    """Return a closed ring (49, 2) [m] around a mode: `SIGMAS` standard deviations."""
    turn = np.linspace(0.0, 2.0 * np.pi, 49)
    variances, axes = np.linalg.eigh(np.asarray(mode.covariance, np.float64))
    radii = SIGMAS * np.sqrt(np.maximum(variances, 1.0))
    circle = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    ring: Floats = mode_position(city, mode) + (circle * radii) @ axes.T
    return ring


def mode_bounds(city: CityMap, mode: Place, *, least: float = 90.0, most: float = 160.0) -> Bounds:
    """Return the rectangle around a mode and its evidence: west, south, east, north [m]."""
    at = mode_position(city, mode)
    shown = [ellipse(city, mode), *(w.at[None] for w in evidence_objects(city, mode))]
    offsets = np.abs(np.concatenate(shown) - at)
    offsets = offsets[(offsets < most).all(axis=1)]
    half = np.clip(1.25 * offsets.max(axis=0, initial=0.0), least, most)
    return (*(at - half).tolist(), *(at + half).tolist())


def evidence_marks(city: CityMap, mode: Place, way: Floats | None = None) -> list[Mark]:
    """Return lines from a mode, or a way (N, 2) [m], to the objects of its evidence, and marks on these."""
    at = mode_position(city, mode)
    way = at[None] if way is None or not len(way) else way
    marks: list[Mark] = [Stroke(way, "mode", 4.0)] if len(way) > 1 else []
    for obj in reversed(evidence_objects(city, mode)):  # the weightiest on top
        color = VERDICT_COLOR[obj.verdict]
        dash = (5.0, 4.0) if obj.verdict == "against" else None
        marks += _draw_outline(city.objects, obj, at, color)
        origin = way[np.argmin(np.hypot(*(way - obj.at).T))]
        if np.hypot(*(obj.at - origin)) > 1.0:
            marks.append(Stroke(np.stack([origin, obj.at]), color, 1.8, dash))
        marks.append(Disc(obj.at, 4.0, color))
    return marks


def _draw_outline(objects: CityObjects, obj: EvidenceObject, at: Floats, color: str) -> list[Mark]:
    """Return the outline, near the mode, of an object that is a line or an area."""
    if obj.row < 0 or objects.kind[obj.row] not in (LINE, AREA):
        return []
    far = max(SHOWN, float(np.abs(obj.at - at).max()) + 40.0)
    window = (*(at - far).tolist(), *(at + far).tolist())
    parts = objects.parts(obj.row)
    if objects.kind[obj.row] == LINE:
        return [Stroke(piece, color, 3.0) for part in parts for piece in clip_line(part, window)]
    rings = [ring for part in parts if len(ring := clip_ring(round_corners(part), window)) > 3]
    return [Stroke(ring, color, 2.0, fill=0.0 if k else 0.14) for k, ring in enumerate(rings)]
