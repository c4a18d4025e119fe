"""Status of an outdoor estimate: `OK`, `AMBIGUOUS` or `LOST`, and why.

The stages of a search fill a `Diagnostics`; `decide` alone turns it into a status and a reason.

A posterior takes every statement as read correctly and as independent of the others. Neither holds, so
its log odds are shrunk by coefficients that were fitted to texts whose places are known.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from math import ceil

import numpy as np

from placegraph.core.estimate import Place, Status
from placegraph.core.geometry import Floats, angle_between
from placegraph.outdoor.language.description import (
    LISTENER,
    SPEAKER,
    Description,
    Relation,
    Statement,
    ends,
    find_speaker_nodes,
)
from placegraph.outdoor.language.statements import RANKED
from placegraph.outdoor.likelihood.query import NOT_MAPPED, Query, is_binding
from placegraph.outdoor.map.city import City
from placegraph.outdoor.map.objects import AREA, POINT
from placegraph.outdoor.search.posterior import MODE_RADIUS, Mode, Posterior

MIN_CONFIDENCE = 0.85
"""Smallest calibrated probability of the claim of an `OK` estimate."""
MAX_SHARE = 1.0 - 1e-4
"""Largest share of a posterior that is calibrated."""
DOUBT = -2.0
"""Change of the log odds where the map should know a name and does not, or much of a text does not fit."""
SERIOUS = 0.1
"""Share of the best place's probability from which another place counts."""
TELLING = 1.0
"""Log-likelihood ratio of a statement that tells where in a named area the speaker is."""
MAX_EXTENT = 300.0
"""Largest distance [m] to the far end of a named area that an `OK` estimate may lie in."""
GRAIN = 50.0
"""Step [m] of the radius of a claim of a named area."""
MAX_QUOTED = 3
"""Largest number of unread words that a reason quotes."""
UNREAD = ("unknown word", "not understood", RANKED)


@dataclass(frozen=True, slots=True)
class Calibration:
    """Shrinkage of posterior shares: log odds become `level + slope * log odds`.

    Coefficients by `placegraph-lab table statuses --fit`: logistic regression of being right on the
    log odds of the posterior, over the texts that statuses may be tuned on.
    """

    level: float
    slope: float

    def apply(self, share: float, *, doubtful: bool) -> float:
        """Calibrate a share of the posterior; the result is at most the share itself."""
        share = min(share, MAX_SHARE)
        if share <= 0.0:
            return 0.0
        odds = self.level + self.slope * np.log(share / (1.0 - share)) + DOUBT * doubtful
        return float(min(share, 1.0 / (1.0 + np.exp(-odds))))


@dataclass(frozen=True, slots=True)
class Claim:
    """Radius and probability that an answer to a kind of text claims."""

    radius: float
    """An `OK` estimate claims that the truth lies within this distance of its best place [m]."""
    of_radius: Calibration
    """Calibration of the share within `radius`."""
    of_place: Calibration
    """Calibration of the share within `MODE_RADIUS`, which is the probability of a place."""
    min_best: float = 1.0 / 3.0
    """Smallest share of the posterior at the best place of an `OK` estimate."""


