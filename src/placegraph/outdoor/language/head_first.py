"""Nouns that come before what is said of them: "côté nord", "à côté de l'église", "l'église et de l'école".

French, Spanish, Italian and Portuguese speak so; their sentences are brought into the order of the
grammar. Their verbs: `verb_first`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import pi

from placegraph.language.islands import Chunk
from placegraph.outdoor.language.languages import Language
from placegraph.outdoor.language.verb_first import (
    LEADS,
    NEW,
    OWNED,
    STATED,
    THINGS,
    existing,
    kind,
    mark,
    negated,
    plain,
    subjects,
)
from placegraph.outdoor.language.words import Direction, tokens

_LINKS = ("OF", "AT", "TO", "FROM")
"""What joins a preposition of two words to its thing."""
_LINKED = ("PREP", "NEARBY", "ACROSS", "BETWEEN", "FROM", "TO", "FACE")
_PLACED = (*_LINKS, "IN", "ON", "PREP", "DIR", "NEARBY", "ACROSS", "BETWEEN")
_CORNERS = ("corner", "crossing")
_FAR = 7
"""So many chunks after its corner a street may stand at most."""
_SIDES = ("side", "end", "corner")
_BODY = {"front": 0.0, "behind": pi}


def head_first(chunks: list[Chunk], language: Language) -> list[Chunk]:
    """Chunks of a sentence in the order of the grammar."""
    chunks = _streets(chunks, language)
    chunks = _qualities(_sides(chunks, language), language)
    for step in (_corners, _links, _repeated, negated, existing):
        chunks = step(chunks)
    return subjects(chunks) if language.order.pro_drop else chunks


def _last(found: Sequence[Chunk]) -> str:
    return kind(found, len(found) - 1)


def _streets(chunks: list[Chunk], language: Language) -> list[Chunk]:
    """Let one be "on" a street that is only named: "je suis rue de la Paix"."""
    found: list[Chunk] = []
    for chunk in chunks:
        if chunk.type == "NAME" and language.is_road(tokens(chunk.value.name)):
            if _last(found) == "NUM":
                found.pop()  # the number of a house
            if _last(found) == "BE":
                found.append(mark(chunk, "ON"))
        found.append(chunk)
    return found


def _qualities(chunks: list[Chunk], language: Language) -> list[Chunk]:
    """Put a common adjective before its noun: "plaza grande"; leave the article of "la mia" out."""
    found: list[Chunk] = []
    for i, chunk in enumerate(chunks):
        if chunk.type == "DET" and kind(chunks, i + 1) in ("MY", "YOUR", "ITS"):
            continue
        if chunk.type == "THIS" and _last(found) == "NOUN" and kind(chunks, i + 1) in _PLACED:
            found.append(replace(chunk, type="BE"))  # "la farmacia esta al norte", for "está"
            continue
        if chunk.type == "DET" and _last(found) == "NO":
            continue  # "né la chiesa"
        if chunk.type == "NO" and _last(found) in ("NOUN", "NAME", "DIR"):
            found.append(mark(chunk, "AND"))  # "ni église ni mosquée"
        if chunk.type == "NO" and kind(chunks, i + 1) in _PLACED:
            if kind(found, plain(found, len(found) - 1, -1)) != "NOT" and not _says_no(found):
                found.append(replace(chunk, type="NOT"))  # "ni al norte"
            continue
        quality = chunk.type == "WORD" and not language.words.isdisjoint(
            (chunk.words, *[form.stem for form in language.forms.of(chunk.words)])
        )
        found.insert(len(found) - (quality and _last(found) == "NOUN"), chunk)
    return found


def _says_no(found: Sequence[Chunk]) -> bool:
    """Tell whether what was found ends with a verb that says no already: "no está | ni"."""
    return _last(found) in STATED and any(chunk.type == "NOT" for chunk in found[-4:])


def _sides(chunks: list[Chunk], language: Language) -> list[Chunk]:
    """Put a direction before its part or noun: "côté nord", "l'entrée nord"; lead it by a place's word."""
    found: list[Chunk] = []
    for i, chunk in enumerate(chunks):
        after = kind(chunks, i + 1)
        if chunk.type == "DIR" and _last(found) == "NEARBY":
            side = language.longest([found[-1].words.rpartition(" ")[2]], 0)
            if side is not None and side[1][0].type == "PART":  # "al lado | norte"
                part = replace(found[-1], type="PART", value=side[1][0].value)
                found[-1:] = [mark(chunk, "ON"), part]
        led = _last(found) in (*LEADS, "PREP", "FACE")
        bare = after == "DIR" and not led and kind(chunks, i + 2) not in ("PART", "NOUN")
        if chunk.type == "DIR" and _last(found) == "PART" and found[-1].value in _SIDES:
            _side(found, chunk, after)
        elif chunk.type == "DIR" and _names_entrance(found, chunk, after, language):
            found.insert(len(found) - 1, chunk)
        elif chunk.type == "DET" and (bare or after in ("A", "THIS", "NO")):
            found.append(replace(chunk, type="AT"))  # "a norte da igreja", "em frente a uma igreja"
        else:
            found.append(chunk)
    return found


