"""What places say of things and of the speaker: "in the corner", "next to the sofa", "behind me"."""

from __future__ import annotations

from placegraph.indoor.language.parse import Noun, Where
from placegraph.indoor.language.sentence import ME, Kind
from placegraph.indoor.language.statements import Statements, looks_of

PARTS = {
    "corner": "in the corner", "corners": "in the corner", "middle": "in the middle",
    "centre": "in the middle", "center": "in the middle",
}  # fmt: skip
"""Parts of a room, as `looks.toml` knows them."""
_BY_WALL = ("against", "next to", "along", "on")
_BESIDES = frozenset(("behind", "above", "under", "left of", "right of", "attached to", "against"))
"""Relations of the speaker to a thing that tell no more than that it is near."""


class Places(Statements):
    """Collects statements, and knows what places state."""

    def _put(self, subject: int, place: Where, anchor: int) -> int:
        """State a place of a subject; returns what a place right after it is said of."""
        match place.how:
            case "towards" | "here" | "sight":
                return self._direct(anchor if anchor >= 0 else subject, place)
            case "alone":
                return self._beside_it(subject, place)
            case "row" | "related" if self._stands(subject, place):
                return anchor
        nodes = [self.node(thing, other_than=subject) for thing in place.things]
        targets = [node for node in nodes if node is not None]
        if None in nodes or (subject >= 0 and subject in targets):
            self.ignore(
                [place], "relates a thing to itself" if subject in targets else "says no thing"
            )
            return anchor
        if any(t < 0 for t in targets):
            return self._to_me(subject, place, targets, anchor)
        if place.how == "faces":
            self.state(
                Kind.TOWARDS, (targets[0],), place, bearing=place.bearing, negated=place.negated
            )
            return targets[0]
        if place.how == "between":
            return self._between(subject, place, targets)
        room = self.mentions[targets[0]].room
        if room and (place.relation == "in" or subject == ME):
            self.state(Kind.ROOM, (targets[0],), place, negated=place.negated)
            return subject
        if subject < 0:
            self._near(place, targets[0])
            return targets[0]
        self._relate(subject, place, targets[0])
        return targets[0]

    def _stands(self, subject: int, place: Where) -> bool:
        """Note where in the room a thing stands, "in the corner", or that it is "in red"."""
        if place.how == "row":
            self.look(subject, ("in a row",))
            return True
        if subject < 0 or place.how != "related":
            return False
        target = place.things[0]
        part = " ".join(chunk.words for chunk in target.words)
        if target.kind == "PART":
            if not place.negated and part in PARTS:
                self.look(subject, (PARTS[part],))
            return True  # "at the end" says no more
        attributes = looks_of(target)
        if attributes and place.relation == "in":
            self.look(subject, attributes)
            return True
        wall = part.endswith(("wall", "walls"))
        if place.relation in _BY_WALL and wall and not place.negated:
            self.look(subject, ("against the wall",))
            return True
        return False

    def _beside_it(self, subject: int, place: Where) -> int:
        """As "with a mirror above": of what was spoken of before."""
        other = next((row for row in reversed(self._spoken) if row != subject), None)
        if subject < 0 or other is None or self.mentions[other].room:
            self.ignore([place], "says no thing")
        else:
            self._relate(subject, place, other)
        return subject

    def _direct(self, subject: int, place: Where) -> int:
        """As "on my left", "next to me", "in sight" of a thing."""
        if subject < 0:
            if place.how == "towards":
                self.ignore([place], "says no thing")
            return subject
        kinds = {"towards": Kind.TOWARDS, "here": Kind.NEAR, "sight": Kind.HOLDS}
        self.state(
            kinds[place.how], (subject,), place, bearing=place.bearing, distance=place.distance,
            negated=place.negated,
        )  # fmt: skip
        return subject

    def _to_me(self, subject: int, place: Where, targets: list[int], anchor: int) -> int:
        """What is said of a thing by where I am: "left of me", "far from me"; or of the room."""
        if ME in targets and subject >= 0 and place.how in ("related", "far"):
            kind = Kind.NEAR if place.how == "related" else Kind.FAR
            self.state(kind, (subject,), place, distance=place.distance, negated=place.negated)
        elif subject != ME or place.relation != "in":
            self.ignore([place], "says no thing")
        return anchor

    def _between(self, subject: int, place: Where, targets: list[int]) -> int:
        two = tuple(targets) if len(targets) == 2 else (targets[0], targets[0])
        if subject < 0:
            self.state(Kind.BETWEEN, two, place, negated=place.negated)
        else:
            for target in dict.fromkeys(two):
                self.state(
                    Kind.RELATED, (subject, target), place, relation="next to",
                    negated=place.negated,
                )  # fmt: skip
        return subject

    def _near(self, place: Where, target: int) -> None:
        """Where I am by one thing."""
        if place.how == "far":
            self.state(Kind.FAR, (target,), place, negated=place.negated)
            return
        relation = "" if place.relation in ("next to", "") else place.relation
        self.state(
            Kind.NEAR, (target,), place, relation="" if relation in _BESIDES else relation,
            distance=place.distance, negated=place.negated,
        )  # fmt: skip

    def _relate(self, subject: int, place: Where, target: int) -> None:
        if place.how == "far":
            self.state(
                Kind.RELATED, (subject, target), place, relation="next to",
                negated=not place.negated,
            )  # fmt: skip
            return
        self.state(
            Kind.RELATED, (subject, target), place, relation=place.relation or "next to",
            negated=place.negated, distance=place.distance,
        )  # fmt: skip

    def _hold(self, node: int, item: Noun) -> None:
        self.state(Kind.ROOM if self.mentions[node].room else Kind.HOLDS, (node,), item)
