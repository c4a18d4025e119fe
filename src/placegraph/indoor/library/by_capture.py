"""A capture finds its scene: scores become a posterior with evidence."""

from __future__ import annotations

from functools import partial
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from placegraph.estimate import Evidence, ObjectRef, SceneEstimate, SceneMode, Status
from placegraph.indoor.frames import chosen_frames
from placegraph.indoor.library.query import encode
from placegraph.indoor.library.search import patch_weights, ratio, scores

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from placegraph.formats.capture import Capture
    from placegraph.formats.frame import Frame
    from placegraph.indoor.library.library import SceneLibrary
    from placegraph.indoor.library.options import SearchOptions
    from placegraph.indoor.library.query import Query
    from placegraph.indoor.library.search import Scores

SURE = 0.9
"""Probability of the best scene from which on the answer is `OK`."""
HEAT = 3.0
"""Nats of log-likelihood that count as one, for a single frame; T frames of one way see much the
same, so that their sum is taken for worth sqrt(T) of them (benchmark: calibration)."""
ELSEWHERE = 0.0
"""Log-likelihood ratio a witness [nat] of a capture taken in no scene of the library."""
UNKNOWN = 0.05
"""Probability of that before anything is seen."""
_EXPLAINED = 8  # objects named


def search_capture(
    library: SceneLibrary,
    capture: Capture | Sequence[Frame],
    frames: slice | Sequence[int] | None,
    options: SearchOptions,
    most: int,
) -> SceneEstimate:
    """Scenes of a library, likeliest first; `SceneLibrary.search` says more."""
    index = library.index
    chosen = chosen_frames(capture, frames)
    start = perf_counter()
    query = encode(chosen, library.encoders)
    encoding = perf_counter() - start
    found = scores(index, query, options)
    probability, elsewhere = posterior(found, len(query), options)
    order = np.argsort(-found.total, kind="stable")[:most]
    names = library.names
    modes = tuple(
        SceneMode(
            scene=names[row],
            probability=float(probability[row]),
            score=float(found.total[row]),
            explain=partial(_explain, library, names[row], query, options),
        )
        for row in order
    )
    status, reason = judge(modes, elsewhere)
    seconds = {"encoding": encoding} | found.seconds
    stats = {"seconds": {k: round(v, 5) for k, v in seconds.items()}, "frames": len(query)}
    return SceneEstimate(status, modes, reason, elsewhere, stats)


def posterior(
    found: Scores, frames: int, options: SearchOptions
) -> tuple[NDArray[np.float64], float]:
    """Probability of each scene (S,), and of being in none of them.

    Sums of cosines are no likelihoods: of them the share of the best is all that can be said.
    """
    if options.method == "cosines":
        logs = (found.total - found.total.max()) / max(1e-9, 0.01 * frames)
        share = np.exp(logs)
        return share / share.sum(), 0.0
    heat = HEAT * np.sqrt(frames)
    none = ELSEWHERE * found.witnesses / heat + np.log(UNKNOWN / (1.0 - UNKNOWN) * len(found.total))
    logs = np.append(found.total / heat, none)
    share = np.exp(logs - logs.max())
    share /= share.sum()
    return share[:-1], float(share[-1])


def judge(modes: tuple[SceneMode, ...], elsewhere: float) -> tuple[Status, str]:
    """Status and reason of ranked scenes."""
    best = modes[0]
    if elsewhere > best.probability:
        return Status.LOST, (
            f"No scene of the library fits ({elsewhere:.0%}); {best.scene} fits best "
            f"({best.probability:.0%})."
        )
    if best.probability >= SURE:
        return Status.OK, f"{best.scene} fits ({best.probability:.0%})."
    rivals = [m.scene for m in modes[1:] if m.probability > 0.1 * best.probability]
    others = f"; so may {', '.join(rivals[:3])}" if rivals else ""
    return Status.AMBIGUOUS, f"{best.scene} fits best ({best.probability:.0%}){others}."


def _explain(
    library: SceneLibrary, name: str, query: Query, options: SearchOptions
) -> tuple[Evidence, ...]:
    """What each object of a scene said for it, and what was seen that it does not have."""
    index, row = library.index, library.names.index(name)
    first, last = int(index.starts[row]), int(index.starts[row + 1])
    share = index.share[first:last]
    gained, seen = np.zeros(last - first), np.zeros(last - first)
    missed = 0.0
    lost = 0.0
    for s in query.said:
        vocabulary = index.vocabularies[s.key]
        r = ratio(s, vocabulary, len(index), options)[vocabulary.code[first:last]].T
        parts = share * r
        mixture = np.log((1.0 - options.wrong) * parts.sum(axis=1) + options.wrong)
        weight = np.bincount(s.word, patch_weights(s, len(query), options), len(s.words))
        patches = np.bincount(s.word, minlength=len(s.words))
        fits = mixture > 0
        owner = parts[fits].argmax(axis=1)
        np.add.at(gained, owner, (weight * mixture)[fits])
        np.add.at(seen, owner, patches[fits])
        missed += float(patches[~fits].sum())
        lost += float((weight * mixture)[~fits].sum())
    graph = library.entry(name).signature.graph
    out = [
        Evidence(
            statement=f"{graph.labels[i]} seen in {int(seen[i])} patches",
            verdict="for",
            weight=float(gained[i]),
            objects=(ObjectRef(graph.ids[i], graph.labels[i], graph.names[i]),),
        )
        for i in np.argsort(-gained, kind="stable")[:_EXPLAINED]
        if gained[i] > 0
    ]
    if missed:
        out.append(Evidence(f"{int(missed)} patches fit nothing here", "against", lost))
    return tuple(out)
