"""Legs of a walk that a text tells, as statements: how far and in which direction it ends."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import atan2, cos, hypot, pi, sin

from placegraph.language.grammar import PlacePhrase
from placegraph.outdoor.language.description import (
    LISTENER,
    SPEAKER,
    Direction,
    Relation,
)
from placegraph.outdoor.language.grammar import Item, Items, NounPhrase, Place
from placegraph.outdoor.language.statements import (
    LEGS,
    OF_A_WALK,
    ROUTE,
    ClauseContext,
    PlaceReader,
)

WALKED = 0.7
"""Certainty that the place is where the legs of a walk end whose lengths were said."""
LEG_SIGMA = 60.0
"""Error of a leg's length [m], beside a share of the length."""
INSTRUCTION = "a route instruction"


@dataclass
class Way:
    """Legs of a walk that follow each other, as one way: so far in that direction."""

    start: int = LISTENER
    """Node at which it starts."""
    east: float = 0.0
    north: float = 0.0
    variance: float = 0.0
    """Variance of the end, to either side [m^2]."""
    heading: float | None = None
    """Bearing [rad] of the last leg; None before the first."""
    is_complete: bool = True
    """Whether the length of every leg but the last was said."""
    is_measured: bool = True
    """Whether the length of the last leg was said."""
    row: int | None = None
    """Statement that says where it ends."""

    def turn(self, direction: Direction) -> bool:
        """Turn to a point of the compass, or to the left or right of the last leg, if it is known."""
        if direction.facing and self.heading is None:
            return False
        ahead = self.heading if direction.facing and self.heading is not None else 0.0
        self.heading = (direction.bearing + ahead) % (2.0 * pi)
        self.is_complete &= self.is_measured
        self.is_measured = False
        return True

    def walk(self, length: float) -> None:
        """Go that far [m] straight on."""
        heading = self.heading or 0.0
        self.east += length * sin(heading)
        self.north += length * cos(heading)
        self.variance += (0.2 * length) ** 2 + LEG_SIGMA**2
        self.is_measured = True

    def find_end(self) -> tuple[Direction, float] | None:
        """Return direction and distance [m] of the end from the start; None where it is not known."""
        far, off = hypot(self.east, self.north), self.variance**0.5
        if not self.is_complete or far < off:
            return None
        sigma = max(0.3, atan2(off, far))
        return Direction(atan2(self.east, self.north) % (2.0 * pi), sigma), far


def _join_measures(items: Items) -> Iterator[Item]:
    """Yield the places of a leg, "south" and "8 blocks" as one."""
    rest = list(items)
    while rest:
        item = rest.pop(0)
        after = rest[0] if rest else None
        if isinstance(item, PlacePhrase) and isinstance(after, PlacePhrase):
            bare = item.how == "towards" and not item.targets and item.distance is None
            if bare and after.how == "away" and not after.targets:
                rest.pop(0)
                item = replace(item, distance=after.distance, end=after.end)
        yield item


