"""A capture, or a text, finds its scene: scores become a posterior with evidence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from time import perf_counter
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from placegraph.core.estimate import Evidence, ObjectRef, SceneEstimate, SceneMode
from placegraph.core.geo import EarthPose
from placegraph.errors import OptionError
from placegraph.indoor.encode import Encoder
from placegraph.indoor.language import Sentence, read, score
from placegraph.indoor.library.search import (
    Query,
    Scores,
    SearchOptions,
    encode,
    patch_weights,
    ratio,
)
from placegraph.indoor.likelihood.observe import spread
from placegraph.indoor.pose.window import chosen_frames
from placegraph.indoor.status import decide_scene
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame

if TYPE_CHECKING:
    from placegraph.indoor.library.library import Scenes

DOUBT, FEW = 1.25, 4
"""Being in none of S scenes is `DOUBT` (S + `FEW`) times as likely, before anything is seen, as being
in a certain one of them."""
_EXPLAINED = 8  # objects named
UNKNOWN = 0.05
"""Probability that a text describes no scene of the library, before it is read."""


class Many(Protocol):
    """Scenes by rows: a library that was read, or shards that are mapped."""

    @property
    def encoders(self) -> tuple[Encoder, ...]:
        """What scenes and captures are compared by."""

    @property
    def missing(self) -> int:
        """Scenes that are known to be there, and cannot be searched."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Why not."""

    def __len__(self) -> int: ...

    def name(self, row: int) -> str:
        """Name of a scene."""

    def earth(self, row: int) -> tuple[EarthPose, ...]:
        """Where it stands."""

    def compared(self, query: Query, options: SearchOptions) -> Scores:
        """What frames say of all scenes, and of the homes beside them."""

    def said(self, sentence: Sentence) -> NDArray[np.float64]:
        """What a text says of each scene (n,) against what is usual [nat]."""

    def evidence(
        self, row: int, asked: Query | Sentence, options: SearchOptions
    ) -> tuple[Evidence, ...]:
        """What speaks for a scene."""

    def holding(self, rows: Sequence[int]) -> Scenes:
        """Library, with their maps, of some scenes at least."""


@dataclass(frozen=True, eq=False)
class Weighed:
    """What frames or a text say of all scenes."""

    shares: NDArray[np.float64]
    """(n,) probability of each."""
    elsewhere: float
    total: NDArray[np.float64]
    """(n,) score of each."""
    asked: Query | Sentence
    options: SearchOptions
    seconds: dict[str, float]
    stats: dict[str, Any] = field(default_factory=dict)

    def modes(self, library: Many, most: int) -> tuple[tuple[int, ...], tuple[SceneMode, ...]]:
        """Rows of the likeliest scenes, and these as modes."""
        rows = np.argsort(-self.shares, kind="stable")[:most].tolist()
        return tuple(rows), tuple(self.mode(library, row) for row in rows)

    def mode(self, library: Many, row: int) -> SceneMode:
        """A scene as a mode."""
        share = float(self.shares[row])
        earth = tuple(replace(p, probability=p.probability * share) for p in library.earth(row))
        explain = partial(library.evidence, row, self.asked, self.options)
        return SceneMode(library.name(row), share, float(self.total[row]), earth, explain=explain)

    def estimate(self, library: Many, most: int) -> SceneEstimate:
        """The likeliest scenes."""
        rows, modes = self.modes(library, most)
        status, reason = decide_scene(modes, self.elsewhere)
        left = () if isinstance(self.asked, Query) else self.asked.ignored
        if left:
            reason += f" Not used: {'; '.join(f'{i.text!r} ({i.reason})' for i in left)}."
        if library.missing:
            reason += f" {library.missing:,} scenes were not searched: {' '.join(library.notes)}"
        seconds = {k: round(v, 5) for k, v in self.seconds.items()}
        stats = {"seconds": seconds, "rows": rows} | self.stats
        return SceneEstimate(status, modes, reason, self.elsewhere, stats)


def search(
    library: Many,
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
        return by_text(library, query).estimate(library, most)
    text = None if description is None else read(description)
    found = by_frames(library, query, frames, options or SearchOptions(), text)
    return found.estimate(library, most)


def by_frames(
    library: Many,
    capture: Capture | Sequence[Frame],
    frames: slice | Sequence[int] | None,
    options: SearchOptions,
    text: Sentence | None = None,
) -> Weighed:
    """What a capture, and a text, say of all scenes; `SceneLibrary.search` says more."""
    exact = options.method == "cosines"
    chosen = chosen_frames(capture, frames)
    if not exact:
        chosen = [chosen[i] for i in spread(len(chosen), options.looks)]
    start = perf_counter()
    query = encode(chosen, library.encoders, exact=exact)
    return by_query(library, query, options, text, {"encoding": perf_counter() - start})


def by_query(
    library: Many,
    query: Query,
    options: SearchOptions,
    text: Sentence | None = None,
    seconds: Mapping[str, float] | None = None,
) -> Weighed:
    """The same of frames that have been encoded."""
    found = library.compared(query, options)
    said = np.zeros(len(library)) if text is None else library.said(text)
    shares, elsewhere = posterior(found, said, library.missing)
    told = {"frames": len(query)}
    return Weighed(
        shares, elsewhere, found.total[: len(said)], query, options,
        {**(seconds or {}), **found.seconds}, told,
    )  # fmt: skip


def by_text(library: Many, text: str) -> Weighed:
    """What a text says of all scenes; `SceneLibrary.search` says more."""
    start = perf_counter()
    sentence = read(text)
    if not sentence.statements:
        ignored = "; ".join(f"{i.text!r}: {i.reason}" for i in sentence.ignored)
        raise OptionError(
            f"{text!r} says nothing of a place{f' ({ignored})' if ignored else ''}; name a room, "
            "things in it, how many, or how they stand to each other."
        )
    said = library.said(sentence)
    # being in none of the scenes is as likely as the average one makes it; so is each that is missing
    every = len(said) + library.missing
    off = np.log(UNKNOWN / (1.0 - UNKNOWN) * every + library.missing)
    shares = np.exp(np.append(said, off) - max(said.max(), off))
    shares /= shares.sum()
    seconds = {"text": perf_counter() - start}
    return Weighed(shares[:-1], float(shares[-1]), said, sentence, SearchOptions(), seconds)


def posterior(
    found: Scores, said: NDArray[np.float64], missing: int = 0
) -> tuple[NDArray[np.float64], float]:
    """Probability of each scene (S,), and of being in none of them.

    Scores beyond the S scenes are those of `decoys`, which stand for all other homes: what cannot be
    told from a few dozen is not known. `said`: (S,) what a text tells of each scene [nat]; `missing`:
    scenes that cannot be searched, each of which is as such a home.
    """
    count = len(said)
    logs = found.total / found.heat
    logs[:count] += said
    others = len(logs) - count
    logs[count:] += np.log((DOUBT * (count + missing + FEW) + missing) / max(1, others))
    share = np.exp(logs - logs.max())
    share /= share.sum()
    return share[:count], float(share[count:].sum())


def evidence(
    library: Scenes, name: str, asked: Query | Sentence, options: SearchOptions
) -> tuple[Evidence, ...]:
    """What each object of a scene, or each statement of a text, says for it."""
    if isinstance(asked, Query):
        return _explain_capture(library, name, asked, options)
    signature = library.entry(name).signature
    rooms = [a.get("room", "") for a in signature.attributes]
    return score(asked, signature.graph, rooms, library.texts, signature.attributes).evidence


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
