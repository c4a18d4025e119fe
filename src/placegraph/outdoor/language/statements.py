"""Statements, and what they are made with: nodes, bearings, and why one was not made."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import TYPE_CHECKING

from placegraph.outdoor.language.description import LISTENER, SPEAKER, Relation, Statement

if TYPE_CHECKING:
    from placegraph.language.check import Ignored
    from placegraph.outdoor.language.lexicon import Direction
    from placegraph.outdoor.language.nodes import Thing
    from placegraph.outdoor.language.refer import Referents

BLOCK = 100.0
"""Metres in a block."""
SIDE_SIGMA = 0.6
"""How loosely "on the north side of" is meant [rad]."""
FROM_YOU = 0.8
"""Certainty that a direction of which nothing more is said is seen from the listener."""
LEGS = (0.5, 0.25, 0.15)
"""Certainty that the place lies in the direction of the first, second, third leg of a walk."""
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
    refer
        The mentions.
    heading
        Bearing in which the speaker faces [rad], or None.
    directive
        Whether the text tells somebody the way: directions are then seen from them.
    """

    def __init__(self, refer: Referents, heading: float | None, *, directive: bool) -> None:
        self.refer, self.heading, self.directive = refer, heading, directive
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
        negated: bool = False,
        far: bool = False,
    ) -> None:
        """Add a statement, unless it relates a thing to itself."""
        if source == target or (source in self.goals and target in self.goals):
            self.reason = "relates a thing to itself"
            return
        refer = self.refer
        for node in (source, target, target2):
            negated = negated or (node is not None and node in refer.negative)
        self.statements.append(
            Statement(
                relation,
                source,
                target,
                target2=target2,
                bearing=None if direction is None else direction.bearing % (2.0 * pi),
                bearing_sigma=0.5 if direction is None else direction.sigma,
                distance=distance,
                negated=negated or said.negated,
                certainty=round(
                    certainty * said.certainty * (direction.certainty if direction else 1.0), 3
                ),
                far=far or said.travel or LISTENER in (source, target),
                text=said.text,
            )
        )

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
