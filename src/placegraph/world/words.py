"""The answer where there are no frames: words and a fix, over scenes, rooms and places in towns.

Somebody who speaks of rooms is probably in one that is mapped (`MAPPED`); else in another building of
a town, or in none of these towns. What was said of the outside tells both apart.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from placegraph.core.estimate import Status
from placegraph.indoor.status import SURE_SCENE as SURE
from placegraph.outdoor.language.description import SPEAKER, WITHIN
from placegraph.world.estimate import WorldEstimate, WorldMode
from placegraph.world.inside import rooms_of
from placegraph.world.standing import nowhere

if TYPE_CHECKING:
    from placegraph.core.estimate import Place
    from placegraph.world.known import Known
    from placegraph.world.outside import Outside
    from placegraph.world.witnesses import Witnesses
    from placegraph.world.world import World

MAPPED, IN_TOWN = 0.9, 0.07
"""Probability that somebody who speaks of a room is in a mapped one; in another place of a town."""
LEAST = 0.005
"""Modes below this probability are not told."""
CLEAR = 0.9
"""Share of one room in its scene from which on it is named alone."""


def by_words(world: World, known: Known, witnesses: Witnesses) -> WorldEstimate:
    """The posterior over scenes, rooms and places of towns."""
    inside = witnesses.speaks_inside or known.text is None
    if not inside and len(witnesses.towns) == 1:
        return _of_one_town(witnesses)
    scenes = inside and (witnesses.scenes or witnesses.others)
    mapped, in_town = (MAPPED, IN_TOWN) if scenes else (0.0, MAPPED + IN_TOWN)
    logs = {
        name: float(np.log(mapped * witnesses.prior(name))) + w.said
        for name, w in witnesses.scenes.items()
    } if mapped else {}  # fmt: skip
    towns = {
        n: t.gain + float(np.log(in_town / len(witnesses.towns)))
        for n, t in witnesses.towns.items()
    }
    unknown = 1.0 - mapped - (in_town if towns else 0.0)
    weights = np.array([*logs.values(), *towns.values(), np.log(unknown)])
    if mapped and witnesses.others:  # no mode's, and not elsewhere
        rest = np.log(mapped / witnesses.crowded) + witnesses.others.weight
        weights = np.append(weights, rest)
    shares = np.exp(weights - np.logaddexp.reduce(weights)).tolist()
    modes: list[WorldMode] = []
    for name, share in zip(logs, shares, strict=False):
        modes += scene_modes(world, witnesses, name, share)
    for name, share in zip(towns, shares[len(logs) :], strict=False):
        modes += place_modes(witnesses.towns[name], share)
    elsewhere = shares[len(logs) + len(towns)]
    modes = sorted(modes, key=lambda m: -m.probability)
    status, reason = _judged(world, known, witnesses, modes, elsewhere)
    return WorldEstimate(
        status, tuple(m for m in modes if m.probability >= LEAST)[: known.top] or tuple(modes[:1]),
        reason, elsewhere=elsewhere, understood=witnesses.understood,
        cities=witnesses.parts,
    )  # fmt: skip


def _of_one_town(witnesses: Witnesses) -> WorldEstimate:
    """What a town says of a sentence about nothing but its outside: all of it, as it says it."""
    (town,) = witnesses.towns.values()
    found = town.estimate
    modes = tuple(replace(_place_mode(town, p), probability=p.probability) for p in found.modes)
    return WorldEstimate(
        found.status, modes, found.reason, elsewhere=town.posterior.elsewhere,
        understood=witnesses.understood, cities=witnesses.parts,
    )  # fmt: skip


def scene_modes(
    world: World, witnesses: Witnesses, name: str, probability: float
) -> list[WorldMode]:
    """Modes of a scene: its rooms, as far as words tell them apart; else all of it."""
    rooms = witnesses.inside.rooms[name] if witnesses.inside else {}
    known = rooms_of(world.library, name)
    if len(known) == 1:
        told = {known[0]: 1.0}
    elif rooms and max(rooms.values()) * len(known) > 1.5:
        told = dict(rooms)
    else:
        told = {"": 1.0}
    return [_scene_mode(witnesses, name, room, share * probability) for room, share in told.items()]


def _scene_mode(witnesses: Witnesses, name: str, room: str, probability: float) -> WorldMode:
    w = witnesses.scenes[name]
    explain = partial(witnesses.evidence, name)
    if not w.standings:
        return WorldMode(None, None, probability, nowhere(), scene=name, room=room, explain=explain)
    best = w.standings[0]
    return WorldMode(
        *best.lonlat, probability, best.covariance, building=w.building, scene=name,
        level=best.anchor.level, room=room, explain=explain,
    )  # fmt: skip


def place_modes(town: Outside, share: float) -> list[WorldMode]:
    """Modes of a town's posterior, which holds a share of the world's."""
    return [
        replace(_place_mode(town, p), probability=share * p.probability)
        for p in town.estimate.modes
    ]


def _place_mode(town: Outside, place: Place) -> WorldMode:
    """A place of a town, with the building that the speaker is said to be in."""
    said = [
        i for i, s in enumerate(town.query.used) if s.relation in WITHIN and s.source == SPEAKER
    ]
    told = (e for i in said for e in place.evidence[i : i + 1])  # found only where it is needed
    building = next((o.name for e in told for o in e.objects if o.id[0] != "n" and o.name), "")
    return WorldMode(
        place.longitude, place.latitude, place.probability, place.covariance, building=building,
        place=place, explain=lambda: place.evidence,
    )  # fmt: skip


def _judged(
    world: World, known: Known, witnesses: Witnesses, modes: list[WorldMode], elsewhere: float
) -> tuple[Status, str]:
    """Status and reason of modes, best first."""
    if not modes:
        return Status.LOST, witnesses.mute or "Nothing that was said can be found on these maps."
    best = modes[0]
    if elsewhere > max(0.5, best.probability):
        return (
            Status.LOST,
            f"No place and no room fits better than being elsewhere ({elsewhere:.0%}).",
        )
    where = best.where
    if known.text is None:
        return Status.AMBIGUOUS, f"A fix alone tells no room; nearest is {where}."
    if best.place is not None:
        town = next(t for t in witnesses.towns.values() if best.place in t.estimate.modes)
        share = best.probability / max(best.place.probability, 1e-9)
        sure = town.estimate.status is Status.OK and share >= SURE
        rooms = " No mapped room fits." if witnesses.speaks_inside and witnesses.scenes else ""
        why = town.estimate.reason
        if share < SURE and town.estimate.status is not Status.LOST:  # it speaks of itself alone
            why = f"The best place holds only {best.probability:.0%} of the probability."
        return Status.OK if sure else Status.AMBIGUOUS, why + rooms
    of_scene = sum(m.probability for m in modes if m.scene == best.scene)
    if of_scene >= SURE and witnesses.scenes[best.scene].said < 0:
        return (
            Status.AMBIGUOUS,
            f"{where} fits best ({best.probability:.0%}), but not what was said.",
        )
    if best.probability >= SURE and (best.room or len(rooms_of(world.library, best.scene)) == 1):
        return Status.OK, f"{where} fits ({best.probability:.0%})."
    if of_scene >= SURE:
        return (
            Status.AMBIGUOUS,
            f"{best.scene} fits ({of_scene:.0%}); which room of it was not told.",
        )
    rivals = [m.where for m in modes[1:4] if m.probability > 0.1 * best.probability]
    others = f"; so may {'; '.join(rivals)}" if rivals else ""
    return Status.AMBIGUOUS, f"{where} fits best ({best.probability:.0%}){others}."
