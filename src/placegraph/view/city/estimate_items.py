"""An estimate as a display list: the posterior as heat, modes, and the evidence joined to them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from placegraph.core.estimate import CityEstimate, ObjectRef, Place
from placegraph.core.geometry import Floats
from placegraph.outdoor.map.objects import CityObjects
from placegraph.outdoor.map.raster_kernels import nearest_on_parts
from placegraph.view.city.items import common_name
from placegraph.view.draw.canvas import Bounds, Disc, Glow, Mark, Stroke
from placegraph.view.draw.clip import clip_line, clip_ring
from placegraph.view.draw.style import AREA, LINE

if TYPE_CHECKING:
    from placegraph.outdoor.city import CityMap

BANDWIDTH = 9.0
"""Standard deviation of the kernel that makes heat of the posterior's points [m]."""
FAINT = 0.1
"""Probability of one spot that is still painted as hot as can be; below, heat is fainter."""
SIGMAS = 2.0
"""Ellipses hold 86 % of a mode."""
SHOWN = 120.0
"""Of long or wide evidence the stretch this close to the mode is marked [m]."""
VERDICT_COLOR = {"for": "for", "against": "against"}


@dataclass(frozen=True)
class Witness:
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
        return self.ref.name or common_name(self.ref.label)


def place_of(city: CityMap, mode: Place) -> Floats:
    """East, north (2,) [m] of a mode."""
    return city.plane.to_plane((mode.longitude, mode.latitude))


def row_of(objects: CityObjects, osm: str) -> int:
    """Row of the object with OpenStreetMap's id, or -1."""
    kind, _, number = osm.partition("/")
    if kind not in ("node", "way", "relation") or not number.isdecimal() or len(number) > 18:
        return -1
    osm_type = ("node", "way", "relation").index(kind)
    rows = np.flatnonzero((objects.osm_id == int(number)) & (objects.osm_type == osm_type))
    return int(rows[0]) if len(rows) else -1


def witnesses(city: CityMap, mode: Place) -> list[Witness]:
    """Objects that spoke for or against a mode, each once, weightiest first."""
    objects, at = city.objects, place_of(city, mode)
    found: dict[str, Witness] = {}
    for evidence in sorted(mode.evidence, key=lambda e: -abs(e.weight)):
        if evidence.verdict not in VERDICT_COLOR:
            continue
        for ref in evidence.objects:
            if ref.id in found:
                continue
            middle = city.plane.to_plane((ref.longitude, ref.latitude))
            row = row_of(objects, ref.id)
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
            found[ref.id] = Witness(ref, row, evidence.verdict, weight, nearest, middle)
    return list(found.values())


def heat_of(city: CityMap, estimate: CityEstimate, bounds: Bounds, pixel: float) -> Glow | None:
    """Posterior in a rectangle on a grid of `pixel` [m]; None where there is nothing of it."""
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
    return Glow(density / max(peak, FAINT), bounds)


def rivals(estimate: CityEstimate, most: int) -> tuple[Place, ...]:
    """Modes that compete with the best one: a tenth as probable, or more."""
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
    ring: Floats = place_of(city, mode) + (circle * radii) @ axes.T
    return ring


def mode_bounds(city: CityMap, mode: Place, *, least: float = 90.0, most: float = 160.0) -> Bounds:
    """Rectangle that shows a mode and its evidence: west, south, east, north [m]."""
    at = place_of(city, mode)
    shown = [ellipse(city, mode), *(w.at[None] for w in witnesses(city, mode))]
    offsets = np.abs(np.concatenate(shown) - at)
    offsets = offsets[(offsets < most).all(axis=1)]
    half = np.clip(1.25 * offsets.max(axis=0, initial=0.0), least, most)
    return (*(at - half).tolist(), *(at + half).tolist())


def evidence_marks(city: CityMap, mode: Place) -> list[Mark]:
    """Lines from a mode to its witnesses, and marks on these."""
    at = place_of(city, mode)
    marks: list[Mark] = []
    for witness in reversed(witnesses(city, mode)):  # the weightiest on top
        color = VERDICT_COLOR[witness.verdict]
        dash = (5.0, 4.0) if witness.verdict == "against" else None
        marks += _outline(city.objects, witness, at, color)
        if np.hypot(*(witness.at - at)) > 1.0:
            marks.append(Stroke(np.stack([at, witness.at]), color, 1.8, dash))
        marks.append(Disc(witness.at, 4.0, color))
    return marks


def _outline(objects: CityObjects, witness: Witness, at: Floats, color: str) -> list[Mark]:
    """Outline of a witness that is a line or an area, near the mode."""
    if witness.row < 0 or objects.kind[witness.row] not in (LINE, AREA):
        return []
    far = max(SHOWN, float(np.abs(witness.at - at).max()) + 40.0)
    window = (*(at - far).tolist(), *(at + far).tolist())
    parts = objects.parts(witness.row)
    if objects.kind[witness.row] == LINE:
        return [Stroke(piece, color, 3.0) for part in parts for piece in clip_line(part, window)]
    rings = [ring for part in parts if len(ring := clip_ring(part, window)) > 3]
    return [Stroke(ring, color, 2.0, fill=0.0 if k else 0.14) for k, ring in enumerate(rings)]
