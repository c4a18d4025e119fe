"""Sentences about the outside and the inside: which wing reads which part, in which language.

Both wings read the whole text. An object is outside where the city has its name, or has such objects and
no room does; a statement about objects inside is no evidence for a place in town, and the other way
round. "Library" is a room in one home and a building in the next town: where the city has one, that.

Floors are taken out of a text before the rest is read: no map draws them. In English the second floor is
OpenStreetMap's level 1 (American) or 2 (British), each as likely; "im zweiten Stock" is level 2.

The outdoor parser knows the grammar of many languages. Objects of rooms in its output ("in der Küche, am
Fenster") get their English words from a table, and its relations become statements about the inside.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph.core.estimate import Evidence
from placegraph.indoor.language import read as read_inside
from placegraph.indoor.language.likeness import EXACT, match_labels, room_kind, table
from placegraph.indoor.language.sentence import Kind, Mention, Sentence, Statement
from placegraph.io.osm.indoor_osm import parse_levels
from placegraph.language.text import IgnoredText, check_text
from placegraph.outdoor.language.description import (
    LISTENER,
    SPEAKER,
    WITHIN,
    Description,
    Relation,
    ends,
)
from placegraph.outdoor.language.description import Statement as OutdoorStatement
from placegraph.outdoor.language.words import COMPASS
from placegraph.outdoor.search.request import parse as read_outside

if TYPE_CHECKING:
    from placegraph.world.towns import Town, TownWords

WRONG_FLOOR_SHARE = 0.12
"""Share of wrong statements about floors, as of other statements."""
FLOOR_PRIOR = 0.25
"""Share of people on any one floor."""
BASEMENT_LEVELS = (-1.0, -2.0, -3.0)
"""Levels of a basement."""
UPPER_LEVELS = tuple(map(float, range(1, 200)))
"""Levels that may be the top floor of a house that has several."""
_ON_TOP = 0.4
"""Share of people on a top floor, among those above the ground: which level it is, no map says."""
MIN_SENSE_WEIGHT = 0.7
"""Weight from which on a word means such an object of the map."""
MAX_ENDING = 2
"""Letters that a word may have behind the one of the table: "Fenstern", "Lampen"."""
_EN = "first|second|third|fourth|fifth|sixth|seventh|eighth|ninth|tenth"
_DE = "erste|zweite|dritte|vierte|fünfte|sechste|siebte|achte|neunte|zehnte"
_NUMBER = {w: i for words in (_EN, _DE) for i, w in enumerate(words.split("|"), 1)}
_NOT = r"(?P<no>\b(?:not|nicht)\s+)?"
_FLOORS = (
    (
        "en", _NOT + r"\b(?:(?:on|at|in|from)\s+)?(?:(?:the|my|our)\s+)?(?:"
        rf"(?P<nth>{_EN}|\d{{1,2}}(?:st|nd|rd|th))\s+(?:floor|storey|story|level)"
        r"|(?:floor|level)\s+(?P<n>\d{1,2})|(?P<zero>ground\s+(?:floor|level))|(?P<low>basement|cellar)"
        r"|(?P<up>(?:top|upper|uppermost)\s+(?:floor|storey|story|level)|attic))\b"
        r"(?P<of>\s+of\b)?",
    ),
    (
        "de", _NOT + r"\b(?:(?:im|in\s+der|in\s+dem|auf\s+der|in\s+meinem)\s+)?(?:"
        rf"(?P<nth>(?:{_DE})[nrms]?|\d{{1,2}}\.)\s*(?:stockwerk|stock|etage|obergeschoss|geschoss|og)"
        r"|(?P<zero>erdgeschoss|parterre|eg)|(?P<low>keller|untergeschoss|ug)"
        r"|(?P<up>oberste[nrms]?\s+(?:stockwerk|stock|etage|geschoss)|dachgeschoss|obergeschoss|dg))\b"
        r"(?P<of>\s+(?:der|des|vom|von|in\s+der|im)\b)?",
    ),
)  # fmt: skip
_PATTERNS = {name: re.compile(pattern, re.IGNORECASE) for name, pattern in _FLOORS}
_ME = re.compile(
    r"\b(?:i|we)(?:['’]m|['’]re|\s+(?:am|are|was|stand|sit|live|work))\b|\b(?:ich|wir)\s+(?:bin|sind|steh|sitz|wohn)"
    r"|^\W*(?:in|on|at|im|auf|not|nicht|ground|basement|erdgeschoss|\d|the\s+\w+\s+floor|"
    rf"{_EN}|{_DE})\b",
    re.IGNORECASE,
)
"""Pattern of a sentence about the speaker, or without a verb."""
_NOTHING = re.compile(r"\W*(?:(?:i|we|ich|wir)\b\W*\w*\W*)?", re.IGNORECASE)
"""Pattern of words that say nothing about the place: "I am"."""
_INSIDE_WORDS = {"der": "in der", "in der": "in der", "des": "im", "of": "in"}


_ARTICLES = frozenset(
    ("a", "an", "the", "my", "our", "one", "two", "three", "some", "this", "that")
)


@dataclass(frozen=True)
class FloorStatement:
    """A floor that the speaker is on, by the text."""

    text: str
    levels: Mapping[float, float]
    """Probability that each level is meant."""
    negated: bool = False

    def ratio(self, level: str, storeys: int = 0) -> float:
        """Log-likelihood ratio of a level, or of one of so many storeys above; 0 where it is not known."""
        base = parse_levels(level)
        if not base:
            return 0.0
        there = {low + n for low in base for n in range(storeys + 1)}
        meant = max(self.levels.get(at, 0.0) for at in there)
        odds = 1.0 - meant if self.negated else meant / FLOOR_PRIOR
        return float(np.log((1.0 - WRONG_FLOOR_SHARE) * odds + WRONG_FLOOR_SHARE))

    def explain(self, level: str, storeys: int = 0) -> Evidence:
        """Compute the evidence of the statement for a level."""
        weight = self.ratio(level, storeys)
        verdict = "for" if weight > 0 else "against" if weight < 0 else "silent"
        note = (
            "" if weight > 0 else f"this is floor {level}" if weight else "its floor is not known"
        )
        return Evidence(self.text, verdict, weight, (), note)


def compare_floors(floors: Sequence[FloorStatement], level: str, storeys: int = 0) -> float:
    """Log-likelihood ratio of a level, or of storeys above, by all statements about floors."""
    return sum(floor.ratio(level, storeys) for floor in floors)


def read_floors(text: str) -> tuple[tuple[FloorStatement, ...], str]:
    """Read the floors that the speaker is on; return them, and the text without them."""
    found: list[FloorStatement] = []
    kept = []
    for sentence in re.split(r"(?<=\D[.!?;])\s+", text):
        rest = sentence
        if _ME.search(sentence):
            for language, pattern in _PATTERNS.items():
                floors = [_read_floor(m, language) for m in pattern.finditer(rest)]
                found += floors
                rest = pattern.sub(_drop_floor, rest) if floors else rest
            rest = "" if _NOTHING.fullmatch(rest) else rest
        kept.append(rest)
    if not found:
        return (), text
    left = re.sub(r"\s+([,.;!?])", r"\1", " ".join(kept))
    return tuple(found), re.sub(r"[,;]+\s*([.,;!?])", r"\1", " ".join(left.split())).strip(" ,;")


def _read_floor(match: re.Match[str], language: str) -> FloorStatement:
    ordinal = match["nth"] or (match["n"] if language == "en" else None)
    levels: dict[float, float]
    if ordinal is not None:
        digits, word = re.match(r"\d+", ordinal), ordinal.casefold()
        k = float(
            digits[0] if digits else next(n for w, n in _NUMBER.items() if word.startswith(w))
        )
        levels = {k: 1.0} if language == "de" else {k: 0.5, k - 1.0: 0.5}
    elif match["zero"]:
        levels = {0.0: 1.0}
    else:
        levels = (
            dict.fromkeys(UPPER_LEVELS, _ON_TOP)
            if match["up"]
            else dict.fromkeys(BASEMENT_LEVELS, 1.0)
        )
    return FloorStatement(
        match[0].removesuffix(match["of"] or "").strip(), levels, bool(match["no"])
    )


def _drop_floor(match: re.Match[str]) -> str:
    """Return the words that replace a floor: "on the second floor of the hotel" becomes "in the hotel"."""
    after = " ".join((match["of"] or "").casefold().split())
    return _INSIDE_WORDS.get(after, "im") if after else ""


@dataclass(frozen=True)
class ParsedSentence:
    """A text as both wings understand it."""

    text: str
    outside: Mapping[str, Description]
    """Statements about the outside, by name of the town; only where there are some."""
    inside: Sentence | None
    """Statements about the inside; None without any."""
    ignored: tuple[IgnoredText, ...] = ()
    """Parts that neither wing could use."""
    floors: tuple[FloorStatement, ...] = ()
    language: str = "en"
    """Code of the language, as far as the outdoor parser tells it."""

    @property
    def indoors(self) -> bool:
        """Whether the speaker may be inside of something."""
        statements = (s for d in self.outside.values() for s in d.statements)
        return self.inside is not None or bool(self.floors) or any(
            s.relation in WITHIN and s.source == SPEAKER for s in statements
        )  # fmt: skip

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and strings."""
        outside = dict.fromkeys(s.text.strip() for d in self.outside.values() for s in d.statements)
        inside = [f"floor: {floor.text}" for floor in self.floors]
        for s in self.inside.statements if self.inside else ():
            words = (self.inside.mentions[t].words for t in s.mentions) if self.inside else ()
            inside.append(f"{s.kind.value}: {' and '.join(words)}")
        return {
            "text": self.text,
            "outside": list(outside),
            "inside": inside,
            "ignored": [{"text": i.text, "reason": i.reason} for i in self.ignored],
        }


