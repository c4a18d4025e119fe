"""Where am I, in all that is known? The stages in order."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from placegraph.errors import OptionError
from placegraph.world.frames import by_frames
from placegraph.world.witnesses import hear
from placegraph.world.words import by_words

if TYPE_CHECKING:
    from placegraph.world.estimate import WorldEstimate
    from placegraph.world.known import Known
    from placegraph.world.world import World

NO_SCENES = "There is no scene map in this world, so the frames were not used."


def locate(world: World, known: Known) -> WorldEstimate:
    """One posterior over place, room and pose; parameters and errors: `World.locate`."""
    if known.capture is not None and not world.scenes and known.text is None:
        raise OptionError(f"capture: {NO_SCENES[0].lower()}{NO_SCENES[1:]}")
    witnesses = hear(world, known)
    if known.capture is not None and world.scenes:
        return by_frames(world, known, witnesses)
    estimate = by_words(world, known, witnesses)
    return replace(estimate, notes=(NO_SCENES,)) if known.capture is not None else estimate
