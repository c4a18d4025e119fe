"""What clauses say: which thing a place belongs to, who "it" is, and what that states."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from placegraph.indoor.language.lexicon import attributes, room_kind
from placegraph.indoor.language.parse import Place, Thing
from placegraph.indoor.language.sentence import ME, Kind, Mention, Statement
from placegraph.indoor.map.relation_words import same_thing
from placegraph.language.check import Ignored

if TYPE_CHECKING:
    from collections.abc import Sequence

    from placegraph.indoor.language.parse import Clause, Item
    from placegraph.language.islands import Chunk

SCENE = -2
"""Stands for the scene itself where a mention could stand."""
_ANYTHING = frozenset(
    ("room", "place", "space", "scene", "flat", "apartment", "house", "home", "area", "spot")
)
"""What names a place without saying which."""
_BESIDES = frozenset(("behind", "above", "under", "left of", "right of", "attached to", "against"))
"""Relations of the speaker to a thing that tell no more than that it is near."""
_REMEMBERED = 50
"""Things back to which "the table" is looked for."""
_NOTHING = frozenset(("thing", "things", "something", "anything", "nothing", "everything", "one"))


class Builder:
    """Collects the statements of a text.

    Parameters
    ----------
    text
        The text.
    """

    def __init__(self, text: str) -> None:
        self.text = text
        self.mentions: list[Mention] = []
        self.statements: list[Statement] = []
        self.ignored: list[Ignored] = []
        self._spoken: list[int] = []
        self._certainty = 1.0

    def take(self, clause: Clause, certainty: float) -> None:
        """Add what a clause says."""
        self._certainty = certainty
        before, after = list(clause.before), list(clause.after)
        things = [item for item in before if isinstance(item, Thing)]
        match clause.verb:
            case "is_" if things and after and isinstance(after[0], Place):
                rest = next((i for i, a in enumerate(after) if isinstance(a, Thing)), len(after))
                self._say_of(before, after[:rest])
                self._walk(after[rest:], ME)  # "..., a lamp behind me"
            case "is_" if things and not any(t.kind == "thing" for t in things):
                self._walk(after, ME)  # "this is the kitchen"
            case "is_" if things:
                self._walk(before, ME)
                self._ignore(after, "says what a thing is, not where")
            case "sees":
                self._sees(before, after)
            case "has":
                self._has(before, after)
            case _:  # "behind me is a bookcase", "on the table there is a plant"
                self._walk([*_turned(after, before)], ME)

    def leave(self, left_out: Sequence[Chunk]) -> None:
        """Note words that no rule expected."""
        for chunk in left_out:
            if chunk.type == "WORD" or (chunk.type in ("REL", "DIST", "BETWEEN", "FACE", "AWAY")):
                self.ignored.append(Ignored(self.text[chunk.start : chunk.end], "not understood"))

    def finish(self) -> None:
        """What is said twice is said once; of what is placed, it is no news that it is there."""
        placed = {t for s in self.statements for t in s.things if s.kind is not Kind.HOLDS}
        kept: dict[Statement, Statement] = {}
        for s in self.statements:
            thing = self.mentions[s.things[0]]
            news = thing.count or thing.several or s.negated or s.things[0] not in placed
            if news or s.kind is not Kind.HOLDS:
                kept.setdefault(replace(s, text=""), s)
        self.statements = list(kept.values())

    # what a clause's parts say of each other
    def _say_of(self, subjects: Sequence[Item], places: Sequence[Item]) -> None:
        """As "The sofa and the table are on my left"."""
        of = [t for t in subjects if isinstance(t, Thing)]
        rest = [item for item in subjects if isinstance(item, Place)]
        for thing in of:
            self._walk([thing, *rest, *[p for p in places if isinstance(p, Place)]], ME)
            rest = []

    def _sees(self, before: list[Item], after: list[Item]) -> None:
        """As "On my left I see a plant on the table"."""
        directions = [p for p in before if isinstance(p, Place) and p.how == "towards"]
        self._walk([p for p in before if isinstance(p, Place) and p not in directions], ME)
        if directions:
            self._walk(_turned(after, directions), ME)
            return
        first = len(self.statements)
        self._walk(after, ME)
        seen = self.statements[first:]
        placed = {
            t
            for s in seen
            if s.kind is not Kind.HOLDS and s.kind is not Kind.RELATED
            for t in s.things
        }
        self.statements[first:] = [
            replace(s, kind=Kind.TOWARDS, wide=True)
            if s.kind is Kind.HOLDS and s.things[0] not in placed
            else s
            for s in seen
        ]

    def _has(self, before: list[Item], after: list[Item]) -> None:
        """As "The kitchen has two sinks", "the table has a plant on it"."""
        things = [item for item in before if isinstance(item, Thing)]
        holder = self._node(things[-1]) if things else ME
        rest = [item for item in before if not isinstance(item, Thing)]
        self._walk(rest, ME)
        if holder is not None and holder >= 0 and self.mentions[holder].room:
            self._state(Kind.ROOM, (holder,), things[-1])
            holder = ME
        with_ = [
            Place("with_", item.start, item.end, (item,)) if isinstance(item, Thing) else item
            for item in after
            if not (isinstance(item, Place) and any(t.kind == "IT" for t in item.things))
        ]
        self._walk(with_, ME if holder is None else holder)

    def _walk(self, items: Sequence[Item], base: int) -> None:
        """Things and places in the order of speech.

        A place right after a thing is said of that thing (`anchor`); after a joint it is said of
        what was spoken of all along (`base`): the speaker, where a place came first.
        """
        anchor, holder, joint = base, base, True
        leads = base == ME and bool(items) and isinstance(items[0], Thing)
        for i, item in enumerate(items):
            if isinstance(item, Thing):
                node = self._node(item)
                if node is None:
                    continue
                if node < 0 or self.mentions[node].room:
                    base = anchor = holder = ME
                    leads = False
                else:
                    anchor = node
                    base = node if leads else base
                if node >= 0:
                    self._hold(node, item)
            elif isinstance(item, Place) and item.how == "with_":
                anchor = self._with(item, holder if joint else anchor, items[i + 1 :])
            elif isinstance(item, Place):
                subject = base if joint else anchor
                anchor = self._put(ME if item.how == "faces" else subject, item, anchor)
            joint = not isinstance(item, Thing | Place)

    def _with(self, item: Place, owner: int, rest: Sequence[Item]) -> int:
        """As "with two sinks": of the scene, or of the thing before; returns what is spoken of."""
        node = self._node(item.things[0])
        if node is None or node < 0:
            return owner
        goes_on = (
            rest and isinstance(rest[0], Place) and rest[0].how in ("towards", "here", "sight")
        )
        if owner >= 0 and owner != node and not goes_on:
            self._state(Kind.RELATED, (node, owner), item, relation="with")
        else:
            self._hold(node, item.things[0])
        return node

    # statements
    def _put(self, subject: int, place: Place, anchor: int) -> int:
        """State a place of a subject; returns what a place right after it is said of."""
        if place.how in ("towards", "here", "sight"):
            return self._direct(anchor if anchor >= 0 else subject, place)
        nodes = [self._node(thing, other_than=subject) for thing in place.things]
        if any(node is None for node in nodes):
            self._ignore([place], "says no thing")
            return anchor
        targets = [node for node in nodes if node is not None]
        if subject >= 0 and any(t == subject for t in targets):
            self._ignore([place], "relates a thing to itself")
            return anchor
        if any(t < 0 for t in targets):
            return self._to_me(subject, place, targets, anchor)
        if place.how == "faces":
            self._state(
                Kind.TOWARDS, (targets[0],), place, bearing=place.bearing, negated=place.negated
            )
            return targets[0]
        if place.how == "between":
            return self._between(subject, place, targets)
        room = self.mentions[targets[0]].room
        if room and (place.relation == "in" or subject == ME):
            self._state(Kind.ROOM, (targets[0],), place, negated=place.negated)
            return subject
        if subject < 0:
            self._near(place, targets[0])
            return targets[0]
        self._relate(subject, place, targets[0])
        return targets[0]

    def _direct(self, subject: int, place: Place) -> int:
        """As "on my left", "next to me", "in sight" of a thing."""
        if subject < 0:
            if place.how != "sight":
                self._ignore([place], "says no thing")
            return subject
        kinds = {"towards": Kind.TOWARDS, "here": Kind.NEAR, "sight": Kind.HOLDS}
        self._state(
            kinds[place.how], (subject,), place, bearing=place.bearing, distance=place.distance,
            negated=place.negated,
        )  # fmt: skip
        return subject

    def _to_me(self, subject: int, place: Place, targets: list[int], anchor: int) -> int:
        """What is said of a thing by where I am: "left of me", "far from me"; or of the room."""
        if ME in targets and subject >= 0 and place.how in ("related", "far"):
            kind = Kind.NEAR if place.how == "related" else Kind.FAR
            self._state(kind, (subject,), place, distance=place.distance, negated=place.negated)
        elif subject != ME or place.relation != "in":
            self._ignore([place], "says no thing")
        return anchor

    def _between(self, subject: int, place: Place, targets: list[int]) -> int:
        two = tuple(targets) if len(targets) == 2 else (targets[0], targets[0])
        if subject < 0:
            self._state(Kind.BETWEEN, two, place, negated=place.negated)
        else:
            for target in dict.fromkeys(two):
                self._state(
                    Kind.RELATED, (subject, target), place, relation="next to",
                    negated=place.negated,
                )  # fmt: skip
        return subject

    def _near(self, place: Place, target: int) -> None:
        """Where I am by one thing."""
        if place.how == "far":
            self._state(Kind.FAR, (target,), place, negated=place.negated)
            return
        relation = "" if place.relation in ("next to", "") else place.relation
        self._state(
            Kind.NEAR, (target,), place, relation="" if relation in _BESIDES else relation,
            distance=place.distance, negated=place.negated,
        )  # fmt: skip

    def _relate(self, subject: int, place: Place, target: int) -> None:
        if place.how == "far":
            self._state(
                Kind.RELATED, (subject, target), place, relation="next to",
                negated=not place.negated,
            )  # fmt: skip
            return
        self._state(
            Kind.RELATED, (subject, target), place, relation=place.relation or "next to",
            negated=place.negated, distance=place.distance,
        )  # fmt: skip

    def _hold(self, node: int, item: Thing) -> None:
        self._state(Kind.ROOM if self.mentions[node].room else Kind.HOLDS, (node,), item)

    def _state(
        self,
        kind: Kind,
        things: tuple[int, ...],
        said: Thing | Place,
        *,
        relation: str = "",
        bearing: float = 0.0,
        distance: float | None = None,
        negated: bool = False,
    ) -> None:
        no = any(self.mentions[t].negated for t in things)
        self.statements.append(
            Statement(
                kind, things, relation, bearing, distance=distance, negated=negated or no,
                certainty=self._certainty, text=self.text[said.start : said.end],
            )
        )  # fmt: skip

    # things
    def _node(self, thing: Thing, *, other_than: int = ME) -> int | None:
        """Row of what a thing is, ME, SCENE, or None where it names nothing."""
        if thing.kind == "ME":
            return ME
        if thing.kind == "SPOT":
            return SCENE
        if thing.kind == "IT":
            return next((row for row in reversed(self._spoken) if row != other_than), None)
        if thing.kind == "PART":
            return None
        mention = _mention(thing, self.text)
        if mention.label in _NOTHING or not mention.label:
            self.ignored.append(Ignored(mention.words, "names no thing"))
            return None
        if mention.label in _ANYTHING:
            return SCENE
        owner = thing.owner
        if owner is not None and owner.kind == "thing" and owner.determiners:
            where = _mention(owner, self.text)
            if where.room:
                self._state(Kind.ROOM, (self._kept(where, owner),), owner)
            else:
                self.ignored.append(Ignored(where.words, "of what a thing is part"))
        self._spoken.append(self._kept(mention, thing))
        return self._spoken[-1]

    def _kept(self, mention: Mention, thing: Thing) -> int:
        """Row of a mention: "the table" is the table spoken of before."""
        definite = any(d.type == "DET" for d in thing.determiners) and not mention.negated
        if definite:
            for row in range(len(self.mentions) - 1, -1, -1)[:_REMEMBERED]:
                other = self.mentions[row]
                if not other.negated and _same(mention, other):
                    return row
        self.mentions.append(mention)
        return len(self.mentions) - 1

    def _ignore(self, items: Sequence[Item], reason: str) -> None:
        said = [item for item in items if isinstance(item, Thing | Place)]
        if said:
            words = self.text[said[0].start : said[-1].end]
            self.ignored.append(Ignored(words, reason))


def _same(one: Mention, other: Mention) -> bool:
    """Whether two mentions may be of one thing."""
    if one.room or other.room:
        return one.room == other.room
    if one.count is not None and one.count != other.count:
        return False
    return same_thing(one.label, other.label) and set(one.attributes) <= set(other.attributes)


def _mention(thing: Thing, text: str) -> Mention:
    """What a noun phrase says."""
    words = [chunk.words for chunk in thing.words]
    looks = attributes()
    head = 0
    while head < len(words) - 1 and words[head] in looks:
        head += 1
    label = " ".join(words[head:])
    if thing.owner is not None and not thing.owner.determiners and thing.owner.kind == "thing":
        label = " ".join([label, "of", *[chunk.words for chunk in thing.owner.words]])
    kinds = {d.type for d in thing.determiners}
    count = next((d.value for d in thing.determiners if d.type == "NUM"), None)
    return Mention(
        words=text[thing.start : thing.end],
        label=label,
        count=count,
        several="SOME" in kinds,
        attributes=tuple(words[:head]),
        negated="NO" in kinds or count == 0,
        room=room_kind(label),
    )


def _turned(after: Sequence[Item], before: Sequence[Item]) -> list[Item]:
    """Things first, then where they are: "behind me is a bookcase"."""
    places = [item for item in before if isinstance(item, Place)]
    things = [item for item in before if isinstance(item, Thing)]
    first = next((i for i, item in enumerate(after) if isinstance(item, Thing)), None)
    if first is None or not places:
        return [*things, *places, *after]
    return [*after[: first + 1], *places, *after[first + 1 :]]
