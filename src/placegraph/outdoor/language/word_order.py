"""Word order: the chunks of a sentence of any language, brought into the order of the one grammar."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from math import pi

from placegraph.language.grammar import Chunk
from placegraph.outdoor.language.clauses import VERBS
from placegraph.outdoor.language.description import Direction
from placegraph.outdoor.language.languages import Language
from placegraph.outdoor.language.languages.language import Order
from placegraph.outdoor.language.words import tokens

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


CASE_LEADS = ("IN", "ON", "AT", "TO", "FROM", "OF", "WITH")
PERSONS = ("ME", "YOU", "IT", "SPOT", "THIS")
_FINAL = ("EXISTS", "BE", "SEE", "HAVE")


@dataclass
class Item:
    """A thing with its marker, a place, or another chunk."""

    kind: str
    """``thing``, ``place``, or the type of the one chunk."""
    chunks: list[Chunk]
    case: list[str] = field(default_factory=list)
    """Types of the markers behind a thing."""

    @property
    def person(self) -> bool:
        """Whether it is a person, or a word for something spoken of before."""
        return self.kind == "thing" and self.chunks[0].type in PERSONS


def verbs_last(items: list[Item]) -> Iterator[Item]:
    """Bring final verbs to where the grammar has them."""
    clause: list[Item] = []
    i = 0
    while i < len(items):
        item = items[i]
        i += 1
        if item.kind not in _FINAL:
            clause.append(item)
            if item.kind in ("CUT", "COND"):
                yield from clause
                clause = []
            continue
        verb = [item]
        while i < len(items) and items[i].kind == "NOT":
            verb.append(items[i])
            i += 1
        if _relative(items, i, clause):  # "南にある建物は": the building in the south
            shown, i = items[i], i + 1
            joints, places = _split_joints(clause)
            chunks = [chunk for one in (shown, *places) for chunk in one.chunks]
            clause = [*joints, replace(shown, chunks=chunks)]
            continue
        yield from _verb_placed(clause, verb)
        clause = []
    yield from clause


def _split_joints(clause: list[Item]) -> tuple[list[Item], list[Item]]:
    """Joints at the beginning of a clause, and the rest of it."""
    n = next((n for n, item in enumerate(clause) if item.kind != "AND"), len(clause))
    return clause[:n], clause[n:]


def _relative(items: list[Item], i: int, clause: list[Item]) -> bool:
    """Tell whether the verb before i ends what is said of the thing at i, and no clause."""
    if i >= len(items) or items[i].kind != "thing" or items[i].person:
        return False
    places = [item for item in clause if item.kind != "AND"]
    return (
        bool(places)
        and items[i - 1].kind in ("EXISTS", "BE")
        and all(item.kind in ("place", "DIR", "PREP", "NEARBY") for item in places)
    )


def _verb_placed(clause: list[Item], verb: list[Item]) -> list[Item]:
    joints, clause = _split_joints(clause)
    free = [n for n, item in enumerate(clause) if item.kind == "thing" and not _lead(item)]
    kind = verb[0].kind
    if free and kind in ("EXISTS", "BE") and free[0] == 0 and (len(clause) > 1 or kind == "BE"):
        return [*joints, clause[0], Item("BE", [replace(verb[0].chunks[0], type="BE")]),
                *verb[1:], *clause[1:]]  # fmt: skip
    seen = [n for n in free if not clause[n].person]
    if not seen or (kind == "BE" and seen[0] == 0):
        kept = verb[1:] if kind in ("BE", "EXISTS") else verb  # "教会の北です": a place alone
        if kind == "SEE":
            return [*joints, *clause, *kept]
        return [*joints, *kept, *clause, Item("CUT", [mark(verb[0].chunks[0], "CUT")])]
    at = seen[0]
    while at and clause[at - 1].kind == "NOT":
        at -= 1
    return [*joints, *clause[:at], *verb, *clause[at:]]


def _lead(item: Item) -> bool:
    return any(case in CASE_LEADS for case in item.case)


_PERSONS = frozenset(("ME", "YOU", "IT", "SPOT"))
_COUNTED = frozenset(("A", "ANOTHER", "NUM", "NO"))
_OWNERS = _COUNTED | {"DET", "THIS", "MY", "YOUR", "ITS", "WORD"}
_THINGS = frozenset(("NOUN", "NAME")) | _PERSONS
_VERBLESS_PLACES = frozenset(
    ("DIR", "PREP", "IN", "ON", "AT", "FROM", "BETWEEN", "ACROSS", "NEARBY", "HERE", "DIST")
)
_WHOLE = _THINGS | {"DIR", "NEARBY", "HERE", "PART", "DIST", "AWAY"}
"""Chunks that may end a place."""
_VERBS = frozenset(
    ("BE", "EXISTS", "SEE", "HAVE", "MEET", "GO", "PASS", "CROSS", "FOLLOW", "REACH")
)
_CUTS = frozenset(("AND", "CUT", "COND"))
_DASHES = ("–", "—", "-")


def told(chunks: Sequence[Chunk], order: Order) -> list[Chunk]:
    """Chunks with what their cases say and what their sentence leaves unsaid."""
    own = {
        id(chunk)
        for chunk, after in zip(chunks, [*chunks[1:], None], strict=True)
        if after is not None and after.type == "GEN"
    }
    found = _insert_owners([chunk for chunk in chunks if chunk.type != "GEN"], own)
    found = [c for i, c in enumerate(found) if not (c.type == found[i - 1].type == "NO" and i)]
    if order.verbless:
        found = [chunk for stretch in _stretches(found) for chunk in _verb_first(stretch)]
        found = _copulas(found)
    return found


def _thing(chunks: Sequence[Chunk], at: int) -> int | None:
    """Return where the noun of a thing that begins here stands; None if none begins."""
    if at and chunks[at - 1].type in _OWNERS:
        return None
    while at < len(chunks) and chunks[at].type in _OWNERS:
        at += 1
    return at if at < len(chunks) and chunks[at].type in _THINGS else None


def _insert_owners(chunks: list[Chunk], own: set[int]) -> list[Chunk]:
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
        if chunk.type in _CUTS and (not found[-1] or found[-1][-1].type not in _CUTS):
            found.append([])
        found[-1].append(chunk)
    return found


def _verb_first(stretch: list[Chunk]) -> list[Chunk]:
    """Give a verb that begins or ends a stretch the place that the grammar has for it."""
    kinds = [chunk.type for chunk in stretch]
    first = next((i for i, kind in enumerate(kinds) if kind not in (*_CUTS, "ADVERB")), None)
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
        if chunk.type in _CUTS and chunks[i - 1].type not in _CUTS:
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
        elif chunk.type in _VERBLESS_PLACES:
            placed, whole = placed or not thing, thing
        found.append(chunk)
    return found


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
        if not (
            chunk.type in ("IN", "ON", "AT", "TO") and after in (*CASE_LEADS, "PREP", "BETWEEN")
        )
    ]


def _items(chunks: Sequence[Chunk], order: Order) -> list[Item]:
    """Group the chunks of a thing, and the markers behind it."""
    items: list[Item] = []
    for chunk in chunks:
        last = items[-1] if items else None
        if chunk.type in (*CASES, *CASE_LEADS):
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
    lead = [case for case in item.case if case in CASE_LEADS][-1:]
    return [*[_at(item.chunks[0], case) for case in lead], *item.chunks]
