"""Clauses: unambiguous chunks, cut at joints between finite verbs and parsed (Eq. 3)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from importlib.resources import files
from math import pi
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

from placegraph.language.grammar import (
    LONGEST_CLAUSE,
    UNSURE,
    Chunk,
    Clause,
    IslandParser,
    PlacePhrase,
    build_clause,
    build_place,
    build_with,
    negate,
)
from placegraph.language.text import Measure
from placegraph.outdoor.language.description import LOOSE_SIGMA, SHARP_SIGMA, Direction, Sense

if TYPE_CHECKING:
    from placegraph.outdoor.language.languages import Language

VERBS = frozenset(
    ("BE", "EXISTS", "SEE", "HAVE", "MEET", "GO", "PASS", "CROSS", "FOLLOW", "REACH", "TOOFAR")
)
JOINTS = frozenset(("AND", "CUT", "COND"))
NEXT_BLOCK = Measure.within(0.0, blocks=1.5)
"""Greatest distance of things on "the next block"."""
LOOSE = 0.8
"""Certainty of a direction that is "mostly" so."""
LEADS = frozenset(("ON", "IN", "AT", "TO", "FROM", "OF", "PREP"))
_BEFORE_DIRECTION = ("DET", "MY", "YOUR", "ITS", "GO")
_BEFORE_THING = frozenset(("DET", "THIS", "NAME", "MY", "YOUR", "A"))
_DETERMINERS = frozenset(("DET", "THIS", "A", "ANOTHER", "NO", "NUM", "MY", "YOUR", "ITS"))
_IN_THING = frozenset(("DET", "THIS", "A", "ANOTHER", "NUM", "WORD", "ADVERB"))
_ENDS = frozenset(("NOUN", "NAME", "ME", "DIR", "HERE", "NEARBY"))
"""Last terminal of a place: an object that follows without a joint is located there."""
_OWNED = frozenset(("NOUN", "NAME", "WORD", "DIR", "PART", "NUM", ""))
_RIGHT = Direction(pi / 2, facing=True)

_STARTS = VERBS - {"BE", "SEE", "HAVE"}
"""Verbs that open a clause of their own even without a joint before them."""
_BEFORE_TARGET = frozenset(("AND", "COND", "PREP", "OF", "FROM", "BETWEEN"))
"""Terminals before a person that is no subject, or is joined already: "next to it is a bank"."""
_SUBJECTS = frozenset(("ME", "YOU", "IT", "SPOT", "THIS"))
_GOVERNS = frozenset(("PREP", "OF", "FROM", "BETWEEN", "ACROSS", "IN", "ON", "AT", "TO", "WITH"))
"""Terminals that make a pronoun no subject of the verb after it: "next to it is a bakery"."""


class Part(NamedTuple):
    """The chunks of one clause."""

    chunks: list[Chunk]
    certainty: float
    opens: bool
    """Whether it opens its sentence."""


def cut_clauses(sentence: list[Chunk], language: Language) -> list[Part]:
    """Cut the chunks of a sentence into clauses."""
    chunks = list(resolve_types(sentence, language))
    verb_ahead, ahead = [False] * len(chunks), False
    for i in range(len(chunks) - 1, -1, -1):  # a verb before the next joint
        verb_ahead[i] = ahead
        ahead = chunks[i].type in VERBS or (ahead and chunks[i].type not in JOINTS)
    cutter = _Cutter()
    for chunk, ahead in zip(chunks, verb_ahead, strict=True):
        cutter.take(chunk, verb_ahead=ahead)
    cutter.cut()
    return cutter.parts


class _Cutter:
    """Collects the chunks of a clause until the next one begins."""

    def __init__(self) -> None:
        self.parts: list[Part] = []
        self.current: list[Chunk] = []
        self.certainty, self.has_verb = 1.0, False

    def take(self, chunk: Chunk, *, verb_ahead: bool) -> None:
        """Add the next chunk, or end the clause before it."""
        kind = chunk.type
        if kind == "UNSURE":
            self.certainty = UNSURE
        elif kind == "CUT" or (kind == "AND" and self.has_verb and verb_ahead):
            self.cut()
        elif kind == "AND":
            if self.current and self.current[-1].type != "AND":
                gives = chunk.words == ":" and not self.has_verb and not verb_ahead
                self.current.append(replace(chunk, type="BE") if gives else chunk)
                self.has_verb = self.has_verb or gives  # "north of me: a church"
        else:
            if kind == "COND" or len(self.current) >= LONGEST_CLAUSE:
                self.cut()
            crossing = kind == "CROSS" and any(c.type == "WHERE" for c in self.current[-6:])
            if kind in VERBS and not crossing:
                self._begin_verb(kind)
            self.current.append(chunk)

    def cut(self) -> None:
        """End the clause."""
        self._drop_joints()
        if self.current:
            self.parts.append(Part(self.current, self.certainty, not self.parts))
        self.current, self.certainty, self.has_verb = [], 1.0, False

    def _begin_verb(self, kind: str) -> None:
        """Cut before a second verb, and separate its subject from the place before it."""
        subject = None
        before = self.current[-2].type if len(self.current) > 1 else ""
        if self.current and self.current[-1].type in _SUBJECTS and before not in _GOVERNS:
            subject = self.current.pop()
        if self.has_verb and (subject is not None or kind in _STARTS):
            self.cut()  # "head south | meet me at the park"
        if kind in _STARTS or (kind == "BE" and subject is None):
            self._drop_joints()  # "to the north, there is"
        if subject is not None:
            if self.current and self.current[-1].type not in _BEFORE_TARGET:
                self.current.append(Chunk("AND", subject.start, subject.start))
            self.current.append(subject)  # "north of here you see"
        self.has_verb = True

    def _drop_joints(self) -> None:
        while self.current and self.current[-1].type == "AND":
            self.current.pop()


def resolve_types(chunks: Sequence[Chunk], language: Language) -> Iterator[Chunk]:
    """Decide what the ambiguous chunks of a sentence are; drop those that say nothing."""
    before, hedge, hedged_at = "", "", 0
    measured: Measure | None = None
    for i, chunk in enumerate(chunks):
        if chunk.type == "ADVERB":
            if chunk.value in ("sharp", "loose"):
                hedge, hedged_at = chunk.value, i
            elif chunk.value == "unsure":
                yield replace(chunk, type="UNSURE")
            continue
        if chunk.type == "DIST":
            measured = chunk.value
        counted = chunk.type == "NUM" and measured is not None and chunk.value
        if measured and counted and _is_distance(before, chunks[i + 1 : i + 5]):
            chunk.type, chunk.value = "DIST", measured.times(chunk.value)
        ambiguous = chunk.type in _TYPES or chunk.type in _BY_REST
        for resolved in (
            _resolve_type(chunk, before, chunks[i + 1 :], language) if ambiguous else (chunk,)
        ):
            if resolved.type == "DIR" and hedge and i - hedged_at <= 2:
                said: Direction = resolved.value
                resolved.value = (
                    said._replace(sigma=SHARP_SIGMA)
                    if hedge == "sharp"
                    else said._replace(sigma=LOOSE_SIGMA, certainty=LOOSE)
                )
                hedge = ""
            before = resolved.type
            yield resolved


def _next_types(behind: Sequence[Chunk]) -> list[str]:
    """Return the types of at most two next chunks that are no adverbs."""
    return [chunk.type for chunk in behind[:4] if chunk.type != "ADVERB"][:2]


def _is_distance(before: str, behind: Sequence[Chunk]) -> bool:
    """Tell whether a number is a distance whose unit was said before: "then 4 north"."""
    after = _next_types(behind)
    if before == "DIR":
        return not after or after[0] in JOINTS
    return after[:1] == ["DIR"] and after[1:] not in (["OF"], ["PART"])


_TYPES: dict[str, Callable[[Chunk, str, str], str | None]] = {
    # "my right", "right of", "turn right", and the adverb of "right next to"
    "RIGHT": lambda _, before, after: (
        "DIR" if before in _BEFORE_DIRECTION or after in ("OF", "PART") else ""
    ),
    # "N" is north where it is a capital or stands before "of"
    "SHORT": lambda chunk, _, after: "DIR" if chunk.capital or after == "OF" else "WORD",
    # "the opposite", "the adjacent block"
    "PREP": lambda chunk, before, _: (
        "WORD" if chunk.words in ("opposite", "adjacent") and before in ("DET", "A") else None
    ),
    # "over the road" is across the road, "head over to" is not
    "ACROSS": lambda chunk, _, after: (
        "" if chunk.words == "over" and after not in _BEFORE_THING else None
    ),
    # opens a sentence, or relates to the thing before
    "THAT_IS": lambda _, before, __: "" if before else "THIS BE",
    # "a garden that borders the lot"
    "THIS": lambda chunk, before, _: (
        "" if chunk.words == "that" and before in ("NOUN", "NAME") else None
    ),
    # ", with a bakery to my east" says that there is one
    "WITH": lambda _, before, __: "EXISTS" if before in ("", *JOINTS) else None,
    # "have gone too far", "we're having coffee at"
    "HAVE": lambda _, before, after: "" if before == "BE" or after == "TOOFAR" else None,
    # "I am walking along" says where one is, "I am walking north" which way one faces
    "GO": lambda _, before, after: None if before != "BE" else "FACE" if after == "DIR" else "",
    # "at it's end"
    "IT": lambda chunk, before, _: "ITS" if chunk.words == "it's" and before in LEADS else None,
    # "its next to a school"
    "ITS": lambda chunk, before, after: (
        "IT BE"
        if chunk.words == "its" and before in ("", *JOINTS) and after not in _OWNED
        else None
    ),
    # "at it's end", "you are too far", "I'm looking at", "where the bank is"
    "BE": lambda chunk, before, after: (
        ""
        if (chunk.words == "it's" and before == "ITS") or after in ("TOOFAR", "SEE", "")
        else None
    ),
}
"""Types that an ambiguous chunk takes between its neighbours; none: it is dropped, None: it stays."""


_BY_REST = frozenset(
    ("WORD", "A", "ANOTHER", "OF", "ON", "IN", "AT", "TO", "WHERE", "NOT", "CALLED", "LETS")
)
"""Types of other chunks that what follows them makes unambiguous."""


def _resolve_type(
    chunk: Chunk, before: str, behind: Sequence[Chunk], language: Language
) -> tuple[Chunk, ...]:
    """Return the type of a chunk between the type before and the chunks behind it."""
    following = _next_types(behind)
    after = following[0] if following else ""
    if chunk.type == "PREP" and chunk.value == "particle":  # "down the street", "head down south"
        return (replace(chunk, value="along"),) if after in _BEFORE_THING else ()
    if chunk.type in _TYPES:
        types = _TYPES[chunk.type](chunk, before, after)
        if types is None:
            return (chunk,)
        value = _RIGHT if chunk.type == "RIGHT" else chunk.value
        return tuple([replace(chunk, type=kind, value=value) for kind in types.split()])
    match chunk.type:
        case "WORD":
            return (_resolve_word(chunk, before, after, language),)
        case "A" | "ANOTHER" | "OF":
            return _resolve_article(chunk, before, following)
        case "ON" | "IN" | "AT":
            return (_resolve_block(chunk, behind),)
        case "TO" if behind and behind[0].type in VERBS and before:
            return (replace(chunk, type="CUT"),)  # "to meet me"
        case "WHERE" | "NOT" | "CALLED" | "LETS":
            return _resolve_by_following(chunk, behind, after)
    return (chunk,)


def _resolve_word(chunk: Chunk, before: str, after: str, language: Language) -> Chunk:
    """Mend a misspelt direction where only one can stand; set aside an unknown verb."""
    if after in ("OF", "PART") or before in _BEFORE_DIRECTION:
        direction = mend_direction(chunk.words, language, certain=after == "OF")
        if direction is not None:
            return replace(chunk, type="DIR", value=direction)
    unknown_verb = after in _DETERMINERS and before not in _DETERMINERS
    return replace(chunk, type="JUNK") if unknown_verb else chunk


def _resolve_article(chunk: Chunk, before: str, after: list[str]) -> tuple[Chunk, ...]:
    """Drop what stands before a measure: "a 2 minute walk", "for another 5 m", "a bit south of"."""
    if chunk.type == "A" and before in _ENDS and after[:1] in (["NOUN"], ["NAME"], ["WORD"]):
        return (replace(chunk, type="EXISTS"), chunk)  # "next to me a bank, to the north a park"
    measured = after[:1] == ["DIST"] or (chunk.type == "OF" and after == ["ANOTHER", "DIST"])
    return () if measured or (chunk.type == "A" and after == ["DIR", "OF"]) else (chunk,)


def _resolve_block(chunk: Chunk, behind: Sequence[Chunk]) -> Chunk:
    """Take "on the next block north" as that far to the north: no map draws a block."""
    for i, other in enumerate(behind[:-1]):
        if other.type == "PART" and other.value == "block" and behind[i + 1].type == "DIR":
            _skip(behind[: i + 1])
            return replace(chunk, type="DIST", value=NEXT_BLOCK)
        if other.type not in _IN_THING:
            break
    return chunk


def _resolve_by_following(chunk: Chunk, behind: Sequence[Chunk], after: str) -> tuple[Chunk, ...]:
    """Resolve "where", "not", "called" and "let's" by what follows them."""
    if chunk.type == "WHERE":  # "where A meets B" is a place, any other "where" opens a clause
        kinds = [other.type for other in behind[:6]]
        end = next((i for i, kind in enumerate(kinds) if kind in JOINTS), len(kinds))
        return (chunk,) if "CROSS" in kinds[:end] else (replace(chunk, type="CUT"),)
    if chunk.type == "NOT":  # the verb of "do not see" is negated
        verb = next((other for other in behind[:3] if other.type != "ADVERB"), None)
        if verb is None or verb.type not in ("SEE", "HAVE"):
            return (chunk,)
        verb.value = "NOT"
        return ()
    if chunk.type == "CALLED":  # "a bar called The Fox": the name follows its noun
        if [other.type for other in behind[:2]] == ["DET", "NAME"]:
            _skip(behind[:1])
        return ()
    if not behind or after in VERBS - {"HAVE"}:  # "let's have a drink at the bar"
        return ()
    place = _find_place(behind)
    if place == len(behind):
        return ()
    _skip(behind[:place])  # "let's get some paint at the store" is meeting at the store
    return (replace(chunk, type="MEET"),)


def _find_place(behind: Sequence[Chunk]) -> int:
    """Return the start of the place of "let's ..."; the number of chunks if there is none."""
    place = len(behind)
    for i, other in enumerate(behind):
        if other.type in JOINTS:
            break
        leads = other.type in ("AT", "IN", "ON", "DET", "THIS")  # "let's visit the museum"
        if leads or (other.type == "PREP" and other.value == "near"):
            return i
        if other.type in _DETERMINERS and place == len(behind):
            place = i
    return place


def _skip(chunks: Sequence[Chunk]) -> None:
    for chunk in chunks:
        chunk.type, chunk.value = "ADVERB", "skip"


@lru_cache(maxsize=4096)
def mend_direction(word: str, language: Language, *, certain: bool) -> Direction | None:
    """Return the direction that a misspelt word means, or None; short words need to be `certain`."""
    from rapidfuzz import process
    from rapidfuzz.distance import OSA

    compass = language.compass
    if len(word) < 4 or word in language.lists["no_compass"]:
        return None
    found = process.extractOne(word, compass.keys(), scorer=OSA.distance, score_cutoff=1)
    if found is None or (len(word) < 5 and not certain and sorted(word) != sorted(found[0])):
        return None
    return compass[found[0]]


@dataclass(slots=True)
class NounMeaning:
    """Value of a NOUN or NAME chunk: what it may be on a map."""

    senses: tuple[Sense, ...] = ()
    name: str = ""
    exact: bool = False
    """Whether it is a label as a map has it, and no English."""


@dataclass(slots=True)
class NounPhrase:
    """Somebody or something spoken of, in one place of the text."""

    kind: str
    """``ME YOU IT SPOT HERE`` or ``thing``."""
    start: int
    end: int
    determiner: str = ""
    """Terminal of the determiner: ``DET A ANOTHER NO NUM MY ...``, or empty."""
    count: int | None = None
    senses: tuple[Sense, ...] = ()
    head: str = ""
    """Common noun, lower-case: "bakery"; the last unknown word where there is none."""
    modifiers: tuple[str, ...] = ()
    """Words before the noun: "grey", "main"."""
    exact: bool = False
    """Whether the noun is a label as a map has it, and no English."""
    name: str = ""
    part: str = ""
    """Terminal of a part of an object: ``corner middle block ...``."""


Place: TypeAlias = PlacePhrase[NounPhrase]
Item: TypeAlias = NounPhrase | Place
Items: TypeAlias = tuple[Item, ...]
_SKIPPED = ("WORD", "JUNK", "AND", "TO", "NOT")
"""Chunks that may be left out where the grammar expects something else."""


def _build_conditional(children: list[Any]) -> Clause:
    clause: Clause = children[-1]
    clause.condition = len(children) > 1
    return clause


def _build_denied(children: list[Any]) -> NounPhrase:
    thing: NounPhrase = children[1]
    thing.determiner = "NO"
    return thing


def _build_measured(children: list[Any]) -> Place:
    """Build "50 m north of the church", "two blocks away"."""
    measure, last = children[0], children[-1]
    place: Place = (
        last if isinstance(last, PlacePhrase) else PlacePhrase("away", measure.start, last.end)
    )
    place.start, place.distance = measure.start, measure.value
    return place


def _build_person(children: list[Any]) -> NounPhrase:
    chunk: Chunk = children[0]
    return NounPhrase("IT" if chunk.type == "THIS" else chunk.type, chunk.start, chunk.end)


def _build_thing(children: list[Any]) -> NounPhrase:
    """Build a noun phrase of its determiner, words, nouns, name and part."""
    start, end = min(c.start for c in children), max(c.end for c in children)
    phrase = NounPhrase("thing", start, end)
    nouns = [child for child in children if child.type == "NOUN"]
    phrase.head = " ".join([child.words for child in children if child.type == "WORD"])
    for child in children:
        if child.type in _DETERMINERS:
            phrase.determiner = phrase.determiner or child.type
            phrase.count = child.value if child.type == "NUM" else None
        elif child.type == "NAME":
            meaning: NounMeaning = child.value
            phrase.name, phrase.senses, phrase.exact = meaning.name, meaning.senses, meaning.exact
        elif child.type == "PART" and not nouns:
            phrase.part = child.value
    if nouns:
        _take_nouns(phrase, nouns)
    return phrase


def _take_nouns(phrase: NounPhrase, nouns: Sequence[Chunk]) -> None:
    """Set the common noun of a phrase: "alcohol shop" is shop=alcohol, not any shop."""
    if phrase.name and len(nouns) > 1:  # "Cupka's cafe restaurant"
        phrase.name = " ".join([phrase.name, *[noun.words for noun in nouns[:-1]]])
        nouns = nouns[-1:]
    meaning: NounMeaning = nouns[-1].value
    phrase.modifiers = (*phrase.head.split(), *[noun.words for noun in nouns[:-1]])
    phrase.senses, phrase.head, phrase.exact = meaning.senses, nouns[-1].words, meaning.exact
    keys = {s.label.partition("=")[0] for s in meaning.senses if s.label.endswith(("=*", "=yes"))}
    for noun in nouns[:-1]:
        special = tuple([s for s in noun.value.senses if s.label.partition("=")[0] in keys])
        phrase.senses = special or phrase.senses


_BUILDERS = {
    **build_with(build_clause, "verb", "is_ exists sees meets goes too_far"),
    **build_with(
        build_place,
        "how",
        "towards side possessed at prep bare across between faces at_both with_ of start nearby here",
    ),
    "clause": _build_conditional,
    "fragment": lambda children: Clause("fragment", before=children[0]),
    "body": lambda children: tuple([item for item in children if not isinstance(item, Chunk)]),
    "not_": negate,
    "no_thing": _build_denied,
    "measured": _build_measured,
    "person": _build_person,
    "thing": _build_thing,
}


@cache
def parser() -> IslandParser:
    """Return the parser of descriptions of places (Eq. 3 of the paper)."""
    text = files(__package__).joinpath("outdoor.lark").read_text("utf-8")
    return IslandParser(text, "clause", _BUILDERS, _SKIPPED)
