"""Relations: places context of things become statements (Eq. 4)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import pi
from typing import TYPE_CHECKING

from placegraph.language.measures import Measure
from placegraph.language.text import Ignored
from placegraph.outdoor.language.description import (
    LISTENER,
    SPEAKER,
    Direction,
    Relation,
    Statement,
)
from placegraph.outdoor.language.grammar import NounPhrase, Place

if TYPE_CHECKING:
    from placegraph.outdoor.language.references import Referents

BlockLength = Callable[[float | None], float]
"""Length of a block [m] in the direction of a bearing [rad], or in any (None)."""


SIDE_SIGMA = 0.6
"""How loosely "on the north side of" is meant [rad]."""
FROM_YOU = 0.8
"""Certainty that a direction of which nothing more is context is seen from the listener."""
LEGS = (0.5, 0.25, 0.15)
"""Certainty that the place lies in the direction of the first, second, third leg of a walk."""
WALKED = 0.7
"""Certainty that the place is where the legs of a walk end whose lengths were context."""
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
class ClauseContext:
    """The clause at hand, as far as its places need it."""

    text: str
    certainty: float = 1.0
    negated: bool = False
    travel: bool = False
    walked: bool = False
    """Whether directions for a walk came before."""
    shared: NounPhrase | None = None
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
        context: ClauseContext,
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
        negated = context.negated or not self.refer.negative.isdisjoint((source, target, target2))
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
                    certainty * context.certainty * (direction.certainty if direction else 1.0), 3
                ),
                far=context.travel or LISTENER in (source, target),
                text=context.text,
            )
        )

    def length(self, distance: float | None, bearing: float | None) -> float | None:
        """Metres of a distance in a direction [rad], or in any: blocks are as long as on the map."""
        if isinstance(distance, Measure) and distance.blocks and self.block_length is not None:
            return distance.blocks * self.block_length(bearing)
        return None if distance is None else float(distance)

    def _implied(self, source: int, context: ClauseContext) -> int | None:
        """What a direction is seen from where nothing is context of it."""
        if not context.travel and source not in self.goals:
            return SPEAKER
        self.reason = NO_TARGET
        return LISTENER if context.travel or self.directive else None

    def _bearing(self, direction: Direction) -> Direction | None:
        """Direction on the compass; None, with a reason, where the heading is needed but unknown."""
        if not direction.facing:
            return direction
        if self.heading is None:
            self.reason = NEEDS_HEADING
            return None
        return direction._replace(bearing=direction.bearing + self.heading, facing=False)

    def _at_hand(self, source: int, target: int | None, context: ClauseContext) -> None:
        """Say that what is to the left, or behind, is there at all, where the heading is not known."""
        if target == SPEAKER and self.reason == NEEDS_HEADING:
            self.add(context, Relation.VISIBLE, source, target)

    def _target(self, thing: NounPhrase, source: int) -> int | None:
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
        """Tell whether a direction from the listener has been context already."""
        return any(
            s.relation is Relation.DIRECTION and s.target == LISTENER and s.certainty >= FROM_YOU
            for s in self.statements
        )


class Directions(Statements):
    """Makes statements of directions; what a place is called in the grammar names the method."""

    def _towards(self, place: Place, source: int, context: ClauseContext) -> None:
        direction = place.direction
        thing = place.targets[0] if place.targets else context.shared
        if direction.facing:
            if context.travel or (thing is not None and thing.kind == "YOU"):
                self.reason = "left and right of a walk say nothing on a map"
                return
            if thing is None and source in self.goals:
                self.reason = NO_TARGET
                return
        target = self._target(thing, source) if thing else self._implied(source, context)
        seen = self._bearing(direction)
        if target is None or seen is None:
            self._at_hand(source, target, context)
            return
        sure = 1.0 if thing is not None or target == SPEAKER else FROM_YOU
        if sure < 1.0 and (context.walked or self.from_listener()):
            sure = LEGS[-1]  # "your destination is to the north": of where the walk has led
        self.add(
            context, Relation.DIRECTION, source, target,
            direction=seen, distance=place.distance, certainty=sure,
        )  # fmt: skip

    def _side(self, place: Place, source: int, context: ClauseContext) -> None:
        """Relate "on the north side of the street"."""
        if not place.targets:
            street = self.refer.street
            if place.direction.facing or street is None or source not in self.goals:
                self._towards(place, source, context)
            else:
                self.add(
                    context, Relation.DIRECTION, source, street, certainty=0.6,
                    direction=place.direction._replace(sigma=SIDE_SIGMA),
                )  # fmt: skip
            return
        target = self._target(place.targets[0], source)
        seen = self._bearing(place.direction)
        if target is None or seen is None:
            return
        wide = seen._replace(sigma=max(seen.sigma, SIDE_SIGMA))
        self.add(context, Relation.DIRECTION, source, target, direction=wide, certainty=0.8)
        if target > LISTENER:
            self.add(context, Relation.NEAR, source, target)

    def _possessed(self, place: Place, source: int, context: ClauseContext) -> None:
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
            self._at_hand(source, target, context)
        else:
            self.add(
                context, Relation.DIRECTION, source, target, direction=seen, distance=place.distance
            )

    def _faces(self, place: Place, source: int, _said: ClauseContext) -> None:
        if source in self.goals and not place.direction.facing and self.heading is None:
            self.heading = place.direction.bearing
        self.reason = "says which way one faces"


BLOCK = Measure.within(0.0, blocks=1.0)
SHORT_WAY = Measure.within(120.0)
"""How far "round the corner" and "down the road" are at most [m]."""
_SIMPLE = {
    "near": (Relation.NEAR, 1.0, None),
    "along": (Relation.ALONG, 1.0, None),
    "inside": (Relation.INSIDE, 1.0, None),
    "opposite": (Relation.ACROSS, 1.0, None),
    "behind": (Relation.NEAR, WEAK, None),
    "same_block": (Relation.NEAR, 0.8, BLOCK),
    "short_way": (Relation.NEAR, 0.8, SHORT_WAY),
    "on_top": (Relation.SAME, 1.0, None),
}
"""Relation, certainty and distance of prepositions that always mean the same."""


class Relator(Directions):
    """Makes statements of places."""

    def relate(self, place: Place, source: int, context: ClauseContext) -> int | None:
        """Add the statements of a place context of a source; return the node it now speaks of.

        That is the source, or what it was context to stand at ("I'm at a cafe ...").
        """
        before, self.reason = len(self.statements), "says nothing about where things stand"
        changed: int | None = getattr(self, f"_{place.how}")(place, source, context)
        if len(self.statements) == before or self.reason == NEEDS_HEADING:
            left_out = Ignored(self.refer.text[place.start : place.end], self.reason)
            if left_out not in self.ignored[-1:]:
                self.ignored.append(left_out)
        if place.negated:
            self.statements[before:] = [replace(s, negated=True) for s in self.statements[before:]]
        return source if changed is None else changed

    def _at(self, place: Place, source: int, context: ClauseContext) -> int | None:
        thing = place.targets[0]
        if len(place.targets) > 1 and thing.part:
            self._part(place, source, context)
            return None
        target = self._target(thing, source)
        if target is None:
            return None
        if len(place.targets) > 1:
            whole = self._target(place.targets[1], target)
            if whole is not None:
                self.add(context, Relation.NEAR, target, whole, certainty=WEAK)
        relation, certainty = self._at_relation(place.word, target, source, context)
        self.add(context, relation, source, target, distance=place.distance, certainty=certainty)
        if source == SPEAKER and not (context.negated or place.negated or context.travel):
            if relation is Relation.SAME:
                self.goals.add(target)
                return target
            if relation is Relation.INSIDE and self.directive and len(self.goals) == 1:
                self.goals.add(target)  # "I'm in a garden. It is ..."
        return None

    def _at_relation(
        self, word: str, target: int, source: int, context: ClauseContext
    ) -> tuple[Relation, float]:
        line = self.refer.is_line(target)
        if context.travel:
            return (Relation.ALONG if line and word == "ON" else Relation.NEAR), 1.0
        if target <= LISTENER:
            return Relation.NEAR, 1.0
        if line:
            return Relation.ALONG, 1.0 if word == "ON" else 0.8
        if word == "IN" or (word == "ON" and self.refer.is_area(target)):
            return Relation.INSIDE, 1.0
        if word in ("AT", "ON") and source == SPEAKER:
            return Relation.SAME, 1.0
        return Relation.NEAR, WEAK if word == "TO" else 1.0

    def _part(self, place: Place, source: int, context: ClauseContext) -> None:
        """Relate "at the end of the street", "in the middle of the park"."""
        part, whole = place.targets
        target = self._target(whole, source)
        if target is None:
            return
        if part.part == "block":
            self.add(context, Relation.NEAR, source, target, distance=BLOCK, certainty=0.8)
        elif part.part == "same_side":
            self.reason = "a side of a street without a direction"
        elif self.refer.is_line(target):
            self.add(context, Relation.ALONG, source, target, distance=place.distance)
        elif part.part in ("middle", "floor"):
            self.add(context, Relation.INSIDE, source, target)
        else:
            self.add(context, Relation.NEAR, source, target, distance=place.distance)

    def _prep(self, place: Place, source: int, context: ClauseContext) -> int | None:
        if len(place.targets) > 1 and place.targets[0].part:
            place = replace(place, targets=place.targets[1:])
        thing, word = place.targets[0], place.word
        target = self._target(thing, source)
        if target is None:
            return None
        if word in ("front", "behind") and target == SPEAKER:
            seen = self._bearing(Direction(pi if word == "behind" else 0.0, facing=True))
            if seen is None:
                self._at_hand(source, target, context)
            else:
                self.add(
                    context, Relation.DIRECTION, source, target,
                    direction=seen, distance=place.distance,
                )  # fmt: skip
        elif word in ("front", "behind") and target == LISTENER:
            self.reason = LISTENER_HEADING
        elif word == "surrounded":
            self.add(context, Relation.NEAR, target, source)
        elif word in ("past", "before", "toward"):
            far = context.travel or word == "toward"
            sure = ROUTE if far else 0.8 if place.distance else PASSED
            self.add(
                replace(context, travel=far), Relation.NEAR, source, target,
                distance=place.distance, certainty=sure,
            )  # fmt: skip
        else:
            relation, certainty, distance = _SIMPLE.get(word, (Relation.NEAR, 1.0, None))
            if relation is Relation.ALONG and not self.refer.is_line(target):
                certainty = 0.8
            self.add(
                context, relation, source, target,
                distance=place.distance or distance, certainty=certainty,
            )  # fmt: skip
            if relation is Relation.SAME and source in self.goals:
                return target
        return None

    def _bare(self, place: Place, source: int, context: ClauseContext) -> int | None:
        """Relate "a bank opposite", of the speaker where nothing more is context."""
        if source in self.goals:
            self.reason = NO_TARGET
            return None
        me = NounPhrase("ME", place.start, place.end)
        return self._prep(replace(place, targets=(me,)), source, context)

    def _across(self, place: Place, source: int, context: ClauseContext) -> None:
        between: int | None = None
        if place.targets:
            between = self.refer.resolve(place.targets[0])
        if len(place.targets) > 1:
            target = self._target(place.targets[1], source)
            if target is not None:
                self.add(
                    context, Relation.ACROSS, source, target,
                    target2=between, distance=place.distance,
                )  # fmt: skip
            return
        if between is not None and not self._can_be_crossed(between):
            self.add(context, Relation.ACROSS, source, between, distance=place.distance)
            return
        if source not in self.goals:
            self.add(
                context, Relation.ACROSS, source, SPEAKER, target2=between, distance=place.distance
            )
        elif self.directive and between is not None and not self.refer.is_road(between):
            self.add(context, Relation.ACROSS, source, LISTENER, target2=between, certainty=0.6)
        else:
            self.reason = NO_TARGET
            target = self._target(context.shared, source) if context.shared is not None else None
            if target is not None and not self.refer.is_line(target):
                self.add(context, Relation.ACROSS, source, target, target2=between, certainty=0.8)

    def _can_be_crossed(self, node: int) -> bool:
        labels = [sense.label for sense in self.refer.mentions[node].senses]
        return self.refer.is_line(node) or any(
            "water" in label or "bridge" in label for label in labels
        )

    def _between(self, place: Place, source: int, context: ClauseContext) -> None:
        things = place.targets
        if len(things) == 1 and things[0].count == 2:  # "between two churches"
            one = replace(things[0], count=None)
            things = (one, replace(one, determiner="ANOTHER"))
        nodes = [self._target(thing, source) for thing in things]
        known = [node for node in nodes if node is not None]
        if len(known) == 2 and known[0] != known[1]:
            self.add(context, Relation.BETWEEN, source, known[0], target2=known[1])
        elif known:
            self.add(context, Relation.NEAR, source, known[0], certainty=WEAK)

    def _at_both(self, place: Place, source: int, context: ClauseContext) -> None:
        """Relate "where Penn Avenue meets 6th Street"."""
        for thing in place.targets:
            target = self._target(thing, source)
            if target is not None:
                self.add(context, Relation.NEAR, source, target)

    def _with_(self, place: Place, source: int, context: ClauseContext) -> int | None:
        """Relate "a park with a pond": what follows is context of the pond."""
        target = self._target(place.targets[0], source)
        if target is not None:
            self.add(context, Relation.NEAR, target, source, certainty=WEAK)
        return target

    def _of(self, place: Place, source: int, context: ClauseContext) -> None:
        vague = source == SPEAKER or place.targets[0].kind != "thing"
        if vague and place.distance is None:  # "join me for coffee"
            self.reason = NO_TARGET
            return
        target = self._target(place.targets[0], source)
        if target is not None:
            self.add(
                context, Relation.NEAR, source, target,
                distance=place.distance, certainty=1.0 if place.distance else WEAK,
            )  # fmt: skip

    def _start(self, place: Place, source: int, context: ClauseContext) -> None:
        """Relate "two blocks from the station"; a bare "from the station" opens a walk."""
        if place.distance is None:
            self.reason = "where a walk starts"
            return
        self._of(place, source, context)

    def _away(self, place: Place, source: int, context: ClauseContext) -> None:
        """Relate "two blocks away"."""
        target = self._implied(source, context)
        if context.travel:
            self.reason = "a distance without a direction"
        elif target is not None:
            self.add(context, Relation.NEAR, source, target, distance=place.distance)

    def _nearby(self, place: Place, source: int, context: ClauseContext) -> None:
        if source in self.goals:
            self.reason = NO_TARGET
        else:
            self.add(context, Relation.NEAR, source, SPEAKER, distance=place.distance)

    def _here(self, _place: Place, source: int, context: ClauseContext) -> None:
        if source in self.goals:
            self.reason = NO_TARGET
        else:
            self.add(context, Relation.VISIBLE, source, SPEAKER)
