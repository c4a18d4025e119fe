"""The statements of a text, while it is read: what nouns mean, and who "it" is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from placegraph.indoor.language.likeness import room_kind
from placegraph.indoor.language.looks import is_look, leading, looks, trailing
from placegraph.indoor.language.parse import Item, Noun, Where
from placegraph.indoor.language.sentence import ME, Kind, Mention, Statement
from placegraph.indoor.map.relations.words import same_thing
from placegraph.language.check import Ignored
from placegraph.language.islands import Chunk

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
