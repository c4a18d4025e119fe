"""A capture, or a text, finds its scene: scores become a posterior with evidence."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from placegraph.errors import OptionError
from placegraph.estimate import Evidence, ObjectRef, SceneEstimate, SceneMode, Status
from placegraph.indoor.language import read, score
from placegraph.indoor.library.options import SearchOptions
from placegraph.indoor.library.query import encode
from placegraph.indoor.library.search import patch_weights, ratio, scores
from placegraph.indoor.likelihood.observe import spread
from placegraph.indoor.pose.query import chosen_frames

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from placegraph.formats.capture.capture import Capture
    from placegraph.formats.capture.frame import Frame
    from placegraph.indoor.language import Sentence
    from placegraph.indoor.library.query import Query
    from placegraph.indoor.library.scenes import Scenes
    from placegraph.indoor.library.search import Scores

SURE = 0.9
"""Probability of the best scene from which on the answer is `OK`."""
DOUBT, FEW = 1.25, 4
"""Being in none of S scenes is `DOUBT` (S + `FEW`) times as likely, before anything is seen, as being
in a certain one of them."""
_EXPLAINED = 8  # objects named
UNKNOWN = 0.05
"""Probability that a text describes no scene of the library, before it is read."""


def search(
    library: Scenes,
    query: str | Capture | Sequence[Frame],
    *,
    frames: slice | Sequence[int] | None = None,
    description: str | None = None,
    options: SearchOptions | None = None,
    most: int = 10,
) -> SceneEstimate:
    """`SceneLibrary.search`."""
    if most < 1:
        raise OptionError(f"most is {most}; ask for at least one scene.")
    if isinstance(query, str):
        return search_text(library, query, most)
    text = None if description is None else read(description)
    return search_capture(library, query, frames, options or SearchOptions(), most, text)


def search_capture(
    library: Scenes,
    capture: Capture | Sequence[Frame],
    frames: slice | Sequence[int] | None,
    options: SearchOptions,
    most: int,
    text: Sentence | None = None,
) -> SceneEstimate:
    """Scenes of a library, likeliest first; `SceneLibrary.search` says more."""
    exact = options.method == "cosines"
    index = library.own_index if exact else library.index
    chosen = chosen_frames(capture, frames)
    if not exact:
        chosen = [chosen[i] for i in spread(len(chosen), options.looks)]
    start = perf_counter()
    query = encode(chosen, library.encoders, exact=exact)
    encoding = perf_counter() - start
    found = scores(index, query, options)
    names = library.names
    said = np.zeros(len(names)) if text is None else library.texts.scores(text)
    probability, elsewhere = posterior(found, said)
    order = np.argsort(-probability, kind="stable")[:most]
    modes = tuple(
        _mode(
            library, names[row], float(probability[row]), float(found.total[row]),
            partial(_explain_capture, library, names[row], query, options),
        )
        for row in order
    )  # fmt: skip
    status, reason = judge(modes, elsewhere)
    seconds = {"encoding": encoding} | found.seconds
    stats = {"seconds": {k: round(v, 5) for k, v in seconds.items()}, "frames": len(query)}
    return SceneEstimate(status, modes, reason, elsewhere, stats)


def _mode(
    library: Scenes,
    name: str,
    probability: float,
    score: float,
    explain: Callable[[], tuple[Evidence, ...]],
) -> SceneMode:
    poses = library.entry(name).earth
    earth = tuple(replace(p, probability=p.probability * probability) for p in poses)
    return SceneMode(name, probability, score, earth, explain=explain)


def posterior(found: Scores, said: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Probability of each scene (S,), and of being in none of them.

    Scores beyond the S scenes are those of `decoys`, which stand for all other homes: what cannot be
    told from a few dozen is not known. `said`: (S,) what a text tells of each scene [nat].
    """
    count = len(said)
    logs = found.total / found.heat
    logs[:count] += said
    others = len(logs) - count
    logs[count:] += np.log(DOUBT * (count + FEW) / max(1, others))
    share = np.exp(logs - logs.max())
    share /= share.sum()
    return share[:count], float(share[count:].sum())


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


def _explain_capture(
    library: Scenes, name: str, query: Query, options: SearchOptions
) -> tuple[Evidence, ...]:
    """What each object of a scene said for it, and what was seen that it does not have."""
    index, place = library.index, library.names.index(name)
    own = np.flatnonzero(index.owner == place)
    first, last = int(index.starts[own[0]]), int(index.starts[own[-1] + 1])
    rows = np.arange(first, last)
    share = index.share[rows] / len(own)
    gained, seen = np.zeros(last - first), np.zeros(last - first)
    missed = 0.0
    lost = 0.0
    for s in query.said:
        r = ratio(s, index.vocabularies[s.key].of_objects(rows), options)[: last - first].T
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
    signature = library.entry(name).signature
    graph, order = signature.graph, np.argsort(signature.part, kind="stable")
    out = [
        Evidence(
            statement=f"{graph.labels[row]} seen in {int(seen[i])} patches",
            verdict="for",
            weight=float(gained[i]),
            objects=(ObjectRef(graph.ids[row], graph.labels[row], graph.names[row]),),
        )
        for i, row in ((i, order[i]) for i in np.argsort(-gained, kind="stable")[:_EXPLAINED])
        if gained[i] > 0
    ]
    if missed:
        out.append(Evidence(f"{int(missed)} patches fit nothing here", "against", lost))
    return tuple(out)


def search_text(library: Scenes, text: str, most: int) -> SceneEstimate:
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
        _mode(
            library, names[row], float(share[row]), float(scores[row]),
            partial(_explain_text, library, names[row], sentence),
        )
        for row in np.argsort(-scores, kind="stable")[:most]
    )  # fmt: skip
    status, reason = judge(modes, float(share[-1]))
    left = "; ".join(f"{i.text!r} ({i.reason})" for i in sentence.ignored)
    return SceneEstimate(
        status=status,
        modes=modes,
        reason=f"{reason} Not used: {left}." if left else reason,
        elsewhere=float(share[-1]),
        stats={"seconds": {"text": round(perf_counter() - start, 5)}},
    )


def _explain_text(library: Scenes, name: str, sentence: Sentence) -> tuple[Evidence, ...]:
    """What each statement says of a scene."""
    signature = library.entry(name).signature
    rooms = [a.get("room", "") for a in signature.attributes]
    return score(sentence, signature.graph, rooms, library.texts, signature.attributes).evidence
