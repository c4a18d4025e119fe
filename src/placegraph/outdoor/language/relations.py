"""Relations: places said of things become statements: "north of", "opposite", "between" (Eq. 4)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import pi

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
from placegraph.outdoor.language.references import References

BlockLength = Callable[[float | None], float]
"""Length of a block [m] in the direction of a bearing [rad], or in any (None)."""

SIDE_SIGMA = 0.6
"""How loosely "on the north side of" is meant [rad]."""
FROM_YOU = 0.8
"""Certainty that a direction without a target is seen from the listener."""
LEGS = (0.5, 0.25, 0.15)
"""Certainty that the place lies in the direction of the first, second, third leg of a walk."""
ROUTE = 0.4
"""Certainty of what only lies on the way."""
PASSED = 0.6
"""Certainty that what is "past" a thing is close to it."""
WEAK = 0.7
"""Certainty of a relation that a preposition only suggests: "the entrance of the park"."""
BLOCK = Measure.within(0.0, blocks=1.0)
SHORT_WAY = Measure.within(120.0)
"""Greatest distance of "round the corner" and "down the road" [m]."""
PREPOSITIONS = {
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

NEEDS_HEADING = "needs a heading"
LISTENER_HEADING = "needs the listener's heading"
NO_MAP = "no map draws it"
NO_TARGET = "does not say of what"
NO_PLACE = "says nothing about where things stand"
UNKNOWN = "unknown word"
OF_A_WALK = "left and right of a walk say nothing on a map"
TO_ITSELF = "relates a thing to itself"


@dataclass
class ClauseContext:
    """Clause at hand, as far as its places need it."""

    text: str
    certainty: float = 1.0
    negated: bool = False
    travel: bool = False
    walked: bool = False
    """Whether directions for a walk came before."""
    shared: NounPhrase | None = None
    """Target of a direction beside one that has none: "north and slightly west of you"."""


class StatementBuilder:
    """Statements of one text.

    Parameters
    ----------
    references
        Mentions of the text.
    heading
        Bearing in which the speaker faces [rad], or None.
    directive
        Whether the text tells somebody the way: directions are then seen from them.
    block_length
        Length of a block [m] in a direction [rad], or in any; 100 m if None.
    """

    def __init__(
        self,
        references: References,
        heading: float | None,
        *,
        directive: bool,
        block_length: BlockLength | None = None,
    ) -> None:
        self.references, self.heading, self.directive = references, heading, directive
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
            self.reason = TO_ITSELF
            return
        bearing = None if direction is None else direction.bearing % (2.0 * pi)
        sure = certainty * context.certainty * (direction.certainty if direction else 1.0)
        absent = not self.references.negative.isdisjoint((source, target, target2))
        self.statements.append(
            Statement(
                relation,
                source,
                target,
                target2=target2,
                bearing=bearing,
                bearing_sigma=0.5 if direction is None else direction.sigma,
                distance=self.measure(distance, bearing),
                within=isinstance(distance, Measure) and distance.at_most,
                negated=context.negated or absent,
                certainty=round(sure, 3),
                far=context.travel or LISTENER in (source, target),
                text=context.text,
            )
        )

    def measure(self, distance: float | None, bearing: float | None) -> float | None:
        """Return a distance [m] in a direction [rad], or in any: blocks are as long as on the map."""
        if isinstance(distance, Measure) and distance.blocks and self.block_length is not None:
            return distance.blocks * self.block_length(bearing)
        return None if distance is None else float(distance)

    def _implied_target(self, source: int, context: ClauseContext) -> int | None:
        """Return the node that a direction or distance without a target is seen from."""
        if not context.travel and source not in self.goals:
            return SPEAKER
        self.reason = NO_TARGET
        return LISTENER if context.travel or self.directive else None

    def _resolve(self, thing: NounPhrase, source: int) -> int | None:
        """Return the node of a target; None, with a reason, where there is none."""
        node = self.references.resolve(thing)
        if node == source and thing.kind == "thing":  # "the bench is north of the bench"
            node = self.references.resolve(thing, other_than=(source,))
        if node is None:
            self.reason = NO_MAP if thing.part else UNKNOWN
        elif node == source:
            self.reason = TO_ITSELF
            return None
        return node

    def _add_direction(
        self,
        context: ClauseContext,
        source: int,
        target: int | None,
        direction: Direction,
        *,
        distance: float | None = None,
        certainty: float = 1.0,
    ) -> None:
        """Add a direction; one of the body needs the heading, without it the source is in sight."""
        if direction.facing and self.heading is None:
            self.reason = NEEDS_HEADING
            if target == SPEAKER:
                self.add(context, Relation.VISIBLE, source, SPEAKER)
            return
        if direction.facing and self.heading is not None:
            turned = direction.bearing + self.heading
            direction = direction._replace(bearing=turned, facing=False)
        if target is not None:
            self.add(
                context, Relation.DIRECTION, source, target,
                direction=direction, distance=distance, certainty=certainty,
            )  # fmt: skip


class PlaceReader(StatementBuilder):
    """Makes statements of places; the rule of the grammar that a place has names the method."""

    def relate(self, place: Place, source: int, context: ClauseContext) -> int | None:
        """Add the statements of a place said of a source; return the node it now speaks of.

        That is the source, or what it was said to stand at ("I'm at a cafe ...").
        """
        before, self.reason = len(self.statements), NO_PLACE
        changed: int | None = getattr(self, f"_{place.how}")(place, source, context)
        if len(self.statements) == before or self.reason == NEEDS_HEADING:
            left_out = Ignored(self.references.text[place.start : place.end], self.reason)
            if left_out not in self.ignored[-1:]:
                self.ignored.append(left_out)
        if place.negated:
            self.statements[before:] = [replace(s, negated=True) for s in self.statements[before:]]
        return source if changed is None else changed

    # directions

    def _towards(self, place: Place, source: int, context: ClauseContext) -> None:
        """Relate "north of the church", "to the left"."""
        thing = place.targets[0] if place.targets else context.shared
        if place.direction.facing:
            if context.travel or (thing is not None and thing.kind == "YOU"):
                self.reason = OF_A_WALK
                return
            if thing is None and source in self.goals:
                self.reason = NO_TARGET
                return
        target = self._resolve(thing, source) if thing else self._implied_target(source, context)
        sure = 1.0 if thing is not None or target == SPEAKER else FROM_YOU
        from_you = any(
            s.relation is Relation.DIRECTION and s.target == LISTENER and s.certainty >= FROM_YOU
            for s in self.statements
        )
        if sure < 1.0 and (context.walked or from_you):
            sure = LEGS[-1]  # "your destination is to the north": of where the walk has led
        self._add_direction(
            context, source, target, place.direction, distance=place.distance, certainty=sure
        )

    def _side(self, place: Place, source: int, context: ClauseContext) -> None:
        """Relate "on the north side of the street"."""
        street = self.references.street
        if not place.targets:
            if place.direction.facing or street is None or source not in self.goals:
                self._towards(place, source, context)
            else:
                wide = place.direction._replace(sigma=SIDE_SIGMA)
                self._add_direction(context, source, street, wide, certainty=0.6)
            return
        target = self._resolve(place.targets[0], source)
        if place.direction.facing and self.heading is None:
            self.reason = NEEDS_HEADING
        elif target is not None:
            wide = place.direction._replace(sigma=max(place.direction.sigma, SIDE_SIGMA))
            self._add_direction(context, source, target, wide, certainty=0.8)
            if target > LISTENER:
                self.add(context, Relation.NEAR, source, target)

    def _possessed(self, place: Place, source: int, context: ClauseContext) -> None:
        """Relate "to my east", "on its north side", "to the garden's northeast"."""
        topic, street = self.references.topic, self.references.street
        target: int | None = SPEAKER if place.owner == "MY" else LISTENER
        if place.targets:
            target = self._resolve(place.targets[0], source)
        elif place.owner == "ITS" and place.part and source in self.goals and street:
            target = street  # "on Penn Avenue, at its southern end"
        elif place.owner == "ITS":
            target = topic if topic is not None and topic != source else SPEAKER
        if target == LISTENER and place.direction.facing:
            self.reason = LISTENER_HEADING
            return
        self._add_direction(context, source, target, place.direction, distance=place.distance)

    def _faces(self, place: Place, source: int, _context: ClauseContext) -> None:
        """Note "facing north"."""
        if source in self.goals and not place.direction.facing and self.heading is None:
            self.heading = place.direction.bearing
        self.reason = "says which way one faces"

    # prepositions

    def _at(self, place: Place, source: int, context: ClauseContext) -> int | None:
        """Relate "on Penn Avenue", "in the park", "at the end of the street"."""
        thing = place.targets[0]
        if len(place.targets) > 1 and thing.part:
            self._at_part(place, source, context)
            return None
        target = self._resolve(thing, source)
        if target is None:
            return None
        if len(place.targets) > 1:
            whole = self._resolve(place.targets[1], target)
            if whole is not None:
                self.add(context, Relation.NEAR, target, whole, certainty=WEAK)
        relation, certainty = self._choose_relation(place.word, target, source, context)
        self.add(context, relation, source, target, distance=place.distance, certainty=certainty)
        if source == SPEAKER and not (context.negated or place.negated or context.travel):
            if relation is Relation.SAME:
                self.goals.add(target)
                return target
            if relation is Relation.INSIDE and self.directive and len(self.goals) == 1:
                self.goals.add(target)  # "I'm in a garden. It is ..."
        return None

    def _choose_relation(
        self, word: str, target: int, source: int, context: ClauseContext
    ) -> tuple[Relation, float]:
        """Return what "on", "in", "at" or "to" means of a target, and how certainly."""
        line = self.references.is_line(target)
        if context.travel:
            return (Relation.ALONG if line and word == "ON" else Relation.NEAR), 1.0
        if target <= LISTENER:
            return Relation.NEAR, 1.0
        if line:
            return Relation.ALONG, 1.0 if word == "ON" else 0.8
        if word == "IN" or (word == "ON" and self.references.is_area(target)):
            return Relation.INSIDE, 1.0
        if word in ("AT", "ON") and source == SPEAKER:
            return Relation.SAME, 1.0
        return Relation.NEAR, WEAK if word == "TO" else 1.0

    def _at_part(self, place: Place, source: int, context: ClauseContext) -> None:
        """Relate "at the end of the street", "in the middle of the park"."""
        part, whole = place.targets
        target = self._resolve(whole, source)
        if target is None:
            return
        if part.part == "block":
            self.add(context, Relation.NEAR, source, target, distance=BLOCK, certainty=0.8)
        elif part.part == "same_side":
            self.reason = "a side of a street without a direction"
        elif self.references.is_line(target):
            self.add(context, Relation.ALONG, source, target, distance=place.distance)
        elif part.part in ("middle", "floor"):
            self.add(context, Relation.INSIDE, source, target)
        else:
            self.add(context, Relation.NEAR, source, target, distance=place.distance)

    def _prep(self, place: Place, source: int, context: ClauseContext) -> int | None:
        """Relate "next to the bank", "opposite the school", "past the park"."""
        things, word, distance = place.targets, place.word, place.distance
        target = self._resolve(things[len(things) > 1 and bool(things[0].part)], source)
        if target is None:
            return None
        if word in ("front", "behind") and target == SPEAKER:
            turned = Direction(pi if word == "behind" else 0.0, facing=True)
            self._add_direction(context, source, target, turned, distance=distance)
        elif word in ("front", "behind") and target == LISTENER:
            self.reason = LISTENER_HEADING
        elif word == "surrounded":
            self.add(context, Relation.NEAR, target, source)
        elif word in ("past", "before", "toward"):
            far = context.travel or word == "toward"
            sure = ROUTE if far else 0.8 if distance else PASSED
            context = replace(context, travel=far)
            self.add(context, Relation.NEAR, source, target, distance=distance, certainty=sure)
        else:
            relation, sure, usual = PREPOSITIONS.get(word, (Relation.NEAR, 1.0, None))
            if relation is Relation.ALONG and not self.references.is_line(target):
                sure = 0.8
            self.add(context, relation, source, target, distance=distance or usual, certainty=sure)
            if relation is Relation.SAME and source in self.goals:
                return target
        return None

    def _bare(self, place: Place, source: int, context: ClauseContext) -> int | None:
        """Relate "a bank opposite", of the speaker where nothing more is said."""
        if source in self.goals:
            self.reason = NO_TARGET
            return None
        me = NounPhrase("ME", place.start, place.end)
        return self._prep(replace(place, targets=(me,)), source, context)

    def _across(self, place: Place, source: int, context: ClauseContext) -> None:
        """Relate "across the street from the bank", "across the river"."""
        things, distance = place.targets, place.distance
        between = self.references.resolve(things[0]) if things else None
        if len(things) > 1:
            target = self._resolve(things[1], source)
            if target is not None:
                self.add(
                    context, Relation.ACROSS, source, target, target2=between, distance=distance
                )
            return
        if between is not None and not self.references.is_line(between):
            labels = [sense.label for sense in self.references.mentions[between].senses]
            if not any("water" in label or "bridge" in label for label in labels):
                self.add(context, Relation.ACROSS, source, between, distance=distance)
                return  # nobody crosses it: "across from the bank"
        if source not in self.goals:
            self.add(context, Relation.ACROSS, source, SPEAKER, target2=between, distance=distance)
        elif self.directive and between is not None and not self.references.is_road(between):
            self.add(context, Relation.ACROSS, source, LISTENER, target2=between, certainty=0.6)
        else:
            self.reason = NO_TARGET
            target = self._resolve(context.shared, source) if context.shared is not None else None
            if target is not None and not self.references.is_line(target):
                self.add(context, Relation.ACROSS, source, target, target2=between, certainty=0.8)

    def _between(self, place: Place, source: int, context: ClauseContext) -> None:
        """Relate "between the school and the river", "between two churches"."""
        things = place.targets
        if len(things) == 1 and things[0].count == 2:
            one = replace(things[0], count=None)
            things = (one, replace(one, determiner="ANOTHER"))
        nodes = [self._resolve(thing, source) for thing in things]
        known = [node for node in nodes if node is not None]
        if len(known) == 2 and known[0] != known[1]:
            self.add(context, Relation.BETWEEN, source, known[0], target2=known[1])
        elif known:
            self.add(context, Relation.NEAR, source, known[0], certainty=WEAK)

    def _at_both(self, place: Place, source: int, context: ClauseContext) -> None:
        """Relate "where Penn Avenue meets 6th Street"."""
        for thing in place.targets:
            target = self._resolve(thing, source)
            if target is not None:
                self.add(context, Relation.NEAR, source, target)

    def _with_(self, place: Place, source: int, context: ClauseContext) -> int | None:
        """Relate "a park with a pond": what follows is said of the pond."""
        target = self._resolve(place.targets[0], source)
        if target is not None:
            self.add(context, Relation.NEAR, target, source, certainty=WEAK)
        return target

    def _of(self, place: Place, source: int, context: ClauseContext) -> None:
        """Relate "the entrance of the park", but not "join me for coffee"."""
        distance = place.distance
        if distance is None and (source == SPEAKER or place.targets[0].kind != "thing"):
            self.reason = NO_TARGET
            return
        target = self._resolve(place.targets[0], source)
        if target is not None:
            sure = 1.0 if distance else WEAK
            self.add(context, Relation.NEAR, source, target, distance=distance, certainty=sure)

    def _start(self, place: Place, source: int, context: ClauseContext) -> None:
        """Relate "two blocks from the station"; a bare "from the station" opens a walk."""
        if place.distance is None:
            self.reason = "where a walk starts"
        else:
            self._of(place, source, context)

    def _away(self, place: Place, source: int, context: ClauseContext) -> None:
        """Relate "two blocks away"."""
        target = self._implied_target(source, context)
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