def parse_sentence(
    text: str,
    towns: Mapping[str, Town],
    objects: Sequence[str],
    heading: float | None = None,
    names: Collection[str] = (),
    language: str | None = None,
) -> ParsedSentence:
    """Parse a text for all towns and for rooms.

    Raises `DescriptionError`: the text is empty, too long, or no text.

    `text`: one or more sentences.
    `towns`: cities, and worlds in shards, by name.
    `things`: labels of the objects in the rooms of the world, and names of these rooms.
    `heading`: where the speaker looks [rad], clockwise from north.
    `names`: names of scenes and buildings, which no city needs to know.
    `language`: of the text, as of `CityMap.locate`.
    """
    check_text(text, "I am in the library on Main Street, by the window.")
    floors, left = read_floors(text)
    full: dict[str, Description] = {}
    for name, town in (towns if left else {}).items():
        description = read_outside(town.words, left, heading=heading, language=language)
        full[name] = translate_rooms(resolve_addresses(description, town), town.words)
    own = {_normalize(name) for name in names}
    out = {name: _find_outdoors(d, towns[name].words, objects, own) for name, d in full.items()}
    outside = {name: _keep_outside(d, out[name]) for name, d in full.items()}
    outside = {name: d for name, d in outside.items() if d.statements}
    spoken = {
        word
        for name, d in full.items()
        for i in out[name]
        for word in _split_words(d.mentions[i].words)
    }
    inside = None
    foreign = next((d for d in full.values() if d.language != "en"), None)
    if left and objects:
        inside = read_inside(left) if foreign is None else convert_to_indoor(foreign)
    parts = {word for name in own for word in name.split()}
    sentence = None if inside is None else _keep_inside(inside, spoken | COMPASS | parts)
    ignored = tuple(dict.fromkeys(i for d in full.values() for i in d.ignored))
    if not towns and inside is not None:
        ignored = inside.ignored
    if sentence is not None:  # the other wing could use these
        used = {
            _normalize(sentence.mentions[t].words) for s in sentence.statements for t in s.mentions
        }
        ignored = tuple(i for i in ignored if _normalize(i.text) not in used)
    # names of scenes and buildings count wherever they are spoken (`evidence`)
    ignored = tuple(
        i for i in ignored if not any(f" {n} " in f" {_normalize(i.text)} " for n in own)
    )
    language = foreign.language if foreign else "en"
    return ParsedSentence(text, outside, sentence, ignored, floors, language)


