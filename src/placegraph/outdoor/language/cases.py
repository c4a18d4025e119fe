"""What cases say and words leave unsaid: "of", "is", who is meant, and that something is not there.

Slavic languages have no "of" ("угол улицы", "brama parku") and mostly no "is" ("слева парк").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from placegraph.language.islands import Chunk
from placegraph.outdoor.language.languages.language import Order

_PERSONS = frozenset(("ME", "YOU", "IT", "SPOT"))
_COUNTED = frozenset(("A", "ANOTHER", "NUM", "NO"))
_OWNED = _COUNTED | {"DET", "THIS", "MY", "YOUR", "ITS", "WORD"}
_THINGS = frozenset(("NOUN", "NAME")) | _PERSONS
_PLACES = frozenset(
    ("DIR", "PREP", "IN", "ON", "AT", "FROM", "BETWEEN", "ACROSS", "NEARBY", "HERE", "DIST")
)
_WHOLE = _THINGS | {"DIR", "NEARBY", "HERE", "PART", "DIST", "AWAY"}
"""Chunks that may end a place."""
_VERBS = frozenset(
    ("BE", "EXISTS", "SEE", "HAVE", "MEET", "GO", "PASS", "CROSS", "FOLLOW", "REACH")
)
_JOINTS = frozenset(("AND", "CUT", "COND"))
_DASHES = ("–", "—", "-")


def told(chunks: Sequence[Chunk], order: Order) -> list[Chunk]:
    """Chunks with what their cases say and what their sentence leaves unsaid."""
    own = {
        id(chunk)
        for chunk, after in zip(chunks, [*chunks[1:], None], strict=True)
        if after is not None and after.type == "GEN"
    }
    found = _owners([chunk for chunk in chunks if chunk.type != "GEN"], own)
    found = [c for i, c in enumerate(found) if not (c.type == found[i - 1].type == "NO" and i)]
    if order.verbless:
        found = [chunk for stretch in _stretches(found) for chunk in _verb_first(stretch)]
        found = _copulas(found)
    return found


def _thing(chunks: Sequence[Chunk], at: int) -> int | None:
    """Return where the noun of a thing that begins here stands; None if none begins."""
    if at and chunks[at - 1].type in _OWNED:
        return None
    while at < len(chunks) and chunks[at].type in _OWNED:
        at += 1
    return at if at < len(chunks) and chunks[at].type in _THINGS else None


def _owners(chunks: list[Chunk], own: set[int]) -> list[Chunk]:
    """Put an OF before what a noun, a part or a direction belongs to."""
    found: list[Chunk] = []
    for i, chunk in enumerate(chunks):
        noun = _thing(chunks, i)
        before = found[-1] if found else None
        if noun is not None and before is not None and chunk.type not in _COUNTED:
            facing = before.type == "DIR" and before.value.facing
            owner = id(chunks[noun]) in own
            named = before.type == "PART" and chunks[noun].type != "NOUN"
            if before.type == "NEARBY" and (owner or chunks[noun].type != "NOUN"):
                found[-1] = replace(before, type="PREP", value="near")  # "niedaleko jeziora"
            elif named or (owner and not facing and before.type in ("NOUN", "PART", "DIR")):
                found.append(Chunk("OF", chunk.start, chunk.start))
        found.append(chunk)
    return found


def _stretches(chunks: list[Chunk]) -> list[list[Chunk]]:
    """Cut before joints."""
    found: list[list[Chunk]] = [[]]
    for chunk in chunks:
        if chunk.type in _JOINTS and (not found[-1] or found[-1][-1].type not in _JOINTS):
            found.append([])
        found[-1].append(chunk)
    return found


def _verb_first(stretch: list[Chunk]) -> list[Chunk]:
    """Give a verb that begins or ends a stretch the place that the grammar has for it."""
    kinds = [chunk.type for chunk in stretch]
    first = next((i for i, kind in enumerate(kinds) if kind not in (*_JOINTS, "ADVERB")), None)
    if first is None:
        return stretch
    noun = _thing(stretch, first + 2) if kinds[first : first + 2] == ["BE", "NOT"] else None
    if noun is not None:  # "لا تقع المدرسة شمال المسجد": the school is not north of the mosque
        thing = stretch[first + 2 : noun + 1]
        return [*stretch[:first], *thing, *stretch[first : first + 2], *stretch[noun + 1 :]]
    seen = kinds[first : first + 2] == ["ME", "SEE"]
    if (seen or kinds[first] in ("BE", "EXISTS")) and kinds[first + 1 : first + 2] != ["NO"]:
        rest = [*stretch[:first], *stretch[first + 1 + seen :]]
        if any(chunk.type == "BE" for chunk in _copulas(rest)):
            return rest  # "توجد عبر الشارع مكتبة": there is, across the street, a library
    if kinds[first] == "BE":  # "stoi kościół": there stands a church; "stoi obok": it stands
        verb = stretch[first]
        if first + 1 < len(stretch) and _thing(stretch, first + 1) is not None:
            return [*stretch[:first], replace(verb, type="EXISTS"), *stretch[first + 1 :]]
        return [*stretch[:first], Chunk("IT", verb.start, verb.start), *stretch[first:]]
    things = [i for i in range(len(stretch)) if kinds[i] not in _PERSONS]
    things = [i for i in things if _thing(stretch, i) is not None]
    if kinds[-2:] == ["EXISTS", "NO"] and things:  # "церкви здесь нет": there is no church here
        at = things[0]
        return [*stretch[:at], *stretch[-2:], *stretch[at:-2]]
    return stretch


def _copulas(chunks: list[Chunk]) -> list[Chunk]:
    """Put a BE between a place and the thing that is said to be there."""
    spoken = [any(c.type in _VERBS for c in s) for s in _stretches(chunks) for _ in s]
    found: list[Chunk] = []
    placed = thing = whole = False
    joint = -1
    for i, given in enumerate(chunks):
        chunk = given
        if chunk.type in _JOINTS and chunks[i - 1].type not in _JOINTS:
            if whole and spoken[i] and not spoken[i - 1] and chunk.type == "AND":
                chunk = replace(chunk, type="CUT")  # "церква за ратушею, | поруч стоїть школа"
            whole = False
            joint = len(found) if thing and chunk.type == "AND" else -1
            placed, thing = placed and not thing and chunk.type == "AND", False
        noun = _thing(chunks, i)
        before = next((c for c in reversed(found) if c.type != "ADVERB"), None)
        if noun is not None and not placed:
            thing = True
        elif noun is not None and before is not None and not (spoken[i] or thing):
            named = before.type == "NOUN" and chunk.type == "NAME"
            if before.type == "AND" and before.words in _DASHES:
                found[found.index(before)] = replace(before, type="BE")
                placed, thing = False, True
            elif before.type in _WHOLE and not named:
                if joint >= 0:  # "я на остановке | рядом киоск"
                    found[joint] = replace(found[joint], type="CUT")
                found.append(Chunk("BE", chunk.start, chunk.start))
                placed, thing = False, True
        elif chunk.type in _PLACES:
            placed, whole = placed or not thing, thing
        found.append(chunk)
    return found
