"""Word order of languages whose nouns come before what is said of them, brought into that of the grammar.

French, Spanish, Italian and Portuguese say "côté nord" and "il y a à ma gauche une église", join a
preposition of two words to its thing ("à côté de l'église"), repeat it in a list, put "no" before
the verb, and leave out who the verb speaks of.
"""

from __future__ import annotations

from dataclasses import replace
from math import pi
from typing import TYPE_CHECKING

from placegraph.language.islands import Chunk
from placegraph.outdoor.language.settle import VERBS
from placegraph.outdoor.language.words import Direction, tokens

if TYPE_CHECKING:
    from collections.abc import Sequence

    from placegraph.outdoor.language.languages import Language

_LEADS = ("IN", "ON", "AT", "TO", "FROM", "OF")
_LINKS = ("OF", "AT", "TO", "FROM")
"""What joins a preposition of two words to its thing."""
_OWNED = ("DET", "THIS", "A", "ANOTHER", "NUM", "NO", "MY", "YOUR", "ITS", "WORD")
_NEW = ("A", "ANOTHER", "NUM", "NO")
_PERSONS = ("ME", "YOU", "IT", "THIS", "SPOT")
_THINGS = ("NOUN", "NAME", *_PERSONS, "HERE")
_ENDS = (*_THINGS, "DIR", "NEARBY", "AWAY", "DIST", "PART")
"""What a place may end with."""
_PLACES = (*_LEADS, "PREP", "DIR", "NEARBY", "ACROSS", "BETWEEN", "DIST")
_VERBS = ("BE", "EXISTS", "SEE", "HAVE")
_JOINTS = ("AND", "CUT", "COND", "THAT_IS")
_CORNERS = ("corner", "crossing")
_SIDES = ("side", "end", "corner")
_BODY = {"front": 0.0, "behind": pi}


def head_first(chunks: list[Chunk], language: Language) -> list[Chunk]:
    """Chunks of a sentence in the order of the grammar."""
    chunks = _streets(chunks, language)
    chunks = _qualities(_sides(chunks, language), language)
    for step in (_corners, _links, _repeated, _negated, _existing):
        chunks = step(chunks)
    return _subjects(chunks) if language.order.pro_drop else chunks


def _type(chunks: Sequence[Chunk], i: int) -> str:
    return chunks[i].type if 0 <= i < len(chunks) else ""


def _plain(chunks: Sequence[Chunk], i: int, step: int = 1) -> int:
    """Index of the first chunk from i on that is no adverb."""
    while 0 <= i < len(chunks) and chunks[i].type == "ADVERB":
        i += step
    return i


def _at(chunk: Chunk, kind: str) -> Chunk:
    """Make a chunk of no words of its own, where another begins."""
    return Chunk(kind, chunk.start, chunk.start)


def _streets(chunks: list[Chunk], language: Language) -> list[Chunk]:
    """Let one be "on" a street that is only named: "je suis rue de la Paix"."""
    found: list[Chunk] = []
    for chunk in chunks:
        if chunk.type == "NAME" and _type(found, len(found) - 1) == "BE":
            if language.is_road(tokens(chunk.value.name)):
                found.append(_at(chunk, "ON"))
        found.append(chunk)
    return found


def _qualities(chunks: list[Chunk], language: Language) -> list[Chunk]:
    """Put a common adjective before its noun: "plaza grande"; leave the article of "la mia" out."""
    found: list[Chunk] = []
    for i, chunk in enumerate(chunks):
        if chunk.type == "DET" and _type(chunks, i + 1) in ("MY", "YOUR", "ITS"):
            continue
        quality = chunk.type == "WORD" and chunk.words in language.words
        found.insert(len(found) - (quality and _type(found, len(found) - 1) == "NOUN"), chunk)
    return found


def _sides(chunks: list[Chunk], language: Language) -> list[Chunk]:
    """Put a direction before its part or noun: "côté nord", "l'entrée nord"; lead it by a place's word."""
    found: list[Chunk] = []
    for i, chunk in enumerate(chunks):
        after = _type(chunks, i + 1)
        if chunk.type == "DIR" and _type(found, len(found) - 1) == "NEARBY":
            side = language.longest([found[-1].words.rpartition(" ")[2]], 0)
            if side is not None and side[1][0].type == "PART":  # "al lado | norte"
                part = replace(found[-1], type="PART", value=side[1][0].value)
                found[-1:] = [_at(chunk, "ON"), part]
        before = _type(found, len(found) - 1)
        if chunk.type == "DIR" and before == "PART" and found[-1].value in _SIDES:
            part = found.pop()
            lead = len(found) - 1 - (_type(found, len(found) - 1) in _OWNED)
            if _type(found, lead) == "OF" and _type(found, lead - 1) not in ("DIR", "PREP", "NEARBY"):
                found[lead] = replace(found[lead], type="ON")  # "du côté nord de la rue"
            elif _type(found, lead) not in (*_LEADS, "PREP") and after == "OF":
                found.insert(lead + 1, _at(chunk, "ON"))
            found += [chunk, part]
            continue
        if chunk.type == "DIR" and before == "NOUN" and _type(found, len(found) - 2) in ("DET", "A"):
            if after not in ("OF", "FROM") or chunk.words.startswith(("l'", "el ", "al ")):
                found.insert(len(found) - 1, chunk)
                continue
        led = before in (*_LEADS, "PREP", "FACE")
        direction = after == "DIR" and not led and _type(chunks, i + 2) not in ("PART", "NOUN")
        if chunk.type == "DET" and (direction or after in ("A", "THIS", "NO")):
            chunk = replace(chunk, type="AT")  # "a norte da igreja", "em frente a uma igreja"
        found.append(chunk)
    return found


