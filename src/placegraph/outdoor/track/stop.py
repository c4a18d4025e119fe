"""What a tracker believes at one place: the belief on arrival, what was said there, and what of it stays.

`search` asks where the best places are; a filter must also know how the rest compares, since motion
may lead there. So the places that matter by belief and bound are scored as `search` scores them, the
others keep their bound, calibrated by those, and what sees nothing of what was said keeps the noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import hypot
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.estimate import Evidence
from placegraph.core.geometry import Floats
from placegraph.language.text import LONGEST_TEXT
from placegraph.outdoor.language.description import Description
from placegraph.outdoor.likelihood.match_kernels import HOPELESS
from placegraph.outdoor.likelihood.promise_kernels import promising_views
from placegraph.outdoor.likelihood.query import Query, compile_query, read
from placegraph.outdoor.likelihood.score_kernels import distant, score_views
from placegraph.outdoor.map.city import City
from placegraph.outdoor.map.index import STRIDE
from placegraph.outdoor.search.candidates import FAR_CANDIDATES, around_far
from placegraph.outdoor.search.evidence import evidence_at
from placegraph.outdoor.search.posterior import Posterior
from placegraph.outdoor.search.request import Request
from placegraph.outdoor.search.viewpoints import CLOSER, SPACING, TOGETHER, look_around
from placegraph.outdoor.track.grid import Belief, TrackGrid, laid, mixed

MOST_STATEMENTS = 24
"""What was said at one place is read as one text up to so many statements."""
SURPRISED = 0.1
"""A text that believed places explain worse than this may have been said somewhere else."""
UNTOLD = 0.02
"""Prior probability that the speaker has moved without a word."""
LIGHT = 1e-5
"""Cells lighter than this, against the heaviest, are no part of a mode."""
MOST_REMEMBERED = 400
"""At most this many positions of a place that was left are kept."""


@dataclass(frozen=True, eq=False)
class Stop:
    """A place at which something was said, and what is believed of it."""

    arrival: Belief
    texts: tuple[str | Description, ...] = ()
    query: Query | None = None
    log_evidence: float = 0.0
    """Log probability of the texts against being said elsewhere [nat]."""
    belief: Belief | None = None
    """After the texts; None where nothing was understood."""
    fine: tuple[Floats, Floats] | None = None
    """Positions (K, 2) [m] within the heaviest cells, and their probabilities (K,)."""

    @property
    def now(self) -> Belief:
        """Return what is believed after all that was said."""
        return self.arrival if self.belief is None else self.belief

    def goes_on(self, text: str | Description) -> bool:
        """Whether a text can be read together with those said here."""
        if isinstance(text, Description) or any(isinstance(t, Description) for t in self.texts):
            return False
        if sum(len(str(t)) for t in (*self.texts, text)) + len(self.texts) > LONGEST_TEXT:
            return False
        return self.query is None or len(self.query.used) < MOST_STATEMENTS

    def after(
        self, text: str | Description, city: City, grid: TrackGrid, heading: float | None
    ) -> Stop | None:
        """Return it with one more text; the same or None where the text adds nothing to it."""
        texts = (*self.texts, text)
        joint = text if isinstance(text, Description) else " ".join(map(str, texts))
        query = compile_query(read(city, joint, heading=heading), city)
        if self.query is not None and len(query.used) == len(self.query.used):
            return self  # said again, it is no surer
        return self.heard(texts, query, city, grid) if query.used else None

    def heard(
        self, texts: tuple[str | Description, ...], query: Query, city: City, grid: TrackGrid
    ) -> Stop:
        """Bayes: the belief on arrival times the likelihood of what was said."""
        arrival = self.arrival
        weights = arrival.mass.ravel()[grid.cells].astype(np.float64)
        scores = score(query, city, weights)
        highest = max(0.0, float(scores.views.max()))
        mass = arrival.mass.ravel() * np.float32(np.exp(scores.nothing - highest))
        mass[grid.cells] = weights * np.exp(scores.views - highest)
        lost = arrival.elsewhere * np.exp(-highest)
        total = float(mass.sum(dtype=np.float64)) + lost
        return Stop(
            arrival,
            texts,
            query,
            float(np.log(total)) + highest,
            Belief((mass / np.float32(total)).reshape(arrival.mass.shape), lost / total),
            _fine(scores, weights, highest, total),
        )

    def unsure(self, grid: TrackGrid) -> Stop:
        """Return a fresh one, whose speaker may have moved without a word."""
        return Stop(mixed(self.now, grid, 1.0 - UNTOLD, 1.0 - UNTOLD, UNTOLD))

    def placed(self, grid: TrackGrid) -> Belief:
        """Belief in which the heaviest cells lie where the closer look saw them."""
        if self.fine is None:
            return self.now
        mass = self.now.mass.copy()
        mass.ravel()[_cells_at(grid, self.fine[0])] = 0.0
        laid(mass, grid, *self.fine)
        return Belief(mass, self.now.elsewhere)

    def posterior(self, grid: TrackGrid, most: int) -> Posterior:
        """Heaviest positions of the belief, fine ones where there are any."""
        mass = self.now.mass.ravel()
        cells = np.flatnonzero(mass > LIGHT * mass.max())
        if len(cells) > most:
            cells = cells[np.argpartition(-mass[cells], most)[:most]]
            cells.sort()
        positions = grid.positions(cells)
        probabilities = mass[cells].astype(np.float64)
        if self.fine is not None:
            at, share = self.fine
            coarse = ~np.isin(cells, _cells_at(grid, at))
            positions = np.concatenate([at, positions[coarse]])
            probabilities = np.concatenate([share, probabilities[coarse]])
        return Posterior(positions, probabilities, self.now.elsewhere)

    def memory(self, grid: TrackGrid) -> Memory | None:
        """Return what stays of it once it is left; None where nothing was understood."""
        if self.query is None:
            return None
        found = self.posterior(grid, MOST_REMEMBERED)
        some = found.probabilities > 0.0
        nowhere = np.zeros(2)
        odds = np.log(found.probabilities[some])
        return Memory(self.query, found.positions[some], odds, nowhere, np.zeros((2, 2)))


@dataclass(frozen=True, eq=False)
class Memory:
    """What was said at an earlier place, and the motion since."""

    query: Query
    positions: Floats
    """(K, 2) [m] where it may have been said ..."""
    log_probability: Floats
    """(K,)"""
    shift: Floats
    """(2,) expected displacement since [m] ..."""
    spread: Floats
    """... and its covariance (2, 2) [m^2]."""

    def evidence(self, position: Floats, city: City) -> tuple[Evidence, ...]:
        """Evidence at the place that most likely led to a position (2,) [m]."""
        off = position - self.shift - self.positions
        loose = np.linalg.inv(self.spread + np.eye(2) * SPACING**2)
        fits = self.log_probability - 0.5 * np.einsum("ni,ij,nj->n", off, loose, off)
        at = self.positions[int(np.argmax(fits))]
        way = hypot(*(position - at))
        note = f"said {way:.0f} m before" if way >= 1.0 else "said here before"
        return tuple(
            replace(e, note="; ".join(part for part in (note, e.note) if part))
            for e in evidence_at(at, city, self.query)
        )

    def after(self, shift: Floats, spread: Floats) -> Memory:
        """Return it after one more motion (2,) [m] with covariance (2, 2) [m^2]."""
        return replace(self, shift=self.shift + shift, spread=self.spread + spread)


def _fine(scores: Scores, weights: Floats, highest: float, total: float) -> tuple[Floats, Floats]:
    """Positions (K, 2) [m] looked at closely, and their probabilities (K,)."""
    n = scores.ratios.shape[1]
    share = weights[scores.closer][:, None] / n * np.exp(scores.ratios - highest) / total
    return scores.positions.reshape(-1, 2), share.ravel()


def _cells_at(grid: TrackGrid, positions: Floats) -> NDArray[np.int64]:
    """Cells that hold positions (K, 2) [m]."""
    column, row = np.rint((positions - grid.low) / STRIDE).astype(np.int64).T
    return np.unique(row * grid.columns + column)


MOST_SCORED = 2500
"""At most this many viewpoints are scored."""
MARGIN = 12.0
"""Viewpoints that must lie this far behind the best are not scored [nat]."""


class Scores(NamedTuple):
    """Log-likelihood ratios against being elsewhere [nat]."""

    views: Floats
    """(W,) of the viewpoints."""
    nothing: float
    """Of a place from which nothing is in sight."""
    closer: NDArray[np.int64]
    """(B,) viewpoints looked at more closely ..."""
    positions: Floats
    """(B, 9, 2) ... at these positions [m] ..."""
    ratios: Floats
    """(B, 9) ... and the ratios there."""


def score(query: Query, city: City, weights: Floats) -> Scores:
    """Score what was said under a belief: `weights` (W,) of the viewpoints, any scale."""
    statements, views = query.statements, city.views
    relative = weights / max(float(weights.max()), 1e-300)
    asked, nothing = Request(city, query), statements.floor
    ratios = np.full(len(weights), nothing)
    chosen, bounds, far = _candidates(query, city, relative)
    if not len(chosen):
        none = np.zeros(0)
        return Scores(ratios, nothing, none.astype(np.int64), none.reshape(0, 9, 2), none[:, None])
    prior = np.log(relative[chosen])
    first = slice(MOST_SCORED)
    found, _ = score_views(
        statements, city.columns, views.columns, asked.words, chosen[first], bounds[first], prior[first],
        far[first], TOGETHER, MARGIN,
    )  # fmt: skip
    found = found.astype(np.float64)
    reached = np.flatnonzero(found > 0.5 * HOPELESS)
    last = int(reached[-1]) + 1 if len(reached) else 0
    left = _kept((found + prior[first])[:last], bounds[:last]) if last else nothing
    least = float(np.log(statements.noise).sum())
    ratios[chosen] = np.maximum(np.log(bounds) - prior + left, least)
    ratios[chosen[reached]] = found[reached]
    best = reached[np.argsort(-(found + prior[first])[reached], kind="stable")[:CLOSER]]
    positions, close = look_around(asked, chosen[best], far[best])
    ratios[chosen[best]] = np.logaddexp.reduce(close, axis=1) - np.log(close.shape[1])
    return Scores(ratios, nothing, chosen[best].astype(np.int64), positions, close)


def _kept(weights: Floats, bounds: Floats) -> float:
    """Log of what the lightest third of the scored keep of their bounds; what is not scored does too."""
    tail = slice(2 * len(weights) // 3, None)
    return float(np.logaddexp.reduce(weights[tail]) - np.log(bounds[tail].sum()))


def _candidates(
    query: Query, city: City, relative: Floats
) -> tuple[NDArray[np.int32], Floats, NDArray[np.float32]]:
    """Viewpoints that matter (K,), the most promising first, their bounds, and what far things add."""
    statements, views = query.statements, city.views
    if statements.negated.all():
        chosen = np.argsort(-relative, kind="stable")[:MOST_SCORED].astype(np.int32)
        bounds = relative[chosen]
    else:
        chosen, bounds, _ = promising_views(
            statements, query.mentions, views.columns, relative, len(relative), 0, 0.0
        )
    chosen, bounds = chosen[bounds > 0.0], bounds[bounds > 0.0]
    far = np.zeros((min(len(chosen), MOST_SCORED), len(statements.op)), np.float32)
    if query.far is None:
        return chosen, bounds, far
    extra = around_far(city, query.far, chosen)
    extra = extra[relative[extra] > 0.0]
    chosen = np.concatenate([chosen, extra])
    bounds = np.concatenate([bounds, relative[extra]])
    heavy = np.argsort(-bounds, kind="stable")[:FAR_CANDIDATES]
    heavy = np.union1d(heavy, np.arange(len(chosen) - len(extra), len(chosen)))
    added = distant(statements, city.columns, query.far, views.positions_of(chosen[heavy]))
    log_bounds = np.log(bounds)
    log_bounds[heavy] += np.log1p(statements.gain * added).sum(axis=1)
    order = np.argsort(-log_bounds, kind="stable")
    row = np.full(len(chosen), -1)
    row[heavy] = np.arange(len(heavy))
    row = row[order[:MOST_SCORED]]
    far = np.where(row[:, None] >= 0, added[row], np.float32(0.0)).astype(np.float32)
    return chosen[order], np.exp(np.minimum(log_bounds[order], 690.0)), far
