"""Chunks: the words of a text, grouped into the terminals of the grammar, and cut into clauses."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partialmethod
from importlib.resources import files
from math import atan2, cos, pi, radians, sin
from typing import Any

from placegraph.indoor.map.floor import label_words
from placegraph.language.grammar import Chunk
from placegraph.language.grammar import IslandParser as Islands
from placegraph.language.measures import COUNTS, whole
from placegraph.language.text import Phrases, Terminal, Word

VERBS = frozenset(("BE", "EXISTS", "SEE", "HAVE"))
_DETERMINERS = frozenset(("DET", "A", "NUM", "NO", "SOME"))
_NOUNS = frozenset(("WORD", *_DETERMINERS))
_BEFORE_NOUN = frozenset(("NOT", *_DETERMINERS))
_PLACES = frozenset(("REL", "DIR", "BETWEEN", "FAR", "HERE", "FACE", "AWAY", "DIST", "ROW"))
_AMBIGUOUS = frozenset(("STAND", "PART", "FACE", "HERE", "SIGHT", "SEE", "HAVE", "SKIP", "WITH"))
"""Types whose single words may be part of what a thing is called: "standing lamp"."""
_STANDS = frozenset(
    ("stands", "sits", "hangs", "lies", "lie", "hang", "run", "runs", "lean", "leans")
)
_LONGEST = 60
"""Chunks in a clause; nobody speaks in longer ones."""
_MOST = 1000
"""More of a thing than this, nobody counts."""
UNSURE = 0.6
"""Certainty of what is said to be "maybe" so."""
_COUNTED = {"couple": 2, "pair": 2, "pairs": 4}


@cache
def english() -> Phrases:
    """The phrases of the grammar."""
    table = tomllib.loads(_file("lexicon.toml"))
    known: dict[tuple[str, ...], tuple[Terminal, ...]] = {}
    for section, entries in table.items():
        for key, phrases in entries.items():
            for phrase in phrases:
                words = tuple(phrase.split())
                known.setdefault(words, tuple(_terminals(section, key, words)))
    return Phrases(known)


def _terminals(section: str, key: str, words: Sequence[str]) -> Iterator[Terminal]:
    if section == "relations":
        yield Terminal("REL", key)
    elif section == "directions":
        yield Terminal("DIR", radians(float(key)))
    else:
        for terminal in key.split():
            yield Terminal(terminal, next((_COUNTED[w] for w in words if w in _COUNTED), None))


def _file(name: str) -> str:
    return files(__package__).joinpath("data", name).read_text("utf-8")


def chunks(sentence: Sequence[Word], text: str) -> list[Chunk]:
    """Chunks of a sentence, in order; what says nothing about a place is left out."""
    lower = [_plain(word) for word in sentence]
    found: list[Chunk] = []
    i = 0
    while i < len(sentence):
        n = _take(sentence, lower, i, text, found)
        i += n
    return list(_denied(_paired(list(_settled(found)))))


def _plain(word: Word) -> str:
    """A word without a possessive: "the kitchen's door" is the kitchen door."""
    lower = word.lower.replace("`", "'").replace("´", "'")
    owner = lower.removesuffix("'s")
    return lower if owner in ("it", "there", "that", "here") or owner == lower else owner


def _take(sentence: Sequence[Word], lower: list[str], i: int, text: str, found: list[Chunk]) -> int:
    """Append what begins at word i; returns how many words it takes."""
    word = sentence[i]
    if word.kind == "measure":
        found.append(Chunk("DIST", word.start, word.end, word.lower, word.metres))
        return 1
    if word.kind == "comma":
        found.append(Chunk("AND", word.start, word.end, text[word.start : word.end].strip()))
        return 1
    known = None if word.kind == "label" else english().longest(lower, i)
    if known and known[0] == 1 and _hyphenated(sentence, i, text):
        known = None  # "built-in wardrobe"
    n, terminals = known or (1, ())
    words = " ".join(lower[i : i + n])
    end = sentence[i + n - 1].end
    if known:
        found.extend([Chunk(t.type, word.start, end, words, t.value) for t in terminals])
    elif words in COUNTS or words.isdecimal():
        count = COUNTS.get(words) or whole(words, _MOST)
        found.append(
            Chunk("SOME" if words in ("few", "several") else "NUM", word.start, end, words, count)
        )
    else:
        # "KitchenTable" is two words, and so is "kitchen_table"
        written = text[word.start : word.start + len(words)]
        parts = [] if written[:-1].isupper() else label_words(written)  # "TVs" is one
        found.append(Chunk("WORD", word.start, end, " ".join(parts) or words))
    return n


def _hyphenated(sentence: Sequence[Word], i: int, text: str) -> bool:
    """Whether a hyphen ties word i to its neighbour."""
    before = i > 0 and text[sentence[i - 1].end : sentence[i].start] == "-"
    after = i + 1 < len(sentence) and text[sentence[i].end : sentence[i + 1].start] == "-"
    return before or after


def _settled(found: list[Chunk]) -> Iterator[Chunk]:
    """Decide what ambiguous chunks are by their neighbours; drop those that say nothing."""
    before: Chunk | None = None
    for i, chunk in enumerate(found):
        after = found[i + 1].type if i + 1 < len(found) else ""
        settled = _settle(chunk, before.type if before else "", after)
        if settled is not None and settled.words in _STANDS and _counted(found[:i]):
            settled = replace(settled, type="WORD")  # "two tv stands in the kitchen"
        if settled is None:
            continue
        if settled.type == "DIR" and before is not None and before.type == "DIR":
            # "behind me on my left": between the two
            before.value = _middle(before.value, settled.value)
            before.end = settled.end
            continue
        before = settled
        yield settled


def _counted(found: Sequence[Chunk]) -> bool:
    """Whether chunks end in more than one of a thing: no verb in the singular follows."""
    end = next((k for k in range(len(found), 0, -1) if found[k - 1].type != "WORD"), 0)
    return end > 0 and found[end - 1].type in ("NUM", "SOME") and found[end - 1].value != 1


def _paired(found: list[Chunk]) -> list[Chunk]:
    """Mark the "and" of "between the table and the fridge": it joins no clauses."""
    for i, chunk in enumerate(found):
        if chunk.type != "BETWEEN":
            continue
        for k in range(i + 1, len(found) - 1):
            if found[k].type == "AND" and k > i + 1:
                if found[k].words in ("and", "&") and found[k + 1].type in _NOUNS:
                    found[k] = replace(found[k], type="BOTH")
                break
            if found[k].type not in _NOUNS | {"OF", "PART"}:
                break
    return found


def _denied(found: list[Chunk]) -> Iterator[Chunk]:
    """Say no of both: "no tub or shower", "neither a sofa nor table"."""
    no = False
    for i, chunk in enumerate(found):
        yield chunk
        no = chunk.type == "NO" or (no and chunk.type in ("WORD", "AND"))
        after = found[i + 1] if i + 1 < len(found) else None
        if no and chunk.words in ("or", "nor") and after is not None and after.type == "WORD":
            yield Chunk("NO", after.start, after.start, "no")


def _middle(one: float, other: float) -> float:
    """The direction between two [rad]."""
    return atan2(sin(one) + sin(other), cos(one) + cos(other))


def _settle(chunk: Chunk, before: str, after: str) -> Chunk | None:
    kind = chunk.type
    single = " " not in chunk.words
    if kind in _AMBIGUOUS and single and after == "WORD" and before in _BEFORE_NOUN:
        return replace(chunk, type="WORD")  # "a standing lamp", "the side table"
    if kind == "PART" and before == "WORD":
        return replace(chunk, type="WORD")
    if kind in ("STAND", "SKIP", "THAT"):
        return None
    if kind == "REL" and chunk.words in ("behind", "before") and after in ("", "AND", "BE"):
        return replace(chunk, type="DIR", value=pi if chunk.words == "behind" else 0.0)
    if kind == "REL" and chunk.words == "around" and after not in _NOUNS | {"ME", "IT"}:
        return replace(chunk, type="SIGHT")
    if kind == "DIR" and chunk.words == "in front" and after == "OF":
        return replace(chunk, type="REL", value="in front of")
    opposite = chunk.words == "opposite" and after == "WORD"  # "on the opposite wall"
    if (kind == "DIR" or opposite) and before in ("DET", "A") and single:
        return replace(chunk, type="WORD")
    if kind == "BE" and chunk.words in _STANDS and after not in _PLACES | _DETERMINERS:
        return replace(chunk, type="WORD")  # "two tv stands"
    if kind == "BE" and before in _DETERMINERS:
        return None
    return chunk


def clauses(found: Sequence[Chunk]) -> Iterator[tuple[list[Chunk], float]]:
    """Cut the chunks of a sentence into clauses, each with its certainty.

    A joint (a comma, "and") cuts where a finite verb follows before the next one, and what came
    before it has a verb of its own or says where something is.
    """
    current: list[Chunk] = []
    certainty, verb = 1.0, False
    for i, chunk in enumerate(found):
        starts = verb and chunk.type == "EXISTS"
        if (
            chunk.type == "CUT"
            or len(current) >= _LONGEST
            or (chunk.type == "AND" and _cuts(current, found[i + 1 :], verb=verb))
            or starts
        ):
            if current:
                yield current, certainty
            current, certainty, verb = [], 1.0, False
            if chunk.type in ("CUT", "AND"):
                continue
        if chunk.type == "UNSURE":
            certainty = UNSURE
            continue
        verb = verb or chunk.type in VERBS
        current.append(chunk)
    if current:
        yield current, certainty


def _cuts(current: Sequence[Chunk], rest: Sequence[Chunk], *, verb: bool) -> bool:
    """Whether the joint after `current` begins a clause of its own."""
    group = []
    for chunk in rest:
        if chunk.type in ("AND", "CUT"):
            break
        group.append(chunk.type)
    if not any(kind in VERBS for kind in group):
        return False
    if verb:
        return True
    placed = sum(chunk.type in _PLACES for chunk in current)
    # "on my left, there is a plant": one place, said of what comes
    leads = placed == 1 and current[0].type in _PLACES
    return placed > 0 and not (leads and not {"EXISTS", "SEE"}.isdisjoint(group))


_SKIPPED = ("WORD", "AND", "OF", "FROM", "NOT", "DET", "A", "NO", "NUM", "SOME", "PART", "SIGHT")
"""Chunks that may be left out where the grammar expects something else."""


@dataclass(slots=True)
class Noun:
    """Somebody or something spoken of, in one place of the text."""

    kind: str
    """``ME IT SPOT PART`` or ``thing``."""
    start: int
    end: int
    determiners: tuple[Chunk, ...] = ()
    words: tuple[Chunk, ...] = ()
    owner: Noun | None = None
    """Of what it is: "the door of the kitchen"."""


@dataclass(slots=True)
class Where:
    """What is said of where something is."""

    how: str
    """Rule of the grammar: ``related alone towards between faces far here sight row with_``."""
    start: int
    end: int
    things: tuple[Noun, ...] = ()
    relation: str = ""
    bearing: float = 0.0
    distance: float | None = None
    negated: bool = False


Joint = Chunk
"""A comma, or "and"."""
Item = Noun | Where | Joint


@dataclass(slots=True)
class Clause:
    """One clause: a verb, what stands before it and after it."""

    verb: str
    """Rule of the grammar: ``fragment is_ exists sees has``."""
    before: list[Item] = field(default_factory=list)
    after: list[Item] = field(default_factory=list)


@cache
def _grammar() -> Islands[Clause]:
    text = files(__package__).joinpath("sentence.lark").read_text("utf-8")
    return Islands(text, "clause", _Build(), Clause, _SKIPPED)


def parse(chunks: list[Chunk]) -> Iterator[tuple[Clause | None, list[Chunk]]]:
    """Parse the chunks of one clause by islands: what was read, and the chunks that were not."""
    for clause, _, left_out in _grammar().parse(chunks):
        yield clause, left_out


class _Build:
    """Callbacks of the grammar's rules, called as soon as a rule is complete."""

    # clauses
    def clause(self, children: list[Any]) -> Clause:
        return children[0]

    def fragment(self, children: list[Any]) -> Clause:
        return Clause("fragment", after=children[0])

    def _clause(self, children: list[Any], *, verb: str) -> Clause:
        said = Clause(verb)
        at_verb = next(i for i, child in enumerate(children) if isinstance(child, Chunk))
        for i, child in enumerate(children):
            if isinstance(child, list):
                if i < at_verb:
                    said.before = child
                else:
                    said.after = child
        return said

    is_ = partialmethod(_clause, verb="is_")
    exists = partialmethod(_clause, verb="exists")
    sees = partialmethod(_clause, verb="sees")
    has = partialmethod(_clause, verb="has")

    def body(self, children: list[Any]) -> list[Item]:
        return list(children)

    # places
    def not_(self, children: list[Any]) -> Where:
        children[1].negated = True
        return children[1]

    def _place(self, children: list[Any], *, how: str) -> Where:
        place = Where(how, children[0].start, children[-1].end)
        place.things = tuple(child for child in children if isinstance(child, Noun))
        for child in children:
            if isinstance(child, Noun):
                continue
            if child.type == "REL":
                place.relation = child.value
            elif child.type == "DIR":
                place.bearing = child.value
            elif child.type == "DIST":
                place.distance = child.value
        return place

    alone = partialmethod(_place, how="alone")
    related = partialmethod(_place, how="related")
    towards = partialmethod(_place, how="towards")
    between = partialmethod(_place, how="between")
    faces = partialmethod(_place, how="faces")
    far = partialmethod(_place, how="far")
    here = partialmethod(_place, how="here")
    sight = partialmethod(_place, how="sight")
    row = partialmethod(_place, how="row")
    with_ = partialmethod(_place, how="with_")

    def back_to(self, children: list[Any]) -> Where:
        place = self._place(children, how="faces")
        place.bearing = pi
        return place

    # things
    def no_thing(self, children: list[Any]) -> Noun:
        negation, thing = children
        thing.determiners = (Chunk("NO", negation.start, negation.end), *thing.determiners)
        return thing

    def _who(self, children: list[Any], *, kind: str) -> Noun:
        return Noun(kind, children[0].start, children[0].end)

    me = partialmethod(_who, kind="ME")
    it = partialmethod(_who, kind="IT")
    scene = partialmethod(_who, kind="SPOT")

    def named(self, children: list[Any]) -> Noun:
        words = tuple(child for child in children if child.type == "WORD")
        determiners = tuple(child for child in children if child.type != "WORD")
        return Noun("thing", children[0].start, children[-1].end, determiners, words)

    def of(self, children: list[Any]) -> Noun:
        thing, _, owner = children
        return Noun("thing", thing.start, owner.end, thing.determiners, thing.words, owner)

    def part(self, children: list[Any]) -> Noun:
        owner = children[-1] if isinstance(children[-1], Noun) else None
        if owner is not None and owner.kind != "SPOT":
            return owner  # the corner of the kitchen is in the kitchen
        words = tuple(c for c in children if isinstance(c, Chunk) and c.type == "PART")
        return Noun("PART", children[0].start, children[-1].end, words=words)