def resolve_addresses(description: Description, town: Town) -> Description:
    """Write addresses as the map does, number first ("5 Gartenweg"), and tell streets from places.

    The speaker is along what the map knows as a street, whatever its name: "on Fischergang".
    """
    mentions = []
    for m in description.mentions:
        words = m.name.split()
        is_address = len(words) > 1 and words[-1][0].isdigit()
        turned = " ".join([words[-1], *words[:-1]]) if is_address else ""
        street = " ".join(words[:-1])
        if turned and not town.words.name_index.find_rows(turned):  # the map may lack the house
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


def _find_outdoors(
    description: Description, town: TownWords, objects: Sequence[str], own: Collection[str]
) -> set[int]:
    """Find the mentions of objects on the map of a town, and not in a room."""
    out, either = set(), set()
    for m in description.mentions[LISTENER + 1 :]:
        words = _normalize(m.words)
        known = any(s.weight >= MIN_SENSE_WEIGHT and s.label in town.label_index for s in m.senses)
        if m.name:
            is_out = bool(town.name_index.find_rows(m.name)) or words not in own
        elif room_kind(words):
            held = {room_kind(thing) for thing in objects}
            whole = " " in words and words in {
                _normalize(s.label.partition("=")[2]) for s in m.senses
            }
            is_out = known and (whole or room_kind(words) not in held)  # a post office is no office
        else:  # rooms of this world hold such things, or homes
            is_out = not any(
                (match_labels(words, t) >= EXACT).any() for t in (objects, table().labels) if t
            )
        if is_out:
            out.add(m.id)
        elif known and not room_kind(words):
            either.add(m.id)
    for (
        s
    ) in description.statements:  # what both have is outside where it lies north, or by a church
        beside = bool(_list_ends(s) & out) and SPEAKER not in ends(s)
        if beside or COMPASS.intersection(_split_words(s.text)):
            out |= either & _list_ends(s)
    return out if objects else out | either  # where no room is mapped, what is known is outside


