"""Statements, and what they are made with: nodes, bearings, and why one was not made."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import pi
from typing import TYPE_CHECKING

from placegraph.language.check import Ignored
from placegraph.language.measures import Measure
from placegraph.outdoor.language.description import LISTENER, SPEAKER, Relation, Statement
from placegraph.outdoor.language.words import Direction

if TYPE_CHECKING:
    from placegraph.outdoor.language.parse import Place, Thing
    from placegraph.outdoor.language.refer import Referents


BlockLength = Callable[[float | None], float]
"""Length of a block [m] in the direction of a bearing [rad], or in any (None)."""


SIDE_SIGMA = 0.6
"""How loosely "on the north side of" is meant [rad]."""
FROM_YOU = 0.8
"""Certainty that a direction of which nothing more is said is seen from the listener."""
LEGS = (0.5, 0.25, 0.15)
"""Certainty that the place lies in the direction of the first, second, third leg of a walk."""
WALKED = 0.7
"""Certainty that the place is where the legs of a walk end whose lengths were said."""
ROUTE = 0.4
"""Certainty of what only lies on the way."""
PASSED = 0.6
"""Certainty that what is "past" a thing is close to it."""
WEAK = 0.7
"""Certainty of a relation that a preposition only suggests: "the entrance of the park"."""

NEEDS_HEADING = "needs a heading"
LISTENER_HEADING = "needs the listener's heading"
NO_MAP = "no map draws it"
NO_TARGET = "does not say of what"
UNKNOWN = "unknown word"


@dataclass
class Said:
    """The clause at hand, as far as its places need it."""

    text: str
    certainty: float = 1.0
    negated: bool = False
    travel: bool = False
    walked: bool = False
    """Whether directions for a walk came before."""
    shared: Thing | None = None
    """Target of a direction beside one that has none: "north and slightly west of you"."""


class Statements:
    """Statements of one text.

    Parameters
    ----------
    heading
        Bearing in which the speaker faces [rad], or None.
    directive
        Whether the text tells somebody the way: directions are then seen from them.
    block_length
        Length of a block [m] in a direction [rad], or in any; 100 m if None.
    """

    def __init__(
        self,
        refer: Referents,
        heading: float | None,
        *,
        directive: bool,
        block_length: BlockLength | None = None,
    ) -> None:
        self.refer, self.heading, self.directive = refer, heading, directive
        self.block_length = block_length
        self.statements: list[Statement] = []
        self.ignored: list[Ignored] = []
        self.goals = {SPEAKER}
        """Nodes that stand where the speaker stands."""
        self.reason = ""
        """Why the last place that became no statement did not."""

    def add(
        self,
        said: Said,
        relation: Relation,
        source: int,
        target: int,
        *,
        target2: int | None = None,
        direction: Direction | None = None,
        distance: float | None = None,
        certainty: float = 1.0,
    ) -> None:
        """Add a statement, unless it relates a thing to itself."""
        if source == target or (source in self.goals and target in self.goals):
            self.reason = "relates a thing to itself"
            return
        bearing = None if direction is None else direction.bearing % (2.0 * pi)
        negated = said.negated or not self.refer.negative.isdisjoint((source, target, target2))
        self.statements.append(
            Statement(
                relation,
                source,
                target,
                target2=target2,
                bearing=bearing,
                bearing_sigma=0.5 if direction is None else direction.sigma,
                distance=self.length(distance, bearing),
                within=isinstance(distance, Measure) and distance.at_most,
                negated=negated,
                certainty=round(
                    certainty * said.certainty * (direction.certainty if direction else 1.0), 3
                ),
                far=said.travel or LISTENER in (source, target),
                text=said.text,
            )
        )

    def length(self, distance: float | None, bearing: float | None) -> float | None:
        """Metres of a distance in a direction [rad], or in any: blocks are as long as on the map."""
        if isinstance(distance, Measure) and distance.blocks and self.block_length is not None:
            return distance.blocks * self.block_length(bearing)
        return None if distance is None else float(distance)

    def _implied(self, source: int, said: Said) -> int | None:
        """What a direction is seen from where nothing is said of it."""
        if not said.travel and source not in self.goals:
            return SPEAKER
        self.reason = NO_TARGET
        return LISTENER if said.travel or self.directive else None

    def _bearing(self, direction: Direction) -> Direction | None:
        """Direction on the compass; None, with a reason, where the heading is needed but unknown."""
        if not direction.facing:
            return direction
        if self.heading is None:
            self.reason = NEEDS_HEADING
            return None
        return direction._replace(bearing=direction.bearing + self.heading, facing=False)

    def _at_hand(self, source: int, target: int | None, said: Said) -> None:
        """Say that what is to the left, or behind, is there at all, where the heading is not known."""
        if target == SPEAKER and self.reason == NEEDS_HEADING:
            self.add(said, Relation.VISIBLE, source, target)

    def _target(self, thing: Thing, source: int) -> int | None:
        node = self.refer.resolve(thing)
        if node == source and thing.kind == "thing":  # "the bench is north of the bench"
            node = self.refer.resolve(thing, other_than=(source,))
        if node is None:
            self.reason = NO_MAP if thing.part else UNKNOWN
        elif node == source:
            self.reason = "relates a thing to itself"
            return None
        return node

    def from_listener(self) -> bool:
        """Tell whether a direction from the listener has been said already."""
        return any(
            s.relation is Relation.DIRECTION and s.target == LISTENER and s.certainty >= FROM_YOU
            for s in self.statements
        )


class Directions(Statements):
    """Makes statements of directions; what a place is called in the grammar names the method."""

    def _towards(self, place: Place, source: int, said: Said) -> None:
        direction = place.direction
        thing = place.targets[0] if place.targets else said.shared
        if direction.facing:
            if said.travel or (thing is not None and thing.kind == "YOU"):
                self.reason = "left and right of a walk say nothing on a map"
                return
            if thing is None and source in self.goals:
                self.reason = NO_TARGET
                return
        target = self._target(thing, source) if thing else self._implied(source, said)
        seen = self._bearing(direction)
        if target is None or seen is None:
            self._at_hand(source, target, said)
            return
        sure = 1.0 if thing is not None or target == SPEAKER else FROM_YOU
        if sure < 1.0 and (said.walked or self.from_listener()):
            sure = LEGS[-1]  # "your destination is to the north": of where the walk has led
        self.add(
            said, Relation.DIRECTION, source, target,
            direction=seen, distance=place.distance, certainty=sure,
        )  # fmt: skip

    def _side(self, place: Place, source: int, said: Said) -> None:
        """Relate "on the north side of the street"."""
        if not place.targets:
            street = self.refer.street
            if place.direction.facing or street is None or source not in self.goals:
                self._towards(place, source, said)
            else:
                self.add(
                    said, Relation.DIRECTION, source, street, certainty=0.6,
                    direction=place.direction._replace(sigma=SIDE_SIGMA),
                )  # fmt: skip
            return
        target = self._target(place.targets[0], source)
        seen = self._bearing(place.direction)
        if target is None or seen is None:
            return
        wide = seen._replace(sigma=max(seen.sigma, SIDE_SIGMA))
        self.add(said, Relation.DIRECTION, source, target, direction=wide, certainty=0.8)
        if target > LISTENER:
            self.add(said, Relation.NEAR, source, target)

    def _possessed(self, place: Place, source: int, said: Said) -> None:
        """Relate "to my east", "on its north side", "to the garden's northeast"."""
        target: int | None
        if place.targets:
            target = self._target(place.targets[0], source)
        elif place.owner == "ITS" and place.part and source in self.goals and self.refer.street:
            target = self.refer.street  # "on Penn Avenue, at its southern end"
        elif place.owner == "ITS":
            topic = self.refer.topic
            target = topic if topic is not None and topic != source else SPEAKER
        else:
            target = SPEAKER if place.owner == "MY" else LISTENER
        if target == LISTENER and place.direction.facing:
            self.reason = LISTENER_HEADING
            return
        seen = self._bearing(place.direction)
        if target is None or seen is None:
            self._at_hand(source, target, said)
        else:
            self.add(
                said, Relation.DIRECTION, source, target, direction=seen, distance=place.distance
            )

    def _faces(self, place: Place, source: int, _said: Said) -> None:
        if source in self.goals and not place.direction.facing and self.heading is None:
            self.heading = place.direction.bearing
        self.reason = "says which way one faces"
