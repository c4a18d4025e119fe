"""Mentions and statements: the nodes and edges of a query graph, read of phrases (Eq. 4)."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, replace
from math import pi
from typing import TYPE_CHECKING

from placegraph.language.text import IgnoredText, Measure
from placegraph.outdoor.language.description import (
    LISTENER,
    SPEAKER,
    Direction,
    Mention,
    Relation,
    Sense,
    Statement,
)
from placegraph.outdoor.language.grammar import NounPhrase, Place
from placegraph.outdoor.language.proper_names import LONGEST_NOUN
from placegraph.outdoor.language.vocabulary import Vocabulary
from placegraph.outdoor.language.words import normalise, singular, tokens

if TYPE_CHECKING:
    from placegraph.outdoor.language.languages import Language

_NEW = frozenset(("A", "ANOTHER", "NO", "NUM"))
"""Determiners that introduce a thing; the others, and none, may speak of one already known."""
RANKS = frozenset(("first", "second", "third", "fourth", "last", "largest", "biggest", "smallest"))
"""Words that tell a thing from others of its kind, which no statement does."""
TYPING_ERROR = 0.8
"""Similarity from which an unknown word counts as a misspelt known one."""
GENERIC = 0.7
"""Probability that a "sandwich place" means the same as "sandwich" alone."""


class References:
    """The mentions of a text, in the order in which they are introduced.

    Parameters
    ----------
    vocabulary
        To mend misspelt words.
    sites
        Names of crossings and houses.
    """

    def __init__(
        self, text: str, language: Language, vocabulary: Vocabulary, sites: Collection[str] = ()
    ) -> None:
        self.text, self.language, self.vocabulary = text, language, vocabulary
        self.sites = sites
        self.lists = language.lists
        self.mentions: list[Mention] = [Mention(SPEAKER, "I"), Mention(LISTENER, "you")]
        self.heads: list[str] = ["", ""]
        """Common noun of every mention, in the singular."""
        self.modifiers: list[frozenset[str]] = [frozenset(), frozenset()]
        """Words before the noun."""
        self.negative: set[int] = set()
        """Mentions of what is said not to be there."""
        self.kinds: set[int] = set()
        """Mentions by a label as a map has it, which stands for any thing of its kind."""
        self.topic: int | None = None
        """Row of the mention that "it" refers to."""
        self.street: int | None = None
        """The street that was spoken of last."""

    def resolve(self, noun: NounPhrase, *, other_than: Iterable[int] = ()) -> int | None:
        """Return the node of a thing; None for a part ("the corner") that is no thing itself."""
        if noun.kind in ("ME", "SPOT", "HERE"):
            return SPEAKER
        if noun.kind == "YOU":
            return LISTENER
        if noun.kind == "IT":
            return SPEAKER if self.topic is None else self.topic
        if noun.part and not noun.name:
            return None
        head, senses = singular(noun.head), noun.senses
        if not senses and not noun.name:
            head, senses = self._guess_senses(noun.head)
            if not senses and not noun.determiner:
                return None  # an unknown word, and no sign that it is a noun
        known = None if noun.determiner in _NEW else self._find(noun, head, senses, other_than)
        return self._introduce(noun, head, senses) if known is None else known

    def _guess_senses(self, words: str) -> tuple[str, tuple[Sense, ...]]:
        """Return noun and senses of unknown words: misspelt, or before a noun that says nothing."""
        if len(words) > LONGEST_NOUN:
            return words, ()
        whole = self.vocabulary.senses(words)
        if whole and " " in words:
            return singular(words), whole
        rest, _, last = words.rpartition(" ")
        found = self.vocabulary.closest(last, cutoff=TYPING_ERROR)
        if found is None and rest and last in self.lists["generic"]:
            found = (rest.rpartition(" ")[2], GENERIC)
        if found is None:
            return singular(last), ()
        senses = self.vocabulary.senses(found[0])
        return singular(found[0]), tuple([Sense(s.label, s.weight * found[1]) for s in senses])

    def _find(
        self, noun: NounPhrase, head: str, senses: tuple[Sense, ...], other_than: Iterable[int]
    ) -> int | None:
        """Return the mention that a name or a definite noun speaks of again, or None."""
        skipped = {*other_than, *self.negative}
        nodes = [n for n in range(len(self.mentions) - 1, LISTENER, -1) if n not in skipped]
        if noun.name:
            name = name_key(noun.name)
            return next((n for n in nodes if name_key(self.mentions[n].name) == name), None)
        modifiers = frozenset(noun.modifiers) - {"same"}
        for n in nodes:  # "the lot" is the parking lot
            longer = not noun.exact and self.heads[n].endswith(f" {head}")
            if (longer or self.heads[n] == head) and modifiers <= self.modifiers[n]:
                return n
        if noun.exact:
            return None
        if head in self.lists["roads"]:
            return next((n for n in nodes if self.is_road(n)), None)
        labels = {sense.label for sense in senses[:2]}
        for n in nodes:
            mention = self.mentions[n]
            if mention.name and labels & {sense.label for sense in mention.senses[:2]}:
                return n
        return None

    def _introduce(self, noun: NounPhrase, head: str, senses: tuple[Sense, ...]) -> int:
        node = len(self.mentions)
        words = self.text[noun.start : noun.end]
        definite = noun.determiner in ("DET", "THIS", "MY", "YOUR", "ITS") or bool(noun.name)
        count = noun.count if noun.count is not None and noun.count >= 2 else None
        self.mentions.append(Mention(node, words, senses, noun.name, count, definite))
        self.heads.append(head)
        self.modifiers.append(frozenset(noun.modifiers) - {"same"})
        if noun.exact and not noun.name:
            self.kinds.add(node)
        if noun.determiner == "NO":
            self.negative.add(node)
        if self.is_road(node):
            self.street = node
        return node

    def list_unknown(self) -> list[IgnoredText]:
        """Return the things of which nothing is known, or that are one of several, with the reason."""
        found = []
        for mention in self.mentions[LISTENER + 1 :]:
            if not (mention.senses or mention.name):
                why = self.vocabulary.explain_unknown(self.heads[mention.id])
                found.append(IgnoredText(mention.words, why))
            elif not RANKS.isdisjoint(self.modifiers[mention.id]):
                found.append(IgnoredText(mention.words, RANKED))
        return found

    def is_known(self, node: int) -> bool:
        """Tell whether a mention has a name, or a noun that a map knows."""
        return bool(self.mentions[node].senses or self.mentions[node].name)

    def is_road(self, node: int) -> bool:
        """Tell whether a mention is a street, by its name or its noun."""
        if self.mentions[node].name in self.sites:
            return False
        name = tokens(self.mentions[node].name)
        if len(name) > 2 and name[0].isdecimal():
            return False  # a house: "125 Main Street"
        return self.heads[node] in self.lists["roads"] or self.language.is_road(name)

    def is_line(self, node: int) -> bool:
        """Tell whether a mention is a road, a river or another line, on which one is along it."""
        key, value = self._first_label(node)
        lists = self.lists
        return self.is_road(node) or (key in lists["line_keys"] and value not in lists["no_lines"])

    def is_area(self, node: int) -> bool:
        """Tell whether a mention is a park, a square or another area, on which one is inside."""
        return node > LISTENER and self._first_label(node)[0] in self.lists["area_keys"]

    def _first_label(self, node: int) -> tuple[str, str]:
        senses = self.mentions[node].senses
        key, _, value = senses[0].label.partition("=") if senses else ("", "", "")
        return key, value


def name_key(name: str) -> str:
    """Return a name in normal form, without an article."""
    return normalise(name).removeprefix("the ")


BlockLength = Callable[[float | None], float]
"""Length of a block [m] in the direction of a bearing [rad], or in any (None)."""

SIDE_SIGMA = 0.6
"""Standard deviation of "on the north side of" [rad]."""
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
BESIDE = Measure.within(30.0)
"""Greatest distance [m] of "on the north side of"."""
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
LISTENER_HEADING = "needs the heading of the listener"
NO_MAP = "is never on a map"
NO_TARGET = "does not say relative to what"
NO_PLACE = "does not locate any object"
UNKNOWN = "unknown word"
RANKED = "which of several it is cannot be used"
OF_A_WALK = "left and right along a walk have no fixed direction on a map"
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


class PlaceReader:
    """Reader of places as statements; the rule of the grammar that a place has names the method.

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
        self.ignored: list[IgnoredText] = []
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

    def _resolve(self, noun: NounPhrase, source: int) -> int | None:
        """Return the node of a target; None, with a reason, where there is none."""
        node = self.references.resolve(noun)
        if node == source and noun.kind == "thing":  # "the bench is north of the bench"
            node = self.references.resolve(noun, other_than=(source,))
        if node is None:
            self.reason = NO_MAP if noun.part else UNKNOWN
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

    def relate(self, place: Place, source: int, context: ClauseContext) -> int | None:
        """Add the statements of a place said of a source; return the node it now speaks of.

        That is the source, or what it was said to stand at ("I'm at a cafe ...").
        """
        before, self.reason = len(self.statements), NO_PLACE
        changed: int | None = getattr(self, f"_{place.how}")(place, source, context)
        if len(self.statements) == before or self.reason == NEEDS_HEADING:
            left_out = IgnoredText(self.references.text[place.start : place.end], self.reason)
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
        whole, topic = self.references.street, self.references.topic
        if not place.targets:
            if topic is not None and not self.directive and self.references.is_area(topic):
                whole = topic  # "Elm Park. North side."
            if place.direction.facing or whole is None or source not in self.goals:
                self._towards(place, source, context)
            else:
                wide = place.direction._replace(sigma=SIDE_SIGMA)
                beside = BESIDE if whole == topic else None
                self._add_direction(context, source, whole, wide, distance=beside, certainty=0.6)
            return
        target = self._resolve(place.targets[0], source)
        if target is not None:
            wide = place.direction._replace(sigma=max(place.direction.sigma, SIDE_SIGMA))
            beside = BESIDE if target > LISTENER else None
            self._add_direction(context, source, target, wide, distance=beside, certainty=0.9)

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
        self.reason = "only says the viewing direction"

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
        """Return the relation of "on", "in", "at" or "to" with a target, and its certainty."""
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
            self.reason = "only says where a walk starts"
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