def _keep_outside(description: Description, out: Collection[int]) -> Description:
    """Drop the statements about objects inside.

    Statements about the room of the speaker become ones about the speaker: "in the kitchen of the hotel".
    """
    known = {*out, SPEAKER, LISTENER}
    rooms = {
        s.target
        for s in description.statements
        if s.source == SPEAKER and s.relation in WITHIN and s.target not in known
    }
    kept = []
    for s in description.statements:
        of_room = s.source in rooms and s.relation is Relation.NEAR
        moved = replace(s, source=SPEAKER, relation=Relation.INSIDE) if of_room else s
        if _list_ends(moved) <= known and _list_ends(moved) - {SPEAKER, LISTENER}:
            kept.append(moved)
    return replace(description, statements=tuple(kept))


def _list_ends(s: OutdoorStatement) -> set[int]:
    return {*ends(s), s.target2 if s.target2 is not None else SPEAKER}


def _keep_inside(sentence: Sentence, outside: Collection[str]) -> Sentence | None:
    """Drop the statements about objects outside; return None where nothing is left.

    A relation to something outside becomes one to the speaker: "in the library, by the window".
    """
    mentions = [_drop_words(m, outside) for m in sentence.mentions]
    away = {i for i, m in enumerate(mentions) if m is None}
    kept: list[Statement] = []
    for s in sentence.statements:
        there = [t for t in s.mentions if t not in away]
        if len(there) == len(s.mentions):
            new = any(mentions[t] is not sentence.mentions[t] for t in there)
            kept.append(replace(s, kind=Kind.ROOM) if new and len(there) == 1 else s)
        elif s.kind is Kind.RELATED and s.mentions[1] in there:
            kept.append(replace(s, kind=Kind.NEAR, mentions=(s.mentions[1],), relation="next to"))
    both = (new or old for new, old in zip(mentions, sentence.mentions, strict=True))
    return replace(sentence, mentions=tuple(both), statements=tuple(kept)) if kept else None


def _drop_words(mention: Mention, outside: Collection[str]) -> Mention | None:
    """Drop words of things outside, "the kitchen of the hotel"; return None where no room is left."""
    words = _split_words(mention.label)
    left = [w for w in words if w not in outside]
    if left == words:
        return mention
    own = " ".join(w for w in left if w != "of")
    return replace(mention, label=own, room=room_kind(own)) if room_kind(own) else None


