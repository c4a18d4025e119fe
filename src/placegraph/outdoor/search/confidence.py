"""How far a posterior is to be believed: what a text claims, and when that is sure.

The posterior takes every statement as read aright, and as independent of the others. Neither holds, so
that its log odds are shrunk, by coefficients that were fitted to texts whose places are known.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from placegraph.core.estimate import Status
from placegraph.outdoor.language.description import LISTENER, SPEAKER, Description, Relation
from placegraph.outdoor.likelihood.query import Query
from placegraph.outdoor.likelihood.statements import ends
from placegraph.outdoor.map.city import City
from placegraph.outdoor.map.objects import POINT
from placegraph.outdoor.search.posterior import WITHIN, Mode, Posterior

SURE = 0.85
"""Probability that what was claimed holds, from which an estimate is OK."""
LARGEST = 1.0 - 1e-4
"""No posterior is believed beyond this."""
UNKNOWN = -2.0
"""Log odds added where a name was said that the map should know and does not."""
HERE = 1.0 / 3.0
"""Share of the posterior that the best place holds at least, whatever is claimed."""
SHOWN = 3
"""Words not understood that a reason names at most."""
UNREAD = ("unknown word", "not understood")


@dataclass(frozen=True, slots=True)
class Trust:
    """What a share of the posterior is worth: its log odds become `level + slope * log odds`.

    Coefficients by `placegraph-lab table statuses --fit`: logistic regression of being right on the
    log odds of the posterior, over the texts that statuses may be tuned on.
    """

    level: float
    slope: float

    def of(self, share: float, *, unknown: bool) -> float:
        """Probability, never above the share itself; `unknown` where a name is not on the map."""
        share = min(share, LARGEST)
        if share <= 0.0:
            return 0.0
        odds = self.level + self.slope * np.log(share / (1.0 - share)) + UNKNOWN * unknown
        return float(min(share, 1.0 / (1.0 + np.exp(-odds))))


@dataclass(frozen=True, slots=True)
class Claim:
    """What an answer to a kind of text claims."""

    within: float
    """An estimate that is OK claims that the truth lies within this of its best place [m]."""
    whole: Trust
    """Of the share within that distance."""
    near: Trust
    """Of the share within `WITHIN`, which a place's probability speaks of."""


IN_SIGHT = Claim(WITHIN, Trust(-0.27, 0.79), Trust(-0.27, 0.79))
"""Of a text about what is in sight of the speaker."""
AT_A_PLACE = Claim(250.0, Trust(-0.03, 0.48), Trust(-0.49, 0.43))
"""Of a text that tells the way, or which thing one stands at: people mean the block, and landmarks
are drawn as points."""


def claim_of(description: Description) -> Claim:
    """What an answer to this text claims."""
    told = any(
        s.far
        or LISTENER in ends(s)
        or (s.relation is Relation.SAME and s.source == SPEAKER and not s.negated)
        for s in description.statements
    )
    return AT_A_PLACE if told else IN_SIGHT


@dataclass(frozen=True, slots=True)
class Doubt:
    """What of a text stands in the way of being sure."""

    names: tuple[str, ...] = ()
    """Names that the map should know and does not."""
    unread: tuple[str, ...] = ()
    """Words that were not understood."""

    @property
    def told(self) -> str:
        """The end of a sentence that says so, or nothing."""
        return f" Not understood: {_listed(self.unread[:SHOWN])}." if self.unread else ""


def doubt_of(query: Query, city: City) -> Doubt:
    """What of a query stands in the way of being sure.

    A name counts where something is said of it, but not on a map of points alone: that is a list of
    landmarks, and it is no wonder what it lacks.
    """
    doubt = doubts(query)
    return replace(doubt, names=()) if (city.objects.kind == POINT).all() else doubt


def doubts(query: Query) -> Doubt:
    """The same on a map that should know all names."""
    told = query.description
    unread = [i.text.strip() for i in told.ignored if i.reason in UNREAD]
    spoken = {node for s in told.statements for node in (*ends(s), s.target2)}
    missing = [told.mentions[node].name for node in sorted(query.by_kind & spoken)]
    return Doubt(tuple(dict.fromkeys(missing)), tuple(dict.fromkeys(filter(None, unread))))


def status_of(
    found: Posterior, peaks: list[Mode], claim: Claim = IN_SIGHT, doubt: Doubt | None = None
) -> tuple[Status, str]:
    """Status and the sentence that says why."""
    doubt = Doubt() if doubt is None else doubt
    if found.elsewhere > 0.5:
        return Status.LOST, "No place on the map fits the description better than chance."
    if not peaks:
        return Status.LOST, "Nowhere are the things of any one statement in sight together."
    best = peaks[0].probability
    sure = claim.whole.of(found.within(peaks[0].position, claim.within), unknown=bool(doubt.names))
    if sure >= SURE and best >= HERE and not doubt.names:
        wide = f" within {claim.within:.0f} m" if claim.within > WITHIN else ""
        return Status.OK, f"One place holds {sure:.0%} of the probability{wide}."
    best = _near(peaks, claim, doubt)
    if doubt.names:
        are = "are" if len(doubt.names) > 1 else "is"
        why = f"{_listed(doubt.names)} {are} not on this map, so the place cannot be sure."
    elif best < 0.05:
        why = f"Too many places fit: the best holds only {best:.1%} of the probability."
    else:
        why = f"The best place holds only {best:.0%} of the probability; others fit as well."
    return Status.AMBIGUOUS, why + doubt.told


def believed(
    found: Posterior, peaks: list[Mode], claim: Claim, doubt: Doubt | None = None
) -> tuple[Posterior, list[Mode]]:
    """Posterior and modes as far as they are to be believed; the rest lies elsewhere."""
    if not peaks or peaks[0].probability <= 0.0:
        return found, peaks
    trust = _near(peaks, claim, doubt) / peaks[0].probability
    shares = trust * found.probabilities
    lost = float(found.probabilities.sum() - shares.sum())
    return (
        replace(found, probabilities=shares, elsewhere=found.elsewhere + lost),
        [replace(peak, probability=trust * peak.probability) for peak in peaks],
    )


def _near(peaks: list[Mode], claim: Claim, doubt: Doubt | None) -> float:
    """Probability of the best place."""
    return claim.near.of(peaks[0].probability, unknown=bool(doubt and doubt.names))


def _listed(words: tuple[str, ...]) -> str:
    """“King Street West” and “Rex”, as in a sentence."""
    quoted = [f"“{word}”" for word in words]
    return " and ".join([", ".join(quoted[:-1]), quoted[-1]] if len(quoted) > 1 else quoted)