def _side(found: list[Chunk], direction: Chunk, after: str) -> None:
    """Put a direction before the part at the end of what was found."""
    part = found.pop()
    lead = len(found) - 1 - (_last(found) in OWNED)
    before = kind(found, lead - 1)
    if kind(found, lead) == "OF" and before not in ("DIR", "PREP", "NEARBY"):
        found[lead] = replace(found[lead], type="ON")  # "du côté nord de la rue"
    elif kind(found, lead) not in (*LEADS, "PREP") and after == "OF":
        found.insert(lead + 1, mark(direction, "ON"))
    found += [direction, part]


def _names_entrance(
    found: Sequence[Chunk], direction: Chunk, after: str, language: Language
) -> bool:
    """Tell whether a direction is that of the noun before it: "l'entrée nord"."""
    if _last(found) != "NOUN" or kind(found, len(found) - 2) not in ("DET", "A"):
        return False
    first = language.longest(direction.words.split(" ")[:1], 0)
    led = first is not None and first[1][0].type in (*LEADS, "DET")  # "un bosque al este"
    return after not in ("OF", "FROM") and not led


def _corners(chunks: list[Chunk]) -> list[Chunk]:
    """Let a corner be "of A and B": "en la esquina de A con B", "all'angolo tra A e B"."""
    found: list[Chunk] = []
    corner = -_FAR
    for i, chunk in enumerate(chunks):
        told = chunk
        if chunk.type == "PART" and chunk.value in _CORNERS:
            if _last(found) in ("NOUN", "NAME", "AND", ""):
                found.append(mark(chunk, "AT"))  # "en Alcalá esquina Goya"
            corner = len(found)
            if kind(chunks, i + 1) in ("NAME", "NOUN"):
                found.append(chunk)
                told = mark(chunks[i + 1], "OF")
        elif chunk.type == "AT" and _last(found) == "PART" and _leads_thing(chunks, i + 1):
            told = replace(chunk, type="OF", value=None)  # "in fondo alla strada"
        elif chunk.type in ("WITH", "BETWEEN") and len(found) - corner <= _FAR:
            if len(found) == corner + 1:
                told = replace(chunk, type="OF", value=None)
            elif chunk.type == "WITH" and _last(found) in ("NAME", "NOUN"):
                told = replace(chunk, type="AND", value=None)
        found.append(told)
    return found


def _links(chunks: list[Chunk]) -> list[Chunk]:
    """Leave out what joins a preposition of two words to its thing: "à côté | de | l'église"."""
    found: list[Chunk] = []
    for i, chunk in enumerate(chunks):
        at = plain(found, len(found) - 1, -1)
        before, after = kind(found, at), plain(chunks, i + 1)
        facing = before in ("FACE", "TO") and bool(kind(chunks, after))
        joins = chunk.type in _LINKS and before in _LINKED
        if joins and (_leads_thing(chunks, after) or facing):
            if before == "NEARBY":
                found[at] = replace(found[at], type="PREP", value="near")
            continue
        if chunk.type == "DET" and before == "FACE" and kind(chunks, after) == "DIR":
            continue
        relation = found[at].value if before == "PREP" else ""
        if relation == "opposite" and chunk.type in NEW and kind(chunks, i - 1) not in _LINKS:
            found.append(mark(chunk, "EXISTS"))  # "y enfrente un banco"
        if relation in _BODY and chunk.type not in (*OWNED, *THINGS, "PART", "DIR"):
            found[at] = _ahead(found[at])
        found.append(chunk)
    if _last(found) == "PREP" and found[-1].value in _BODY:
        found[-1] = _ahead(found[-1])
    return found


def _ahead(chunk: Chunk) -> Chunk:
    """Read "derrière" without a thing as a direction."""
    return replace(chunk, type="DIR", value=Direction(_BODY[str(chunk.value)], facing=True))


def _leads_thing(chunks: Sequence[Chunk], i: int) -> bool:
    """Tell whether a thing begins at i, and no direction or relation."""
    start = i
    while kind(chunks, i) in (*OWNED, "ADVERB"):
        i += 1
    if i > start and kind(chunks, i - 1) == "WORD":
        return True  # a thing that is not known
    side = kind(chunks, i) == "DIR" and kind(chunks, i + 1) == "PART"
    return side or kind(chunks, i) in (*THINGS, "PART")


def _repeated(chunks: list[Chunk]) -> list[Chunk]:
    """Leave out an "of" that a list repeats, or that says "some": "de A et de B", "ci sono dei negozi"."""
    found: list[Chunk] = []
    link = ""
    for i, chunk in enumerate(chunks):
        before = kind(found, plain(found, len(found) - 1, -1))
        thing = _leads_thing(chunks, i + 1)
        some = before in ("EXISTS", "SEE", "HAVE", "NOT", "WITH") or (before == "AND" and not link)
        if not before and kind(chunks, i + 1) == "DET":
            some = chunks[i + 1].start == chunk.start  # "Des arbres ..."
        listed = before == "AND" and chunk.type == link and kind(chunks, i + 1) != "PART"
        if thing and (listed or (chunk.type == "OF" and some)):
            continue
        if chunk.type in STATED:
            link = ""
        elif chunk.type in LEADS:
            link = chunk.type
        elif chunk.type in ("PREP", "NEARBY", "ACROSS"):
            following = kind(chunks, i + 1)
            link = following if following in _LINKS else "OF"
        found.append(chunk)
    return found
