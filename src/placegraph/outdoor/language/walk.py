"""A walk to the place: where its legs lead, and what is met on the way."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import atan2, cos, hypot, pi, sin
from typing import TYPE_CHECKING

from placegraph.outdoor.language.description import LISTENER, SPEAKER, Relation
from placegraph.outdoor.language.parse import Items, Place, Thing
from placegraph.outdoor.language.statements import LEGS, ROUTE, WALKED, Said
from placegraph.outdoor.language.words import Direction

if TYPE_CHECKING:
    from placegraph.outdoor.language.relate import Relator

ASIDE = 60.0
"""How far people are off in what they say of a leg [m], beside a share of its length."""


@dataclass
class Legs:
    """Legs of a walk that follow each other, as one way: so far in that direction."""

    start: int = LISTENER
    """Node at which it starts."""
    east: float = 0.0
    north: float = 0.0
    variance: float = 0.0
    """Of the end, to either side [m^2]."""
    heading: float | None = None
    """Bearing [rad] of the last leg; None before the first."""
    whole: bool = True
    """Whether the length of every leg but the last was said."""
    measured: bool = True
    """Whether the length of the last leg was said."""
    row: int | None = None
    """Statement that says where it ends."""

    def turn(self, direction: Direction) -> bool:
        """Turn to a point of the compass, or to the left or right of the last leg, if it is known."""
        if direction.facing and self.heading is None:
            return False
        ahead = self.heading if direction.facing and self.heading is not None else 0.0
        self.heading = (direction.bearing + ahead) % (2.0 * pi)
        self.whole &= self.measured
        self.measured = False
        return True

    def walk(self, length: float) -> None:
        """Go that far [m] straight on."""
        heading = self.heading or 0.0
        self.east += length * sin(heading)
        self.north += length * cos(heading)
        self.variance += (0.2 * length) ** 2 + ASIDE**2
        self.measured = True

    def way(self) -> tuple[Direction, float] | None:
        """Direction and distance [m] of the end from the start; None where it is not known."""
        far, off = hypot(self.east, self.north), self.variance**0.5
        if not self.whole or far < off:
            return None
        sigma = max(0.3, atan2(off, far))
        return Direction(atan2(self.east, self.north) % (2.0 * pi), sigma), far


def _measured(items: Items) -> Iterator[Thing | Place]:
    """Places of a leg, "south" and "8 blocks" taken as one."""
    rest = list(items)
    while rest:
        item = rest.pop(0)
        after = rest[0] if rest else None
        if isinstance(item, Place) and isinstance(after, Place):
            bare = item.how == "towards" and not item.targets and item.distance is None
            if bare and after.how == "away" and not after.targets:
                rest.pop(0)
                item = replace(item, distance=after.distance, end=after.end)
        yield item


class Walk:
    """What a text says of a walk, leg by leg."""

    def __init__(self, relator: Relator) -> None:
        self.relator, self.refer = relator, relator.refer
        self.way = Legs()
        self.legs = 0
        self.told = 0
        """How often the end of a measured way was told; each time replaces the one before."""
        self.on_the_way: int | None = None
        """What was last said to be met on the way."""
        self.led_to: int | None = None
        """Where the walk was last said to lead."""

    def go(self, items: Items, travel: str, said: Said) -> None:
        """A leg of a walk to the place: where it leads, and what lies on the way."""
        said = replace(said, travel=True)
        for item in _measured(items):
            if isinstance(item, Thing):
                self._meet_on_the_way(item, travel, said)
            elif item.how == "start" and item.distance is None:
                self.starts_at(item.targets[0])
            elif item.how in ("towards", "away") and not item.targets:
                self._leg(item, said)
            elif item.how in ("at", "prep", "across", "towards", "with_", "of"):
                sure = said.certainty * (ROUTE if item.how != "prep" else 1.0)
                if item.how == "prep" and item.word not in ("past", "before", "toward"):
                    sure *= ROUTE
                self.relator.relate(item, SPEAKER, replace(said, certainty=sure))
                self._pass(item)
            else:
                self.relator.reason = "a route instruction"

    def starts_at(self, thing: Thing) -> None:
        """Begin anew where a walk starts: "from the station", "when you reach the church"."""
        node = self.refer.resolve(thing)
        if node is not None and node != SPEAKER and not self.refer.is_line(node):
            self.way = Legs(node)

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
        if place.how == "towards" and not self.way.turn(place.direction):
            self.relator.reason = "left and right of a walk say nothing on a map"
            return
        if place.distance is not None and self.way.heading is not None:
            self.way.walk(self.relator.length(place.distance, self.way.heading) or 0.0)
            if self._ends(said):
                return
        if place.how == "away" or place.direction.facing:
            self.relator.reason = "a route instruction"
            return
        sure = said.certainty * LEGS[min(self.legs, len(LEGS) - 1)]
        self.legs += 1
        self.relator.add(
            replace(said, certainty=sure), Relation.DIRECTION, SPEAKER, LISTENER,
            direction=place.direction._replace(sigma=max(0.7, place.direction.sigma)),
        )  # fmt: skip

    def _ends(self, said: Said) -> bool:
        """Say where the walk so far ends, in place of where it ended before."""
        end = self.way.way()
        if end is None:
            return False
        statements = self.relator.statements
        before = statements[self.way.row].text if self.way.row is not None else ""
        text = f"{before}, {said.text}" if before and before != said.text else said.text
        self.relator.add(
            replace(said, text=text), Relation.DIRECTION, SPEAKER, self.way.start,
            direction=end[0], distance=end[1], certainty=WALKED,
        )  # fmt: skip
        self.told += 1
        if self.way.row is None:
            self.way.row = len(statements) - 1
        else:
            statements[self.way.row] = statements.pop()
        return True

    def join(self, first: int) -> None:
        """Take measured directions from one thing, from a statement on, as legs of one way.

        "16 blocks south and a block and a half west of you" is neither 16 blocks south of you, nor
        one and a half west.
        """
        statements = self.relator.statements
        legs: list[int] = []
        for row in range(first, len(statements)):
            s = statements[row]
            if s.bearing is None or s.distance is None or s.within or s.negated:
                continue
            if s.source in self.relator.goals and s.target == statements[(legs or [row])[0]].target:
                legs.append(row)
        if not legs:
            return
        self.way = Legs(statements[legs[0]].target, row=legs[0])
        for row in legs:
            bearing, length = statements[row].bearing or 0.0, statements[row].distance or 0.0
            self.way.turn(Direction(bearing))
            self.way.walk(length)
        end = self.way.way()
        if len(legs) > 1 and end is not None:
            statements[legs[0]] = replace(
                statements[legs[0]], bearing=end[0].bearing, distance=end[1]
            )
            for row in legs[:0:-1]:
                del statements[row]

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
        if travel == "REACH":
            self.starts_at(thing)

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