IN_SIGHT = Claim(MODE_RADIUS, Calibration(-0.27, 0.79), Calibration(-0.27, 0.79))
"""Claim for a text about what the speaker sees."""
AT_A_PLACE = Claim(250.0, Calibration(-0.03, 0.48), Calibration(-0.49, 0.43))
"""Claim for a text that tells the way, or what the speaker stands at: people mean the block, and maps
draw landmarks as points."""
IN_AN_AREA = Claim(MODE_RADIUS, Calibration(0.0, 1.0), AT_A_PLACE.of_place, min_best=0.0)
"""Claim for a text that only names an area; the radius is that of the area."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Diagnostics:
    """Findings of all stages that decide on the status of an outdoor estimate."""

    obstacle: str = ""
    """Sentence that says why nothing was searched; empty where a posterior exists."""
    contradiction: str = ""
    """Conflict within the description that holds at the best place as well."""
    cell_matcher: str = ""
    """Name of the matcher where it ranks cells; empty for viewpoints."""
    is_ranking_only: bool = False
    """Whether scores of the matcher are cosines or edits, and no log odds."""
    elsewhere: float = 0.0
    """Posterior probability that the place is not on the map."""
    best: float | None = None
    """Posterior share within `MODE_RADIUS` of the best place; None without a place."""
    near_best: float = 0.0
    """Posterior share within the radius of `claim` of the best place."""
    claim: Claim = IN_SIGHT
    others: int = 0
    """Number of further places within the radius of `claim` that are at least a tenth as probable."""
    unknown_names: tuple[str, ...] = ()
    """Names in the text that the map should know and does not."""
    unread: tuple[str, ...] = ()
    """Words of the text that were not understood."""
    uncertainty: str = ""
    """Why the best place is not sure however probable it is: a unique name that does not fit it."""
    remark: str = ""
    """Sentence appended to the reason."""

    @property
    def is_probable(self) -> bool:
        """Whether the best place is as probable as an `OK` estimate claims."""
        if self.best is None or self.best < self.claim.min_best or self.unknown_names:
            return False
        return self.claim.of_radius.apply(self.near_best, doubtful=False) >= MIN_CONFIDENCE


def decide(diagnostics: Diagnostics) -> tuple[Status, str]:
    """Return the status and the reason of an estimate."""
    status, reason = _decide(diagnostics)
    return status, f"{reason} {diagnostics.remark}".strip()


def _decide(diagnostics: Diagnostics) -> tuple[Status, str]:
    ranked = (
        f"The {diagnostics.cell_matcher} matcher only ranks places; its scores are not "
        "probabilities."
    )
    if diagnostics.obstacle:
        return Status.LOST, diagnostics.obstacle
    if diagnostics.contradiction:
        return Status.LOST, f"The description contradicts itself: {diagnostics.contradiction}"
    if diagnostics.is_ranking_only and diagnostics.best is not None:
        return Status.AMBIGUOUS, ranked
    if diagnostics.elsewhere > 0.5:
        return Status.LOST, "No place on the map fits the description better than chance."
    if diagnostics.best is None:
        return (
            Status.LOST,
            "No place on the map is within sight of all objects of any statement.",
        )
    names, claim = diagnostics.unknown_names, diagnostics.claim
    sure = claim.of_radius.apply(diagnostics.near_best, doubtful=bool(names))
    if diagnostics.is_probable:
        if diagnostics.cell_matcher or diagnostics.uncertainty:
            return Status.AMBIGUOUS, diagnostics.uncertainty or ranked
        return Status.OK, _confirm(diagnostics, sure)
    best = claim.of_place.apply(diagnostics.best, doubtful=bool(names))
    if names:
        are = "are" if len(names) > 1 else "is"
        why = f"{_quote(names)} {are} not on this map, so the place cannot be sure."
    else:
        why = describe_doubt(best)
    unread = (
        f" Not understood: {_quote(diagnostics.unread[:MAX_QUOTED])}." if diagnostics.unread else ""
    )
    return Status.AMBIGUOUS, why + unread


def describe_doubt(best: float) -> str:
    """Say that the best place holds too little of the probability."""
    if best < 0.05:
        return f"Too many places fit: the best holds only {best:.1%} of the probability."
    return f"The best place holds only {best:.0%} of the probability; others fit as well."


def _confirm(diagnostics: Diagnostics, sure: float) -> str:
    """Say how much of the probability (`sure`) lies within the radius of a claim, and at its best place."""
    claim, others = diagnostics.claim, diagnostics.others
    best = claim.of_place.apply(diagnostics.best or 0.0, doubtful=False)
    nearer = f" Within {MODE_RADIUS:.0f} m it holds {best:.0%}."
    nearer = "" if f"{best:.0%}" == f"{sure:.0%}" else nearer
    if not others:
        return f"One place holds {sure:.0%} of the probability within {claim.radius:.0f} m.{nearer}"
    return (
        f"The best place holds {sure:.0%} of the probability within {claim.radius:.0f} m, where "
        f"{others + 1} places fit: it may be any of them.{nearer}"
    )


def _quote(words: tuple[str, ...]) -> str:
    """Join words as in a sentence: “King Street West” and “Rex”."""
    quoted = [f"“{word}”" for word in words]
    return " and ".join([", ".join(quoted[:-1]), quoted[-1]] if len(quoted) > 1 else quoted)


def diagnose(
    posterior: Posterior,
    modes: list[Mode],
    claim: Claim,
    query: Query | None,
    city: City | None = None,
) -> Diagnostics:
    """Collect the findings of a posterior, its modes and its query that decide on the status.

    Unknown names of a query count where statements are about them. They do not count on a `city` of
    points alone: such a list of landmarks lacks most names.
    """
    names, unread = [], []
    if query is not None:
        text = query.description
        used = {node for s in text.statements for node in (*ends(s), s.target2)}
        if city is None or not (city.objects.kind == POINT).all():
            names = [text.mentions[node].name for node in sorted(query.by_kind & used)]
        unread = [i.text.strip() for i in text.ignored if i.reason in UNREAD]
    near, others = 0.0, 0
    if modes:
        at = modes[0].position
        others = sum(
            other.probability >= SERIOUS * modes[0].probability
            and float(np.hypot(*(other.position - at))) <= claim.radius
            for other in modes[1:]
        )
        extent = find_area_extent(query, at, city) if query and city else 0.0
        near = posterior.mass_within(at, max(extent, claim.radius))
        if extent > MODE_RADIUS:  # most viewpoints of a wide area were not scored
            claim = replace(IN_AN_AREA, radius=GRAIN * ceil(extent / GRAIN))
            near *= (1.0 - posterior.elsewhere) / float(posterior.probabilities.sum())
            others = 0  # one place is the area
    return Diagnostics(
        elsewhere=posterior.elsewhere,
        best=modes[0].probability if modes else None,
        near_best=near,
        claim=claim,
        others=others,
        unknown_names=tuple(dict.fromkeys(names)),
        unread=tuple(dict.fromkeys(filter(None, unread))),
    )


def shrink(
    posterior: Posterior, modes: list[Mode], diagnostics: Diagnostics
) -> tuple[Posterior, list[Mode]]:
    """Calibrate a posterior and its modes by the best one; the rest of the probability lies elsewhere."""
    best = diagnostics.best
    if best is None or best <= 0.0:
        return posterior, modes
    unknown = bool(diagnostics.unknown_names)
    factor = diagnostics.claim.of_place.apply(best, doubtful=unknown) / best
    shares = factor * posterior.probabilities
    lost = float(posterior.probabilities.sum() - shares.sum())
    return (
        replace(posterior, probabilities=shares, elsewhere=posterior.elsewhere + lost),
        [replace(mode, probability=factor * mode.probability) for mode in modes],
    )


def infer_claim(description: Description) -> Claim:
    """Infer the claim of an answer to a text: a place in sight, or the block that the text tells of."""
    at_a_place = any(
        s.far
        or LISTENER in ends(s)
        or (s.relation is Relation.SAME and s.source == SPEAKER and not s.negated)
        or (is_binding(s) and any(description.mentions[node].name for node in ends(s)))
        for s in description.statements
    )
    return AT_A_PLACE if at_a_place else IN_SIGHT


def find_area_extent(query: Query, position: Floats, city: City) -> float:
    """Return the distance [m] from a position (2,) to the far end of the area that a text names.

    0 where a text says more than that the speaker is in one area of a unique name, which a map draws.
    """
    nodes = {node for s in query.used for node in ends(s)} - {SPEAKER}
    alone = len(nodes) == 1 and not (query.unused or query.description.ignored)
    if not alone or not nodes <= query.unique - query.sites or not all(map(is_binding, query.used)):
        return 0.0
    return query.find_extent(min(nodes), position, city, kinds=(AREA,))


_NUMBER = r"(-?\d{1,3}\.\d{3,})\s*°?\s*"
_COORDINATES = re.compile(rf"(?<![\d.]){_NUMBER}(S?)N?\s*[,;/ ]\s*{_NUMBER}(W?)", re.IGNORECASE)
"""Latitude and longitude, as people and links to maps write them."""
ADVICE = "describe the objects around you, and their directions."


def find_obstacle(query: Query, description: Description, *, tells_way: bool = False) -> str:
    """Return why a text does not suffice to find a place; empty where it does.

    A text that tells the way to the place (`tells_way`) suffices.
    """
    place = _COORDINATES.search(description.text)
    is_link = place is not None and "://" in description.text
    if tells_way or (any(not s.negated for s in query.used) and not is_link):
        return ""
    if place is not None:
        latitude, south, longitude, west = place.groups()
        north = -abs(float(latitude)) if south else float(latitude)
        east = -abs(float(longitude)) if west else float(longitude)
        if abs(north) > 90.0:  # longitude first, as in GeoJSON
            north, east = east, north
        return (
            f"The text gives coordinates; pass them as `near` (--near {east:.9g},{north:.9g} on "
            f"the command line), and {ADVICE}"
        )
    if query.unused:
        return f"No statement of the text can be used: {_join_reasons(query)}."
    if query.used:
        return "The text only says what is absent; also mention something you can see."
    if description.ignored:
        return f"The text could not be understood; {ADVICE}"
    return f"The text does not describe a place; {ADVICE}"


def explain_no_change(query: Query) -> str:
    """Explain why one more text did not change an estimate."""
    if query.unused:
        return f"No statement of the last text can be used: {_join_reasons(query)}."
    return "The last text could not be understood."


def _join_reasons(query: Query) -> str:
    return "; ".join(sorted({reason for _, reason in query.unused}))


def find_contradiction(best: Place | None, query: Query | None) -> str:
    """Return the conflict in a description that holds at its best place; empty where there is none.

    Most of the statements must exclude each other there, with no further object that fits them.
    """
    if best is None or query is None or not query.description.conflicts:
        return ""
    evidence = best.evidence[: len(query.used)]
    opposed: set[int] = set()
    for i, a in enumerate(query.used):
        count = sum(node not in (SPEAKER, LISTENER) for node in ends(a))
        for j, b in enumerate(query.used[:i]):
            pair = evidence[i], evidence[j]
            if _are_opposed(a, b) and (
                any(e.verdict == "against" for e in pair)
                or len({o.id for e in pair for o in e.objects}) <= count
            ):
                opposed |= {i, j}
    return query.description.conflicts[0] if 2 * len(opposed) > len(query.used) else ""


def find_uncertainty(
    best: Place | None, query: Query | None, city: City, diagnostics: Diagnostics
) -> str:
    """Return why the best place cannot be sure; empty where nothing speaks against it.

    Statements may not fit (`find_misfit`). A named area tells no more than its extent, unless the claim is
    as wide or another unique name tells where in it.
    """
    misfit = find_misfit(best, query, diagnostics)
    if best is None or query is None or misfit:
        return misfit
    if (city.objects.kind == POINT).all():
        return ""  # a list of landmarks tells no extents
    position = city.plane.to_plane((best.longitude, best.latitude))
    names = [mention.name for mention in query.description.mentions]
    wide: dict[int, float] = {}
    narrow = False
    here = find_speaker_nodes(query.used)
    for s, evidence in zip(query.used, best.evidence, strict=False):
        if s.negated or s.far:
            continue
        names_area = is_binding(s) or s.relation is Relation.NEAR
        extents = {
            node: query.find_extent(node, position, city)
            for node in query.unique.intersection(ends(s)) - query.sites
            if names_area or node not in here
        }
        if max(extents.values(), default=0.0) <= max(MAX_EXTENT, diagnostics.claim.radius):
            told = not any(names[node][:1].isdecimal() for node in ends(s))
            narrow |= told and evidence.weight > TELLING
        elif names_area:
            wide |= extents
    if not wide or narrow:
        return ""
    node = min(wide, key=wide.__getitem__)
    return f"“{names[node]}” is more than {wide[node]:.0f} m wide; say where in it."


def find_misfit(best: Place | None, query: Query | None, diagnostics: Diagnostics) -> str:
    """Return which statements forbid that the best place is sure; empty where they do not.

    A unique name that does not fit the place forbids certainty, and so does an unknown name where
    nothing of its kind fits. So do more statements that do not fit, or are about what the map lacks,
    than statements that do. One in three that does not fit makes a probability doubtful (`DOUBT`).
    """
    if best is None or query is None:
        return ""
    fits = sum(e.verdict == "for" for e in best.evidence)
    fails = sum(e.verdict == "against" for e in best.evidence)
    told = fits + fails + sum(e.note.endswith(NOT_MAPPED) for e in best.evidence)
    doubtful = 2 * fails >= max(fits, 1)
    sure = diagnostics.claim.of_radius.apply(diagnostics.near_best, doubtful=doubtful)
    if told > 2 * fits or sure < MIN_CONFIDENCE:
        return f"Only {fits} of {told} statements fit the best place, so it cannot be sure."
    here = find_speaker_nodes(query.used)
    for s, evidence in zip(query.used, best.evidence, strict=False):
        if s.negated or s.far or here.isdisjoint(ends(s)):
            continue
        failing = query.unique if evidence.verdict == "against" else frozenset[int]()
        if evidence.verdict != "for":
            failing |= query.by_kind
        if failing := failing.intersection(ends(s)):
            name = query.description.mentions[min(failing)].name
            return f"“{name}” does not fit the best place, so the place cannot be sure."
    return ""


def _are_opposed(a: Statement, b: Statement) -> bool:
    """Whether two directions between the same mentions exclude each other."""
    if a.bearing is None or b.bearing is None or set(ends(a)) != set(ends(b)):
        return False
    other = b.bearing if ends(a) == ends(b) else b.bearing + np.pi
    return float(angle_between(a.bearing, other)) > 2.0
