"""Places said of things become statements."""

from __future__ import annotations

from dataclasses import replace
from math import pi

from placegraph.language.check import Ignored
from placegraph.language.measures import Measure
from placegraph.outdoor.language.description import LISTENER, SPEAKER, Relation
from placegraph.outdoor.language.parse import Place, Thing
from placegraph.outdoor.language.statements import (
    LISTENER_HEADING,
    NEEDS_HEADING,
    NO_TARGET,
    PASSED,
    ROUTE,
    WEAK,
    Directions,
    Said,
)
from placegraph.outdoor.language.words import Direction

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

    def relate(self, place: Place, source: int, said: Said) -> int | None:
        """Add the statements of a place said of a source; return the node it now speaks of.

        That is the source, or what it was said to stand at ("I'm at a cafe ...").
        """
        before, self.reason = len(self.statements), "says nothing about where things stand"
        changed: int | None = getattr(self, f"_{place.how}")(place, source, said)
        if len(self.statements) == before or self.reason == NEEDS_HEADING:
            left_out = Ignored(self.refer.text[place.start : place.end], self.reason)
            if left_out not in self.ignored[-1:]:
                self.ignored.append(left_out)
        if place.negated:
            self.statements[before:] = [replace(s, negated=True) for s in self.statements[before:]]
        return source if changed is None else changed

    def _at(self, place: Place, source: int, said: Said) -> int | None:
        thing = place.targets[0]
        if len(place.targets) > 1 and thing.part:
            self._part(place, source, said)
            return None
        target = self._target(thing, source)
        if target is None:
            return None
        if len(place.targets) > 1:
            whole = self._target(place.targets[1], target)
            if whole is not None:
                self.add(said, Relation.NEAR, target, whole, certainty=WEAK)
        relation, certainty = self._at_relation(place.word, target, source, said)
        self.add(said, relation, source, target, distance=place.distance, certainty=certainty)
        if source == SPEAKER and not (said.negated or place.negated or said.travel):
            if relation is Relation.SAME:
                self.goals.add(target)
                return target
            if relation is Relation.INSIDE and self.directive and len(self.goals) == 1:
                self.goals.add(target)  # "I'm in a garden. It is ..."
        return None

    def _at_relation(
        self, word: str, target: int, source: int, said: Said
    ) -> tuple[Relation, float]:
        line = self.refer.is_line(target)
        if said.travel:
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

    def _part(self, place: Place, source: int, said: Said) -> None:
        """Relate "at the end of the street", "in the middle of the park"."""
        part, whole = place.targets
        target = self._target(whole, source)
        if target is None:
            return
        if part.part == "block":
            self.add(said, Relation.NEAR, source, target, distance=BLOCK, certainty=0.8)
        elif part.part == "same_side":
            self.reason = "a side of a street without a direction"
        elif self.refer.is_line(target):
            self.add(said, Relation.ALONG, source, target, distance=place.distance)
        elif part.part in ("middle", "floor"):
            self.add(said, Relation.INSIDE, source, target)
        else:
            self.add(said, Relation.NEAR, source, target, distance=place.distance)

    def _prep(self, place: Place, source: int, said: Said) -> int | None:
        if len(place.targets) > 1 and place.targets[0].part:
            place = replace(place, targets=place.targets[1:])
        thing, word = place.targets[0], place.word
        target = self._target(thing, source)
        if target is None:
            return None
        if word in ("front", "behind") and target == SPEAKER:
            seen = self._bearing(Direction(pi if word == "behind" else 0.0, facing=True))
            if seen is None:
                self._at_hand(source, target, said)
            else:
                self.add(
                    said, Relation.DIRECTION, source, target,
                    direction=seen, distance=place.distance,
                )  # fmt: skip
        elif word in ("front", "behind") and target == LISTENER:
            self.reason = LISTENER_HEADING
        elif word == "surrounded":
            self.add(said, Relation.NEAR, target, source)
        elif word in ("past", "before", "toward"):
            far = said.travel or word == "toward"
            sure = ROUTE if far else 0.8 if place.distance else PASSED
            self.add(
                replace(said, travel=far), Relation.NEAR, source, target,
                distance=place.distance, certainty=sure,
            )  # fmt: skip
        else:
            relation, certainty, distance = _SIMPLE.get(word, (Relation.NEAR, 1.0, None))
            if relation is Relation.ALONG and not self.refer.is_line(target):
                certainty = 0.8
            self.add(
                said, relation, source, target,
                distance=place.distance or distance, certainty=certainty,
            )  # fmt: skip
            if relation is Relation.SAME and source in self.goals:
                return target
        return None

    def _bare(self, place: Place, source: int, said: Said) -> int | None:
        """Relate "a bank opposite", of the speaker where nothing more is said."""
        if source in self.goals:
            self.reason = NO_TARGET
            return None
        me = Thing("ME", place.start, place.end)
        return self._prep(replace(place, targets=(me,)), source, said)

    def _across(self, place: Place, source: int, said: Said) -> None:
        between: int | None = None
        if place.targets:
            between = self.refer.resolve(place.targets[0])
        if len(place.targets) > 1:
            target = self._target(place.targets[1], source)
            if target is not None:
                self.add(
                    said, Relation.ACROSS, source, target,
                    target2=between, distance=place.distance,
                )  # fmt: skip
            return
        if between is not None and not self._can_be_crossed(between):
            self.add(said, Relation.ACROSS, source, between, distance=place.distance)
            return
        if source not in self.goals:
            self.add(
                said, Relation.ACROSS, source, SPEAKER, target2=between, distance=place.distance
            )
        elif self.directive and between is not None and not self.refer.is_road(between):
            self.add(said, Relation.ACROSS, source, LISTENER, target2=between, certainty=0.6)
        else:
            self.reason = NO_TARGET
            target = self._target(said.shared, source) if said.shared is not None else None
            if target is not None and not self.refer.is_line(target):
                self.add(said, Relation.ACROSS, source, target, target2=between, certainty=0.8)

    def _can_be_crossed(self, node: int) -> bool:
        labels = [sense.label for sense in self.refer.mentions[node].senses]
        return self.refer.is_line(node) or any(
            "water" in label or "bridge" in label for label in labels
        )

    def _between(self, place: Place, source: int, said: Said) -> None:
        things = place.targets
        if len(things) == 1 and things[0].count == 2:  # "between two churches"
            one = replace(things[0], count=None)
            things = (one, replace(one, determiner="ANOTHER"))
        nodes = [self._target(thing, source) for thing in things]
        known = [node for node in nodes if node is not None]
        if len(known) == 2 and known[0] != known[1]:
            self.add(said, Relation.BETWEEN, source, known[0], target2=known[1])
        elif known:
            self.add(said, Relation.NEAR, source, known[0], certainty=WEAK)

    def _at_both(self, place: Place, source: int, said: Said) -> None:
        """Relate "where Penn Avenue meets 6th Street"."""
        for thing in place.targets:
            target = self._target(thing, source)
            if target is not None:
                self.add(said, Relation.NEAR, source, target)

    def _with_(self, place: Place, source: int, said: Said) -> int | None:
        """Relate "a park with a pond": what follows is said of the pond."""
        target = self._target(place.targets[0], source)
        if target is not None:
            self.add(said, Relation.NEAR, target, source, certainty=WEAK)
        return target

    def _of(self, place: Place, source: int, said: Said) -> None:
        vague = source == SPEAKER or place.targets[0].kind != "thing"
        if vague and place.distance is None:  # "join me for coffee"
            self.reason = NO_TARGET
            return
        target = self._target(place.targets[0], source)
        if target is not None:
            self.add(
                said, Relation.NEAR, source, target,
                distance=place.distance, certainty=1.0 if place.distance else WEAK,
            )  # fmt: skip

    def _start(self, place: Place, source: int, said: Said) -> None:
        """Relate "two blocks from the station"; a bare "from the station" opens a walk."""
        if place.distance is None:
            self.reason = "where a walk starts"
            return
        self._of(place, source, said)

    def _away(self, place: Place, source: int, said: Said) -> None:
        """Relate "two blocks away"."""
        target = self._implied(source, said)
        if said.travel:
            self.reason = "a distance without a direction"
        elif target is not None:
            self.add(said, Relation.NEAR, source, target, distance=place.distance)

    def _nearby(self, place: Place, source: int, said: Said) -> None:
        if source in self.goals:
            self.reason = NO_TARGET
        else:
            self.add(said, Relation.NEAR, source, SPEAKER, distance=place.distance)

    def _here(self, _place: Place, source: int, said: Said) -> None:
        if source in self.goals:
            self.reason = NO_TARGET
        else:
            self.add(said, Relation.VISIBLE, source, SPEAKER)
