"""From words to clauses: phrases of lexicon.toml become chunks, and the grammar reads them by islands."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from math import atan2, cos, pi, radians, sin
from typing import Any, TypeAlias

from placegraph.indoor.map.floor import split_label
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
from placegraph.language.text import Phrases, Terminal, Word, parse_count

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
_MOST = 1000
"""Largest number of things that is counted."""
_COUNTED = {"couple": 2, "pair": 2, "pairs": 4}
_SKIPPED = ("WORD", "AND", "OF", "FROM", "NOT", "DET", "A", "NO", "NUM", "SOME", "PART", "SIGHT")
"""Chunks that may be left out where the grammar expects something else."""


@dataclass(slots=True)
class NounPhrase:
    """Somebody or something spoken of, in one place of the text."""

    kind: str
    """``ME IT SPOT PART`` or ``thing``."""
    start: int
    end: int
    determiners: tuple[Chunk, ...] = ()
    words: tuple[Chunk, ...] = ()
    owner: NounPhrase | None = None
    """The whole: "the door of the kitchen"."""


Place: TypeAlias = PlacePhrase[NounPhrase]
Item: TypeAlias = NounPhrase | Place | Chunk
"""Noun phrase, place phrase, or a joint: a comma, or "and"."""


@cache
def english() -> Phrases:
    """Return the phrases of the grammar."""
    table = tomllib.loads(files(__package__).joinpath("data", "lexicon.toml").read_text("utf-8"))
    known: dict[tuple[str, ...], tuple[Terminal, ...]] = {}
    for section, entries in table.items():
        for key, phrases in entries.items():
            for words in [tuple(phrase.split()) for phrase in phrases]:
                count = next((_COUNTED[w] for w in words if w in _COUNTED), None)
                terminals: tuple[Terminal, ...]
                if section == "relations":
                    terminals = (Terminal("REL", key),)
                elif section == "directions":
                    terminals = (Terminal("DIR", radians(float(key))),)
                else:
                    terminals = tuple([Terminal(kind, count) for kind in key.split()])
                known.setdefault(words, terminals)
    return Phrases(known)


def find_chunks(sentence: Sequence[Word], text: str) -> list[Chunk]:
    """Return the chunks of a sentence, in order, without what says nothing about a place."""
    lower = []
    for word in sentence:  # "the kitchen's door" is the kitchen door
        plain = word.lower.replace("`", "'").replace("´", "'")
        owner = plain.removesuffix("'s")
        lower.append(plain if owner in ("it", "there", "that", "here") else owner)
    found: list[Chunk] = []
    i = 0
    while i < len(sentence):
        i += _take_phrase(sentence, lower, i, text, found)
    return list(_deny_both(_mark_pairs(list(_resolve_types(found)))))


def _take_phrase(
    sentence: Sequence[Word], lower: list[str], i: int, text: str, chunks: list[Chunk]
) -> int:
    """Append what begins at word i; return how many words it takes."""
    word = sentence[i]
    if word.kind == "measure":
        chunks.append(Chunk("DIST", word.start, word.end, word.lower, word.metres))
        return 1
    if word.kind == "comma":
        chunks.append(Chunk("AND", word.start, word.end, text[word.start : word.end].strip()))
        return 1
    known = None if word.kind == "label" else english().longest(lower, i)
    if known and known[0] == 1:
        ends = [sentence[k : k + 2] for k in (i - 1, i) if 0 <= k < len(sentence) - 1]
        if any(text[one.end : other.start] == "-" for one, other in ends):
            known = None  # "built-in wardrobe"
    n, terminals = known or (1, ())
    words = " ".join(lower[i : i + n])
    end = sentence[i + n - 1].end
    if known:
        chunks.extend([Chunk(t.type, word.start, end, words, t.value) for t in terminals])
    elif (count := parse_count(words, largest=_MOST)) is not None:
        kind = "SOME" if words in ("few", "several") else "NUM"
        chunks.append(Chunk(kind, word.start, end, words, count))
    else:
        # "KitchenTable" is two words, and so is "kitchen_table"
        written = text[word.start : word.start + len(words)]
        parts = [] if written[:-1].isupper() else split_label(written)  # "TVs" is one
        chunks.append(Chunk("WORD", word.start, end, " ".join(parts) or words))
    return n


def _resolve_types(chunks: list[Chunk]) -> Iterator[Chunk]:
    """Decide what ambiguous chunks are by their neighbours; drop those that say nothing."""
    before: Chunk | None = None
    for i, chunk in enumerate(chunks):
        after = chunks[i + 1].type if i + 1 < len(chunks) else ""
        resolved = _resolve_type(chunk, before.type if before else "", after)
        if resolved is None:
            continue
        if resolved.words in _STANDS:
            end = next((k for k in range(i, 0, -1) if chunks[k - 1].type != "WORD"), 0)
            count = chunks[end - 1] if end else chunk
            if count.type in ("NUM", "SOME") and count.value != 1:
                resolved = replace(resolved, type="WORD")  # "two tv stands in the kitchen"
        if resolved.type == "DIR" and before is not None and before.type == "DIR":
            # "behind me on my left": between the two
            one, other = before.value, resolved.value
            before.value = atan2(sin(one) + sin(other), cos(one) + cos(other))
            before.end = resolved.end
            continue
        before = resolved
        yield resolved


def _resolve_type(chunk: Chunk, before: str, after: str) -> Chunk | None:
    """Return the type of a chunk between two types; None where it says nothing."""
    kind, words = chunk.type, chunk.words
    single = " " not in words
    opposite = words == "opposite" and after == "WORD"  # "on the opposite wall"
    if (
        # "a standing lamp", "the side table"
        (kind in _AMBIGUOUS and single and after == "WORD" and before in _BEFORE_NOUN)
        or (kind == "PART" and before == "WORD")
    ):
        return replace(chunk, type="WORD")
    if kind in ("STAND", "SKIP", "THAT"):
        return None
    if kind == "REL" and words in ("behind", "before") and after in ("", "AND", "BE"):
        return replace(chunk, type="DIR", value=pi if words == "behind" else 0.0)
    if kind == "REL" and words == "around" and after not in _NOUNS | {"ME", "IT"}:
        return replace(chunk, type="SIGHT")
    if kind == "DIR" and words == "in front" and after == "OF":
        return replace(chunk, type="REL", value="in front of")
    stands = kind == "BE" and words in _STANDS and after not in _PLACES | _DETERMINERS
    if stands or ((kind == "DIR" or opposite) and before in ("DET", "A") and single):
        return replace(chunk, type="WORD")  # "two tv stands"
    return None if kind == "BE" and before in _DETERMINERS else chunk


def _mark_pairs(chunks: list[Chunk]) -> list[Chunk]:
    """Mark the "and" of "between the table and the fridge": it joins no clauses."""
    for i, chunk in enumerate(chunks):
        if chunk.type != "BETWEEN":
            continue
        for k in range(i + 1, len(chunks) - 1):
            if chunks[k].type == "AND" and k > i + 1:
                if chunks[k].words in ("and", "&") and chunks[k + 1].type in _NOUNS:
                    chunks[k] = replace(chunks[k], type="BOTH")
                break
            if chunks[k].type not in _NOUNS | {"OF", "PART"}:
                break
    return chunks


def _deny_both(chunks: list[Chunk]) -> Iterator[Chunk]:
    """Say no of both: "no tub or shower", "neither a sofa nor table"."""
    no = False
    for i, chunk in enumerate(chunks):
        yield chunk
        no = chunk.type == "NO" or (no and chunk.type in ("WORD", "AND"))
        after = chunks[i + 1] if i + 1 < len(chunks) else None
        if no and chunk.words in ("or", "nor") and after is not None and after.type == "WORD":
            yield Chunk("NO", after.start, after.start, "no")


def cut_clauses(chunks: Sequence[Chunk]) -> Iterator[tuple[list[Chunk], float]]:
    """Cut the chunks of a sentence into clauses, each with its certainty.

    A joint (a comma, "and") cuts where a finite verb follows before the next one, and what came
    before it has a verb of its own or says where something is.
    """
    current: list[Chunk] = []
    certainty, verb = 1.0, False
    for i, chunk in enumerate(chunks):
        if (
            chunk.type == "CUT"
            or len(current) >= LONGEST_CLAUSE
            or (chunk.type == "AND" and _begins_clause(current, chunks[i + 1 :], verb=verb))
            or (verb and chunk.type == "EXISTS")
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


def _begins_clause(current: Sequence[Chunk], behind: Sequence[Chunk], *, verb: bool) -> bool:
    """Tell whether a clause of its own begins at the joint after `current`."""
    kinds = [chunk.type for chunk in behind]
    end = next((i for i, kind in enumerate(kinds) if kind in ("AND", "CUT")), len(kinds))
    if VERBS.isdisjoint(kinds[:end]):
        return False
    placed = sum(chunk.type in _PLACES for chunk in current)
    # "on my left, there is a plant": one place, said of what comes
    leads = placed == 1 and current[0].type in _PLACES
    return verb or (placed > 0 and not (leads and {"EXISTS", "SEE"} & set(kinds[:end])))


def _build_back(children: list[Any]) -> Place:
    """Build "with my back to the wall"."""
    place = build_place(children, how="faces")
    place.direction = pi
    return place


def _build_denied(children: list[Any]) -> NounPhrase:
    negation, thing = children
    thing.determiners = (Chunk("NO", negation.start, negation.end), *thing.determiners)
    return thing


def _build_who(children: list[Any], *, kind: str) -> NounPhrase:
    return NounPhrase({"scene": "SPOT"}.get(kind, kind.upper()), children[0].start, children[0].end)


def _build_named(children: list[Any]) -> NounPhrase:
    words = tuple([child for child in children if child.type == "WORD"])
    determiners = tuple([child for child in children if child.type != "WORD"])
    return NounPhrase("thing", children[0].start, children[-1].end, determiners, words)


def _build_owned(children: list[Any]) -> NounPhrase:
    """Build "the door of the kitchen"."""
    thing, _, owner = children
    return NounPhrase("thing", thing.start, owner.end, thing.determiners, thing.words, owner)


def _build_part(children: list[Any]) -> NounPhrase:
    owner = children[-1]
    if isinstance(owner, NounPhrase) and owner.kind != "SPOT":
        return owner  # the corner of the kitchen is in the kitchen
    words = tuple([c for c in children if isinstance(c, Chunk) and c.type == "PART"])
    return NounPhrase("PART", children[0].start, owner.end, words=words)


_BUILDERS = {
    **build_with(build_clause, "verb", "is_ exists sees has"),
    **build_with(
        build_place, "how", "alone related towards between faces far here sight row with_"
    ),
    **build_with(_build_who, "kind", "me it scene"),
    "clause": lambda children: children[0],
    "fragment": lambda children: Clause("fragment", after=children[0]),
    "body": tuple,
    "not_": negate,
    "back_to": _build_back,
    "no_thing": _build_denied,
    "named": _build_named,
    "of": _build_owned,
    "part": _build_part,
}


@cache
def parser() -> IslandParser:
    """Return the parser of sentences about places indoors."""
    text = files(__package__).joinpath("sentence.lark").read_text("utf-8")
    return IslandParser(text, "clause", _BUILDERS, _SKIPPED)
