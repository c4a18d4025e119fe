"""From words to statements: what a text says of a place indoors, and what of it was left unread."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from placegraph.indoor.language.appearance import (
    appearance_words,
    is_look,
    parse_attributes,
    parse_trailing_colours,
)
from placegraph.indoor.language.grammar import (
    Item,
    NounPhrase,
    Place,
    cut_clauses,
    find_chunks,
    parser,
)
from placegraph.indoor.language.likeness import room_kind
from placegraph.indoor.language.sentence import ME, Kind, Mention, Sentence, Statement
from placegraph.indoor.map.relations import matches_label
from placegraph.language.grammar import Chunk, Clause, PlacePhrase
from placegraph.language.text import IgnoredText, check_text, scan_text

SCENE = -2
"""Stands for the scene itself where a mention could stand."""
PARTS = {
    "corner": "in the corner", "corners": "in the corner", "middle": "in the middle",
    "centre": "in the middle", "center": "in the middle",
}  # fmt: skip
"""Parts of a room, as `looks.toml` knows them."""
_ANYTHING = frozenset(
    ("room", "place", "space", "scene", "flat", "apartment", "house", "home", "area", "spot")
)
"""Words for a place of no kind."""
_OTHER_ROOM = 0.3
"""Certainty of being in a room that is named after one of another kind."""
_REMEMBERED = 50
"""Mentions among which "the table" is looked for."""
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
_BY_WALL = ("against", "next to", "along", "on")
_BESIDES = frozenset(
    ("behind", "above", "under", "left of", "right of", "attached to", "against", "next to")
)
"""Relations of the speaker to a thing that tell no more than that it is near."""
_WAYS = frozenset(("door", "doors", "doorway", "opening", "entrance", "passage", "access", "exit"))


def read(text: str) -> Sentence:
    """Read a text: where somebody is in a place, and what it holds.

    Raises `DescriptionError`: if the text is empty, too long, or no text; A text of which nothing
    is understood is no error: it gives a sentence without statements that says what was ignored.

    `text`: english; the words for things may be any ("KitchenTable", "chest of drawers").
    """
    check_text(text, "I am next to the sofa, facing the window.")
    reader = Reader(text)
    for sentence in scan_text(text):
        reader.begin_sentence()
        for part, certainty in cut_clauses(find_chunks(sentence, text)):
            for clause, left_out in parser().parse(part):
                if clause.verb:
                    reader.take(clause, certainty)
                reader.ignore_chunks(left_out)
    reader.finish()
    if not reader.statements and not reader.ignored:
        reader.ignored.append(IgnoredText(text.strip(), "does not describe a place"))
    return Sentence(text, tuple(reader.mentions), tuple(reader.statements), tuple(reader.ignored))


class Reader:
    """Collects the mentions and statements of the clauses of a text, one after the other."""

    def __init__(self, text: str) -> None:
        self.text = text
        self.mentions: list[Mention] = []
        self.statements: list[Statement] = []
        self.ignored: list[IgnoredText] = []
        self._spoken: list[int] = []
        self._parts: set[int] = set()  # what things come with: "it" is rarely one of them
        self.certainty = 1.0
        self._room_before = ""  # kind of room that sentences before were about

    def begin_sentence(self) -> None:
        """Begin a sentence: a room of another kind that it names may be seen through a door."""
        rooms = [self.mentions[s.mentions[0]].room for s in self.statements if s.kind is Kind.ROOM]
        self._room_before = rooms[0] if rooms else ""

    def ignore_chunks(self, left_out: Sequence[Chunk]) -> None:
        """Note words that no rule expected."""
        for chunk in left_out:
            if chunk.type in ("WORD", "REL", "DIST", "BETWEEN", "FACE", "AWAY"):
                self.ignored.append(
                    IgnoredText(self.text[chunk.start : chunk.end], "not understood")
                )

    def finish(self) -> None:
        """Drop what is said twice, and that a thing is there of which a place is said."""
        placed = {t for s in self.statements for t in s.mentions if s.kind is not Kind.HOLDS}
        distinct: dict[Statement, Statement] = {}
        for s in self.statements:
            thing = self.mentions[s.mentions[0]]
            news = thing.count or thing.several or s.negated or s.mentions[0] not in placed
            if news or s.kind is not Kind.HOLDS:
                distinct.setdefault(replace(s, text=""), s)
        self.statements = list(distinct.values())

    def state(
        self,
        kind: Kind,
        mentions: tuple[int, ...],
        phrase: NounPhrase | Place,
        *,
        relation: str = "",
        negated: bool | None = None,
    ) -> None:
        """Add what a phrase states of some things; `negated` if other than the phrase is."""
        place: Place = phrase if isinstance(phrase, PlacePhrase) else PlacePhrase("", 0, 0)
        negated = place.negated if negated is None else negated
        certainty = self.certainty
        if kind is Kind.ROOM and self._room_before not in ("", self.mentions[mentions[0]].room):
            certainty *= _OTHER_ROOM
        self.statements.append(
            Statement(
                kind,
                mentions,
                relation,
                place.direction or 0.0,
                distance=None if kind is Kind.ROOM else place.distance,
                negated=negated or any(self.mentions[t].negated for t in mentions),
                certainty=certainty,
                text=self.text[phrase.start : phrase.end],
            )
        )

    def resolve(self, noun: NounPhrase, *, other_than: int = ME) -> int | None:
        """Return the row of a thing's mention, ME, SCENE, or None where it names nothing."""
        match noun.kind:
            case "ME":
                return ME
            case "SPOT":
                return SCENE
            case "IT":
                spoken = [row for row in reversed(self._spoken) if row != other_than]
                whole = (row for row in spoken if row not in self._parts)
                return next(whole, spoken[0] if spoken else None)
            case "PART":
                return None
        mention = _mention(noun, self.text)
        if is_look(mention.label) and mention.label not in _THINGS_TOO:
            # "two chairs, a red one and a blue one"
            attributes = (*mention.attributes, mention.label)
            alike = self.mentions[self._spoken[-1]].label if self._spoken else ""
            mention = replace(mention, label=alike, attributes=attributes, plural=False)
        last = mention.label.rpartition(" ")[2]
        if last in _NOTHING or not mention.label:
            self.ignored.append(IgnoredText(mention.words, "does not name an object"))
            return None
        if last in _ANYTHING and not mention.room:
            self._describe_scene(mention.attributes)
            return SCENE
        owner = noun.owner
        if owner is not None and owner.kind == "thing" and owner.determiners:
            where = _mention(owner, self.text)
            if where.room:
                self.state(Kind.ROOM, (self._find_or_add(where, owner),), owner)
            else:
                self.ignored.append(
                    IgnoredText(where.words, "does not say what the object is part of")
                )
        self._spoken.append(self._find_or_add(mention, noun))
        return self._spoken[-1]

    def _describe_scene(self, attributes: Sequence[str]) -> None:
        """Note how the room looks: the one that was named, or one of no kind."""
        if {"sizes", "states"}.isdisjoint(appearance_words().classify(attributes)):
            return
        row = next((i for i, m in enumerate(self.mentions) if m.room and not m.negated), None)
        if row is not None:
            self.describe_thing(row, attributes)
            return
        words = " ".join([*attributes, "room"])
        self.mentions.append(Mention(words, "room", attributes=tuple(attributes)))
        row = len(self.mentions) - 1
        self.statements.append(Statement(Kind.ROOM, (row,), certainty=self.certainty, text=words))

    def _find_or_add(self, mention: Mention, noun: NounPhrase) -> int:
        """Return the row of a mention: "the table" is the table spoken of before."""
        if any(d.type == "DET" for d in noun.determiners) and not mention.negated:
            for row in range(len(self.mentions) - 1, -1, -1)[:_REMEMBERED]:
                if not self.mentions[row].negated and _may_be_same(mention, self.mentions[row]):
                    return row
        self.mentions.append(mention)
        return len(self.mentions) - 1

    def describe_thing(self, row: int | None, attributes: Sequence[str]) -> None:
        """Note how a thing looks, or the room, or where in the room a thing stands."""
        if row == SCENE and attributes:
            self._describe_scene(attributes)
        if row is not None and row >= 0:
            own = self.mentions[row]
            new = tuple([word for word in attributes if word not in own.attributes])
            self.mentions[row] = replace(own, attributes=own.attributes + new)

    def take(self, clause: Clause, certainty: float) -> None:
        """Add what a clause says."""
        self.certainty = certainty
        before, after = list(clause.before), list(clause.after)
        things = [item for item in before if isinstance(item, NounPhrase)]
        match clause.verb:
            case "is_" if things and after and isinstance(after[0], PlacePhrase):
                nouns = [i for i, item in enumerate(after) if isinstance(item, NounPhrase)]
                rest = nouns[0] if nouns else len(after)
                self._place_subjects(before, after[:rest])
                self._walk(after[rest:], ME)  # "..., a lamp behind me"
            case "is_" if things and not any(t.kind == "thing" for t in things):
                self._walk(after, ME)  # "this is the kitchen"
            case "is_" if things:
                self._read_looks(before, after)
            case "sees":
                self._read_sight(before, after)
            case "has":
                self._read_holder(before, after)
            case _:  # "behind me is a bookcase", "on the table there is a plant"
                self._walk(_things_first(after, before), ME)

    def _place_subjects(self, subjects: Sequence[Item], places: Sequence[Item]) -> None:
        """Read "The sofa and the table are on my left"."""
        rest = [item for item in subjects if isinstance(item, PlacePhrase)]
        behind = [item for item in places if isinstance(item, PlacePhrase)]
        for thing in [item for item in subjects if isinstance(item, NounPhrase)]:
            attributes = looks_of(thing)
            if attributes and self._spoken:
                # "the sofa, which is red, is ..."
                self.describe_thing(self._spoken[-1], attributes)
                continue
            self._walk([thing, *rest, *behind], ME)
            rest = []

    def _read_looks(self, before: list[Item], after: Sequence[Item]) -> None:
        """Read "The walls are blue", "the floor is dark wood"."""
        spoken = len(self._spoken)
        self._walk(before, ME)
        row = self._spoken[-1] if len(self._spoken) > spoken else SCENE
        for i, item in enumerate(after):
            attributes = looks_of(item) if isinstance(item, NounPhrase) else ()
            if not isinstance(item, Chunk) and not attributes:
                self._walk(after[i:], ME)
                return
            self.describe_thing(row, attributes)

    def _read_sight(self, before: list[Item], after: list[Item]) -> None:
        """Read "On my left I see a plant on the table"."""
        places = [item for item in before if isinstance(item, PlacePhrase)]
        directions = [place for place in places if place.how == "towards"]
        self._walk([place for place in places if place.how != "towards"], ME)
        if directions:
            self._walk(_things_first(after, directions), ME)
            return
        first = len(self.statements)
        self._walk(after, ME)
        seen = self.statements[first:]
        placed = {t for s in seen if s.kind not in (Kind.HOLDS, Kind.RELATED) for t in s.mentions}
        self.statements[first:] = [
            replace(s, kind=Kind.TOWARDS, wide=True)
            if s.kind is Kind.HOLDS and s.mentions[0] not in placed
            else s
            for s in seen
        ]

    def _read_holder(self, before: list[Item], after: list[Item]) -> None:
        """Read "The kitchen has two sinks", "the table has a plant on it"."""
        things = [item for item in before if isinstance(item, NounPhrase)]
        holder = self.resolve(things[-1]) if things else ME
        self._walk([item for item in before if not isinstance(item, NounPhrase)], ME)
        if holder is not None and holder >= 0 and self.mentions[holder].room:
            self.state(Kind.ROOM, (holder,), things[-1])
            holder = ME
        held: list[Item] = []
        for item in after:
            if isinstance(item, NounPhrase):
                held.append(PlacePhrase("with_", item.start, item.end, (item,)))
            elif isinstance(item, Chunk) or not any(t.kind == "IT" for t in item.targets):
                held.append(item)
        self._walk(held, ME if holder is None else holder)

    def _walk(self, items: Sequence[Item], base: int) -> None:
        """Read things and places in the order of speech.

        A place right after a thing is said of that thing (`anchor`); after a joint it is said of
        what was spoken of all along (`base`): the speaker, where a place came first.
        """
        anchor, holder, joint = base, base, True
        leads = base == ME and bool(items) and isinstance(items[0], NounPhrase)
        for i, item in enumerate(items):
            if isinstance(item, NounPhrase):
                attributes = looks_of(item)
                if attributes:  # "a hall, quite empty"
                    self.describe_thing(anchor if anchor >= 0 else SCENE, attributes)
                    continue
                row = None if self._leads_on(items[i - 1 : i], item) else self.resolve(item)
                if row is None:
                    continue
                if row < 0 or self.mentions[row].room:
                    base = anchor = holder = ME
                    leads = False
                else:
                    anchor = row
                    base = row if leads else base
                self._hold(row, item)
            elif isinstance(item, PlacePhrase) and item.how == "with_":
                anchor = self._read_part(item, holder if joint else anchor, items[i + 1 :])
            elif isinstance(item, PlacePhrase):
                subject = ME if item.how == "faces" else base if joint else anchor
                anchor = self._put(subject, item, anchor)
            joint = isinstance(item, Chunk)

    @staticmethod
    def _leads_on(before: Sequence[Item], noun: NounPhrase) -> bool:
        """Tell whether a thing is a room behind a way out: "a door to the balcony"."""
        way = before[0] if before else None
        out = isinstance(way, NounPhrase) and bool(way.words) and way.words[-1].words in _WAYS
        named = noun.kind == "thing" and room_kind(" ".join([c.words for c in noun.words]))
        return out and bool(named)

    def _read_part(self, item: Place, owner: int, following: Sequence[Item]) -> int:
        """Read "with two sinks": of the scene, or of the thing before; return what is spoken of."""
        row = self.resolve(item.targets[0])
        if row is None or row < 0:
            return owner
        after = following[0] if following else None
        goes_on = isinstance(after, PlacePhrase) and after.how in ("towards", "here", "sight")
        if owner >= 0 and owner != row and not goes_on:
            self._parts.add(row)
            self.state(Kind.RELATED, (row, owner), item, relation="with")
        else:
            self._hold(row, item.targets[0])
        return row

    def _hold(self, row: int, item: NounPhrase) -> None:
        """State that a thing is here, or that this is a room."""
        if row >= 0:
            self.state(Kind.ROOM if self.mentions[row].room else Kind.HOLDS, (row,), item)

    # places: "in the corner", "next to the sofa", "behind me"

    def _put(self, subject: int, place: Place, anchor: int) -> int:
        """State a place of a subject; return what a place right after it is said of."""
        match place.how:
            case "towards" | "here" | "sight":
                return self._put_around_me(anchor if anchor >= 0 else subject, place)
            case "alone":  # "with a mirror above": of what was spoken of before
                other = next((row for row in reversed(self._spoken) if row != subject), None)
                if subject < 0 or other is None or self.mentions[other].room:
                    self._ignore(place, "does not mention an object")
                else:
                    self._relate(subject, place, other)
                return subject
            case "row" | "related" if self._put_in_room(subject, place):
                return anchor
        rows = [self.resolve(thing, other_than=subject) for thing in place.targets]
        targets = [row for row in rows if row is not None]
        if None in rows or (subject >= 0 and subject in targets):
            itself = subject in targets
            self._ignore(
                place, "relates a thing to itself" if itself else "does not mention an object"
            )
            return anchor
        if any(t < 0 for t in targets):  # "left of me", "far from me"; or of the room
            if ME in targets and subject >= 0 and place.how in ("related", "far"):
                self.state(Kind.NEAR if place.how == "related" else Kind.FAR, (subject,), place)
            elif subject != ME or place.word != "in":
                self._ignore(place, "does not mention an object")
            return anchor
        return self._put_at(subject, place, targets)

    def _put_at(self, subject: int, place: Place, targets: list[int]) -> int:
        """State a place of a subject by things; return what a place right after it is said of."""
        if place.how == "faces":
            self.state(Kind.TOWARDS, (targets[0],), place)
            return targets[0]
        if place.how == "between":
            two = (targets[0], targets[-1])
            if subject < 0:
                self.state(Kind.BETWEEN, two, place)
                return subject
            for target in dict.fromkeys(two):
                self.state(Kind.RELATED, (subject, target), place, relation="next to")
            return subject
        if self.mentions[targets[0]].room and (place.word == "in" or subject == ME):
            self.state(Kind.ROOM, (targets[0],), place)
            return subject
        if subject >= 0:
            self._relate(subject, place, targets[0])
        elif place.how == "far":
            self.state(Kind.FAR, (targets[0],), place)
        else:
            relation = "" if place.word in _BESIDES else place.word
            self.state(Kind.NEAR, (targets[0],), place, relation=relation)
        return targets[0]

    def _put_in_room(self, subject: int, place: Place) -> bool:
        """Note where in the room a thing stands, "in the corner", or that it is "in red"."""
        if place.how == "row":
            self.describe_thing(subject, ("in a row",))
            return True
        if subject < 0:
            return False
        target = place.targets[0]
        part = " ".join([chunk.words for chunk in target.words])
        attributes = looks_of(target) if place.word == "in" else ()
        if target.kind == "PART":  # "at the end" says no more
            attributes = (PARTS[part],) if not place.negated and part in PARTS else ()
        elif not attributes and place.word in _BY_WALL and part.endswith(("wall", "walls")):
            attributes = () if place.negated else ("against the wall",)
        self.describe_thing(subject, attributes)
        return bool(attributes) or target.kind == "PART"

    def _put_around_me(self, subject: int, place: Place) -> int:
        """State "on my left", "next to me", "in sight" of a thing."""
        if subject >= 0:
            kinds = {"towards": Kind.TOWARDS, "here": Kind.NEAR, "sight": Kind.HOLDS}
            self.state(kinds[place.how], (subject,), place)
        elif place.how == "towards":
            self._ignore(place, "does not mention an object")
        return subject

    def _relate(self, subject: int, place: Place, target: int) -> None:
        far = place.how == "far"
        self.state(
            Kind.RELATED,
            (subject, target),
            place,
            relation="next to" if far else place.word or "next to",
            negated=place.negated is not far,
        )

    def _ignore(self, place: Place, reason: str) -> None:
        self.ignored.append(IgnoredText(self.text[place.start : place.end], reason))


