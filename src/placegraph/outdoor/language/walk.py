"""Legs of a walk that a text tells, as statements: how far and in which direction it ends."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import atan2, cos, hypot, pi, sin

from placegraph.language.grammar import PlacePhrase
from placegraph.outdoor.language.description import (
    LISTENER,
    SPEAKER,
    Direction,
    Relation,
    Statement,
)
from placegraph.outdoor.language.grammar import Items, NounPhrase, Place
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
    """Legs of a walk that follow each other: so far in that direction."""

    start: int = LISTENER
    """Node at which it starts."""
    legs: list[tuple[float, float | None]] = field(default_factory=list)
    """Bearing [rad] and length [m] of every leg; None where no length was said."""
    statements: list[Statement] = field(default_factory=list)
    """Statements about it, which one about its end replaces."""

    def turn(self, direction: Direction) -> bool:
        """Turn to a point of the compass, or to the left or right of the last leg, if it is known."""
        if direction.facing and not self.legs:
            return False
        ahead = self.legs[-1][0] if direction.facing else 0.0
        self.legs.append(((direction.bearing + ahead) % (2.0 * pi), None))
        return True

    def walk(self, length: float) -> None:
        """Go that far [m] straight on."""
        bearing, known = self.legs[-1]
        self.legs[-1 if known is None else len(self.legs) :] = [(bearing, length)]

    def find_end(self) -> tuple[Direction, float] | None:
        """Return direction and distance [m] of the end from the start; None where it is not known."""
        lengths = [length for _, length in self.legs if length is not None]
        east = sum(length * sin(bearing) for bearing, length in self.legs if length)
        north = sum(length * cos(bearing) for bearing, length in self.legs if length)
        far = hypot(east, north)
        off = sum((0.2 * length) ** 2 + LEG_SIGMA**2 for length in lengths) ** 0.5
        if not lengths or len(lengths) < len(self.legs) or far < off:
            return None
        return Direction(atan2(east, north) % (2.0 * pi), max(0.3, atan2(off, far))), far


class Walk:
    """Adds what a text says of a walk, leg by leg."""

    def __init__(self, places: PlaceReader) -> None:
        self.places, self.references = places, places.references
        self.way = Way()
        self.legs = 0
        """Number of statements about legs whose length was not said."""
        self.on_the_way: int | None = None
        """Node that was last said to be met on the way."""
        self.led_to: int | None = None
        """Node where the walk was last said to lead."""

    def go(self, items: Items, travel: str, context: ClauseContext) -> None:
        """Add a leg of a walk to the place: where it leads, and what lies on the way."""
        context = replace(context, travel=True)
        for item in items:
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
        if place.distance is not None and self.way.legs:
            self.way.walk(self.places.measure(place.distance, self.way.legs[-1][0]) or 0.0)
        start, sure = self.way.start, WALKED
        end: tuple[Direction, float | None] | None = self.way.find_end()
        if end is not None:
            texts = dict.fromkeys((*[s.text for s in self.way.statements], context.text))
            context = replace(context, text=", ".join(texts))
            self.legs -= sum(s.distance is None for s in self.way.statements)
        elif place.how == "away" or place.direction.facing:
            self.places.reason = INSTRUCTION
            return
        else:
            start, sure = LISTENER, LEGS[min(self.legs, len(LEGS) - 1)]
            end = place.direction._replace(sigma=max(0.7, place.direction.sigma)), None
            self.legs += 1
        statements = self.places.statements
        n = len(statements)
        self.places.add(
            context, Relation.DIRECTION, SPEAKER, start,
            direction=end[0], distance=end[1], certainty=sure,
        )  # fmt: skip
        if len(statements) > n and end[1] is not None and self.way.statements:
            self._replace_statements(self.way.statements, statements.pop())
        else:
            self.way.statements += statements[n:]

    def _replace_statements(self, old: list[Statement], end: Statement) -> None:
        """Let one statement about the end of the way stand for those about its legs."""
        statements = self.places.statements
        statements[statements.index(old[0])] = end
        for leg in old[1:]:
            statements.remove(leg)
        self.way.statements = [end]

    def join(self, first: int) -> None:
        """Join measured directions from one thing, from a statement on, as legs of one way.

        "16 blocks south and a block and a half west of you" is neither 16 blocks south of you, nor
        one and a half west.
        """
        legs = [
            s
            for s in self.places.statements[first:]
            if s.bearing is not None and s.distance is not None and not (s.within or s.negated)
            if s.source in self.places.goals
        ]
        legs = [s for s in legs if s.target == legs[0].target]
        if legs:
            ways = [(s.bearing or 0.0, s.distance) for s in legs]
            self.way = Way(legs[0].target, ways, [legs[0]])
            end = self.way.find_end()
            if len(legs) > 1 and end is not None:
                self._replace_statements(
                    legs, replace(legs[0], bearing=end[0].bearing, distance=end[1])
                )

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
