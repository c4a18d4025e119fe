"""Ask back where buildings or rooms compete: "Are you in the kitchen?"."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from placegraph.errors import OptionError
from placegraph.outdoor.search.ask import NO, WORTH, YES, Answer, Question, Thing

if TYPE_CHECKING:
    from placegraph.world.estimate import WorldMode
    from placegraph.world.known import Known

BUILDING, ROOM = "the building one is in", "the room one is in"
"""Labels of what such questions are about; no city has things of that label."""


def question_of(modes: Sequence[WorldMode], answered: Sequence[str]) -> Question | None:
    """Which building, else which room: what is told most by a yes or no, and was not yet answered."""
    buildings: dict[str, float] = defaultdict(float)
    rooms: dict[str, float] = defaultdict(float)
    for m in modes:
        buildings[m.building or m.scene] += m.probability
        rooms[m.room] += m.probability
    for label, shares, words in ((BUILDING, buildings, "{}"), (ROOM, rooms, "the {}")):
        asked = [  # shares of everything: where no mode is, one is elsewhere
            Question(f"Are you in {words.format(name)}?", (YES, NO), (Thing(name, label),), gain)
            for name, p in shares.items()
            if name and (gain := _entropy(p)) > WORTH
        ]
        left = [q for q in asked if q.text not in answered]
        if left:
            return max(left, key=lambda q: q.gain)
    return None


def with_answers(known: Known) -> Known:
    """What is known, with answers about buildings and rooms as sentences; others are a city's."""
    said, others = [known.text] if known.text else [], []
    for answer in known.answers:
        if not isinstance(answer, Answer):
            raise OptionError(
                f"answers holds {answer!r}; answer questions by `question.answer(option)`."
            )
        thing = answer.question.things[0]
        if thing.label not in (BUILDING, ROOM):
            others.append(answer)
        elif answer.option in (YES, NO):
            name = thing.words if thing.label == BUILDING else f"the {thing.words}"
            said.append(f"I am {'not ' if answer.option == NO else ''}in {name}.")
    text = known.text if len(said) == bool(known.text) else " ".join(map(_ended, said))
    return replace(known, text=text, answers=tuple(others))


def _ended(sentence: str) -> str:
    """Sentence with a mark at its end."""
    told = sentence.rstrip()
    return told if told[-1:] in (".", "!", "?") else f"{told}."


def _entropy(p: float) -> float:
    """Of a yes or no [nat]."""
    q = np.clip([p, 1.0 - p], 1e-12, 1.0)
    return float(-(q * np.log(q)).sum())
