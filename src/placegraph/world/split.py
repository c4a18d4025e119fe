"""What of a sentence speaks of the outside, and what of the inside.

Both wings read the whole of it. A thing is outside where the city has its name, or has such things
and no room does; what is said of things inside is no evidence for a place in town, and the other way
round. "Library" is a room in one home and a building in the next town: where the city has one, that.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from placegraph.indoor.language import read as read_inside
from placegraph.indoor.language.likeness import EXACT, fits, room_kind, table
from placegraph.indoor.language.sentence import Kind
from placegraph.language.text import Ignored, check_text
from placegraph.outdoor.language.description import LISTENER, SPEAKER, WITHIN, Relation
from placegraph.outdoor.likelihood.query import ends
from placegraph.outdoor.search.request import parse as read_outside
from placegraph.world.floors import said_floors
from placegraph.world.translate import in_english, of_rooms

if TYPE_CHECKING:
    from placegraph.indoor.language import Sentence
    from placegraph.indoor.language.sentence import Mention as Thing
    from placegraph.indoor.language.sentence import Statement as Inside
    from placegraph.outdoor.language.description import Description
    from placegraph.outdoor.language.description import Statement as Outside
    from placegraph.world.floors import Floor
    from placegraph.world.outside import Town, Words


SENSE = 0.7
"""Weight from which on a word means such a thing of the map."""
_ARTICLES = frozenset(
    ("a", "an", "the", "my", "our", "one", "two", "three", "some", "this", "that")
)
_WINDS = frozenset(
    ("north", "south", "east", "west", "northeast", "northwest", "southeast", "southwest")
)


@dataclass(frozen=True)
class Understood:
    """What was understood of a text, by both wings."""

    text: str
    outside: Mapping[str, Description]
    """Of each town, by its name, what is said of the outside; only where there is something."""
    inside: Sentence | None
    """What is said of the inside; None if nothing."""
    ignored: tuple[Ignored, ...] = ()
    """What neither wing could use."""
    floors: tuple[Floor, ...] = ()
    """Floors that the speaker was said to be on."""

    @property
    def indoors(self) -> bool:
        """Whether the speaker may be inside of something, by what was said."""
        said = (s for description in self.outside.values() for s in description.statements)
        return self.inside is not None or bool(self.floors) or any(
            s.relation in WITHIN and s.source == SPEAKER for s in said
        )  # fmt: skip

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings."""
        outside: dict[str, None] = {}
        for description in self.outside.values():
            outside |= dict.fromkeys(_told(description))
        inside = [_said(self.inside, s) for s in self.inside.statements] if self.inside else []
        return {
            "text": self.text,
            "outside": list(outside),
            "inside": [f"floor: {floor.text}" for floor in self.floors] + inside,
            "ignored": [{"text": i.text, "reason": i.reason} for i in self.ignored],
        }


def understand(
    text: str,
    towns: Mapping[str, Town],
    things: Sequence[str],
    heading: float | None = None,
    names: Collection[str] = (),
    language: str | None = None,
) -> Understood:
    """Read a text for all cities and for rooms.

    Parameters
    ----------
    text
        What was said.
    towns
        Cities, and worlds in shards, by name.
    things
        Labels of what stands in the rooms of the world, and names of these rooms.
    heading
        Where the speaker looks [rad], clockwise from north.
    names
        Names of scenes and buildings, which no city needs to know.
    language
        Of the text, as of `CityMap.locate`.

    Raises
    ------
    DescriptionError
        The text is empty, too long, or no text.

    """
    check_text(text, "I am in the library on Main Street, by the window.")
    floors, left = said_floors(text)
    whole = {
        name: in_english(
            addressed(read_outside(town.words, left, heading=heading, language=language), town),
            town.words,
        )
        for name, town in (towns if left else {}).items()
    }
    own = {" ".join(_words(name)) for name in names}
    out = {name: _outside(d, towns[name].words, things, own) for name, d in whole.items()}
    outside = {name: _kept(d, out[name]) for name, d in whole.items()}
    outside = {name: d for name, d in outside.items() if d.statements}
    spoken = {
        word for name, d in whole.items() for i in out[name] for word in _words(d.mentions[i].words)
    }
    inside = None
    if left and things:
        foreign = next((d for d in whole.values() if d.language != "en"), None)
        inside = read_inside(left) if foreign is None else of_rooms(foreign)
    sentence = None if inside is None else _inside(inside, spoken | _WINDS | _parts(own))
    ignored = tuple(dict.fromkeys(i for d in whole.values() for i in d.ignored))
    if not towns and inside is not None:
        ignored = inside.ignored
    if sentence is not None:  # what the other wing could use
        used = {_plain(sentence.mentions[t].words) for s in sentence.statements for t in s.things}
        ignored = tuple(i for i in ignored if _plain(i.text) not in used)
    # a scene's or a building's name is heard wherever it is spoken (`witnesses`)
    ignored = tuple(i for i in ignored if not any(f" {n} " in f" {_plain(i.text)} " for n in own))
    return Understood(text, outside, sentence, ignored, floors)


