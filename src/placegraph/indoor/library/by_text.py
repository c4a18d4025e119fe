"""A text finds its scene: "a kitchen with two sinks"."""

from __future__ import annotations

from functools import partial
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from placegraph.errors import OptionError
from placegraph.estimate import SceneEstimate, SceneMode
from placegraph.indoor.language import read, score
from placegraph.indoor.library.by_capture import judge

if TYPE_CHECKING:
    from placegraph.estimate import Evidence
    from placegraph.indoor.language import Sentence
    from placegraph.indoor.library.library import SceneLibrary

UNKNOWN = 0.05
"""Probability that a text describes no scene of the library, before it is read."""


def search_text(library: SceneLibrary, text: str, most: int) -> SceneEstimate:
    """Scenes that a text describes, likeliest first; `SceneLibrary.search` says more."""
    start = perf_counter()
    sentence = read(text)
    if not sentence.statements:
        ignored = "; ".join(f"{i.text!r}: {i.reason}" for i in sentence.ignored)
        raise OptionError(
            f"{text!r} says nothing of a place{f' ({ignored})' if ignored else ''}; name a room, "
            "things in it, how many, or how they stand to each other."
        )
    scores = library.texts.scores(sentence)
    # being in none of the scenes is as likely as the average one makes it
    logs = np.append(scores, np.log(UNKNOWN / (1.0 - UNKNOWN) * len(scores)))
    share = np.exp(logs - logs.max())
    share /= share.sum()
    names = library.names
    modes = tuple(
        SceneMode(
            scene=names[row],
            probability=float(share[row]),
            score=float(scores[row]),
            explain=partial(_explain, library, names[row], sentence),
        )
        for row in np.argsort(-scores, kind="stable")[:most]
    )
    status, reason = judge(modes, float(share[-1]))
    left = "; ".join(f"{i.text!r} ({i.reason})" for i in sentence.ignored)
    return SceneEstimate(
        status=status,
        modes=modes,
        reason=f"{reason} Not used: {left}." if left else reason,
        elsewhere=float(share[-1]),
        stats={"seconds": {"text": round(perf_counter() - start, 5)}},
    )


def _explain(library: SceneLibrary, name: str, sentence: Sentence) -> tuple[Evidence, ...]:
    """What each statement says of a scene."""
    signature = library.entry(name).signature
    rooms = [a.get("room", "") for a in signature.attributes]
    return score(sentence, signature.graph, rooms, library.texts).evidence
