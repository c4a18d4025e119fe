"""A walk to the place: where its legs lead, and what is met on the way."""

from __future__ import annotations

from dataclasses import replace
from math import pi
from typing import TYPE_CHECKING

from placegraph.outdoor.language.description import LISTENER, SPEAKER, Relation
from placegraph.outdoor.language.parse import Place, Thing
from placegraph.outdoor.language.statements import LEGS, ROUTE

if TYPE_CHECKING:
    from placegraph.outdoor.language.parse import Items
    from placegraph.outdoor.language.relate import Relator
    from placegraph.outdoor.language.statements import Said
    from placegraph.outdoor.language.words import Direction


class Walk:
    """What a text says of a walk, leg by leg."""

    def __init__(self, relator: Relator) -> None:
        self.relator, self.refer = relator, relator.refer
        self.legs = 0
        self.on_the_way: int | None = None
        """What was last said to be met on the way."""
        self.led_to: int | None = None
        """Where the walk was last said to lead."""

    def go(self, items: Items, travel: str, said: Said) -> None:
        """A leg of a walk to the place: where it leads, and what lies on the way."""
        said = replace(said, travel=True)
        for item in items:
            if isinstance(item, Thing):
                self._meet_on_the_way(item, travel, said)
            elif item.how == "towards" and not item.targets:
                self._leg(item, said)
            elif item.how in ("at", "prep", "across", "towards", "with_", "of"):
                sure = said.certainty * (ROUTE if item.how != "prep" else 1.0)
                if item.how == "prep" and item.word not in ("past", "before", "toward"):
                    sure *= ROUTE
                self.relator.relate(item, SPEAKER, replace(said, certainty=sure))
                self._pass(item)
            else:
                self.relator.reason = "a route instruction"

    def _pass(self, place: Place) -> None:
        """Remember what a place on the way speaks of."""
        if not place.targets or place.targets[0].kind != "thing":
            return
        self.on_the_way = self.refer.resolve(
            replace(place.targets[0], determiner="DET", count=None)
        )
        to = place.word in ("TO", "AT", "IN") and len(place.targets) == 1
        if to and self.on_the_way is not None and not self.refer.is_line(self.on_the_way):
            mention = self.refer.mentions[self.on_the_way]
            self.led_to = self.on_the_way if mention.senses or mention.name else self.led_to

    def _leg(self, place: Place, said: Said) -> None:
        if place.direction.facing:
            self.relator.reason = "left and right of a walk say nothing on a map"
            return
        sure = said.certainty * LEGS[min(self.legs, len(LEGS) - 1)]
        self.legs += 1
        self.relator.add(
            replace(said, certainty=sure), Relation.DIRECTION, SPEAKER, LISTENER,
            direction=place.direction._replace(sigma=max(0.7, place.direction.sigma)),
            distance=place.distance,
        )  # fmt: skip

    def _meet_on_the_way(self, thing: Thing, travel: str, said: Said) -> None:
        node = self.refer.resolve(thing)
        if node is None or node <= LISTENER:
            self.relator.reason = "a route instruction"
            return
        self.on_the_way = node
        if travel == "CROSS" and not self.refer.is_road(node):
            self.relator.add(said, Relation.ACROSS, SPEAKER, LISTENER, target2=node, certainty=0.5)
        elif travel == "FOLLOW" and self.refer.is_line(node):
            self.relator.add(said, Relation.ALONG, SPEAKER, node, certainty=ROUTE)
        else:
            self.relator.add(said, Relation.NEAR, SPEAKER, node, certainty=ROUTE)

    def look_back(self, items: Items, said: Said) -> None:
        """Look back in "you've gone too far west": the place lies east of what was met."""
        for item in items:
            if not isinstance(item, Place) or item.how != "towards" or item.direction.facing:
                continue
            if self.on_the_way is not None:
                back: Direction = item.direction._replace(bearing=item.direction.bearing + pi)
                self.relator.add(
                    replace(said, travel=True), Relation.DIRECTION, SPEAKER, self.on_the_way,
                    direction=back, certainty=0.6,
                )  # fmt: skip
