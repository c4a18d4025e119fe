"""Where a sentence says that somebody is: a log prior over the positions and headings of a map.

Each statement s of a pose x is read as in the outdoor wing,

    P(s | x) / P(s) = (1 - WRONG) fit(s, x) / mean of fit over all poses + WRONG

so that what is true of few poses tells more, and a statement that is wrong costs its logarithm and no
more. The fits are soft, and are read off the panoramas of the visibility table: whether a thing is in
sight from a position, how near its surface comes, and in which direction. Of several things of a
name the one that fits best counts.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.core.estimate import Evidence, ObjectRef
from placegraph.indoor.language.referents import Referents
from placegraph.indoor.language.sentence import Sentence, Statement
from placegraph.indoor.language.sight import Sight
from placegraph.indoor.likelihood.visibility import VisibilityTable
from placegraph.indoor.map.panoramas_kernels import AZIMUTHS, STEP
from placegraph.indoor.map.refs import ref
from placegraph.indoor.map.scene import Scene
from placegraph.language.check import Ignored

WRONG = 0.15
"""Share of statements that are wrong, or about another thing of that name."""
_NOWHERE = 1e-6
"""Mean fit of a statement that is true of no pose."""
_TOLD = 0.05  # evidence that says anything [nat]


def prior(sentence: Sentence, scene: Scene, table: VisibilityTable) -> NDArray[np.float32]:
    """Log prior (K, A) float32 over the table's positions and headings a * STEP [nat].

    Against the uniform: its exponential has the mean 1 for each statement, so it can be added
    to what images say. Zero where nothing was said that the map could serve (`unused`).
    """
    total = np.zeros((len(table), AZIMUTHS), np.float32)
    for _, ratio in _ratios(sentence, scene, table):
        if ratio is not None:
            total += ratio
    return total


def unused(sentence: Sentence, scene: Scene) -> tuple[Ignored, ...]:
    """What of the sentence says nothing on this map, and why: things it does not have."""
    things = Referents(sentence, scene)
    reasons = [(s, things.missing(s)) for s in sentence.statements]
    return tuple(Ignored(s.text, reason) for s, reason in reasons if reason)


def evidence(
    sentence: Sentence, scene: Scene, table: VisibilityTable, pose: ArrayLike
) -> tuple[Evidence, ...]:
    """What each statement says of a pose (4,) x, y, z [m], yaw [rad] on a map."""
    if not len(table):
        return ()
    pose = np.asarray(pose, np.float64)
    row = int(np.square(table.positions - pose[:3]).sum(axis=1).argmin())
    heading = int(np.round(pose[3] / STEP)) % AZIMUTHS
    things = Referents(sentence, scene)
    out = []
    for s, ratio in _ratios(sentence, scene, table):
        if ratio is None:
            out.append(Evidence(s.text, "silent", 0.0, note=things.missing(s)))
            continue
        weight = float(ratio[row, heading % ratio.shape[1]])
        verdict = "for" if weight > _TOLD else "against" if weight < -_TOLD else "silent"
        out.append(Evidence(s.text, verdict, weight, _served(s, things)))
    return tuple(out)


def _served(s: Statement, things: Referents) -> tuple[ObjectRef, ...]:
    """The objects that a statement is most probably about, at most one of each thing."""
    rows = [int(things.weights[t].argmax()) for t in s.things if things.weights[t].any()]
    return tuple(ref(things.scene, r) for r in rows)


def _ratios(
    sentence: Sentence, scene: Scene, table: VisibilityTable
) -> list[tuple[Statement, NDArray[np.float32] | None]]:
    """Log-likelihood ratio (K, A) or (K, 1) of each statement; None where it says nothing here."""
    if not len(table):
        return [(s, None) for s in sentence.statements]
    things = Referents(sentence, scene)
    useful = [s for s in sentence.statements if not things.missing(s)]
    sight = Sight(things, table) if useful else None
    return [
        (s, None if sight is None or s not in useful else _compared(sight.fit(s), s.certainty))
        for s in sentence.statements
    ]


def _compared(fit: NDArray[np.float32], certainty: float) -> NDArray[np.float32] | None:
    mean = float(fit.mean(dtype=np.float64))
    if mean < _NOWHERE:
        return None
    wrong = 1.0 - (1.0 - WRONG) * certainty
    return np.log(fit * np.float32((1.0 - wrong) / mean) + np.float32(wrong))