def _split_words(text: str) -> list[str]:
    words = "".join(c if c.isalnum() else " " for c in text.casefold()).split()
    return [w for w in words if w not in _ARTICLES]


def _normalize(text: str) -> str:
    return " ".join(_split_words(text))


def translate_rooms(description: Description, town: TownWords) -> Description:
    """Give objects of rooms their English words; names on the town's map stay."""
    english = _load_tables().get(description.language)
    if english is None:
        return description
    mentions, known = list(description.mentions), set()
    for i, m in enumerate(description.mentions[LISTENER + 1 :], LISTENER + 1):
        word = _translate(m.words, english)
        if word and not (m.name and town.name_index.find_rows(m.name)):
            mentions[i] = replace(m, words=word, name="")
            known.add(m.words)
    ignored = tuple(i for i in description.ignored if i.text not in known)
    return replace(description, mentions=tuple(mentions), ignored=ignored)


def _translate(words: str, english: Mapping[str, str]) -> str:
    """Translate the name of an object, in any case or number, to English; empty where unknown."""
    last = words.casefold().split()[-1:] or [""]
    found = [w for w in english if last[0].startswith(w) and len(last[0]) - len(w) <= MAX_ENDING]
    return english[max(found, key=len)] if found else ""


def convert_to_indoor(description: Description) -> Sentence:
    """Convert a description with English words (`translate_rooms`) into statements about rooms."""
    english = _load_tables().get(description.language, {})
    mentions = description.mentions[LISTENER + 1 :]
    own = {
        m.id
        for m in mentions
        if m.words in english.values() or (english and room_kind(m.words) and not m.name)
    }
    objects = [Mention(m.words, m.words, m.count, room=room_kind(m.words)) for m in mentions]
    made: dict[tuple[Kind, tuple[int, ...]], Statement] = {}
    for s in description.statements:
        for kind, nodes in _convert_statement(s, own, objects):
            rows = tuple(node - LISTENER - 1 for node in nodes)
            relation = "next to" if kind is Kind.RELATED else ""
            new = Statement(
                kind, rows, relation, negated=s.negated, certainty=s.certainty, text=s.text
            )
            made.setdefault((kind, rows), new)
    return Sentence(description.text, tuple(objects), tuple(made.values()))


def _convert_statement(
    s: OutdoorStatement, own: set[int], objects: list[Mention]
) -> list[tuple[Kind, tuple[int, ...]]]:
    """Convert an outdoor statement to kinds and mentions of indoor statements."""

    def is_room(node: int) -> bool:
        return node > LISTENER and bool(objects[node - LISTENER - 1].room)

    nodes = [n for n in (s.source, s.target) if n in own]
    inside = (Relation.INSIDE, Relation.SAME)
    if s.far or not nodes:
        return []
    if len(nodes) == 2:
        if is_room(s.target):
            return [(Kind.ROOM, (s.target,)), (Kind.HOLDS, (s.source,))]
        if s.relation is Relation.NEAR:
            return [(Kind.RELATED, (s.source, s.target))]
        return [(Kind.HOLDS, (n,)) for n in nodes]
    if is_room(nodes[0]):  # the speaker is in it; "the kitchen of the hotel" says no more
        here = s.relation in inside and s.source == SPEAKER
        return [(Kind.ROOM, (nodes[0],))] if here else []
    is_near = SPEAKER in (s.source, s.target) and s.relation in (*inside, Relation.NEAR)
    return [(Kind.NEAR if is_near else Kind.HOLDS, (nodes[0],))]


@lru_cache(maxsize=1)
def _load_tables() -> dict[str, dict[str, str]]:
    """Load the English words of objects in rooms, by language."""
    text = files("placegraph.world").joinpath("data", "things.tsv").read_text("utf-8")
    tables: dict[str, dict[str, str]] = {}
    for line in text.splitlines():
        if not line.startswith("#"):
            language, words, english = line.split("\t")
            tables.setdefault(language, {}).update(
                dict.fromkeys((word.strip() for word in words.split(",")), english)
            )
    return tables
