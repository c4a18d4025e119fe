"""Clauses become a query graph: who stands where, as seen from whom (Eq. 3-4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from placegraph.language.check import Ignored
from placegraph.outdoor.language.description import LISTENER, SPEAKER, Relation
from placegraph.outdoor.language.items import (
    arrived,
    has_no,
    is_bare_word,
    is_leg,
    is_person,
    joins,
    placed,
    shared,
)
from placegraph.outdoor.language.parse import Clause, Items, Place, Thing
from placegraph.outdoor.language.refer import Referents
from placegraph.outdoor.language.relate import Relator
from placegraph.outdoor.language.statements import NO_MAP, UNKNOWN, BlockLength, Said
from placegraph.outdoor.language.walk import Walk
from placegraph.outdoor.language.words import Words

if TYPE_CHECKING:
    from placegraph.outdoor.language.languages import Language

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
        said = Said(words, certainty, clause.negated, walked=self.walk.legs > 0)
        before = self._told()
        self.relator.reason = "says nothing about where things stand"
        if clause.condition:
            self._on_the_way(clause, said)
        elif clause.verb:
            getattr(self, f"_{clause.verb}")(clause, said, opens)
            if clause.verb != "goes":
                self.walk.join(before[0])
        else:
            self.relator.reason = "not understood"
        if self._told() == before and clause.verb != "too_far":
            self.ignored.append(Ignored(words, self.relator.reason))
        self.walking = clause.verb == "goes" or (self.walking and clause.verb == "fragment")
        self._remember()

    def _told(self) -> tuple[int, int, int]:
        """How much has been said, understood or not; it grows with every clause that tells anything."""
        return len(self.relator.statements), len(self.ignored), self.walk.told

    def finish(self) -> None:
        """Where nothing says where the speaker is, a walk leads there."""
        if self.directive and self.walk.led_to is not None and self.relator.goals == {SPEAKER}:
            mention = self.refer.mentions[self.walk.led_to]
            said = Said(mention.words)
            self.relator.add(said, Relation.SAME, SPEAKER, self.walk.led_to, certainty=LED)
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

    def _is_(self, clause: Clause, said: Said, _opens: bool) -> None:
        before, after = clause.before, clause.after
        if isinstance(before[0], Place):  # "north of here is a bakery"
            if after and isinstance(after[0], Thing):
                self._shown(placed(before, after), said)
            else:
                self._say((*before, *after), [SPEAKER], said)
            return
        heads = self._say(before, [], replace(said, negated=False))
        if not after:
            return
        if isinstance(after[0], Thing):
            self._identity(heads, after[0], said)
            after = after[1:]
        self._say(after, heads, said)

    def _identity(self, heads: Sequence[int], thing: Thing, said: Said) -> None:
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
            self.relator.add(said, Relation.VISIBLE, node, SPEAKER)
            return
        self.relator.add(said, Relation.SAME, subject, node)
        if subject in self.relator.goals and not said.negated:
            self.relator.goals.add(node)

    def _exists(self, clause: Clause, said: Said, _opens: bool) -> None:
        places: Items = clause.before
        if places and is_person(places[-1]):
            if any(isinstance(item, Place) for item in clause.after):
                self._say(places[:-1], [SPEAKER], said)  # "facing north, I have a bar to my right"
                places = ()
            places = places[:-1]  # "to my right I have a bar"
        owner = places[0] if places else None
        if isinstance(owner, Thing):
            places = clause.before[1:]
            if owner.kind == "thing" and clause.after and isinstance(clause.after[0], Thing):
                if not self.directive:
                    self.refer.topic = self.refer.resolve(owner)
                has = Place("at", owner.start, owner.end, (owner,), "TO")
                places = (*places, has)  # "the street has a bakery"
        self._shown(placed(places, clause.after), said)

    def _shown(self, items: Items, said: Said, *, always: bool = False) -> None:
        """Things that are said to be there, in sight of the speaker unless more is said."""
        if not items or not isinstance(items[0], Thing):
            self._say(items, [SPEAKER], said)
            return
        first = len(self.relator.statements)
        heads = self._say(items, [], said, collect=True)
        made = self.relator.statements[first:]
        placed = {s.source for s in made}
        seen = {s.source for s in made if SPEAKER in (s.source, s.target)}
        for head in heads:
            mention = self.refer.mentions[head]
            if head in (seen if always else placed):
                continue
            if mention.senses or mention.name:
                self.relator.add(said, Relation.VISIBLE, head, SPEAKER)
            else:
                self.relator.reason = UNKNOWN

    def _sees(self, clause: Clause, said: Said, opens: bool) -> None:
        """What can be seen: "I see a church", "across the street you will find a bakery"."""
        things = [item for item in clause.before if isinstance(item, Thing)]
        seer = things[-1] if things else None
        places = tuple([item for item in clause.before if item is not seer])
        after = clause.after
        if after and isinstance(after[0], Thing) and after[0].kind == "ME":
            self._meets(clause, said, opens)  # "you will find me at the corner"
            return
        mine = seer is not None and seer.kind == "ME"
        sure = said.certainty if mine else said.certainty * SHOWN
        if any(isinstance(item, Place) for item in (*places, *after)):
            sure = said.certainty if mine else said.certainty * 0.9
        self._shown(placed(places, after), replace(said, certainty=sure), always=mine)

    def _meets(self, clause: Clause, said: Said, _opens: bool) -> None:
        places = tuple([item for item in (*clause.before, *clause.after) if not is_person(item)])
        if places and isinstance(places[0], Thing):  # "meet me the garden"
            thing = places[0]
            places = (Place("at", thing.start, thing.end, (thing,), "AT"), *places[1:])
        if not places:  # "you will see a bank. Meet me there."
            if self.heads and self.heads[0] > LISTENER:
                self.walk.led_to = self.heads[0]
            self.finish()
            return
        self._say((*[arrived(place) for place in places[:1]], *places[1:]), [SPEAKER], said)

    def _goes(self, clause: Clause, said: Said, _opens: bool) -> None:
        subject = clause.before[0] if clause.before else None
        if isinstance(subject, Thing) and subject.kind in ("thing", "IT", "SPOT"):
            heads = self._say(clause.before, [], said)  # "the road runs along a river"
            self._say(clause.after, heads, replace(said, certainty=said.certainty * 0.7))
            return
        places = tuple(item for item in clause.before if isinstance(item, Place))
        self.walk.go((*places, *clause.after), clause.travel, said)
        if clause.travel == "REACH":  # "get to the entrance"
            self.walk.led_to = self.walk.on_the_way

    def _on_the_way(self, clause: Clause, said: Said) -> None:
        """What is met on the way: "when you see the bank", "until you reach Penn Avenue"."""
        if clause.verb == "meets":
            self._meets(clause, said, False)
            return
        items = clause.after or clause.before
        self.walk.go(items, clause.travel or "REACH", said)

    def _too_far(self, clause: Clause, said: Said, _opens: bool) -> None:
        self.walk.look_back(clause.after, said)

    def _fragment(self, clause: Clause, said: Said, opens: bool) -> None:
        items = clause.before
        goes_on = self.walking or (self.walk.way.row is not None and is_leg(items[0]))
        if isinstance(items[0], Place) and goes_on and not opens:  # "then west"
            self.walk.go(items, "GO", said)
        elif isinstance(items[0], Place):  # "..., but not near the church"
            self._say(items, [SPEAKER] if opens else self.heads, said)
        elif all(is_person(item) for item in items):
            self.relator.reason = "says nothing about where things stand"
        elif is_bare_word(items):
            self.relator.reason = UNKNOWN  # "Hello", "Qué": a capital alone makes no name
        else:
            bare = len(items) == 1 and not has_no(items[0])
            sure = (LED if self.directive else MENTIONED) if bare else 1.0
            self._shown(items, replace(said, certainty=said.certainty * sure))

    # the chain of things and places

    def _say(
        self, items: Items, heads: Sequence[int], said: Said, *, collect: bool = False
    ) -> list[int]:
        """Relate places to the things before them; return the things.

        A thing without a place of its own joins the target before it ("north of the school and the
        church"); one with a place is spoken of anew ("a bakery to my east and a stop across ...").
        """
        group, spoken = list(heads), list(heads)
        last: Place | None = None
        for i, item in enumerate(items):
            following = items[i + 1] if i + 1 < len(items) else None
            if isinstance(item, Place):
                said.shared = shared(item, last, following)
                group = self._relate_all(item, group or [SPEAKER], said)
                last = item
            elif last is not None and joins(last, item, heads, following):
                again = replace(last, targets=(*last.targets[:-1], item))
                self._relate_all(again, group, said)
            elif (node := self._new_head(item)) is not None:
                if spoken and not self.directive:
                    self.refer.topic = spoken[-1]  # "a bakery ..., and a kiosk next to it"
                group = [*group, node] if last is None and i else [node]
                spoken.append(node)
                last = None
        self.heads = spoken if collect or len(spoken) <= 1 else spoken[:1]
        return spoken if collect or not group or group[0] in spoken else group

    def _new_head(self, thing: Thing) -> int | None:
        node = self.refer.resolve(thing)
        if node is None:
            self.relator.reason = NO_MAP if thing.part else UNKNOWN
        return node

    def _relate_all(self, place: Place, group: Sequence[int], said: Said) -> list[int]:
        return [
            node for head in group if (node := self.relator.relate(place, head, said)) is not None
        ]
