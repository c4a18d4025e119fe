"""What kind of item a thing or a place is, and which of its neighbours it belongs to."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import atan2, cos, hypot, pi, sin
from typing import TYPE_CHECKING

from placegraph.language.grammar import Clause, PlacePhrase
from placegraph.language.text import Ignored
from placegraph.outdoor.language.description import LISTENER, SPEAKER, Direction, Relation
from placegraph.outdoor.language.grammar import Item, Items, NounPhrase, Place
from placegraph.outdoor.language.references import Referents
from placegraph.outdoor.language.relations import (
    LEGS,
    NO_MAP,
    ROUTE,
    UNKNOWN,
    WALKED,
    BlockLength,
    ClauseContext,
    Relator,
)
from placegraph.outdoor.language.words import Words

if TYPE_CHECKING:
    from placegraph.outdoor.language.languages import Language


def placed(places: Items, after: Items) -> Items:
    """Put places before a verb behind the things after it: "south of me are a school and a park"."""
    n = next((i for i, item in enumerate(after) if isinstance(item, PlacePhrase)), len(after))
    return (*after[:n], *places, *after[n:])


def joins(last: Place, thing: NounPhrase, heads: Sequence[int], following: Item | None) -> bool:
    """Tell whether a thing after a place is one more of its targets."""
    mine = isinstance(following, PlacePhrase) and (
        following.owner == "MY" or any(thing.kind == "ME" for thing in following.targets)
    )
    listed = not mine and (bool(heads) or not isinstance(following, PlacePhrase))
    things = bool(last.targets) and last.targets[-1].kind == thing.kind == "thing"
    return listed and things and last.how != "between"


def shared(item: Place, last: Place | None, following: Item | None) -> NounPhrase | None:
    """Target of the direction beside one that names none, or of "..., across the street"."""
    if (
        item.how == "across"
        and len(item.targets) < 2
        and isinstance(last, PlacePhrase)
        and last.targets
    ):
        return last.targets[-1] if last.how in ("towards", "prep") else None
    if item.how != "towards" or item.targets:
        return None
    for other in (following, last):
        if isinstance(other, PlacePhrase) and other.targets and other.how in ("towards", "start"):
            return other.targets[0]
        if isinstance(other, PlacePhrase) and other.how == "across" and len(other.targets) == 2:
            return other.targets[1]
    return None


def is_person(item: Item) -> bool:
    """Tell whether an item is no thing of the map: somebody, "it", "here"."""
    return isinstance(item, NounPhrase) and item.kind != "thing"


def is_leg(item: Item) -> bool:
    """Tell whether a place may be a further leg of a way: "then 500 m north"."""
    if not isinstance(item, PlacePhrase) or item.distance is None:
        return False
    return item.how in ("towards", "away") and not item.targets


def has_no(item: Item) -> bool:
    """Tell whether a thing is context not to be there: "no trees"."""
    return isinstance(item, NounPhrase) and item.determiner == "NO"


def is_bare_word(items: Items) -> bool:
    """Tell whether a clause is one word with a capital that nothing is known of."""
    thing = items[0]
    return (
        len(items) == 1
        and isinstance(thing, NounPhrase)
        and bool(thing.name)
        and not thing.senses
        and " " not in thing.name
    )


def arrived(item: Item) -> Item:
    """Take "come to the garden" as meeting at the garden."""
    return replace(item, word="AT") if isinstance(item, PlacePhrase) and item.word == "TO" else item


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
    """Whether the length of every leg but the last was context."""
    measured: bool = True
    """Whether the length of the last leg was context."""
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


def _measured(items: Items) -> Iterator[Item]:
    """Places of a leg, "south" and "8 blocks" taken as one."""
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
    """What a text says of a walk, leg by leg."""

    def __init__(self, relator: Relator) -> None:
        self.relator, self.refer = relator, relator.refer
        self.way = Legs()
        self.legs = 0
        self.told = 0
        """How often the end of a measured way was told; each time replaces the one before."""
        self.on_the_way: int | None = None
        """What was last context to be met on the way."""
        self.led_to: int | None = None
        """Where the walk was last context to lead."""

    def go(self, items: Items, travel: str, context: ClauseContext) -> None:
        """A leg of a walk to the place: where it leads, and what lies on the way."""
        context = replace(context, travel=True)
        for item in _measured(items):
            if isinstance(item, NounPhrase):
                self._meet_on_the_way(item, travel, context)
            elif item.how == "start" and item.distance is None:
                self.starts_at(item.targets[0])
            elif item.how in ("towards", "away") and not item.targets:
                self._leg(item, context)
            elif item.how in ("at", "prep", "across", "towards", "with_", "of"):
                sure = context.certainty * (ROUTE if item.how != "prep" else 1.0)
                if item.how == "prep" and item.word not in ("past", "before", "toward"):
                    sure *= ROUTE
                self.relator.relate(item, SPEAKER, replace(context, certainty=sure))
                self._pass(item)
            else:
                self.relator.reason = "a route instruction"

    def starts_at(self, thing: NounPhrase) -> None:
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

    def _leg(self, place: Place, context: ClauseContext) -> None:
        if place.how == "towards" and not self.way.turn(place.direction):
            self.relator.reason = "left and right of a walk say nothing on a map"
            return
        if place.distance is not None and self.way.heading is not None:
            self.way.walk(self.relator.length(place.distance, self.way.heading) or 0.0)
            if self._ends(context):
                return
        if place.how == "away" or place.direction.facing:
            self.relator.reason = "a route instruction"
            return
        sure = context.certainty * LEGS[min(self.legs, len(LEGS) - 1)]
        self.legs += 1
        self.relator.add(
            replace(context, certainty=sure), Relation.DIRECTION, SPEAKER, LISTENER,
            direction=place.direction._replace(sigma=max(0.7, place.direction.sigma)),
        )  # fmt: skip

    def _ends(self, context: ClauseContext) -> bool:
        """Say where the walk so far ends, in place of where it ended before."""
        end = self.way.way()
        if end is None:
            return False
        statements = self.relator.statements
        before = statements[self.way.row].text if self.way.row is not None else ""
        text = f"{before}, {context.text}" if before and before != context.text else context.text
        self.relator.add(
            replace(context, text=text), Relation.DIRECTION, SPEAKER, self.way.start,
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

    def _meet_on_the_way(self, thing: NounPhrase, travel: str, context: ClauseContext) -> None:
        node = self.refer.resolve(thing)
        if node is None or node <= LISTENER:
            self.relator.reason = "a route instruction"
            return
        self.on_the_way = node
        if travel == "CROSS" and not self.refer.is_road(node):
            self.relator.add(
                context, Relation.ACROSS, SPEAKER, LISTENER, target2=node, certainty=0.5
            )
        elif travel == "FOLLOW" and self.refer.is_line(node):
            self.relator.add(context, Relation.ALONG, SPEAKER, node, certainty=ROUTE)
        else:
            self.relator.add(context, Relation.NEAR, SPEAKER, node, certainty=ROUTE)
        if travel == "REACH":
            self.starts_at(thing)

    def look_back(self, items: Items, context: ClauseContext) -> None:
        """Look back in "you've gone too far west": the place lies east of what was met."""
        for item in items:
            if not isinstance(item, PlacePhrase) or item.how != "towards" or item.direction.facing:
                continue
            if self.on_the_way is not None:
                back: Direction = item.direction._replace(bearing=item.direction.bearing + pi)
                self.relator.add(
                    replace(context, travel=True), Relation.DIRECTION, SPEAKER, self.on_the_way,
                    direction=back, certainty=0.6,
                )  # fmt: skip


MENTIONED = 0.7
"""Certainty that a thing is in sight that is only named."""
LED = 0.5
"""Certainty that the place is where the walk leads."""
SHOWN = 0.6
"""Certainty that what "you will see" can be seen from the place itself."""


class Builder:
    """Takes the clauses of a text one after the other.

    Parameters
    ----------
    vocabulary
        To mend misspelt words.
    heading
        Bearing in which the speaker faces [rad], or None.
    directive
        Whether the text tells somebody the way; "it" is then the place they are told to find.
    block_length
        See `Statements`.
    """

    def __init__(
        self,
        text: str,
        language: Language,
        vocabulary: Words,
        heading: float | None,
        *,
        directive: bool,
        block_length: BlockLength | None = None,
    ) -> None:
        self.text, self.directive = text, directive
        self.refer = Referents(text, language, vocabulary)
        self.relator = Relator(self.refer, heading, directive=directive, block_length=block_length)
        self.walk = Walk(self.relator)
        self.ignored = self.relator.ignored
        self.heads: list[int] = [SPEAKER]
        """What the last clause spoke of."""
        self.walking = False
        """Whether the last clause led somewhere."""

    def take(self, clause: Clause, certainty: float, *, opens: bool) -> None:
        """Add what a clause says; `opens` tells whether it opens a sentence."""
        words = self.text[clause.start : clause.end]
        context = ClauseContext(words, certainty, clause.negated, walked=self.walk.legs > 0)
        before = self._told()
        self.relator.reason = "says nothing about where things stand"
        if clause.condition:
            self._on_the_way(clause, context)
        elif clause.verb:
            getattr(self, f"_{clause.verb}")(clause, context, opens)
            if clause.verb != "goes":
                self.walk.join(before[0])
        else:
            self.relator.reason = "not understood"
        if self._told() == before and clause.verb != "too_far":
            self.ignored.append(Ignored(words, self.relator.reason))
        self.walking = clause.verb == "goes" or (self.walking and clause.verb == "fragment")
        self._remember()

    def _told(self) -> tuple[int, int, int]:
        """How much has been context, understood or not; it grows with every clause that tells anything."""
        return len(self.relator.statements), len(self.ignored), self.walk.told

    def finish(self) -> None:
        """Where nothing says where the speaker is, a walk leads there."""
        if self.directive and self.walk.led_to is not None and self.relator.goals == {SPEAKER}:
            mention = self.refer.mentions[self.walk.led_to]
            context = ClauseContext(mention.words)
            self.relator.add(context, Relation.SAME, SPEAKER, self.walk.led_to, certainty=LED)
            self.relator.goals.add(self.walk.led_to)

    def _remember(self) -> None:
        """Decide what "it" will mean in the next clause."""
        goal = [n for n in self.relator.goals if n != SPEAKER]
        if self.directive:
            self.refer.topic = max(goal, default=self.walk.led_to)
        elif self.heads and self.heads[0] > LISTENER:
            self.refer.topic = self.heads[0]
        elif goal:
            self.refer.topic = max(goal)
        elif len(self.refer.mentions) > 2:
            self.refer.topic = len(self.refer.mentions) - 1

    # clauses, by the rules of the grammar

    def _is_(self, clause: Clause, context: ClauseContext, _opens: bool) -> None:
        before, after = clause.before, clause.after
        if isinstance(before[0], PlacePhrase):  # "north of here is a bakery"
            if after and isinstance(after[0], NounPhrase):
                self._shown(placed(before, after), context)
            else:
                self._say((*before, *after), [SPEAKER], context)
            return
        heads = self._say(before, [], replace(context, negated=False))
        if not after:
            return
        if isinstance(after[0], NounPhrase):
            self._identity(heads, after[0], context)
            after = after[1:]
        self._say(after, heads, context)

    def _identity(self, heads: Sequence[int], thing: NounPhrase, context: ClauseContext) -> None:
        """Two names of one thing: "it is the last pub on the block"."""
        if thing.kind != "thing" or not (thing.senses or thing.name) or not heads:
            return
        bare = not thing.determiner and bool(self.refer.lists["articles"])
        if heads[0] == SPEAKER and bare and not thing.name:
            return  # "I'm buying flowers"
        node, subject = self.refer.resolve(thing), heads[0]
        if node is None or node == subject:
            return
        said_of = self.refer.mentions[subject]
        if subject > LISTENER and not (said_of.senses or said_of.name):  # "the nearest one is ..."
            self.relator.add(context, Relation.VISIBLE, node, SPEAKER)
            return
        self.relator.add(context, Relation.SAME, subject, node)
        if subject in self.relator.goals and not context.negated:
            self.relator.goals.add(node)

    def _exists(self, clause: Clause, context: ClauseContext, _opens: bool) -> None:
        places: Items = clause.before
        if places and is_person(places[-1]):
            if any(isinstance(item, PlacePhrase) for item in clause.after):
                self._say(
                    places[:-1], [SPEAKER], context
                )  # "facing north, I have a bar to my right"
                places = ()
            places = places[:-1]  # "to my right I have a bar"
        owner = places[0] if places else None
        if isinstance(owner, NounPhrase):
            places = clause.before[1:]
            if owner.kind == "thing" and clause.after and isinstance(clause.after[0], NounPhrase):
                if not self.directive:
                    self.refer.topic = self.refer.resolve(owner)
                has = PlacePhrase("at", owner.start, owner.end, (owner,), "TO")
                places = (*places, has)  # "the street has a bakery"
        self._shown(placed(places, clause.after), context)

    def _shown(self, items: Items, context: ClauseContext, *, always: bool = False) -> None:
        """Things that are context to be there, in sight of the speaker unless more is context."""
        if not items or not isinstance(items[0], NounPhrase):
            self._say(items, [SPEAKER], context)
            return
        first = len(self.relator.statements)
        heads = self._say(items, [], context, collect=True)
        made = self.relator.statements[first:]
        placed = {s.source for s in made}
        seen = {s.source for s in made if SPEAKER in (s.source, s.target)}
        for head in heads:
            mention = self.refer.mentions[head]
            if head in (seen if always else placed):
                continue
            if mention.senses or mention.name:
                self.relator.add(context, Relation.VISIBLE, head, SPEAKER)
            else:
                self.relator.reason = UNKNOWN

    def _sees(self, clause: Clause, context: ClauseContext, opens: bool) -> None:
        """What can be seen: "I see a church", "across the street you will find a bakery"."""
        things = [item for item in clause.before if isinstance(item, NounPhrase)]
        seer = things[-1] if things else None
        places = tuple([item for item in clause.before if item is not seer])
        after = clause.after
        if after and isinstance(after[0], NounPhrase) and after[0].kind == "ME":
            self._meets(clause, context, opens)  # "you will find me at the corner"
            return
        mine = seer is not None and seer.kind == "ME"
        sure = context.certainty if mine else context.certainty * SHOWN
        if any(isinstance(item, PlacePhrase) for item in (*places, *after)):
            sure = context.certainty if mine else context.certainty * 0.9
        self._shown(placed(places, after), replace(context, certainty=sure), always=mine)

    def _meets(self, clause: Clause, context: ClauseContext, _opens: bool) -> None:
        places = tuple([item for item in (*clause.before, *clause.after) if not is_person(item)])
        if places and isinstance(places[0], NounPhrase):  # "meet me the garden"
            thing = places[0]
            places = (PlacePhrase("at", thing.start, thing.end, (thing,), "AT"), *places[1:])
        if not places:  # "you will see a bank. Meet me there."
            if self.heads and self.heads[0] > LISTENER:
                self.walk.led_to = self.heads[0]
            self.finish()
            return
        self._say((*[arrived(place) for place in places[:1]], *places[1:]), [SPEAKER], context)

    def _goes(self, clause: Clause, context: ClauseContext, _opens: bool) -> None:
        subject = clause.before[0] if clause.before else None
        if isinstance(subject, NounPhrase) and subject.kind in ("thing", "IT", "SPOT"):
            heads = self._say(clause.before, [], context)  # "the road runs along a river"
            self._say(clause.after, heads, replace(context, certainty=context.certainty * 0.7))
            return
        places = tuple(item for item in clause.before if isinstance(item, PlacePhrase))
        self.walk.go((*places, *clause.after), clause.travel, context)
        if clause.travel == "REACH":  # "get to the entrance"
            self.walk.led_to = self.walk.on_the_way

    def _on_the_way(self, clause: Clause, context: ClauseContext) -> None:
        """What is met on the way: "when you see the bank", "until you reach Penn Avenue"."""
        if clause.verb == "meets":
            self._meets(clause, context, False)
            return
        items = clause.after or clause.before
        self.walk.go(items, clause.travel or "REACH", context)

    def _too_far(self, clause: Clause, context: ClauseContext, _opens: bool) -> None:
        self.walk.look_back(clause.after, context)

    def _fragment(self, clause: Clause, context: ClauseContext, opens: bool) -> None:
        items = clause.before
        goes_on = self.walking or (self.walk.way.row is not None and is_leg(items[0]))
        if isinstance(items[0], PlacePhrase) and goes_on and not opens:  # "then west"
            self.walk.go(items, "GO", context)
        elif isinstance(items[0], PlacePhrase):  # "..., but not near the church"
            self._say(items, [SPEAKER] if opens else self.heads, context)
        elif all(is_person(item) for item in items):
            self.relator.reason = "says nothing about where things stand"
        elif is_bare_word(items):
            self.relator.reason = UNKNOWN  # "Hello", "Qué": a capital alone makes no name
        else:
            bare = len(items) == 1 and not has_no(items[0])
            sure = (LED if self.directive else MENTIONED) if bare else 1.0
            self._shown(items, replace(context, certainty=context.certainty * sure))

    # the chain of things and places

    def _say(
        self, items: Items, heads: Sequence[int], context: ClauseContext, *, collect: bool = False
    ) -> list[int]:
        """Relate places to the things before them; return the things.

        A thing without a place of its own joins the target before it ("north of the school and the
        church"); one with a place is spoken of anew ("a bakery to my east and a stop across ...").
        """
        group, spoken = list(heads), list(heads)
        last: Place | None = None
        for i, item in enumerate(items):
            following = items[i + 1] if i + 1 < len(items) else None
            if isinstance(item, PlacePhrase):
                context.shared = shared(item, last, following)
                group = self._relate_all(item, group or [SPEAKER], context)
                last = item
            elif last is not None and joins(last, item, heads, following):
                again = replace(last, targets=(*last.targets[:-1], item))
                self._relate_all(again, group, context)
            elif (node := self._new_head(item)) is not None:
                if spoken and not self.directive:
                    self.refer.topic = spoken[-1]  # "a bakery ..., and a kiosk next to it"
                group = [*group, node] if last is None and i else [node]
                spoken.append(node)
                last = None
        self.heads = spoken if collect or len(spoken) <= 1 else spoken[:1]
        return spoken if collect or not group or group[0] in spoken else group

    def _new_head(self, thing: NounPhrase) -> int | None:
        node = self.refer.resolve(thing)
        if node is None:
            self.relator.reason = NO_MAP if thing.part else UNKNOWN
        return node

    def _relate_all(self, place: Place, group: Sequence[int], context: ClauseContext) -> list[int]:
        return [
            node
            for head in group
            if (node := self.relator.relate(place, head, context)) is not None
        ]
