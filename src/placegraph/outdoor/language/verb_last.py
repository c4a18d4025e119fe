"""Verbs at the end of their clause, and the things and places before them: "kita ni kyōkai ga aru"."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

from placegraph.language.islands import Chunk
from placegraph.outdoor.language.verb_first import mark

LEADS = ("IN", "ON", "AT", "TO", "FROM", "OF", "WITH")
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
            joints, places = _joints(clause)
            chunks = [chunk for one in (shown, *places) for chunk in one.chunks]
            clause = [*joints, replace(shown, chunks=chunks)]
            continue
        yield from _verb_placed(clause, verb)
        clause = []
    yield from clause


def _joints(clause: list[Item]) -> tuple[list[Item], list[Item]]:
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
    joints, clause = _joints(clause)
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
    return any(case in LEADS for case in item.case)
