"""From words to statements: what a text says of a place, and what of it was left unread."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from placegraph.indoor.language.chunk import chunks, clauses
from placegraph.indoor.language.parse import Clause, Item, Noun, Where, parse
from placegraph.indoor.language.places import Places
from placegraph.indoor.language.sentence import ME, Kind, Sentence
from placegraph.indoor.language.statements import SCENE, is_room, looks_of
from placegraph.language.check import Ignored, check
from placegraph.language.words import scan

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
    check(text, _EXAMPLE)
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