def _may_be_same(one: Mention, other: Mention) -> bool:
    """Tell whether two mentions may be of one thing."""
    if one.room or other.room:
        return one.room == other.room
    if one.count is not None and one.count != other.count:
        return False
    return matches_label(one.label, other.label) and set(one.attributes) <= set(other.attributes)


def looks_of(noun: NounPhrase) -> tuple[str, ...]:
    """Return the attributes that a noun phrase is nothing but: "blue", "dark wood"; else none."""
    words = [chunk.words for chunk in noun.words]
    if noun.owner is not None and words in ([w] for w in _MADE):
        return looks_of(noun.owner)  # "made of dark wood"
    if noun.kind != "thing" or not words or noun.owner is not None or noun.determiners:
        return ()
    if len(words) == 1 and words[0] in _THINGS_TOO:
        return ()
    found, first = parse_attributes([*words, ""])
    return found if first == len(words) else ()


def _mention(noun: NounPhrase, text: str) -> Mention:
    """Return the mention of a noun phrase."""
    words = [chunk.words for chunk in noun.words]
    before, first = parse_attributes(words)
    after, last = parse_trailing_colours(words[first:])
    owner = noun.owner if noun.owner is not None and noun.owner.kind == "thing" else None
    if owner is not None and words[-1] in _MADE and len(words) > first + 1:
        after, last, owner = looks_of(owner), len(words) - first - 1, None
    label = " ".join(words[first : first + last])
    if owner is not None and not owner.determiners:
        label = " ".join([label, "of", *[chunk.words for chunk in owner.words]])
    kinds = {d.type for d in noun.determiners}
    count = next((d.value for d in noun.determiners if d.type == "NUM"), None)
    several = "SOME" in kinds
    # "curtains", but not "glass" and "coats"
    plural = label.endswith("s") and not label.endswith(("ss", "us")) and label not in _MANY_IN_ONE
    named_by, _, last_word = label.rpartition(" ")  # "office space"
    of_room = named_by if last_word in ("space", "area", "part") else ""
    return Mention(
        words=text[noun.start : noun.end],
        label=label,
        count=count,
        several=several,
        plural=count is None and not several and plural,
        attributes=before + after,
        negated="NO" in kinds or count == 0,
        room=room_kind(label) or room_kind(of_room),
    )


def _things_first(after: Sequence[Item], before: Sequence[Item]) -> list[Item]:
    """Return things, then where they are: "behind me is a bookcase"."""
    places = [item for item in before if isinstance(item, PlacePhrase)]
    first = next((i for i, item in enumerate(after) if isinstance(item, NounPhrase)), None)
    if first is None or not places:
        return [*[item for item in before if isinstance(item, NounPhrase)], *places, *after]
    return [*after[: first + 1], *places, *after[first + 1 :]]