def _corners(chunks: list[Chunk]) -> list[Chunk]:
    """Let a corner be "of A and B": "en la esquina de A con B", "all'angolo tra A e B"."""
    found: list[Chunk] = []
    corner = -9
    for i, chunk in enumerate(chunks):
        if chunk.type == "PART" and chunk.value in _CORNERS:
            corner = len(found)
            if _type(found, corner - 1) in ("NOUN", "NAME", "AND", ""):
                found.append(_at(chunk, "AT"))  # "en Alcalá esquina Goya"
                corner += 1
            found.append(chunk)
            if _type(chunks, i + 1) in ("NAME", "NOUN"):
                found.append(_at(chunks[i + 1], "OF"))
            continue
        if chunk.type == "AT" and _type(found, len(found) - 1) == "PART" and _leads_thing(chunks, i + 1):
            chunk = replace(chunk, type="OF", value=None)  # "in fondo alla strada"
        if chunk.type in ("WITH", "BETWEEN") and len(found) - corner <= 7:
            if len(found) == corner + 1:
                chunk = replace(chunk, type="OF", value=None)
            elif chunk.type == "WITH" and _type(found, len(found) - 1) in ("NAME", "NOUN"):
                chunk = replace(chunk, type="AND", value=None)
        found.append(chunk)
    return found


def _links(chunks: list[Chunk]) -> list[Chunk]:
    """Leave out what joins a preposition of two words to its thing: "à côté | de | l'église"."""
    found: list[Chunk] = []
    for i, chunk in enumerate(chunks):
        at = _plain(found, len(found) - 1, -1)
        before, after = _type(found, at), _plain(chunks, i + 1)
        if chunk.type in _LINKS and before in ("PREP", "NEARBY", "ACROSS", "BETWEEN", "FROM", "TO", "FACE"):
            if _leads_thing(chunks, after) or (before in ("FACE", "TO") and _type(chunks, after)):
                if before == "NEARBY":
                    found[at] = replace(found[at], type="PREP", value="near")
                continue
        if chunk.type == "DET" and before == "FACE" and _type(chunks, after) == "DIR":
            continue
        lone = before in ("PREP",) and found[at].value in _BODY
        if lone and chunk.type not in (*_OWNED, *_THINGS, "PART", "DIR"):
            found[at] = _ahead(found[at])
        found.append(chunk)
    if found and found[-1].type == "PREP" and found[-1].value in _BODY:
        found[-1] = _ahead(found[-1])
    return found


def _ahead(chunk: Chunk) -> Chunk:
    """Read "derrière" without a thing as a direction."""
    return replace(chunk, type="DIR", value=Direction(_BODY[str(chunk.value)], facing=True))


def _leads_thing(chunks: Sequence[Chunk], i: int) -> bool:
    """Tell whether a thing begins at i, and no direction or relation."""
    while _type(chunks, i) in (*_OWNED, "ADVERB"):
        i += 1
    following = _type(chunks, i)
    return following in (*_THINGS, "PART") or (following == "DIR" and _type(chunks, i + 1) == "PART")


def _repeated(chunks: list[Chunk]) -> list[Chunk]:
    """Leave out an "of" that a list repeats, or that says "some": "de A et de B", "ci sono dei negozi"."""
    found: list[Chunk] = []
    link = ""
    for i, chunk in enumerate(chunks):
        before = _type(found, _plain(found, len(found) - 1, -1))
        thing = _leads_thing(chunks, i + 1)
        some = before in ("EXISTS", "SEE", "HAVE", "NOT", "WITH", "") or (before == "AND" and not link)
        contracted = _type(chunks, i + 1) == "DET" and chunks[i + 1].start == chunk.start
        if chunk.type == "OF" and thing and some and (before or contracted):
            continue
        if before == "AND" and chunk.type == link and thing and _type(chunks, i + 1) != "PART":
            continue
        if chunk.type in _VERBS:
            link = ""
        elif chunk.type in _LEADS:
            link = chunk.type
        elif chunk.type in ("PREP", "NEARBY", "ACROSS"):
            link = next((c.type for c in chunks[i + 1 : i + 2] if c.type in _LINKS), "OF")
        found.append(chunk)
    return found


