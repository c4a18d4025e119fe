"""Clauses: the settled chunks of a sentence, cut at joints between finite verbs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

from placegraph.language.islands import Chunk
from placegraph.outdoor.language.settle import JOINTS, VERBS, settled

if TYPE_CHECKING:
    from placegraph.outdoor.language.languages import Language

_STARTS = VERBS - {"BE", "SEE", "HAVE"}
"""Verbs that open a clause of their own even without a joint before them."""
_BEFORE_TARGET = frozenset(("AND", "COND", "PREP", "OF", "FROM", "BETWEEN"))
"""What a person after them is no subject of, or joined to already: "next to it is a bank"."""
_SUBJECTS = frozenset(("ME", "YOU", "IT", "SPOT", "THIS"))
_GOVERNS = frozenset(("PREP", "OF", "FROM", "BETWEEN", "ACROSS", "IN", "ON", "AT", "TO", "WITH"))
"""What makes a pronoun no subject of the verb behind it: "next to it is a bakery"."""
LONGEST = 60
"""Chunks in a clause; nobody speaks in longer ones."""
UNSURE = 0.6
"""Certainty of what is said to be "maybe" so."""


class Part(NamedTuple):
    """The chunks of one clause."""

    chunks: list[Chunk]
    certainty: float
    opens: bool
    """Whether it opens its sentence."""


def clauses(sentence: list[Chunk], language: Language) -> list[Part]:
    """Cut the chunks of a sentence into clauses."""
    chunks = list(settled(sentence, language))
    cutter = _Cutter()
    for chunk, verb_ahead in zip(chunks, _verb_before_joint(chunks), strict=True):
        cutter.take(chunk, verb_ahead=verb_ahead)
    cutter.cut()
    return cutter.parts


class _Cutter:
    """Collects the chunks of a clause until the next one begins."""

    def __init__(self) -> None:
        self.parts: list[Part] = []
        self.current: list[Chunk] = []
        self.certainty, self.has_verb = 1.0, False

    def take(self, chunk: Chunk, *, verb_ahead: bool) -> None:
        kind = chunk.type
        if kind == "UNSURE":
            self.certainty = UNSURE
        elif kind == "AND":
            self._joint(chunk, verb_ahead=verb_ahead)
        elif kind == "CUT":
            self.cut()
        else:
            if kind == "COND" or len(self.current) >= LONGEST:
                self.cut()
            if kind in VERBS and not (kind == "CROSS" and self._has_where()):
                self._verb(kind)
            self.current.append(chunk)

    def cut(self) -> None:
        """End the clause."""
        self._drop_joints()
        if self.current:
            self.parts.append(Part(self.current, self.certainty, not self.parts))
        self.current, self.certainty, self.has_verb = [], 1.0, False

    def _joint(self, chunk: Chunk, *, verb_ahead: bool) -> None:
        if self.has_verb and verb_ahead:
            self.cut()
        elif not self.current or self.current[-1].type == "AND":
            return
        elif chunk.words == ":" and not self.has_verb and not verb_ahead:
            self.current.append(replace(chunk, type="BE"))  # "north of me: a church"
            self.has_verb = True
        else:
            self.current.append(chunk)

    def _verb(self, kind: str) -> None:
        subject = None
        before = self.current[-2].type if len(self.current) > 1 else ""
        if self.current and self.current[-1].type in _SUBJECTS and before not in _GOVERNS:
            subject = self.current.pop()
        if self.has_verb and (subject is not None or kind in _STARTS):
            self.cut()  # "head south | meet me at the park"
        if kind in _STARTS or (kind == "BE" and subject is None):
            self._drop_joints()  # "to the north, there is"
        if subject is not None:
            if self.current and self.current[-1].type not in _BEFORE_TARGET:
                self.current.append(Chunk("AND", subject.start, subject.start))
            self.current.append(subject)  # "north of here you see"
        self.has_verb = True

    def _drop_joints(self) -> None:
        while self.current and self.current[-1].type == "AND":
            self.current.pop()

    def _has_where(self) -> bool:
        """Tell whether a verb says where two streets meet, and is none of the clause."""
        return any(chunk.type == "WHERE" for chunk in self.current[-6:])


def _verb_before_joint(chunks: Sequence[Chunk]) -> list[bool]:
    """For every chunk, whether a verb follows it before the next joint."""
    ahead, found = [False] * len(chunks), False
    for i in range(len(chunks) - 1, -1, -1):
        ahead[i] = found
        if chunks[i].type in JOINTS:
            found = False
        elif chunks[i].type in VERBS:
            found = True
    return ahead
