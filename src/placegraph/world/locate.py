"""Where am I, in all that is known? The stages in order."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from placegraph.core.estimate import Status
from placegraph.errors import OptionError
from placegraph.world.among import among
from placegraph.world.ask import with_answers
from placegraph.world.frames import by_frames
from placegraph.world.witnesses import hear, said
from placegraph.world.words import by_words

if TYPE_CHECKING:
    from placegraph.world.estimate import WorldEstimate
    from placegraph.world.known import Known
    from placegraph.world.witnesses import Heard
    from placegraph.world.world import World

NO_SCENES = "There is no scene map in this world, so the frames were not used."


def locate(world: World, asked: Known) -> WorldEstimate:
    """One posterior over place, room and pose; parameters and errors: `World.locate`."""
    if asked.budget is not None and not world.planets:
        raise OptionError("budget: it is of worlds in shards, and here is none; leave it out.")
    known = with_answers(asked)
    answered = tuple(answer.question.text for answer in asked.answers)
    return replace(_located(world, known), answered=answered)


def _located(world: World, known: Known) -> WorldEstimate:
    heard = said(world, known)
    if world.crowd is not None:
        world = among(world, world.crowd, known, heard)
    if known.capture is not None and not world.scenes and known.text is None:
        raise OptionError(f"capture: {NO_SCENES[0].lower()}{NO_SCENES[1:]}")
    witnesses = hear(world, known, heard)
    notes = world.others.notes if world.others else ()
    if known.capture is not None and world.scenes:
        estimate = by_frames(world, known, witnesses)
    else:
        estimate = by_words(world, known, witnesses)
        notes += (NO_SCENES,) if known.capture is not None else ()
    return _searched(replace(_off_told(world, known, estimate), notes=notes), heard)


def _searched(estimate: WorldEstimate, heard: Heard) -> WorldEstimate:
    """Estimate that says what was searched; where that was not all, nothing is sure."""
    towns = heard.towns.values()
    gaps = [town.gap for town in towns if town.gap]
    reason = estimate.reason
    if gaps and estimate.status is Status.LOST:  # of what was not searched nothing is known
        gaps, reason = [*gaps, f"In what was, {reason[:1].lower()}{reason[1:]}"], ""
    told = filter(None, [reason, *gaps, *(town.cost for town in towns)])
    short = bool(gaps) and estimate.status is Status.OK
    return replace(
        estimate, status=Status.AMBIGUOUS if short else estimate.status, reason=" ".join(told),
        notes=(*estimate.notes, *(note for town in towns for note in town.notes)),
    )  # fmt: skip


def _off_told(world: World, known: Known, estimate: WorldEstimate) -> WorldEstimate:
    """Estimate that says so where a fix is off every town, and on one with its numbers swapped."""
    if known.near is None or estimate.status is Status.OK:
        return estimate
    hints = [town.off(known.near, known.radius) for town in world.towns.values()]
    if not hints or None in hints:
        return estimate
    hint = next(filter(None, hints), "")
    return replace(estimate, reason=f"{estimate.reason} The fix is on none of the maps.{hint}")
