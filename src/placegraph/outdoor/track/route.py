"""Way along the streets of a map that a text tells: a path in a graph, matches by dynamic programming.

A path is a sequence of legs, straight on but for bends, and of turns between them. Every step of the
text is an observation of the path. With V(t, n) the weight of all paths that have come to edge n of
leg t, a step multiplies V by a transition within the legs, V'(t, n) = sum over m of V(t, m) M(t, m, n),
and a turn moves it to new legs. The last leg gives the posterior of the end, the way back its path.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats, angle_between, bearing
from placegraph.outdoor.map.city import City
from placegraph.outdoor.map.objects import LINE, Lines, Rows, expand, join
from placegraph.outdoor.map.street_graph import StreetGraph
from placegraph.outdoor.search.posterior import PRIOR_ELSEWHERE, Posterior
from placegraph.outdoor.track.route_text import Move, Step

MAX_EDGES, MAX_LEG = 16, 1500.0
"""Largest number of edges of a leg, and its largest length [m]."""
BEAM, CHUNK, MAX_ENDS = 1e-6, 4000, 200
"""Smallest weight of a leg that is followed, against the heaviest; number of legs that are followed at
a time; and largest number of edges on which the way may end."""
SIGHT, CORNER = 45.0, 40.0
"""Distance within which a landmark is seen from the way, and that of a corner from its junction [m]."""
OUTLINE = 10.0
"""Distance of the samples of the outline of a landmark [m]."""
MISCOUNT = np.array([1.0, 0.08, 0.015, 0.003])
"""Likelihood of a count that is off by none, one, two, or more."""
GOES_ON = 0.05
"""Likelihood of an end of the street where it goes on."""
UNTOLD, ANCHORED, SOUGHT = 0.25, 0.02, 0.1
"""Likelihood of a junction that is passed untold: usually, after the text said at which one one is, and
on the way to a name at the end."""
TURN_SIGMA, HEADING_SIGMA = np.deg2rad(32.0), np.deg2rad(25.0)
"""Standard deviations of the angle of a turn, and of the heading at the start [rad]."""
START_SIGMA, START_REACH = 8.0, 40.0
"""Standard deviation of the start about a street, and its largest distance [m]."""
MISSED_NAME, MISSED_KIND = 0.05, 0.4
"""Likelihoods of a landmark that is not there, by name or by kind."""
WRONG_SIDE = 0.2
"""Likelihood of a landmark that is not on the side that is told."""
FAR_OFF = 0.005
"""Likelihood of an end that is not where the text says."""
END = 60.0, 150.0
"""Mean distance of an end from the last junction, by kinds alone and to a name [m]."""
_LATER = np.triu(np.ones((MAX_EDGES, MAX_EDGES)))


@dataclass(frozen=True, eq=False)
class Legs:
    """Straight ways: T rows of at most `MAX_EDGES` edges, -1 behind the end."""

    line: Rows
    far: Floats
    """(T, N) distance of the beginning of the edge from that of the leg [m]."""
    passed: tuple[Rows, Rows]
    """(T, N) junctions passed before the edge: all, and those with lights."""
    arrives: tuple[NDArray[np.bool_], NDArray[np.bool_]]
    """(T, N) whether one is at the end of the edge."""

    @classmethod
    def follow(cls, streets: StreetGraph, first: Rows, offset: Floats) -> Legs:
        """Follow the streets straight on from edges (T,), each from a distance (T,) along it [m]."""
        line = np.full((len(first), MAX_EDGES), -1, np.int64)
        far = np.zeros(line.shape)
        edge, at = first, -offset
        for n in range(MAX_EDGES):
            line[:, n], far[:, n] = edge, at
            at = at + streets.length[edge] * (edge >= 0)
            edge = np.where((edge >= 0) & (at < MAX_LEG), streets.straight[edge], -1)
            edge[(line == edge[:, None]).any(axis=1)] = -1  # a ring road ends
        tail, head = streets.junction[streets.tail[line]], streets.junction[streets.head[line]]
        arrives = (line >= 0) & (head >= 0) & (head != tail)
        lit = arrives & np.append(streets.lights, False)[head]
        passed = np.cumsum(arrives, axis=1) - arrives, np.cumsum(lit, axis=1) - lit
        return cls(line, far, passed, (arrives, lit))

    def go_on(self, untold: float, fit: Floats | NDArray[np.bool_], at: slice) -> Floats:
        """Return the transition (n, N, N) of going on to edges with a likelihood (T, N).

        Every junction that is passed has the likelihood `untold`.
        """
        passed = self.passed[0][at]
        more = np.maximum(passed[:, None, :] - passed[:, :, None], 0)
        return np.asarray(untold**more * _LATER * (fit * (self.line >= 0))[at][:, None])


class Matches(NamedTuple):
    """Places on directed edges that a landmark stands at."""

    edge: Rows
    along: Floats
    weight: Floats
    row: Rows
    """Rows of the map's objects."""