def _negated(chunks: list[Chunk]) -> list[Chunk]:
    """Put "no" where the grammar has it: behind "is" and "there is", before "see"; "not far" is near."""
    found = list(chunks)
    i = 0
    while i < len(found):
        at = i + 1
        while _type(found, at) in ("ADVERB", "ME", "YOU", "IT"):
            at += 1
        if found[i].type == "NOT" and _type(found, at) in _VERBS:
            negation = found.pop(i)
            found.insert(at if _type(found, at - 1) in ("BE", "EXISTS") else at - 1, negation)
            i = at
        i += 1
    for i in range(len(found) - 2, -1, -1):
        again = _plain(found, i + 1)
        if found[i].type == _type(found, again) == "NOT":
            del found[again], found[i]
    return found


def _existing(chunks: list[Chunk]) -> list[Chunk]:
    """Put a place behind "there is" before it: "il y a à ma gauche une église"."""
    found: list[Chunk] = []
    i = 0
    told = _type(chunks, 0) in _PLACES and not any(c.type in VERBS for c in chunks)
    if told and (bare := _new_thing(chunks, 0)):  # "devant moi, une église"
        chunks = [*chunks[:bare], _at(chunks[bare], "EXISTS"), *chunks[bare:]]
    while i < len(chunks):
        if chunks[i].type == "EXISTS" and _type(found, len(found) - 1) in ("NOUN", "NAME"):
            after = _plain(chunks, i + 1)
            if _type(chunks, after) in _PLACES and not _new_thing(chunks, after):
                found.append(replace(chunks[i], type="BE"))  # "la torre se ve al norte"
                i += 1
                continue
        if chunks[i].type not in ("EXISTS", "SEE", "HAVE"):
            found.append(chunks[i])
            i += 1
            continue
        verb = i
        i += 1
        while _type(chunks, i) in ("NOT", "ADVERB"):
            i += 1
        start = i + (_type(chunks, i) == "AND")
        end = _new_thing(chunks, start) if _type(chunks, start) in _PLACES else 0
        mine = []
        if end and chunks[verb].type != "EXISTS":
            while found and found[-1].type in ("ME", "YOU", "NOT"):
                mine.insert(0, found.pop())
        if end:
            found += [c for c in chunks[start:end] if c.type != "AND" or c is not chunks[end - 1]]
            start = end
        else:
            start = i
        found += [*mine, *chunks[verb:i]]
        i = start
    return found


def _new_thing(chunks: Sequence[Chunk], start: int) -> int:
    """Where, behind a whole place that begins at `start`, a new thing begins; 0 if none does."""
    for i in range(start + 1, len(chunks)):
        if chunks[i].type in (*_VERBS, "CUT", "COND"):
            return 0
        before = _type(chunks, i - 1 - (_type(chunks, i - 1) == "AND"))
        bare = chunks[i].type == "NOUN" and before in ("DIR", "NEARBY", "ME", "HERE")
        if (chunks[i].type in _NEW or bare) and before in _ENDS:
            listed = _type(chunks, i - 1) == "AND" and chunks[i - 1].words not in (",", ":")
            return 0 if listed else i
    return 0


def _subjects(chunks: list[Chunk]) -> list[Chunk]:
    """Give a verb the subject that it carries: "está al norte", and none to one that has its own."""
    found: list[Chunk] = []
    for i, chunk in enumerate(chunks):
        before = _type(found, _plain(found, len(found) - 1, -1))
        own = chunk.type == "ME" and _type(chunks, i + 1) == "BE" and chunks[i + 1].start == chunk.start
        if own and before in ("NOUN", "NAME"):
            continue  # "i negozi sono a nord"
        if chunk.type == "BE" and before in ("", *_JOINTS):
            after = _plain(chunks, i + 1)
            after = _plain(chunks, after + 1) if _type(chunks, after) == "NOT" else after
            if _type(chunks, after) in (*_OWNED, "NOUN", "NAME") and _has_place(chunks, after):
                chunk = replace(chunk, type="EXISTS")  # "está la iglesia a mi derecha"
            else:
                found.append(_at(chunk, "IT"))
        found.append(chunk)
    return found


def _has_place(chunks: Sequence[Chunk], start: int) -> bool:
    """Tell whether a place is said of the thing at `start`."""
    for chunk in chunks[start:]:
        if chunk.type in (*_VERBS, *_JOINTS):
            break
        if chunk.type in _PLACES and chunk.type != "OF":
            return True
    return False