class Walk:
    """Adds what a text says of a walk, leg by leg."""

    def __init__(self, places: PlaceReader) -> None:
        self.places, self.references = places, places.references
        self.way = Way()
        self.legs = 0
        self.ends = 0
        """Number of times that the end of a measured way was given; each replaces the one before."""
        self.on_the_way: int | None = None
        """Node that was last said to be met on the way."""
        self.led_to: int | None = None
        """Node where the walk was last said to lead."""

    def go(self, items: Items, travel: str, context: ClauseContext) -> None:
        """Add a leg of a walk to the place: where it leads, and what lies on the way."""
        context = replace(context, travel=True)
        for item in _join_measures(items):
            if isinstance(item, NounPhrase):
                self._meet(item, travel, context)
            elif item.how == "start" and item.distance is None:
                self.start_at(item.targets[0])
            elif item.how in ("towards", "away") and not item.targets:
                self._add_leg(item, context)
            elif item.how in ("at", "prep", "across", "towards", "with_", "of"):
                sure = context.certainty * (1.0 if item.how == "prep" else ROUTE)
                if item.how == "prep" and item.word not in ("past", "before", "toward"):
                    sure *= ROUTE
                self.places.relate(item, SPEAKER, replace(context, certainty=sure))
                self._remember(item)
            else:
                self.places.reason = INSTRUCTION

    def start_at(self, noun: NounPhrase) -> None:
        """Begin anew where a walk starts: "from the station", "when you reach the church"."""
        node = self.references.resolve(noun)
        if node is not None and node != SPEAKER and not self.references.is_line(node):
            self.way = Way(node)

    def _remember(self, place: Place) -> None:
        """Remember what a place on the way speaks of."""
        if not place.targets or place.targets[0].kind != "thing":
            return
        noun = replace(place.targets[0], determiner="DET", count=None)
        node = self.on_the_way = self.references.resolve(noun)
        to = place.word in ("TO", "AT", "IN") and len(place.targets) == 1
        if to and node is not None and not self.references.is_line(node):
            self.led_to = node if self.references.is_known(node) else self.led_to

    def _add_leg(self, place: Place, context: ClauseContext) -> None:
        if place.how == "towards" and not self.way.turn(place.direction):
            self.places.reason = OF_A_WALK
            return
        if place.distance is not None and self.way.heading is not None:
            self.way.walk(self.places.measure(place.distance, self.way.heading) or 0.0)
            if self._add_end(context):
                return
        if place.how == "away" or place.direction.facing:
            self.places.reason = INSTRUCTION
            return
        sure = context.certainty * LEGS[min(self.legs, len(LEGS) - 1)]
        self.legs += 1
        self.places.add(
            replace(context, certainty=sure), Relation.DIRECTION, SPEAKER, LISTENER,
            direction=place.direction._replace(sigma=max(0.7, place.direction.sigma)),
        )  # fmt: skip

    def _add_end(self, context: ClauseContext) -> bool:
        """Say where the walk so far ends, in place of where it ended before."""
        end = self.way.find_end()
        if end is None:
            return False
        statements, row = self.places.statements, self.way.row
        before = statements[row].text if row is not None else ""
        if before not in ("", context.text):
            context = replace(context, text=f"{before}, {context.text}")
        self.places.add(
            context, Relation.DIRECTION, SPEAKER, self.way.start,
            direction=end[0], distance=end[1], certainty=WALKED,
        )  # fmt: skip
        self.ends += 1
        if row is None:
            self.way.row = len(statements) - 1
        else:
            statements[row] = statements.pop()
        return True

    def join(self, first: int) -> None:
        """Join measured directions from one thing, from a statement on, as legs of one way.

        "16 blocks south and a block and a half west of you" is neither 16 blocks south of you, nor
        one and a half west.
        """
        statements = self.places.statements
        legs: list[int] = []
        for row in range(first, len(statements)):
            s = statements[row]
            measured = s.bearing is not None and s.distance is not None and not s.within
            if not measured or s.negated or s.source not in self.places.goals:
                continue
            if s.target == statements[(legs or [row])[0]].target:
                legs.append(row)
        if not legs:
            return
        self.way = Way(statements[legs[0]].target, row=legs[0])
        for row in legs:
            self.way.turn(Direction(statements[row].bearing or 0.0))
            self.way.walk(statements[row].distance or 0.0)
        end = self.way.find_end()
        if len(legs) > 1 and end is not None:
            joined = replace(statements[legs[0]], bearing=end[0].bearing, distance=end[1])
            statements[legs[0]] = joined
            for row in legs[:0:-1]:
                del statements[row]

    def _meet(self, noun: NounPhrase, travel: str, context: ClauseContext) -> None:
        """Relate a thing that is met on the way."""
        node = self.references.resolve(noun)
        if node is None or node <= LISTENER:
            self.places.reason = INSTRUCTION
            return
        self.on_the_way = node
        if travel == "CROSS" and not self.references.is_road(node):
            self.places.add(
                context, Relation.ACROSS, SPEAKER, LISTENER, target2=node, certainty=0.5
            )
        else:
            follows = travel == "FOLLOW" and self.references.is_line(node)
            relation = Relation.ALONG if follows else Relation.NEAR
            self.places.add(context, relation, SPEAKER, node, certainty=ROUTE)
        if travel == "REACH":
            self.start_at(noun)

    def look_back(self, items: Items, context: ClauseContext) -> None:
        """Look back in "you've gone too far west": the place lies east of what was met."""
        for item in items:
            if not isinstance(item, PlacePhrase) or item.how != "towards" or item.direction.facing:
                continue
            if self.on_the_way is not None:
                back = item.direction._replace(bearing=item.direction.bearing + pi)
                self.places.add(
                    replace(context, travel=True), Relation.DIRECTION, SPEAKER, self.on_the_way,
                    direction=back, certainty=0.6,
                )  # fmt: skip
