"""Verbs of languages that say little else: "no está cerca", "il y a à ma gauche une église".

They put "no" before the verb and a place between "there is" and what is there, and leave out who the
verb speaks of.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

from placegraph.language.islands import Chunk
from placegraph.outdoor.language.settle import VERBS

LEADS = ("IN", "ON", "AT", "TO", "FROM", "OF")
OWNED = ("DET", "THIS", "A", "ANOTHER", "NUM", "NO", "MY", "YOUR", "ITS", "WORD")
NEW = ("A", "ANOTHER", "NUM", "NO")
THINGS = ("NOUN", "NAME", "ME", "YOU", "IT", "THIS", "SPOT", "HERE")
STATED = ("BE", "EXISTS", "SEE", "HAVE")
_ENDS = (*THINGS, "DIR", "NEARBY", "AWAY", "DIST", "PART")
"""What a place may end with."""
_PLACES = (*LEADS, "PREP", "DIR", "NEARBY", "ACROSS", "BETWEEN", "DIST")
_JOINTS = ("AND", "CUT", "COND", "THAT_IS")


def kind(chunks: Sequence[Chunk], i: int) -> str:
    """Type of the chunk at i, or an empty string."""
    return chunks[i].type if 0 <= i < len(chunks) else ""


def plain(chunks: Sequence[Chunk], i: int, step: int = 1) -> int:
    """Index of the first chunk from i on that is no adverb."""
    while 0 <= i < len(chunks) and chunks[i].type == "ADVERB":
        i += step
    return i


def mark(chunk: Chunk, kind: str) -> Chunk:
    """Make a chunk of no words of its own, where another begins."""
    return Chunk(kind, chunk.start, chunk.start)


def negated(chunks: list[Chunk]) -> list[Chunk]:
    """Put "no" where the grammar has it: behind "is" and "there is", before "see"; "not far" is near."""
    found = list(chunks)
    i = 0
    while i < len(found):
        at = i + 1
        while kind(found, at) in ("ADVERB", "ME", "YOU", "IT"):
            at += 1
        if found[i].type == "NOT" and kind(found, at) in STATED:
            no = found.pop(i)
            found.insert(at if kind(found, at - 1) in ("BE", "EXISTS") else at - 1, no)
            i = at
        i += 1
    for i in range(len(found) - 2, -1, -1):
        again = plain(found, i + 1)
        if found[i].type == kind(found, again) == "NOT":
            del found[again], found[i]
    return found


def existing(chunks: list[Chunk]) -> list[Chunk]:
    """Put a place behind "there is" before it: "il y a à ma gauche une église"."""
    verbless = kind(chunks, 0) in _PLACES and not any(chunk.type in VERBS for chunk in chunks)
    if verbless and (bare := _new_thing(chunks, 0)):  # "devant moi, une église"
        chunks = [*chunks[:bare], mark(chunks[bare], "EXISTS"), *chunks[bare:]]
    found: list[Chunk] = []
    i = 0
    while i < len(chunks):
        verb = chunks[i]
        end = i + 1
        while verb.type in ("EXISTS", "SEE", "HAVE") and kind(chunks, end) in ("NOT", "ADVERB"):
            end += 1
        place = end + (kind(chunks, end) == "AND")
        thing = _new_thing(chunks, place) if kind(chunks, place) in _PLACES else 0
        subject = kind(found, len(found) - 1) in ("NOUN", "NAME")
        if verb.type not in ("EXISTS", "SEE", "HAVE"):
            found.append(verb)
        elif verb.type == "EXISTS" and subject and place == end < len(chunks) and not thing:
            said = kind(chunks, end) in _PLACES  # "la torre se ve al norte"
            found += [replace(verb, type="BE") if said else verb, *chunks[i + 1 : end]]
        elif thing:
            seer = len(found)
            while verb.type != "EXISTS" and kind(found, seer - 1) in ("ME", "YOU", "NOT"):
                seer -= 1
            told = thing - (kind(chunks, thing - 1) == "AND")
            found[seer:] = [*chunks[place:told], *found[seer:], *chunks[i:end]]
            end = thing
        else:
            found += chunks[i:end]
        i = end
    return found


def gapped(chunks: list[Chunk]) -> list[Chunk]:
    """Say the verb that is left out: "nördlich ist eine Schule, südlich davon [ist] ein Park"."""
    found = list(chunks)
    joints = [i for i, chunk in enumerate(chunks) if chunk.type in ("AND", "CUT", "COND")]
    for start, end in reversed([*pairwise([*joints, len(chunks)])]):
        part = chunks[start + 1 : end]
        verbs = [chunk.type in VERBS for chunk in chunks]
        if not any(verbs[:start]) or any(verbs[start:end]) or kind(part, 0) not in _PLACES:
            continue
        if thing := _new_thing(part, 0):
            found.insert(start + 1 + thing, mark(part[thing], "EXISTS"))
    return found


def _new_thing(chunks: Sequence[Chunk], start: int) -> int:
    """Where, behind a whole place that begins at `start`, a new thing begins; 0 if none does."""
    for i in range(start + 1, len(chunks)):
        if chunks[i].type in (*STATED, "CUT", "COND"):
            return 0
        joint = kind(chunks, i - 1) == "AND"
        before = kind(chunks, i - 1 - joint)
        bare = chunks[i].type == "NOUN" and before in ("DIR", "NEARBY", "ME", "HERE", "IT")
        if (chunks[i].type in NEW or bare) and before in _ENDS:
            return 0 if joint and chunks[i - 1].words not in (",", ":") else i
    return 0


def subjects(chunks: list[Chunk]) -> list[Chunk]:
    """Give a verb the subject that it carries: "está al norte", and none to one that has its own."""
    found: list[Chunk] = []
    relative = False
    for i, chunk in enumerate(chunks):
        before = kind(found, plain(found, len(found) - 1, -1))
        one = chunk.type == "ME" and kind(chunks, i + 1) == "BE"
        carried = one and chunks[i + 1].start == chunk.start and before in ("NOUN", "NAME")
        if carried or chunk.type == before == "ME":
            continue  # "i negozi sono a nord", "io sono"
        relative = relative or chunk.type == "THAT_IS"
        aside = before == "AND" and found[-1].words == "," and relative
        if chunk.type != "BE" or before not in ("", *_JOINTS) or aside:
            found.append(chunk)
        elif _shows(chunks, i + 1):
            found.append(replace(chunk, type="EXISTS"))  # "está la iglesia a mi derecha"
        else:
            found += [mark(chunk, "IT"), chunk]
    return found


def _shows(chunks: Sequence[Chunk], i: int) -> bool:
    """Tell whether a thing begins at i, and where it is follows."""
    i = plain(chunks, i)
    i = plain(chunks, i + 1) if kind(chunks, i) == "NOT" else i
    if kind(chunks, i) not in (*OWNED, "NOUN", "NAME"):
        return False
    for chunk in chunks[i:]:
        if chunk.type in (*STATED, *_JOINTS):
            break
        if chunk.type in _PLACES and chunk.type != "OF":
            return True
    return False
