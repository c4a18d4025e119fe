"""Word order: the chunks of a sentence of any language, brought into the order of the one grammar.

The grammar speaks as English does: a relation stands before its thing ("north of the church"), a
verb between what it speaks of. The table of a language says what else it does (`languages.Order`):
`order_chunks` picks the rules for it. Most rules pass over the chunks from left to right (`_rewrite`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby, pairwise
from math import pi

from placegraph.language.grammar import Chunk
from placegraph.outdoor.language.grammar import JOINTS, VERBS
from placegraph.outdoor.language.languages import Language

_NEW = ("A", "ANOTHER", "NUM", "NO")
_DETERMINERS = ("DET", "THIS", *_NEW, "MY", "YOUR", "ITS", "WORD")
_PERSONS = ("ME", "YOU", "IT", "SPOT")
_NOUNS = ("NOUN", "NAME")
_THINGS = (*_NOUNS, *_PERSONS, "THIS", "HERE")
_LEADS = ("IN", "ON", "AT", "TO", "FROM", "OF")
_LINKS = ("OF", "AT", "TO", "FROM")
"""Terminals that join a preposition of two words to its object."""
_LINKED = ("PREP", "NEARBY", "ACROSS", "BETWEEN", "FROM", "TO", "FACE")
_PLACES = (*_LEADS, "PREP", "DIR", "NEARBY", "ACROSS", "BETWEEN", "DIST")
_STATED = ("BE", "EXISTS", "SEE", "HAVE")
_ENDS = (*_THINGS, "DIR", "NEARBY", "AWAY", "DIST", "PART")
"""Last terminals of a place."""
_RELATIONS = ("DIR", "SHORT", "PREP", "BETWEEN", "ACROSS", "PART")
_MEASURED = ("DIST", "AWAY")
_CASES = ("GEN", "DROP")
"""Markers that only order needs; they are not in the grammar."""
_FAR = 7
"""Chunks between a corner and its street at most."""

Rule = Callable[[list[Chunk], list[Chunk], int, Language], None]
"""Appends chunk i of a sentence to what was found so far, or what it becomes there."""


def order_chunks(chunks: list[Chunk], language: Language) -> list[Chunk]:
    """Return the chunks of a sentence in the order of the grammar."""
    order = language.order
    if order.genitive:
        chunks = _rewrite(chunks, _mark_genitive, language)
    if order.cases or order.verbless:
        chunks = _mark_owners(chunks)
    if order.verbless:
        parts = [_order_verb(part) for part in _cut_at_joints(chunks)]
        chunks = _say_copulas([chunk for part in parts for chunk in part])
    if order.head_first:
        for rule in _HEAD_FIRST:
            chunks = _rewrite(chunks, rule, language)
        chunks = _place_existing(_place_negations(chunks))
    if order.head_first and order.pro_drop:
        chunks = _rewrite(chunks, _say_subject, language)
    if order.postpositions:
        chunks = _order_postpositions(chunks, language)
    chunks = [chunk for chunk in chunks if chunk.type not in _CASES]
    if not (order.head_first or order.verb_final):
        chunks = _place_existing(chunks)
    return _say_gapped_verbs(chunks)


def _rewrite(chunks: list[Chunk], rule: Rule, language: Language) -> list[Chunk]:
    """Apply a rule to one chunk after the other."""
    output: list[Chunk] = []
    for i in range(len(chunks)):
        rule(output, chunks, i, language)
    return output


def _type(chunks: Sequence[Chunk], i: int) -> str:
    """Return the type of the chunk at i, or an empty string."""
    return chunks[i].type if 0 <= i < len(chunks) else ""


def _last(output: Sequence[Chunk], back: int = 1) -> str:
    return _type(output, len(output) - back)


def _plain(chunks: Sequence[Chunk], i: int, step: int = 1) -> int:
    """Return the index of the first chunk from i on that is no adverb."""
    while 0 <= i < len(chunks) and chunks[i].type == "ADVERB":
        i += step
    return i


def _last_plain(output: Sequence[Chunk]) -> str:
    return _type(output, _plain(output, len(output) - 1, -1))


def _mark(chunk: Chunk, kind: str) -> Chunk:
    """Return a chunk of no words of its own, where another begins."""
    return Chunk(kind, chunk.start, chunk.start)


def _noun_of(chunks: Sequence[Chunk], at: int) -> int | None:
    """Return the position of the noun of a mention that begins here; None if none begins."""
    while _type(chunks, at) in _DETERMINERS:
        at += 1
    return at if _type(chunks, at) in (*_NOUNS, *_PERSONS) else None


def _leads_thing(chunks: Sequence[Chunk], i: int) -> bool:
    """Tell whether a thing begins at i, and no direction or relation."""
    start = i
    while _type(chunks, i) in (*_DETERMINERS, "ADVERB"):
        i += 1
    if i > start and _type(chunks, i - 1) == "WORD":
        return True  # a thing that no vocabulary knows: "près de la fenêtre"
    side = _type(chunks, i) == "DIR" and _type(chunks, i + 1) == "PART"
    return side or _type(chunks, i) in (*_THINGS, "PART")


def _new_thing(chunks: Sequence[Chunk], start: int) -> int:
    """Return the start of the next mention behind the complete place at `start`; 0 if there is none."""
    for i in range(start + 1, len(chunks)):
        joint = _type(chunks, i - 1) == "AND"
        before = _type(chunks, i - 1 - joint)
        bare = chunks[i].type == "NOUN" and before in ("DIR", "NEARBY", "ME", "HERE", "IT")
        if (chunks[i].type in _NEW or bare) and before in _ENDS:
            return i
    return 0


# cases: "nördlich der Kirche", "угол улицы", "brama parku"


def _mark_genitive(output: list[Chunk], chunks: list[Chunk], i: int, language: Language) -> None:
    """Put an OF between a direction or a part and its thing: "nördlich der Kirche"."""
    chunk, before, after = chunks[i], _type(chunks, i - 1), _type(chunks, i + 1)
    joints = [other.type for other in chunks[:i] if other.type in ("BETWEEN", "AND", "CUT", "OF")]
    if chunk.type == "OF" and before in _NOUNS and joints[-1:] == ["BETWEEN"]:
        chunk = replace(chunk, type="AND")  # "בין בית הספר ל|כנסייה"
    elif chunk.type == "NEARBY" and after in (*_DETERMINERS, "OF", *_NOUNS):
        chunk = replace(chunk, type="PREP", value="near")  # "in der Nähe der Kirche"
    elif chunk.type == "FROM" and before == "PART":
        chunk = replace(chunk, type="OF")  # "الجانب الشمالي من الساحة"
    output.append(chunk)
    articles = language.lists["articles"].intersection(language.prefixes)
    rest = [other.type for other in chunks[i + 1 : i + 3] if other.type != "ADVERB"]
    led = i > 0 and chunks[i - 1].words in articles
    owns = chunk.type == "NOUN" and not led and rest[:2] == ["DET", "NOUN"]  # "مدخل ال|حديقة"
    if chunk.type in ("DIR", "PART") and rest:
        written_on = chunk.words.rpartition(" ")[2].startswith(tuple(articles))
        owned = chunk.type == "DIR" and before in _DETERMINERS  # "der nördliche Eingang"
        bare = rest[0] in (*_NOUNS, "ME", "YOU", "IT", "WORD") and not owned
        # none follows an article that is written onto the word: "على اليمين"
        owns = not written_on and (bare or rest[0] in ("DET", "THIS", "MY", "YOUR", "ITS"))
    if owns:
        output.append(_mark(chunks[i + 1], "OF"))


def _mark_owners(chunks: list[Chunk]) -> list[Chunk]:
    """Put an OF before a genitive behind a noun, a part or a direction."""
    genitive = {id(chunk) for chunk, after in pairwise(chunks) if after.type == "GEN"}
    chunks = [chunk for chunk in chunks if chunk.type != "GEN"]
    found: list[Chunk] = []
    for i, chunk in enumerate(chunks):
        noun = _noun_of(chunks, i)
        if noun is not None and found and chunk.type not in _NEW:
            before, owner = found[-1], id(chunks[noun]) in genitive
            facing = before.type == "DIR" and before.value.facing
            named = before.type == "PART" and chunks[noun].type != "NOUN"
            if before.type == "NEARBY" and (owner or chunks[noun].type != "NOUN"):
                found[-1] = replace(before, type="PREP", value="near")  # "niedaleko jeziora"
            elif named or (owner and not facing and before.type in ("NOUN", "PART", "DIR")):
                found.append(_mark(chunk, "OF"))
        found.append(chunk)
    return found


# languages without "is": "слева парк", "stoi kościół"


def _cut_at_joints(chunks: list[Chunk]) -> list[list[Chunk]]:
    """Cut chunks before their joints."""
    found: list[list[Chunk]] = [[]]
    for chunk in chunks:
        if chunk.type in JOINTS and _last(found[-1]) not in JOINTS:
            found.append([])
        found[-1].append(chunk)
    return found


def _order_verb(part: list[Chunk]) -> list[Chunk]:
    """Give a verb that begins or ends a part of a sentence the place that the grammar has for it."""
    kinds = [chunk.type for chunk in part]
    first = next((i for i, kind in enumerate(kinds) if kind not in (*JOINTS, "ADVERB")), None)
    if first is None:
        return part
    noun = _noun_of(part, first + 2) if kinds[first : first + 2] == ["BE", "NOT"] else None
    if noun is not None:  # "لا تقع المدرسة شمال المسجد": the school is not north of the mosque
        thing = part[first + 2 : noun + 1]
        return [*part[:first], *thing, *part[first : first + 2], *part[noun + 1 :]]
    seen = kinds[first : first + 2] == ["ME", "SEE"]
    if (seen or kinds[first] in ("BE", "EXISTS")) and _type(part, first + 1) != "NO":
        rest = [*part[:first], *part[first + 1 + seen :]]
        if any(chunk.type == "BE" for chunk in _say_copulas(rest)):
            return rest  # "توجد عبر الشارع مكتبة": there is, across the street, a library
    if kinds[first] == "BE":  # "stoi kościół": there stands a church; "stoi obok": it stands
        verb = part[first]
        if first + 1 < len(part) and _noun_of(part, first + 1) is not None:
            return [*part[:first], replace(verb, type="EXISTS"), *part[first + 1 :]]
        return [*part[:first], _mark(verb, "IT"), *part[first:]]
    things = [i for i, kind in enumerate(kinds) if kind not in _PERSONS]
    at = next((i for i in things if _noun_of(part, i) is not None), None)
    if kinds[-2:] == ["EXISTS", "NO"] and at is not None:
        return [*part[:at], *part[-2:], *part[at:-2]]  # "церкви здесь нет": there is no church here
    return part


def _say_copulas(chunks: list[Chunk]) -> list[Chunk]:
    """Put a BE between a place and the thing that is said to be there."""
    spoken = [any(c.type in VERBS for c in part) for part in _cut_at_joints(chunks) for _ in part]
    found: list[Chunk] = []
    placed = thing = whole = False
    joint = -1
    for i, given in enumerate(chunks):
        chunk = given
        if chunk.type in JOINTS and chunks[i - 1].type not in JOINTS:
            if whole and spoken[i] and not spoken[i - 1] and chunk.type == "AND":
                chunk = replace(chunk, type="CUT")  # "церква за ратушею, | поруч стоїть школа"
            joint = len(found) if thing and chunk.type == "AND" else -1
            placed, thing = placed and not thing and chunk.type == "AND", False
            whole = False
        noun = _noun_of(chunks, i)
        if noun is not None and not placed:
            thing = True
        elif noun is not None and not (spoken[i] or thing):
            if _say_copula(found, chunk, joint):
                placed, thing = False, True
        elif noun is None and chunk.type in (*_PLACES, "HERE") and chunk.type not in ("TO", "OF"):
            placed, whole = placed or not thing, thing
        found.append(chunk)
    return found


def _say_copula(output: list[Chunk], chunk: Chunk, joint: int) -> bool:
    """Append a BE before a thing behind a whole place, and cut at the joint before; tell whether."""
    at = _plain(output, len(output) - 1, -1)
    before = _type(output, at)
    if before == "AND" and output[at].words in ("–", "—", "-"):
        output[at] = replace(output[at], type="BE")
        return True
    ends = before in _ENDS and before != "THIS"
    if not ends or (before == "NOUN" and chunk.type == "NAME"):
        return False
    if joint >= 0:  # "я на остановке | рядом киоск"
        output[joint] = replace(output[joint], type="CUT")
    output.append(_mark(chunk, "BE"))
    return True


# nouns before what is said of them: "côté nord", "à côté de l'église", "plaza grande"


def _move_direction(output: list[Chunk], chunks: list[Chunk], i: int, language: Language) -> None:
    """Put a direction before its part or noun: "côté nord", "l'entrée nord"."""
    chunk, after = chunks[i], _type(chunks, i + 1)
    if chunk.type == "DIR" and _last(output) == "NEARBY":
        side = language.longest([output[-1].words.rpartition(" ")[2]], 0)
        if side is not None and side[1][0].type == "PART":  # "al lado | norte"
            part = replace(output[-1], type="PART", value=side[1][0].value)
            output[-1:] = [_mark(chunk, "ON"), part]
    led = _last(output) in (*_LEADS, "PREP", "FACE")
    bare = after == "DIR" and not led and _type(chunks, i + 2) not in ("PART", "NOUN")
    sides = ("side", "end", "corner")
    if chunk.type == "DIR" and _last(output) == "PART" and output[-1].value in sides:
        part = output.pop()
        lead = len(output) - 1 - (_last(output) in _DETERMINERS)
        before = _type(output, lead - 1)
        if _type(output, lead) == "OF" and before not in ("DIR", "PREP", "NEARBY"):
            output[lead] = replace(output[lead], type="ON")  # "du côté nord de la rue"
        output += [chunk, part]
    elif chunk.type == "DET" and (bare or after in ("A", "THIS", "NO")):
        output.append(replace(chunk, type="AT"))  # "a norte da igreja", "em frente a uma igreja"
    else:
        output.append(chunk)


def _move_quality(output: list[Chunk], chunks: list[Chunk], i: int, language: Language) -> None:
    """Put a common adjective before its noun: "plaza grande"; leave the article of "la mia" out."""
    chunk, after, last = chunks[i], _type(chunks, i + 1), _last(output)
    placed = after in (*_LEADS, "PREP", "DIR", "NEARBY", "ACROSS", "BETWEEN")
    if chunk.type == "DET" and (after in ("MY", "YOUR", "ITS") or last == "NO"):
        return  # "né la chiesa"
    if chunk.type == "THIS" and last == "NOUN" and placed:
        output.append(replace(chunk, type="BE"))  # "la farmacia esta al norte", for "está"
        return
    if chunk.type == "NO" and last in (*_NOUNS, "DIR"):
        output.append(_mark(chunk, "AND"))  # "ni église ni mosquée"
    if chunk.type == "NO" and placed:  # "ni al norte"; the verb says no in "no está | ni"
        denied = _last(output) in _STATED and any(other.type == "NOT" for other in output[-4:])
        if _last_plain(output) != "NOT" and not denied:
            output.append(replace(chunk, type="NOT"))
        return
    stems = [form.stem for form in language.forms.of(chunk.words)] if chunk.type == "WORD" else []
    quality = bool(stems) and not language.words.isdisjoint((chunk.words, *stems))
    output.insert(len(output) - (quality and _last(output) == "NOUN"), chunk)


def _link_corner(output: list[Chunk], chunks: list[Chunk], i: int, _language: Language) -> None:
    """Let a corner be "of A and B": "en la esquina de A con B", "all'angolo tra A e B"."""
    chunk = chunks[i]
    if chunk.type == "PART" and chunk.value in ("corner", "crossing"):
        if _last(output) in (*_NOUNS, "AND", ""):
            output.append(_mark(chunk, "AT"))  # "en Alcalá esquina Goya"
        output.append(chunk)
        if _type(chunks, i + 1) in _NOUNS:
            output.append(_mark(chunks[i + 1], "OF"))
        return
    if chunk.type == "AT" and _last(output) == "PART" and _leads_thing(chunks, i + 1):
        chunk = replace(chunk, type="OF", value=None)  # "in fondo alla strada"
    elif chunk.type in ("WITH", "BETWEEN"):
        near = [c.type == "PART" and c.value in ("corner", "crossing") for c in output[-_FAR:]]
        if near and near[-1]:
            chunk = replace(chunk, type="OF", value=None)
        elif any(near) and chunk.type == "WITH" and _last(output) in _NOUNS:
            chunk = replace(chunk, type="AND", value=None)
    output.append(chunk)


def _drop_link(output: list[Chunk], chunks: list[Chunk], i: int, _language: Language) -> None:
    """Leave out what joins a preposition of two words to its thing: "à côté | de | l'église"."""
    chunk, at, after = chunks[i], _plain(output, len(output) - 1, -1), _plain(chunks, i + 1)
    before = _type(output, at)
    joins = chunk.type in _LINKS and before in _LINKED
    if joins and _leads_thing(chunks, after):
        if before == "NEARBY":
            output[at] = replace(output[at], type="PREP", value="near")
        return
    relation = output[at].value if before == "PREP" else ""
    if relation == "opposite" and chunk.type in _NEW and _type(chunks, i - 1) not in _LINKS:
        output.append(_mark(chunk, "EXISTS"))  # "y enfrente un banco"
    output.append(chunk)


def _drop_repeated(output: list[Chunk], chunks: list[Chunk], i: int, _language: Language) -> None:
    """Leave out an "of" that a list repeats, or that says "some": "de A et de B", "dei negozi"."""
    chunk, before, after = chunks[i], _last_plain(output), _type(chunks, i + 1)
    some = before in ("EXISTS", "SEE", "HAVE", "NOT", "WITH", "AND")
    if not before and after == "DET":
        some = chunks[i + 1].start == chunk.start  # "Des arbres ..."
    if not (chunk.type == "OF" and some and _leads_thing(chunks, i + 1)):
        output.append(chunk)


_HEAD_FIRST: tuple[Rule, ...] = (
    _move_direction, _move_quality, _link_corner, _drop_link, _drop_repeated,
)  # fmt: skip


# verbs: "no está cerca", "il y a à ma gauche une église"


def _place_negations(chunks: list[Chunk]) -> list[Chunk]:
    """Put "no" behind "is" and "there is", before "see"; "not far" is near."""
    found = list(chunks)
    i = 0
    while i < len(found):
        at = i + 1
        while _type(found, at) in ("ADVERB", "ME", "YOU", "IT"):
            at += 1
        if found[i].type == "NOT" and _type(found, at) in _STATED:
            no = found.pop(i)
            found.insert(at if _type(found, at - 1) in ("BE", "EXISTS") else at - 1, no)
            i = at
        i += 1
    for i in range(len(found) - 2, -1, -1):
        again = _plain(found, i + 1)
        if found[i].type == _type(found, again) == "NOT":
            del found[again], found[i]
    return found


def _place_existing(chunks: list[Chunk]) -> list[Chunk]:
    """Put a place behind "there is" before it: "il y a à ma gauche une église"."""
    verbless = _type(chunks, 0) in _PLACES and not any(chunk.type in VERBS for chunk in chunks)
    if verbless and (bare := _new_thing(chunks, 0)):  # "devant moi, une église"
        chunks = [*chunks[:bare], _mark(chunks[bare], "EXISTS"), *chunks[bare:]]
    found: list[Chunk] = []
    i = 0
    while i < len(chunks):
        verb, end = chunks[i], i + 1
        if verb.type not in ("EXISTS", "SEE", "HAVE"):
            found.append(verb)
            i = end
            continue
        while _type(chunks, end) in ("NOT", "ADVERB"):
            end += 1
        place = end + (_type(chunks, end) == "AND")
        thing = _new_thing(chunks, place) if _type(chunks, place) in _PLACES else 0
        if thing:
            seer = len(found)
            stop = thing - (_type(chunks, thing - 1) == "AND")
            found[seer:] = [*chunks[place:stop], *found[seer:], *chunks[i:end]]
            end = thing
        else:
            subject = verb.type == "EXISTS" and _last(found) in _NOUNS
            if subject and _type(chunks, end) in _PLACES:  # "la torre se ve al norte"
                verb = replace(verb, type="BE")
            found += [verb, *chunks[i + 1 : end]]
        i = end
    return found


def _say_gapped_verbs(chunks: list[Chunk]) -> list[Chunk]:
    """Say the verb that is left out: "nördlich ist eine Schule, südlich davon [ist] ein Park"."""
    found = list(chunks)
    joints = [i for i, chunk in enumerate(chunks) if chunk.type in JOINTS]
    verbs = [chunk.type in VERBS for chunk in chunks]
    for start, end in reversed([*pairwise([*joints, len(chunks)])]):
        part = chunks[start + 1 : end]
        if not any(verbs[:start]) or any(verbs[start:end]) or _type(part, 0) not in _PLACES:
            continue
        if thing := _new_thing(part, 0):
            found.insert(start + 1 + thing, _mark(part[thing], "EXISTS"))
    return found


def _say_subject(output: list[Chunk], chunks: list[Chunk], i: int, _language: Language) -> None:
    """Give a verb the subject that it carries: "está al norte", and none to one that has its own."""
    chunk, before = chunks[i], _last_plain(output)
    one = chunk.type == "ME" and _type(chunks, i + 1) == "BE"
    carried = one and chunks[i + 1].start == chunk.start and before in _NOUNS
    if carried or chunk.type == before == "ME":
        return  # "i negozi sono a nord", "io sono"
    relative = any(other.type == "THAT_IS" for other in chunks[: i + 1])
    aside = before == "AND" and output[-1].words == "," and relative
    if chunk.type != "BE" or before not in ("", *JOINTS, "THAT_IS") or aside:
        output.append(chunk)
    elif _shows(chunks, i + 1):
        output.append(replace(chunk, type="EXISTS"))  # "está la iglesia a mi derecha"
    else:
        output += [_mark(chunk, "IT"), chunk]


def _shows(chunks: Sequence[Chunk], i: int) -> bool:
    """Tell whether a thing begins at i, and where it is follows."""
    i = _plain(chunks, i)
    i = _plain(chunks, i + 1) if _type(chunks, i) == "NOT" else i
    if _type(chunks, i) not in (*_DETERMINERS, *_NOUNS):
        return False
    for chunk in chunks[i:]:
        if chunk.type in (*_STATED, *JOINTS, "THAT_IS"):
            break
        if chunk.type in _PLACES and chunk.type != "OF":
            return True
    return False


# postpositions and final verbs: "kirkon vieressä", "kita ni kyōkai ga aru"


@dataclass
class _Item:
    """A thing with its markers, a place, or another chunk."""

    kind: str
    """``thing``, ``place``, or the type of the one chunk."""
    chunks: list[Chunk]
    case: list[str] = field(default_factory=list)
    """Types of the markers behind a thing."""

    @property
    def is_person(self) -> bool:
        return self.kind == "thing" and self.chunks[0].type in (*_PERSONS, "THIS")

    @property
    def lead(self) -> list[str]:
        """Return the last marker that stands for a word before the thing."""
        return [case for case in self.case if case in (*_LEADS, "WITH")][-1:]


def _order_postpositions(chunks: list[Chunk], language: Language) -> list[Chunk]:
    """Bring things behind the relations that follow them, and final verbs between what they join."""
    order = language.order
    items = _mark_nearby(_group_items(chunks), language)
    found: list[_Item] = []
    kinds = (*_RELATIONS, *_MEASURED)
    groups = [list(group) for _, group in groupby(items, lambda item: item.kind in kinds)]
    for group, following in zip(groups, [*groups[1:], []], strict=False):
        if group[0].kind in kinds:
            shows = bool(following) and following[0].kind == "thing"
            _relate(found, group, marked=order.marked, shows=shows)
        else:
            found += group
    items = _move_owners(found)
    if order.verb_final:
        items = list(_move_verbs(items))
    # the case of a thing becomes a word before it
    return [
        chunk
        for item in items
        for chunk in (*[_mark(item.chunks[0], case) for case in item.lead], *item.chunks)
    ]


def _group_items(chunks: Sequence[Chunk]) -> list[_Item]:
    """Group the chunks of a thing, and the markers behind it."""
    items: list[_Item] = []
    for chunk in chunks:
        last = items[-1] if items else _Item("", [])
        if chunk.type in (*_CASES, *_LEADS, "WITH"):
            if last.kind == "thing":
                last.case.append(chunk.type)
            elif last.kind not in (*_RELATIONS, *_MEASURED, "NEARBY", "HERE"):
                items.append(_Item(chunk.type, [chunk]))
        elif chunk.type in (*_NOUNS, *_DETERMINERS, *_PERSONS):
            before = _last(last.chunks)
            goes_on = before in _DETERMINERS or (before, chunk.type) in (_NOUNS, _NOUNS[::-1])
            alone = last.is_person or bool(last.case) or chunk.type in (*_PERSONS, "THIS")
            if last.kind == "thing" and goes_on and not alone:
                last.chunks.append(chunk)
            else:
                items.append(_Item("thing", [chunk]))
        elif chunk.type != "ADVERB" or chunk.value != "skip":
            items.append(_Item(chunk.type, [chunk]))
    return [item for item in items if item.kind not in _CASES]


def _mark_nearby(items: list[_Item], language: Language) -> list[_Item]:
    """Take "nearby" beside a thing as "near" it: "kirkon lähellä", "lähellä kirkkoa"."""
    order = language.order
    for i, item in enumerate(items):
        behind = i and items[i - 1].kind == "thing" and (items[i - 1].case or not order.marked)
        before = not order.verb_final and i + 1 < len(items) and items[i + 1].kind == "thing"
        if item.kind == "NEARBY" and (behind or before):
            item.kind, item.chunks = "PREP", [replace(item.chunks[0], type="PREP", value="near")]
    return items


def _relate(output: list[_Item], words: list[_Item], *, marked: bool, shows: bool) -> None:
    """Append a relation and the things before it that are its own; `shows`: another thing follows."""
    hedges = [output.pop()] if output and output[-1].kind == "ADVERB" else []
    relations = [word for word in words if word.kind not in _MEASURED]
    measured = [word for word in words if word.kind in _MEASURED]
    if not _takes_thing(output, measured_only=not relations, marked=marked, shows=shows):
        output += [*hedges, *measured, *relations]
        return
    things = [output.pop()]
    if output and output[-1].kind == "FROM":
        output.pop()  # "离我100米", from me 100 m: the grammar has it the other way round
    if relations and relations[0].kind in ("BETWEEN", "PART"):
        while len(output) > 1 and output[-1].kind == "AND" and output[-2].kind == "thing":
            things = [output[-2], output[-1], *things]
            del output[-2:]
    while output and output[-1].kind == "DIST" and not measured:
        measured = [output.pop()]  # "50 metriä kirkosta pohjoiseen"
    target = [chunk for thing in things for chunk in thing.chunks]
    of_thing = target[0].type not in ("ME", "YOU")
    heads: list[Chunk] = []
    for chunk in [chunk for word in relations for chunk in word.chunks]:
        turned = chunk.value.bearing if chunk.type == "DIR" and chunk.value.facing else None
        in_line = of_thing and turned in (0.0, pi)
        if in_line:  # a thing has no heading: "in front" or "behind" it
            chunk = replace(chunk, type="PREP", value="behind" if turned else "front")  # noqa: PLW2901
        heads.append(chunk)
    kind = heads[-1].type if heads else ""
    lead = [_mark(target[0], "AT")] if kind == "PART" else []
    between = {"DIR": "OF", "SHORT": "OF", "PART": "OF"}.get(kind, "" if relations else "FROM")
    output += hedges
    distance = [chunk for word in measured for chunk in word.chunks]
    joint = [_mark(target[0], between)] if between else []
    output.append(_Item("place", [*distance, *lead, *heads, *joint, *target]))


def _takes_thing(output: list[_Item], *, measured_only: bool, marked: bool, shows: bool) -> bool:
    """Tell whether the thing before a relation is what it relates to."""
    if not output or output[-1].kind != "thing" or "DROP" in output[-1].case:
        return False
    case, before = output[-1].case, output[-2].kind if len(output) > 1 else ""
    if before in ("SEE", "AND") and not shows and any(item.kind == "SEE" for item in output):
        return False  # what is seen, and then where
    if measured_only:
        return "FROM" in case or before == "FROM"
    return {"IN", "AT", "ON"}.isdisjoint(case) and (bool(case) or not marked)


def _move_owners(items: list[_Item]) -> list[_Item]:
    """Bring an owner behind what it owns: "puiston portti" is "the gate of the park"."""
    found: list[_Item] = []
    for item in items:
        owner = found[-1] if found else None
        owned = owner is not None and owner.kind == "thing" and owner.case == ["GEN"]
        if owner is None or not owned or item.kind not in ("thing", "place"):
            found.append(item)
            continue
        found[-1] = item
        if item.kind == "thing" and not owner.is_person and not item.is_person:
            found.append(_Item("place", [_mark(owner.chunks[0], "OF"), *owner.chunks]))
    return found


def _move_verbs(items: list[_Item]) -> Iterator[_Item]:
    """Bring final verbs to where the grammar has them."""
    clause: list[_Item] = []
    i = 0
    while i < len(items):
        item = items[i]
        i += 1
        if item.kind not in _STATED:
            clause.append(item)
            continue
        verb = [item]
        while i < len(items) and items[i].kind == "NOT":
            verb.append(items[i])
            i += 1
        start = next((n for n, other in enumerate(clause) if other.kind != "AND"), len(clause))
        joints, clause = clause[:start], clause[start:]
        shown = items[i] if i < len(items) and items[i].kind == "thing" else None
        places = [other.kind for other in clause if other.kind != "AND"]
        relative = verb[-1].kind in ("EXISTS", "BE") and bool(places)
        relative = relative and {"place", "DIR", "PREP", "NEARBY"}.issuperset(places)
        if relative and shown is not None and not shown.is_person:
            i += 1  # "南にある建物は": the building in the south
            chunks = [chunk for one in (shown, *clause) for chunk in one.chunks]
            clause = [*joints, replace(shown, chunks=chunks)]
            continue
        yield from joints
        yield from _place_verb(clause, verb)
        clause = []
    yield from clause


def _place_verb(clause: list[_Item], verb: list[_Item]) -> list[_Item]:
    """Return the items of a clause with its verb where the grammar has it."""
    free = [n for n, item in enumerate(clause) if item.kind == "thing" and not item.lead]
    kind = verb[0].kind
    if free and kind in ("EXISTS", "BE") and free[0] == 0 and (len(clause) > 1 or kind == "BE"):
        be = _Item("BE", [replace(verb[0].chunks[0], type="BE")])
        return [clause[0], be, *verb[1:], *clause[1:]]
    seen = [n for n in free if not clause[n].is_person]
    if not seen or (kind == "BE" and seen[0] == 0):
        left = verb[1:] if kind in ("BE", "EXISTS") else verb  # "教会の北です": a place alone
        return [*left, *clause, _Item("CUT", [_mark(verb[0].chunks[0], "CUT")])]
    at = seen[0]
    return [*clause[:at], *verb, *clause[at:]]