def addressed(description: Description, town: Town) -> Description:
    """A description with addresses as the map writes them, number first: "5 Gartenweg".

    One is along what the map knows as a street, whatever its name: "on Fischergang".
    """
    mentions = []
    for m in description.mentions:
        words = m.name.split()
        turned = (
            " ".join([words[-1], *words[:-1]]) if len(words) > 1 and words[-1][0].isdigit() else ""
        )
        street = " ".join(words[:-1])
        if turned and not town.words.name_index.named(turned):  # the map may lack the house
            turned = street if town.is_street(street) else ""
        mentions.append(replace(m, name=turned) if turned else m)
    statements = tuple(
        replace(s, relation=Relation.ALONG)
        if s.source == SPEAKER
        and s.relation in WITHIN
        and (name := mentions[s.target].name)
        and town.is_street(name)
        else s
        for s in description.statements
    )
    return replace(description, mentions=tuple(mentions), statements=statements)


def _outside(
    said: Description, town: Words, things: Sequence[str], own: Collection[str]
) -> set[int]:
    """Mentions that speak of something on the town's map, and not in a room."""
    out, either = set(), set()
    for m in said.mentions[LISTENER + 1 :]:
        words = " ".join(_words(m.words))
        known = any(s.weight >= SENSE and s.label in town.label_index for s in m.senses)
        if m.name:
            is_out = bool(town.name_index.named(m.name)) or words not in own
        elif room_kind(words):
            held = {room_kind(thing) for thing in things}
            whole = " " in words and words in {_plain(s.label.partition("=")[2]) for s in m.senses}
            is_out = known and (whole or room_kind(words) not in held)  # a post office is no office
        else:
            is_out = not _in_rooms(words, things)
        if is_out:
            out.add(m.id)
        elif known and not room_kind(words):
            either.add(m.id)
    for s in said.statements:  # what both have is outside where it lies north, or by a church
        beside = bool(_ends(s) & out) and SPEAKER not in ends(s)
        if beside or _WINDS.intersection(_words(s.text)):
            out |= either & _ends(s)
    return out if things else out | either  # where no room is mapped, what is known is outside


def _in_rooms(words: str, things: Sequence[str]) -> bool:
    """Whether rooms hold such things: those of this world, or homes."""
    return any(
        bool((fits(words, held) >= EXACT).any()) for held in (things, table().things) if held
    )


def _kept(said: Description, out: Collection[int]) -> Description:
    """A description without what is said of things inside.

    What is said of the room that one is in, is said of oneself: "in the kitchen of the hotel".
    """
    known = {*out, SPEAKER, LISTENER}
    rooms = {
        s.target
        for s in said.statements
        if s.source == SPEAKER and s.relation in WITHIN and s.target not in known
    }
    kept = []
    for s in said.statements:
        of_room = s.source in rooms and s.relation is Relation.NEAR
        told = replace(s, source=SPEAKER, relation=Relation.INSIDE) if of_room else s
        if _ends(told) <= known and _ends(told) - {SPEAKER, LISTENER}:
            kept.append(told)
    return replace(said, statements=tuple(kept))


def _ends(s: Outside) -> set[int]:
    return {*ends(s), s.target2 if s.target2 is not None else SPEAKER}


def _inside(said: Sentence, outside: Collection[str]) -> Sentence | None:
    """A sentence without what is said of things outside; None where nothing is left.

    What stands to something outside as a place to a speaker, stands so to the speaker: "in the
    library, by the window".
    """
    mentions = [_within(m, outside) for m in said.mentions]
    away = {i for i, m in enumerate(mentions) if m is None}
    kept: list[Inside] = []
    for s in said.statements:
        there = [t for t in s.things if t not in away]
        if len(there) == len(s.things):
            new = any(mentions[t] is not said.mentions[t] for t in there)
            kept.append(replace(s, kind=Kind.ROOM) if new and len(there) == 1 else s)
        elif s.kind is Kind.RELATED and s.things[1] in there:
            kept.append(replace(s, kind=Kind.NEAR, things=(s.things[1],), relation="next to"))
    both = (new or old for new, old in zip(mentions, said.mentions, strict=True))
    return replace(said, mentions=tuple(both), statements=tuple(kept)) if kept else None


def _within(thing: Thing, outside: Collection[str]) -> Thing | None:
    """A thing without the names of things outside, "the kitchen of the hotel"; None: it is one of these."""
    words = _words(thing.label)
    left = [w for w in words if w not in outside]
    if left == words:
        return thing
    own = " ".join(w for w in left if w != "of")
    return replace(thing, label=own, room=room_kind(own)) if room_kind(own) else None


def _words(text: str) -> list[str]:
    words = "".join(c if c.isalnum() else " " for c in text.casefold()).split()
    return [w for w in words if w not in _ARTICLES]


def _plain(text: str) -> str:
    return " ".join(_words(text))


def _parts(names: Collection[str]) -> set[str]:
    return {word for name in names for word in name.split()}


def _told(said: Description) -> list[str]:
    return [s.text.strip() for s in said.statements]


def _said(sentence: Sentence, s: Inside) -> str:
    things = " and ".join(sentence.mentions[t].words for t in s.things)
    return f"{s.kind.value}: {things}"
