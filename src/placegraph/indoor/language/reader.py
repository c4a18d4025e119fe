"""The statements of a text, while it is read: what nouns mean, and who "it" is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from placegraph.indoor.language.appearance import is_look, leading, looks, trailing
from placegraph.indoor.language.grammar import Clause, Item, Noun, Where, chunks, clauses, parse
from placegraph.indoor.language.likeness import room_kind
from placegraph.indoor.language.sentence import ME, Kind, Mention, Sentence, Statement
from placegraph.indoor.map.relations import same_thing
from placegraph.language.grammar import Chunk
from placegraph.language.text import Ignored, check_text
from placegraph.language.text import scan_text as scan

SCENE = -2
"""Stands for the scene itself where a mention could stand."""
_ANYTHING = frozenset(
    ("room", "place", "space", "scene", "flat", "apartment", "house", "home", "area", "spot")
)
"""What names a place without saying which."""
_OTHER_ROOM = 0.3
"""How certainly one is in a room that is named after one of another kind."""
_REMEMBERED = 50
"""Things back to which "the table" is looked for."""
_MANY_IN_ONE = frozenset(
    ("coats", "clothes", "stairs", "blinds", "books", "dishes", "scissors", "headphones", "tiles",
     "bunks", "drawers", "walls", "shelves")
)  # fmt: skip
"""Plurals that a map has as one thing."""
_THINGS_TOO = frozenset(("light", "glass", "flat", "orange", "brick"))
"""Words for looks that name things when they stand alone."""
_MADE = ("made", "out", "built")
_NOTHING = frozenset(
    ("thing", "things", "something", "anything", "nothing", "everything", "one", "ones", "furniture",
     "stuff", "else", "item", "items", "object", "objects", "look", "looks", "style", "view", "side",
     "sides", "way", "feel", "lot", "own")
)  # fmt: skip


class Statements:
    """Collects the statements of a text."""

    def __init__(self, text: str) -> None:
        self.text = text
        self.mentions: list[Mention] = []
        self.statements: list[Statement] = []
        self.ignored: list[Ignored] = []
        self._spoken: list[int] = []
        self._parts: set[int] = set()  # what things come with: "it" is rarely one of them
        self.certainty = 1.0
        self._before = ""  # kind of room that sentences before were about

    def next_sentence(self) -> None:
        """Begin a sentence: a room of another kind that it names may be seen through a door."""
        rooms = [self.mentions[s.things[0]].room for s in self.statements if s.kind is Kind.ROOM]
        self._before = rooms[0] if rooms else ""

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

    def state(
        self,
        kind: Kind,
        things: tuple[int, ...],
        said: Noun | Where,
        *,
        relation: str = "",
        bearing: float = 0.0,
        distance: float | None = None,
        negated: bool = False,
    ) -> None:
        """Add what `said` states of some things."""
        no = any(self.mentions[t].negated for t in things)
        certainty = self.certainty
        if kind is Kind.ROOM and self._before not in ("", self.mentions[things[0]].room):
            certainty *= _OTHER_ROOM
        self.statements.append(
            Statement(
                kind, things, relation, bearing, distance=distance, negated=negated or no,
                certainty=certainty, text=self.text[said.start : said.end],
            )
        )  # fmt: skip

    def node(self, thing: Noun, *, other_than: int = ME) -> int | None:
        """Row of what a thing is, ME, SCENE, or None where it names nothing."""
        if thing.kind == "ME":
            return ME
        if thing.kind == "SPOT":
            return SCENE
        if thing.kind == "IT":
            spoken = [row for row in reversed(self._spoken) if row != other_than]
            whole = (row for row in spoken if row not in self._parts)
            return next(whole, spoken[0] if spoken else None)
        if thing.kind == "PART":
            return None
        mention = _mention(thing, self.text)
        if is_look(mention.label) and mention.label not in _THINGS_TOO:
            # "two chairs, a red one and a blue one"
            looks_ = (*mention.attributes, mention.label)
            alike = self.mentions[self._spoken[-1]].label if self._spoken else ""
            mention = replace(mention, label=alike, attributes=looks_, plural=False)
        last = mention.label.rpartition(" ")[2]
        if last in _NOTHING or not mention.label:
            self.ignored.append(Ignored(mention.words, "names no thing"))
            return None
        if last in _ANYTHING and not mention.room:
            self._scene(mention.attributes)
            return SCENE
        owner = thing.owner
        if owner is not None and owner.kind == "thing" and owner.determiners:
            where = _mention(owner, self.text)
            if where.room:
                self.state(Kind.ROOM, (self._kept(where, owner),), owner)
            else:
                self.ignored.append(Ignored(where.words, "of what a thing is part"))
        self._spoken.append(self._kept(mention, thing))
        return self._spoken[-1]

    def _scene(self, attributes: Sequence[str]) -> None:
        """Note how the room looks: the one that was named, or one of no kind."""
        said = looks().said(attributes)
        if not {"sizes", "states"} & set(said):
            return
        row = next((i for i, m in enumerate(self.mentions) if m.room and not m.negated), None)
        if row is not None:
            self.look(row, attributes)
            return
        words = " ".join([*attributes, "room"])
        self.mentions.append(Mention(words, "room", attributes=tuple(attributes)))
        self.statements.append(
            Statement(Kind.ROOM, (len(self.mentions) - 1,), certainty=self.certainty, text=words)
        )

    def _kept(self, mention: Mention, thing: Noun) -> int:
        """Row of a mention: "the table" is the table spoken of before."""
        definite = any(d.type == "DET" for d in thing.determiners) and not mention.negated
        if definite:
            for row in range(len(self.mentions) - 1, -1, -1)[:_REMEMBERED]:
                other = self.mentions[row]
                if not other.negated and _same(mention, other):
                    return row
        self.mentions.append(mention)
        return len(self.mentions) - 1

    def look(self, row: int | None, attributes: Sequence[str]) -> None:
        """Note how a thing looks, or the room, or where in the room a thing stands."""
        if row == SCENE and attributes:
            self._scene(attributes)
        if row is None or row < 0:
            return
        own = self.mentions[row]
        new = tuple(word for word in attributes if word not in own.attributes)
        self.mentions[row] = replace(own, attributes=own.attributes + new)

    def ignore(self, items: Sequence[Item], reason: str) -> None:
        """Note that some items say nothing that can be used, and why."""
        said = [item for item in items if isinstance(item, Noun | Where)]
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


def looks_of(thing: Noun) -> tuple[str, ...]:
    """Attributes that a noun phrase is nothing but: "blue", "dark wood"; else none."""
    words = [chunk.words for chunk in thing.words]
    if thing.owner is not None and words in ([w] for w in _MADE):
        return looks_of(thing.owner)  # "made of dark wood"
    if thing.kind != "thing" or not words or thing.owner is not None or thing.determiners:
        return ()
    if len(words) == 1 and words[0] in _THINGS_TOO:
        return ()
    found, first = leading([*words, ""])
    return found if first == len(words) else ()


def is_room(thing: Noun) -> bool:
    """Whether a noun phrase names a kind of room."""
    return thing.kind == "thing" and bool(room_kind(" ".join(c.words for c in thing.words)))


def _mention(thing: Noun, text: str) -> Mention:
    """What a noun phrase says."""
    words = [chunk.words for chunk in thing.words]
    seen, first = leading(words)
    after, last = trailing(words[first:])
    owner = thing.owner if thing.owner is not None and thing.owner.kind == "thing" else None
    if owner is not None and words[-1] in _MADE and len(words) > first + 1:
        after, last, owner = looks_of(owner), len(words) - first - 1, None
    label = " ".join(words[first : first + last])
    if owner is not None and not owner.determiners:
        label = " ".join([label, "of", *[chunk.words for chunk in owner.words]])
    kinds = {d.type for d in thing.determiners}
    count = next((d.value for d in thing.determiners if d.type == "NUM"), None)
    several = "SOME" in kinds
    return Mention(
        words=text[thing.start : thing.end],
        label=label,
        count=count,
        several=several,
        plural=count is None and not several and _plural(label),
        attributes=seen + after,
        negated="NO" in kinds or count == 0,
        room=room_kind(label) or room_kind(_named_by(label)),
    )


def _named_by(label: str) -> str:
    """What says which room is meant: "office" of "office space"."""
    first, _, last = label.rpartition(" ")
    return first if last in ("space", "area", "part") else ""


def _plural(label: str) -> bool:
    """Whether more than one thing is meant: "curtains", but not "glass" and "coats"."""
    return label.endswith("s") and not label.endswith(("ss", "us")) and label not in _MANY_IN_ONE


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


_EXAMPLE = "I am next to the sofa, facing the window."

_WAYS = frozenset(("door", "doors", "doorway", "opening", "entrance", "passage", "access", "exit"))


def read(text: str) -> Sentence:
    """Read a text: where somebody is in a place, and what it holds.

    Parameters
    ----------
    text
        English; the words for things may be any ("KitchenTable", "chest of drawers").

    Raises
    ------
    DescriptionError
        If the text is empty, too long, or no text. A text of which nothing is understood is no
        error: it gives a sentence without statements that says what was ignored.

    """
    check_text(text, _EXAMPLE)
    reader = Reader(text)
    for sentence in scan(text):
        reader.next_sentence()
        for part, certainty in clauses(chunks(sentence, text)):
            for clause, left_out in parse(part):
                if clause is not None:
                    reader.take(clause, certainty)
                reader.leave(left_out)
    reader.finish()
    if not reader.statements and not reader.ignored:
        reader.ignored.append(Ignored(text.strip(), "says nothing about a place"))
    return Sentence(text, tuple(reader.mentions), tuple(reader.statements), tuple(reader.ignored))


class Reader(Places):
    """Says what the clauses of a text state, one after the other."""

    def take(self, clause: Clause, certainty: float) -> None:
        """Add what a clause says."""
        self.certainty = certainty
        before, after = list(clause.before), list(clause.after)
        things = [item for item in before if isinstance(item, Noun)]
        match clause.verb:
            case "is_" if things and after and isinstance(after[0], Where):
                rest = next((i for i, a in enumerate(after) if isinstance(a, Noun)), len(after))
                self._say_of(before, after[:rest])
                self._walk(after[rest:], ME)  # "..., a lamp behind me"
            case "is_" if things and not any(t.kind == "thing" for t in things):
                self._walk(after, ME)  # "this is the kitchen"
            case "is_" if things:
                self._is(before, after)
            case "sees":
                self._sees(before, after)
            case "has":
                self._has(before, after)
            case _:  # "behind me is a bookcase", "on the table there is a plant"
                self._walk([*_turned(after, before)], ME)

    # what a clause's parts say of each other
    def _say_of(self, subjects: Sequence[Item], places: Sequence[Item]) -> None:
        """As "The sofa and the table are on my left"."""
        of = [t for t in subjects if isinstance(t, Noun)]
        rest = [item for item in subjects if isinstance(item, Where)]
        for thing in of:
            attributes = looks_of(thing)
            if attributes and self._spoken:
                self.look(self._spoken[-1], attributes)  # "the sofa, which is red, is ..."
                continue
            self._walk([thing, *rest, *[p for p in places if isinstance(p, Where)]], ME)
            rest = []

    def _is(self, before: list[Item], after: Sequence[Item]) -> None:
        """As "The walls are blue", "the floor is dark wood": how a thing looks."""
        spoken = len(self._spoken)
        self._walk(before, ME)
        node = self._spoken[-1] if len(self._spoken) > spoken else SCENE
        for i, item in enumerate(after):
            attributes = looks_of(item) if isinstance(item, Noun) else ()
            if isinstance(item, Noun | Where) and not attributes:
                self._walk(after[i:], ME)
                return
            self.look(node, attributes)

    def _sees(self, before: list[Item], after: list[Item]) -> None:
        """As "On my left I see a plant on the table"."""
        directions = [p for p in before if isinstance(p, Where) and p.how == "towards"]
        self._walk([p for p in before if isinstance(p, Where) and p not in directions], ME)
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
        things = [item for item in before if isinstance(item, Noun)]
        holder = self.node(things[-1]) if things else ME
        rest = [item for item in before if not isinstance(item, Noun)]
        self._walk(rest, ME)
        if holder is not None and holder >= 0 and self.mentions[holder].room:
            self.state(Kind.ROOM, (holder,), things[-1])
            holder = ME
        with_ = [
            Where("with_", item.start, item.end, (item,)) if isinstance(item, Noun) else item
            for item in after
            if not (isinstance(item, Where) and any(t.kind == "IT" for t in item.things))
        ]
        self._walk(with_, ME if holder is None else holder)

    def _walk(self, items: Sequence[Item], base: int) -> None:
        """Things and places in the order of speech.

        A place right after a thing is said of that thing (`anchor`); after a joint it is said of
        what was spoken of all along (`base`): the speaker, where a place came first.
        """
        anchor, holder, joint = base, base, True
        leads = base == ME and bool(items) and isinstance(items[0], Noun)
        for i, item in enumerate(items):
            if isinstance(item, Noun):
                attributes = looks_of(item)
                if attributes:
                    self.look(anchor if anchor >= 0 else SCENE, attributes)  # "a hall, quite empty"
                    continue
                if _leads_to(items[i - 1] if i else None) and is_room(item):
                    continue  # "a door to the balcony"
                node = self.node(item)
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
            elif isinstance(item, Where) and item.how == "with_":
                anchor = self._with(item, holder if joint else anchor, items[i + 1 :])
            elif isinstance(item, Where):
                subject = base if joint else anchor
                anchor = self._put(ME if item.how == "faces" else subject, item, anchor)
            joint = not isinstance(item, Noun | Where)

    def _with(self, item: Where, owner: int, rest: Sequence[Item]) -> int:
        """As "with two sinks": of the scene, or of the thing before; returns what is spoken of."""
        node = self.node(item.things[0])
        if node is None or node < 0:
            return owner
        goes_on = (
            rest and isinstance(rest[0], Where) and rest[0].how in ("towards", "here", "sight")
        )
        if owner >= 0 and owner != node and not goes_on:
            self._parts.add(node)
            self.state(Kind.RELATED, (node, owner), item, relation="with")
        else:
            self._hold(node, item.things[0])
        return node


def _leads_to(item: Item | None) -> bool:
    """Whether an item is a way out."""
    return isinstance(item, Noun) and bool(item.words) and item.words[-1].words in _WAYS


def _turned(after: Sequence[Item], before: Sequence[Item]) -> list[Item]:
    """Things first, then where they are: "behind me is a bookcase"."""
    places = [item for item in before if isinstance(item, Where)]
    things = [item for item in before if isinstance(item, Noun)]
    first = next((i for i, item in enumerate(after) if isinstance(item, Noun)), None)
    if first is None or not places:
        return [*things, *places, *after]
    return [*after[: first + 1], *places, *after[first + 1 :]]