Transit = Callable[[slice], Floats]
"""Transition matrices (n, N, N) of some legs."""


class Transition(NamedTuple):
    """Step of the dynamic programme, kept for the way back."""

    step: Step
    legs: Legs
    weights: Floats
    """(T, N) before the step."""
    move: Transit | Floats
    """Transition (n, N, N) within some legs; of a turn (4, K): leg and number of the edge before it,
    edge after it, weight."""
    mean: float
    """Mean likelihood of the step on all edges ahead."""
    objects: Matches | None = None
    """Places of the landmark."""


@dataclass(frozen=True, eq=False)
class RouteEnds(Posterior):
    """Posterior of the end of a way."""

    leg: Rows
    """(K,) last leg ..."""
    number: Rows
    """... number of the edge in it ..."""
    far: Floats
    """... and distance of the end from the beginning of the leg [m]."""
    likelihoods: list[tuple[Step, Matches | None, Floats]]
    """Likelihood (K,) of what each step after the last junction says."""


class Route:
    """Way of a text on a map, from where it may begin.

    Parameters
    ----------
    starts
        Posterior of where the way begins; None: anywhere.
    heading
        Direction of the first leg [rad, clockwise from north]; None: any.
    sigma
        Standard deviation of the start about a street [m].
    """

    def __init__(
        self,
        city: City,
        starts: Posterior | None,
        heading: float | None,
        sigma: float = START_SIGMA,
    ) -> None:
        self.city, self.streets = city, city.street_graph
        self.history: list[Transition] = []
        self.anchor: Move | None = None
        streets = self.streets
        edges = np.arange(len(streets.tail))
        own, sample, along = streets.sample(edges)
        weight, at = np.ones(len(own)), np.arange(len(own))
        if starts is not None:
            i, at = join(starts.positions, streets.points[sample], START_REACH)
            off = np.hypot(*(starts.positions[i] - streets.points[sample[at]]).T)
            weight = starts.probabilities[i] * (np.exp(-0.5 * (off / sigma) ** 2) + 1e-6)
        if heading is not None:
            ahead = bearing(streets.ahead[sample[at]]) + np.pi * (own[at] & 1)
            weight *= np.exp(-0.5 * (angle_between(ahead, heading) / HEADING_SIGMA) ** 2) + 1e-5
        order = np.lexsort((-weight, own[at]))
        best = at[order[np.diff(own[at[order]], prepend=-1) != 0]]
        total = np.bincount(own[at], weight, len(edges))[own[best]]
        self._start_legs(own[best], along[best] * (starts is not None), total)

    def _start_legs(self, first: Rows, offset: Floats, weight: Floats) -> None:
        """Begin legs (T,)."""
        heavy = weight > BEAM * weight.max(initial=0.0)
        self.legs = Legs.follow(self.streets, first[heavy], offset[heavy])
        self.weights = np.zeros(self.legs.line.shape)
        self.weights[:, 0] = weight[heavy] / max(weight.sum(), 1e-300)

    def follow(self, steps: list[Step]) -> RouteEnds:
        """Follow all steps; return the posterior of the end."""
        anchors = [i for i, s in enumerate(steps) if s.move in (Move.TURN, Move.PASS, Move.REACH)]
        last = anchors[-1] if anchors else -1
        for step in steps[: last + 1]:
            if step.move is Move.TURN:
                self._turn(step)
            elif step.move in (Move.PASS, Move.REACH):
                self._move(step, self._count(step))
                self.anchor = step.move
            elif step.move is Move.WALK:
                self._move(step, self._walk(step.amount))
                self.anchor = Move.REACH
            elif step.move is Move.MARK:
                matches = self._match(step)
                self._move(step, self._see(step, matches), matches)
        return self._end(steps[max(last, 0) :])

    def _move(self, step: Step, move: Transit, matches: Matches | None = None) -> None:
        weights = self._apply(move)
        total = float(weights.sum())
        ahead = (self.weights * (self.legs.line >= 0)[:, ::-1].cumsum(axis=1)[:, ::-1]).sum()
        mean = total / max(float(ahead), 1e-300)
        self.history.append(Transition(step, self.legs, self.weights, move, mean, matches))
        self.weights = weights / max(total, 1e-300)

    def _apply(self, move: Transit) -> Floats:
        """Multiply the weights (T, N) by a transition, some legs at a time."""
        starts = range(0, max(len(self.weights), 1), CHUNK)
        parts = [slice(first, first + CHUNK) for first in starts]
        return np.concatenate([np.einsum("tm,tmn->tn", self.weights[at], move(at)) for at in parts])

    def _count(self, step: Step) -> Transit:
        """Return the transition of a count of junctions."""
        legs, reach = self.legs, step.move is Move.REACH
        passed, arrives = (each[step.unit == "light"] for each in (legs.passed, legs.arrives))
        there = arrives if reach else np.pad(arrives, ((0, 0), (1, 0)))[:, :-1]
        if step.is_end:
            there = there * np.where(self.streets.straight[legs.line] < 0, 1.0, GOES_ON)
        base = np.zeros_like(passed) if step.is_ordinal else passed

        def move(at: slice) -> Floats:
            count = (passed[at] + reach)[:, None, :] - base[at][:, :, None]
            off = np.minimum(np.abs(count - int(step.amount)), len(MISCOUNT) - 1)
            total = MISCOUNT[off] * there[at][:, None, :]
            return total * _LATER * (legs.line[at] >= 0)[:, None, :]

        return move

    def _walk(self, amount: float) -> Transit:
        """Return the transition of going some metres to the end of an edge."""
        legs, length = self.legs, np.append(self.streets.length, 0.0)
        end = legs.far + length[legs.line]
        begin = end if self.anchor is Move.REACH else np.maximum(legs.far, 0.0)

        def move(at: slice) -> Floats:
            off = (end[at][:, None, :] - begin[at][:, :, None] - amount) / (0.2 * amount + 20.0)
            there = (legs.line >= 0)[at][:, None, :]
            return (np.exp(-0.5 * off**2) + FAR_OFF) * _LATER * there

        return move

    def _turn(self, step: Step) -> None:
        streets, legs = self.streets, self.legs
        self._move(step, partial(legs.go_on, self._loose, legs.arrives[0]))
        weights = self.weights.copy()
        joint = np.where(legs.line >= 0, streets.junction[streets.tail[legs.line]], -1)
        inner = (joint >= 0) & (joint == streets.junction[streets.head[legs.line]])
        for k in range(1, MAX_EDGES):  # the next carriageway of a street is at the same junction
            weights[:, k] += inner[:, k] * weights[:, k - 1]
        t, n = np.nonzero(weights > 1e-7 * weights.max(initial=0.0))
        edge = legs.line[t, n]
        first = streets.turn_starts[edge]
        own, option = expand(first, streets.turn_starts[edge + 1] - first)
        to, angle = streets.turn_edges[option], streets.turn_angles[option]
        off = angle_between(angle, np.deg2rad(step.amount)) / TURN_SIGMA
        fit = np.exp(-0.5 * off**2) + 1e-4
        if abs(step.amount) == 180.0:
            own, to, fit = np.arange(len(edge)), edge ^ 1, np.ones(len(edge))
        value = weights[t[own], n[own]] * fit
        turn = np.stack([t[own], n[own], to, value])
        self.history.append(Transition(step, legs, self.weights, turn, 1.0))
        new, leg = np.unique(to, return_inverse=True)
        self._start_legs(
            new, np.zeros(len(new)), np.bincount(leg.reshape(-1), value, len(new)).astype(float)
        )
        self.anchor = Move.TURN

    @property
    def _loose(self) -> float:
        """Likelihood of a junction that is passed untold."""
        return ANCHORED if self.anchor is Move.REACH else UNTOLD

    def _see(self, step: Step, matches: Matches) -> Transit:
        """Return the transition of going on to where a landmark is seen."""
        length, line = self.streets.length, self.legs.line
        own, begin, end = np.zeros((3, len(length) + 1))
        near, far = matches.along <= CORNER, matches.along >= length[matches.edge] - CORNER
        np.maximum.at(own, matches.edge, matches.weight)
        np.maximum.at(begin, matches.edge[near], matches.weight[near])
        np.maximum.at(end, matches.edge[far], matches.weight[far])
        here = own[line]
        ahead = np.maximum(end, begin[np.append(self.streets.straight, -1)])[line]
        behind, before = (np.pad(x, ((0, 0), (1, 0)))[:, :-1] for x in (ahead, here))
        crossed = step.where == "past" and (self.city.objects.kind[matches.row] == LINE).any()
        shares = (0.1, 0.1, 1.0, 0.1) if crossed else (0.5, 1.0, 0.8, 0.3)
        seen = np.max(
            [w * x for w, x in zip(shares, (here, ahead, behind, before), strict=True)], axis=0
        )
        miss = MISSED_NAME if step.names else MISSED_KIND
        return partial(self.legs.go_on, self._loose, miss + (1.0 - miss) * seen)

    def _match(self, step: Step) -> Matches:
        """Find the places on the legs that a landmark stands at."""
        streets, city = self.streets, self.city
        edges = np.unique(self.legs.line[self.legs.line >= 0])
        own, sample, along = streets.sample(edges)
        at = streets.points[sample]
        fit = find_objects(city, step)
        rows = np.flatnonzero(fit)
        low, high = at.min(axis=0) - SIGHT, at.max(axis=0) + SIGHT
        box = city.columns.box[rows]
        rows = rows[((box[:, 2:] >= low) & (box[:, :2] <= high)).all(axis=1)]
        outlines = Lines.of_objects(city.objects, rows)
        line, points, _ = outlines.sample(OUTLINE)
        i, k = join(points, at, SIGHT)
        distance = np.hypot(*(points[i] - at[k]).T)
        order = np.lexsort((distance, own[k], i))  # the nearest sample of every edge
        pair = i[order] * len(edges) + own[k][order]
        best = order[np.diff(pair, prepend=-1) != 0]
        i, k = i[best], k[best]
        row, edge = outlines.row[line[i]], edges[own[k]]
        east, north = (streets.ahead[sample[k]] * np.where(edge & 1, -1.0, 1.0)[:, None]).T
        x, y = (points[i] - at[k]).T
        wrong = (x * north - y * east) * step.side < 0.0
        return Matches(edge, along[k], fit[row] * np.where(wrong, WRONG_SIDE, 1.0), row)

    def _end(self, steps: list[Step]) -> RouteEnds:
        """Return the posterior of the end by the last junction or turn and the steps after it."""
        legs, streets, reached = self.legs, self.streets, self.anchor is Move.REACH
        named = any(s.names for s in steps)
        measured = any(s.move in (Move.SHARE, Move.WALK) for s in steps)
        how = steps[0].where if steps and steps[0].move is Move.REACH else ""
        spread = self.weights
        if not reached:
            untold = SOUGHT if named else ANCHORED
            spread = self._apply(partial(legs.go_on, untold, legs.line >= 0))
        heavy = np.argsort(-spread, axis=None, kind="stable")[:MAX_ENDS]
        heavy = heavy[spread.ravel()[heavy] > 1e-5 * spread.max(initial=0.0)]
        t, n = np.unravel_index(heavy, spread.shape)
        own, sample, x = streets.sample(legs.line[t, n])
        t, n = t[own], n[own]
        s = legs.far[t, n] + x
        block = (legs.passed[0][t] == legs.passed[0][t, n][:, None]) & (legs.line[t] >= 0)
        begin = np.maximum(np.where(block, legs.far[t], np.inf).min(axis=1), 0.0)
        finish = np.where(block, legs.far[t] + streets.length[legs.line[t]], -np.inf).max(axis=1)
        behind, ahead = s - begin, finish - s
        with np.errstate(divide="ignore"):
            log = np.log(spread[t, n] * (s >= 0.0))
        if how:
            log += np.log(np.exp(-np.abs(ahead - 10.0) / 12.0) + FAR_OFF)
        elif reached:
            log += np.logaddexp(-ahead / 12.0, np.log(0.3) - behind / 12.0)
        elif not measured:
            log -= behind / END[int(named)]
        likelihoods: list[tuple[Step, Matches | None, Floats]] = []
        for step in steps:
            amount, matches = step.amount, None
            if step.move is Move.MARK:
                matches = self._match(step)
                fit = self._see_near(step, matches, t, s)
            elif step.move is Move.WALK:
                fit = np.exp(-0.5 * ((behind - amount) / (0.2 * amount + 8.0)) ** 2) + FAR_OFF
            elif step.move is Move.SHARE and not amount:
                fit = np.exp(-behind / 12.0) + FAR_OFF
            elif step.move is Move.SHARE:
                fit = np.exp(-0.5 * ((behind / (finish - begin) - amount) / 0.15) ** 2) + FAR_OFF
            else:
                continue
            likelihoods.append((step, matches, fit))
            log += np.log(fit)
        weights = np.exp(log - log.max(initial=-1e300))
        weights *= (1.0 - PRIOR_ELSEWHERE) / max(weights.sum(), 1e-300)
        return RouteEnds(streets.points[sample], weights, PRIOR_ELSEWHERE, t, n, s, likelihoods)

    def _see_near(self, step: Step, matches: Matches, t: Rows, s: Floats) -> Floats:
        """Return the likelihood (K,) of a landmark near ends at distances (K,) along legs (K,) [m]."""
        fit = np.zeros(len(t))
        for leg in np.unique(t).tolist():
            line, mine = self.legs.line[leg], np.flatnonzero(t == leg)
            here, number = np.nonzero(matches.edge[:, None] == line)
            delta = s[mine, None] - self.legs.far[leg, number] - matches.along[here]
            if step.where == "past":
                kernel = (delta > -10.0) * np.exp(-np.maximum(delta, 0.0) / 200.0)
            else:
                shift = {"after": 14.0, "before": -14.0}.get(step.where, 0.0)
                kernel = np.exp(-0.5 * ((delta - shift) / 15.0) ** 2)
            fit[mine] = (kernel * matches.weight[here]).max(axis=1, initial=0.0)
        return (MISSED_NAME if step.names else MISSED_KIND) / 2.0 + fit

    def trace(self, ends: RouteEnds, k: int) -> tuple[Floats, list[tuple[Step, float, Rows]]]:
        """Trace the likeliest path to an end.

        Returns its points (N, 2) [m], and of every step its log-likelihood ratio against all other
        paths [nat] and the objects of its landmark.
        """
        legs, leg, n = self.legs, int(ends.leg[k]), int(ends.number[k])
        said = [
            (step, float(np.log(fit[k] / fit.mean())), _pick(matches, legs.line[leg, n : n + 1]))
            for step, matches, fit in reversed(ends.likelihoods)
        ]
        pieces = [self._points(legs, leg, n, float(ends.far[k]))]
        n = int(np.argmax(self.weights[leg, : n + 1]))
        for step, before, weights, move, mean, matches in reversed(self.history):
            if isinstance(move, np.ndarray):  # a turn
                own = np.flatnonzero(move[2] == legs.line[leg, 0])
                leg, n = (int(x) for x in move[:2, own[np.argmax(move[3, own])]])
                legs = before
                pieces.append(self._points(legs, leg, n, np.inf))
                continue
            moved = move(slice(leg, leg + 1))[0]
            paths = weights[leg] * moved.T  # to edge n (rows) from edge m
            while n and not paths[n].any():
                n -= 1
            m = int(np.argmax(paths[n]))
            ratio = float(np.log(max(moved[m, n], 1e-12) / max(mean, 1e-12)))
            said.append((step, ratio, _pick(matches, legs.line[leg, max(0, n - 1) : n + 2])))
            n = m
        return np.concatenate(pieces[::-1]), said[::-1]

    def _points(self, legs: Legs, leg: int, n: int, far: float) -> Floats:
        """Return the points (N, 2) [m] of a leg up to edge n, or to a distance [m]."""
        own, sample, along = self.streets.sample(legs.line[leg, : n + 1])
        along += legs.far[leg, own]
        return self.streets.points[sample[(along >= 0.0) & (along <= far)]]


def _pick(matches: Matches | None, edges: Rows) -> Rows:
    """Return the best object of a landmark on some edges; none where it has none there."""
    if matches is None:
        return np.zeros(0, np.int64)
    here = np.flatnonzero(np.isin(matches.edge, edges))
    return matches.row[here[np.argsort(-matches.weight[here], kind="stable")[:1]]]


def find_objects(city: City, step: Step) -> Floats:
    """Return the weight (N,) of every object of the map as a landmark; 0 where it is none."""
    pairs = [(len(city.objects.labels) + row, weight) for row, weight in step.names]
    pairs += [(row, s.weight) for s in step.kinds for row in city.label_index.get(s.label, ())]
    fit = np.zeros(len(city.objects))
    tokens = np.array([token for token, _ in pairs], np.int32)
    for (_, weight), rows in zip(pairs, city.bearers(tokens), strict=True):
        fit[rows] = np.maximum(fit[rows], weight)
    return fit
