"""Status of an estimate of a world: `OK`, `AMBIGUOUS` or `LOST`, and why."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from placegraph.core.estimate import PoseEstimate, Status
from placegraph.core.geometry import angle_between
from placegraph.indoor.status import SURE_SCENE, diagnostics_of, restate_claim
from placegraph.outdoor.search.status import describe_doubt
from placegraph.world.evidence import SceneEvidence, WorldEvidence, list_rooms
from placegraph.world.sentence import compare_floors

if TYPE_CHECKING:
    from placegraph.world.estimate import WorldEstimate, WorldMode, WorldQuery
    from placegraph.world.towns import TownMatch
    from placegraph.world.world import World

MIN_FIX_FIT = 0.01
"""A location prior that fits a scene no better than this contradicts it."""
MIN_FLOOR_RATIO = -1.0
"""Log-likelihood ratio of a level below which the floors of the text contradict it."""
MAX_HEADING_ERROR = float(np.radians(60.0))
"""A compass heading so far off contradicts a pose [rad]."""


def decide_by_text(
    world: World, query: WorldQuery, evidence: WorldEvidence, modes: list[WorldMode], elsewhere: float
) -> tuple[Status, str]:  # fmt: skip
    """Decide on modes, best first, by a text and a location prior; return status and reason."""
    if not modes:
        why = evidence.obstacle or "None of these maps contains anything that the text mentions."
        return Status.LOST, why
    best = modes[0]
    where, share = best.where, f"holds {best.probability:.0%} of the probability"
    if elsewhere > max(0.5, best.probability):
        why = f"No place or room fits better than a place off the map ({elsewhere:.0%})."
        return Status.LOST, why
    if query.text is None:
        return Status.AMBIGUOUS, (
            f"A position fix alone does not identify a room; the nearest is {where}."
        )
    if best.place is not None:
        town = next(t for t in evidence.towns.values() if best.place in t.estimate.modes).estimate
        held = best.probability / max(best.place.probability, 1e-9)
        rooms = " No mapped room fits." if evidence.is_indoors and evidence.scenes else ""
        why, is_ok = town.reason, town.status is Status.OK
        if is_ok and f"{best.place.probability:.0%}" != f"{best.probability:.0%}":
            why += f" Among all maps, the best place holds {best.probability:.0%}."
        if held < SURE_SCENE and town.status is not Status.LOST:  # it speaks of the town alone
            why = describe_doubt(best.probability)
        return Status.OK if is_ok and held >= SURE_SCENE else Status.AMBIGUOUS, why + rooms
    of_scene = sum(m.probability for m in modes if m.scene == best.scene)
    if of_scene >= SURE_SCENE and evidence.scenes[best.scene].ratio < 0:
        return Status.AMBIGUOUS, f"{where} {share}, but the description does not fit it."
    if best.probability >= SURE_SCENE and (
        best.room or len(list_rooms(world.library, best.scene)) == 1
    ):
        return Status.OK, f"{where} {share}."
    if of_scene >= SURE_SCENE:
        where, share = (
            evidence.scenes[best.scene].where,
            share.replace(f"{best.probability:.0%}", f"{of_scene:.0%}"),
        )
        return Status.AMBIGUOUS, f"{where} {share}, but the text does not identify the room."
    likely = [m for m in modes[1:4] if m.probability > 0.1 * best.probability]
    rivals = filter(None, dict.fromkeys(m.where if m.scene else m.building for m in likely))
    others = "; ".join(rivals)
    others = f"; it may also be {others}" if others else ""
    return Status.AMBIGUOUS, f"{where} {share}{others}."


def decide_by_frames(
    best: PoseEstimate, modes: Sequence[WorldMode], evidence: WorldEvidence, query: WorldQuery
) -> tuple[Status, str, bool]:
    """Decide on modes, best first: the status in the best scene, unless evidence contradicts it.

    Returns status, reason, and whether no evidence contradicts the best.
    """
    mode, shares = modes[0], [m.probability for m in modes]
    where = restate_claim(best.reason, shares, best.modes[0].covariance, mode.where)
    where = where if where != best.reason else f"In {mode.where}: {best.reason}"
    for name, scene in evidence.scenes.items():
        where = where.replace(f" in {name}.", f" in {scene.where}.")
    against = _find_contradictions(evidence.scenes[mode.scene], mode, query)
    unmet = diagnostics_of(best).unmet
    if not against or (unmet and unmet in best.reason):
        return best.status, where, not against
    also = "But" if best.status is Status.OK else "And"
    return Status.AMBIGUOUS, f"{where} {also} {' and '.join(against)}.", False


def _find_contradictions(w: SceneEvidence, mode: WorldMode, query: WorldQuery) -> list[str]:
    """Find evidence that contradicts a pose; return it in words."""
    out = []
    if w.outside < 0:
        out.append("the description of the outside does not fit")
    if w.inside < 0 and not any(e.verdict == "for" for e in mode.evidence if not e.objects):
        out.append("the description of the room does not fit")
    if mode.level and compare_floors(w.floors, mode.level) < MIN_FLOOR_RATIO:
        out.append(f"floor {mode.level} is not the stated one")
    if query.near is not None and w.anchors and w.near < MIN_FIX_FIT:
        out.append("it is far from the fix")
    if query.heading is not None and mode.earth is not None:
        off = float(angle_between(mode.earth.heading, query.heading))
        if off > MAX_HEADING_ERROR:
            out.append(f"the camera looks {np.degrees(off):.0f} degrees away from the heading")
    return out


def decide_without_frames(
    best: PoseEstimate, by_text: WorldEstimate | None, left: Sequence[WorldMode]
) -> tuple[Status, str]:
    """Decide where frames fit none of the searched scenes.

    `left` are modes by the text and the location prior in other places; they are never `OK`.
    """
    if by_text is None:
        return Status.LOST, best.reason
    reason = f"The frames fit none of the searched scenes: {best.reason}"
    is_open = bool(left) and by_text.status is not Status.LOST
    return Status.AMBIGUOUS if is_open else Status.LOST, reason


def limit_status(
    estimate: WorldEstimate, world: World, query: WorldQuery, searched: Mapping[str, TownMatch]
) -> tuple[Status, str]:
    """Limit a status where parts that matter were not searched; explain a location prior off the maps."""
    reason, status = estimate.reason, estimate.status
    if query.near is not None and status is not Status.OK:
        hints = [t.explain_prior(query.near, query.radius) for t in world.towns.values()]
        if hints and None not in hints:
            reason = f"{reason} The fix lies outside all maps.{next(filter(None, hints), '')}"
    gaps = [town.gap for town in searched.values() if town.gap]
    is_short = bool(gaps) and status is Status.OK
    if gaps and status is Status.LOST:  # other parts were not searched
        gaps, reason = [*gaps, f"In the searched part, {reason[:1].lower()}{reason[1:]}"], ""
    parts = filter(None, [reason, *gaps, *(town.cost for town in searched.values())])
    return Status.AMBIGUOUS if is_short else status, " ".join(parts)
