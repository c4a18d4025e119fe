"""Word order: the chunks of a sentence of any language, brought into the order of the one grammar.

The grammar speaks as English does: a relation stands before its thing ("north of the church"), a
verb between what it speaks of. Where a language has postpositions or final verbs its table says so.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from math import pi

from placegraph.language.islands import Chunk
from placegraph.outdoor.language.cases import told
from placegraph.outdoor.language.head_first import head_first
from placegraph.outdoor.language.languages import Language
from placegraph.outdoor.language.languages.language import Order
from placegraph.outdoor.language.verb_first import existing, gapped
from placegraph.outdoor.language.verb_last import LEADS, PERSONS, Item, verbs_last

CASES = frozenset(("GEN", "DROP"))
"""Markers that only order needs; they are not in the grammar."""
_OWNED = ("DET", "THIS", "A", "ANOTHER", "NUM", "NO", "MY", "YOUR", "ITS", "WORD")
_RELATIONS = ("DIR", "SHORT", "PREP", "BETWEEN", "ACROSS", "PART")
_MEASURED = ("DIST", "AWAY")


def ordered(chunks: list[Chunk], language: Language) -> list[Chunk]:
    """Chunks of a sentence in the order of the grammar."""
    order = language.order
    if order.genitive:
        chunks = list(
            _genitives(chunks, language.lists["articles"].intersection(language.prefixes))
        )
    if order.cases or order.verbless:
        chunks = told(chunks, order)
    if order.head_first:
        chunks = head_first(chunks, language)
    if order.postpositions:
        items = list(_related(_items(chunks, order), marked=order.marked))
        if order.verb_final:
            items = list(verbs_last(items))
        chunks = [chunk for item in items for chunk in _told(item)]
    chunks = _one_lead([chunk for chunk in chunks if chunk.type not in CASES])
    if not (order.head_first or order.verb_final):
        chunks = existing(chunks)
    return gapped(chunks)


def _at(chunk: Chunk, kind: str) -> Chunk:
    """Make a chunk of no words of its own, where another begins."""
    return Chunk(kind, chunk.start, chunk.start)


def _genitives(chunks: Sequence[Chunk], articles: frozenset[str]) -> Iterator[Chunk]:
    """Put an OF between a direction or a part and the thing that follows it: "nördlich der Kirche".

    None follows a word with an article written onto it: "على اليمين".
    """
    between = ""
    for i, chunk in enumerate(chunks):
        between = chunk.type if chunk.type in ("BETWEEN", "AND", "CUT") else between
        if chunk.type == "OF" and between == "BETWEEN" and chunks[i - 1].type in ("NOUN", "NAME"):
            yield replace(chunk, type="AND")  # "בין בית הספר ל|כנסייה"
            between = ""
            continue
        following = chunks[i + 1].type if i + 1 < len(chunks) else ""
        if chunk.type == "NEARBY" and following in (*_OWNED, "OF", "NOUN", "NAME"):
            yield replace(chunk, type="PREP", value="near")  # "in der Nähe der Kirche"
            continue
        if chunk.type == "OF" and i and chunks[i - 1].type == "NEARBY":
            continue
        if chunk.type == "FROM" and i and chunks[i - 1].type == "PART":
            yield replace(chunk, type="OF")  # "الجانب الشمالي من الساحة"
            continue
        yield chunk
        rest = [other.type for other in chunks[i + 1 : i + 3] if other.type != "ADVERB"]
        owner = chunk.type == "NOUN" and [other.words for other in chunks[i - 1 : i] if i]
        if isinstance(owner, list) and articles.isdisjoint(owner) and rest[:2] == ["DET", "NOUN"]:
            yield _at(chunks[i + 1], "OF")  # "مدخل ال|حديقة"
        if chunk.type not in ("DIR", "PART") or not rest:
            continue
        if chunk.words.rpartition(" ")[2].startswith(tuple(articles)):
            continue
        before = chunks[i - 1].type if i else ""
        owned = chunk.type == "DIR" and before in _OWNED  # "der nördliche Eingang"
        bare = rest[0] in ("NOUN", "NAME", "ME", "YOU", "IT", "WORD") and not owned
        if bare or rest[0] in ("DET", "THIS", "MY", "YOUR", "ITS"):
            yield _at(chunks[i + 1], "OF")


def _one_lead(chunks: list[Chunk]) -> list[Chunk]:
    """Leave out a lead before another or before a preposition: "在公园里" is "in the park"."""
    following = [*[chunk.type for chunk in chunks[1:]], ""]
    return [
        chunk
        for chunk, after in zip(chunks, following, strict=True)
        if not (chunk.type in ("IN", "ON", "AT", "TO") and after in (*LEADS, "PREP", "BETWEEN"))
    ]


def _items(chunks: Sequence[Chunk], order: Order) -> list[Item]:
    """Group the chunks of a thing, and the markers behind it."""
    items: list[Item] = []
    for chunk in chunks:
        last = items[-1] if items else None
        if chunk.type in (*CASES, *LEADS):
            if last is not None and last.kind == "thing":
                last.case.append(chunk.type)
            elif last is None or last.kind not in (*_RELATIONS, *_MEASURED, "NEARBY", "HERE"):
                items.append(Item(chunk.type, [chunk]))
        elif chunk.type == "ADVERB" and chunk.value == "skip":
            continue
        elif chunk.type in ("NOUN", "NAME", *_OWNED, *PERSONS):
            if last is not None and _continues(last, chunk):
                last.chunks.append(chunk)
            else:
                items.append(Item("thing", [chunk]))
        else:
            items.append(Item(chunk.type, [chunk]))
    items = [item for item in items if item.kind not in CASES]
    for i, item in enumerate(items):
        behind = i and items[i - 1].kind == "thing" and (items[i - 1].case or not order.marked)
        before = not order.verb_final and i + 1 < len(items) and items[i + 1].kind == "thing"
        if item.kind == "NEARBY" and (behind or before):  # "kirkon lähellä", "lähellä kirkkoa"
            item.kind, item.chunks = "PREP", [replace(item.chunks[0], type="PREP", value="near")]
    return items


def _continues(last: Item, chunk: Chunk) -> bool:
    """Tell whether a chunk is of the thing before it."""
    if last.kind != "thing" or last.person or last.case or chunk.type in PERSONS:
        return False
    before = last.chunks[-1].type
    if before in _OWNED:
        return True
    return (before, chunk.type) in (("NAME", "NOUN"), ("NOUN", "NAME"))


def _related(items: list[Item], *, marked: bool) -> Iterator[Item]:
    """Bring a thing behind the relation that follows it: "kirkon vieressä" is "beside the church"."""
    found: list[Item] = []
    i = 0
    while i < len(items):
        end = i
        while end < len(items) and items[end].kind in (*_RELATIONS, *_MEASURED):
            end += 1
        if end == i:
            found.append(items[i])
            i += 1
            continue
        shows = end < len(items) and items[end].kind == "thing"
        _relate(found, items[i:end], marked=marked, shows=shows)
        i = end
    return iter(_owners(found))


def _relate(found: list[Item], words: list[Item], *, marked: bool, shows: bool) -> None:
    """Append a relation, and what of the things before it is its own.

    `shows`: another thing follows.
    """
    kinds = [word.kind for word in words]
    hedges = [found.pop()] if found and found[-1].kind == "ADVERB" else []
    relations = [word for word in words if word.kind not in _MEASURED]
    measured = [word for word in words if word.kind in _MEASURED]
    if not _takes(found, kinds, marked=marked, shows=shows):
        found += [*hedges, *measured, *relations]
        return
    things = [found.pop()]
    if found and found[-1].kind == "FROM":
        found.pop()  # "离我100米", from me 100 m: the grammar has it the other way round
    if relations and relations[0].kind in ("BETWEEN", "PART"):
        while len(found) > 1 and found[-1].kind == "AND" and found[-2].kind == "thing":
            things = [found[-2], found[-1], *things]
            del found[-2:]
    while found and found[-1].kind == "DIST" and not measured:
        measured = [found.pop()]  # "50 metriä kirkosta pohjoiseen"
    target = [chunk for thing in things for chunk in thing.chunks]
    distance = [chunk for word in measured for chunk in word.chunks]
    heads = [_as_of_a_thing(chunk, target[0]) for word in relations for chunk in word.chunks]
    lead, between = _words_between(relations, target[0])
    found += hedges
    found.append(Item("place", [*distance, *lead, *heads, *between, *target]))


def _words_between(relations: list[Item], target: Chunk) -> tuple[list[Chunk], list[Chunk]]:
    """Words that the grammar wants before a relation, and between it and its thing."""
    kind = relations[-1].kind if relations else ""
    if kind == "DIR" and _stands_in_line(relations[-1].chunks[0], target):
        return [], []
    if kind in ("DIR", "SHORT"):
        return [], [_at(target, "OF")]
    if kind == "PART":
        return [_at(target, "AT")], [_at(target, "OF")]
    return [], [] if kind else [_at(target, "FROM")]


def _stands_in_line(chunk: Chunk, target: Chunk) -> bool:
    """Tell whether "in front" or "behind" is said of a thing, which has no heading."""
    turned = chunk.value.bearing if chunk.type == "DIR" and chunk.value.facing else None
    return turned in (0.0, pi) and target.type not in ("ME", "YOU")


def _as_of_a_thing(chunk: Chunk, target: Chunk) -> Chunk:
    if not _stands_in_line(chunk, target):
        return chunk
    return replace(chunk, type="PREP", value="behind" if chunk.value.bearing else "front")


def _takes(found: list[Item], kinds: Sequence[str], *, marked: bool, shows: bool) -> bool:
    """Tell whether the thing before a relation is what it relates to."""
    if not found or found[-1].kind != "thing" or "DROP" in found[-1].case:
        return False
    case = found[-1].case
    seen = any(item.kind == "SEE" for item in found)
    if seen and not shows and len(found) > 1 and found[-2].kind in ("SEE", "AND"):
        return False  # what is seen, and then where
    if all(kind in _MEASURED for kind in kinds):
        return "FROM" in case or (len(found) > 1 and found[-2].kind == "FROM")
    if "IN" in case or "AT" in case or "ON" in case:
        return False
    return bool(case) or not marked


def _owners(items: list[Item]) -> list[Item]:
    """Bring an owner behind what it owns: "puiston portti" is "the gate of the park"."""
    found: list[Item] = []
    for item in items:
        owner = found[-1] if found else None
        if (
            owner is not None
            and item.kind in ("thing", "place")
            and owner.kind == "thing"
            and owner.case == ["GEN"]
        ):
            found.pop()
            if item.kind == "thing" and not owner.person and item.chunks[0].type not in PERSONS:
                place = Item("place", [_at(owner.chunks[0], "OF"), *owner.chunks])
                found += [item, place]
                continue
        found.append(item)
    return found


def _told(item: Item) -> list[Chunk]:
    """Chunks of an item; the case of a thing becomes a word before it."""
    lead = [case for case in item.case if case in LEADS][-1:]
    return [*[_at(item.chunks[0], case) for case in lead], *item.chunks]
