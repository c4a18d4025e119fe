"""Way along the streets of a map that a text tells: a path in a graph, matches by dynamic programming.

A path is a sequence of legs, straight on but for bends, and of turns between them. Every step of the
text is an observation of the path. With V(t, n) the weight of all paths that have come to edge n of
leg t, a step multiplies V by a transition within the legs, V'(t, n) = sum over m of V(t, m) M(t, m, n),
and a turn moves it to new legs. The last leg gives the posterior of the end, the way back its path.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats, angle_between, bearing
from placegraph.outdoor.map.city import City
from placegraph.outdoor.map.objects import POINT
from placegraph.outdoor.map.street_graph import Rows, StreetGraph, expand, join
from placegraph.outdoor.search.posterior import PRIOR_ELSEWHERE, Posterior
from placegraph.outdoor.track.route_text import Move, Step

MAX_EDGES, MAX_LEG = 24, 1500.0
"""Largest number of edges of a leg, and its largest length [m]."""
MAX_LEGS, MAX_ENDS = 6000, 600
"""Largest numbers of legs that are followed at a time, and of edges on which the way may end."""
SIGHT, FRONT, CORNER = 45.0, 25.0, 40.0
"""A landmark is seen within `SIGHT` of the way, stands at the street within `FRONT`, and at a corner
within `CORNER` of the junction, along the street [m]."""
MISCOUNT = np.array([1.0, 0.08, 0.015, 0.003])
"""Likelihood of a count that is off by none, one, two, or more."""
BY_LIGHTS = 0.85
"""Probability that "light" counts junctions where the map has lights, and not all."""
SINCE_TURN = 0.85
"""Probability that "the third light" is counted from the last turn."""
UNTOLD, ANCHORED = 0.25, 0.02
"""Likelihood of a junction that is passed untold, and after the text said at which one one is."""
TURN_SIGMA, HEADING_SIGMA = np.deg2rad(32.0), np.deg2rad(25.0)
"""Standard deviations of the angle of a turn, and of the heading at the start [rad]."""
START_SIGMA, START_REACH = 8.0, 40.0
"""Standard deviation of the start about a street, and its largest distance [m]."""
MISSED_NAME, MISSED_KIND, WRONG_SIDE = 0.05, 0.4, 0.3
"""Likelihoods of a landmark that is not there, by name or by kind, or on the other side."""
FAR_OFF = 0.005
"""Likelihood of an end that is not where the text says."""
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


class Matches(NamedTuple):
    """Places on directed edges that a landmark stands at."""

    edge: Rows
    along: Floats
    weight: Floats
    row: Rows
    """Rows of the map's objects."""


class Transition(NamedTuple):
    """Step of the dynamic programme, kept for the way back."""

    step: Step
    legs: Legs
    weights: Floats
    """(T, N) before the step."""
    move: Floats
    """(T, N, N) transition within legs; of a turn (4, K): leg and number of the edge before it, edge
    after it, weight."""
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
        # at the end of an edge one is rather at the beginning of the next
        weight *= np.where(along[at] > streets.length[own[at]] - 1.0, 0.3, 1.0)
        order = np.lexsort((-weight, own[at]))
        best = at[order[np.diff(own[at[order]], prepend=-1) != 0]]
        total = np.bincount(own[at], weight, len(edges))[own[best]]
        self._start_legs(own[best], along[best] * (starts is not None), total)

    def _start_legs(self, first: Rows, offset: Floats, weight: Floats) -> None:
        """Begin legs (T,), the heaviest."""
        heavy = np.sort(np.argsort(-weight, kind="stable")[:MAX_LEGS])
        first, offset, weight = first[heavy], offset[heavy], weight[heavy]
        self.legs = Legs.follow(self.streets, first, offset)
        self.weights = np.zeros(self.legs.line.shape)
        self.weights[:, 0] = weight / max(weight.sum(), 1e-300)

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
                far = self.legs.far
                off = (far[:, None, :] - far[:, :, None] - step.amount) / (0.3 * step.amount + 40.0)
                self._move(step, np.exp(-0.5 * off**2) * self._go_on(1.0))
            elif step.move is Move.MARK and step.where != "beyond":
                near = self.anchor is Move.REACH and step.where != "past"
                matches = self._match(step)
                move = self._go_on(ANCHORED if near else UNTOLD) * self._see(step, matches)[:, None]
                self._move(step, move, matches)
        return self._end(steps[max(last, 0) :])

    def _move(self, step: Step, move: Floats, matches: Matches | None = None) -> None:
        self.history.append(Transition(step, self.legs, self.weights, move, matches))
        weights = np.einsum("tm,tmn->tn", self.weights, move)
        self.weights = weights / max(weights.sum(), 1e-300)

    def _go_on(self, untold: float) -> Floats:
        """Return the transition (T, N, N) of going on, with a likelihood for every junction passed."""
        passed = self.legs.passed[0]
        more = np.maximum(passed[:, None, :] - passed[:, :, None], 0)
        return np.where((self.legs.line >= 0)[:, None, :], untold**more, 0.0) * _LATER

    def _count(self, step: Step) -> Floats:
        """Return the transition (T, N, N) of a count of junctions."""
        legs, reach, ahead = self.legs, step.move is Move.REACH, self.anchor is Move.REACH
        by_lights = BY_LIGHTS if step.unit == "light" else 1.0 - BY_LIGHTS
        since = SINCE_TURN if step.is_ordinal else 0.0
        total = np.zeros((*legs.line.shape, MAX_EDGES))
        shares = (1.0 - by_lights, by_lights)
        for share, passed, arrives in zip(shares, legs.passed, legs.arrives, strict=True):
            came = np.pad(arrives, ((0, 0), (1, 0)))[:, :-1]
            there = arrives if reach else came
            first = arrives if step.unit != "light" else legs.arrives[1]
            base = passed + first if ahead else passed
            for part, k in (
                (since, np.broadcast_to((passed + reach)[:, None, :], total.shape)),
                (1.0 - since, (passed + reach)[:, None, :] - base[:, :, None]),
            ):
                off = np.minimum(np.abs(k - int(step.amount)), len(MISCOUNT) - 1)
                total += share * part * MISCOUNT[off] * there[:, None, :]
        if step.is_end:
            ends = (
                np.where(self.streets.straight[legs.line] < 0, 1.0, MISCOUNT[1]) * legs.arrives[0]
            )
            total = self._go_on(1.0) * ends[:, None, :]
        total *= _LATER * (legs.line >= 0)[:, None, :]
        return 0.5 * total + 0.5 * np.eye(MAX_EDGES) if step.is_same and ahead else total

    def _turn(self, step: Step) -> None:
        streets, legs = self.streets, self.legs
        loose = ANCHORED if self.anchor is Move.REACH else UNTOLD
        self._move(step, self._go_on(loose) * legs.arrives[0][:, None, :])
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
        fit = np.exp(-0.5 * off**2) * (to != streets.straight[edge[own]]) + 1e-4
        if abs(step.amount) == 180.0:
            own, to, fit = np.arange(len(edge)), edge ^ 1, np.ones(len(edge))
        value = weights[t[own], n[own]] * fit
        turn = np.stack([t[own], n[own], to, value])
        self.history.append(Transition(step, legs, self.weights, turn))
        new, leg = np.unique(to, return_inverse=True)
        self._start_legs(
            new, np.zeros(len(new)), np.bincount(leg.reshape(-1), value, len(new)).astype(float)
        )
        self.anchor = Move.TURN

    def _see(self, step: Step, matches: Matches) -> Floats:
        """Return the likelihood (T, N) of a landmark seen from every edge."""
        length, line = self.streets.length, self.legs.line
        own, begin, end = np.zeros((3, len(length) + 1))
        near, far = matches.along <= CORNER, matches.along >= length[matches.edge] - CORNER
        np.maximum.at(own, matches.edge, matches.weight)
        np.maximum.at(begin, matches.edge[near], matches.weight[near])
        np.maximum.at(end, matches.edge[far], matches.weight[far])
        here = own[line]
        ahead = np.maximum(end, begin[np.append(self.streets.straight, -1)])[line]
        behind, before = (np.pad(x, ((0, 0), (1, 0)))[:, :-1] for x in (ahead, here))
        at_corner = step.is_corner or self.anchor is Move.REACH
        passed = self.anchor is Move.PASS
        shares = (0.5, 1.0, 1.0 if passed else 0.6, 0.0) if at_corner else (1.0, 0.9, 0.8, 0.6)
        seen = np.max(
            [w * x for w, x in zip(shares, (here, ahead, behind, before), strict=True)], axis=0
        )
        miss = MISSED_NAME if step.names else MISSED_KIND
        return np.asarray(miss + (1.0 - miss) * seen)

    def _match(self, step: Step) -> Matches:
        """Find the places on the legs that a landmark stands at."""
        streets, edges = self.streets, np.unique(self.legs.line)[1:]
        rows, fits = find_objects(self.city, step)
        own, sample, along = streets.sample(edges)
        at = streets.points[sample]
        points, owner = trace_outlines(
            self.city, rows, at.min(axis=0) - SIGHT, at.max(axis=0) + SIGHT
        )
        i, k = join(points, at, SIGHT)
        away, ahead = (
            points[i] - at[k],
            streets.ahead[sample[k]] * (1 - 2 * (edges[own[k]] & 1))[:, None],
        )
        distance = np.hypot(*away.T)
        order = np.lexsort((distance, own[k], i))  # the nearest sample of every edge
        best = order[
            (np.diff(i[order], prepend=-1) != 0) | (np.diff(own[k][order], prepend=-1) != 0)
        ]
        left = (ahead[:, 0] * away[:, 1] > ahead[:, 1] * away[:, 0]) == (step.side == "left")
        weight = fits[owner[i]] * np.exp(-0.5 * (np.maximum(distance - FRONT, 0.0) / 15.0) ** 2)
        weight *= np.where(left | (step.side == ""), 1.0, WRONG_SIDE)
        return Matches(edges[own[k]][best], along[k][best], weight[best], rows[owner[i]][best])

    def _end(self, steps: list[Step]) -> RouteEnds:
        """Return the posterior of the end by the last junction or turn and the steps after it."""
        legs, streets, reached = self.legs, self.streets, self.anchor is Move.REACH
        marks = [s for s in steps if s.move is Move.MARK]
        measured = any(s.move in (Move.SHARE, Move.WALK) for s in steps)
        how = steps[0].where if steps and steps[0].move is Move.REACH else ""
        loose = UNTOLD if marks and not measured and not reached else ANCHORED
        spread = np.einsum("tm,tmn->tn", self.weights, self._go_on(loose))
        if reached:  # or just behind the junction
            spread = self.weights + 0.3 * np.pad(self.weights, ((0, 0), (1, 0)))[:, :-1] * (
                legs.line >= 0
            )
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
        done = ahead if reached else behind  # distance to the junction spoken of
        if how:
            log += np.log(np.exp(-np.abs(ahead - 10.0 * (how == "before")) / 12.0) + FAR_OFF)
        elif reached:
            log += np.logaddexp(-ahead / 12.0, np.log(0.3) - behind / 12.0)
        elif not measured:
            log -= behind / (150.0 if marks else 20.0)
        likelihoods: list[tuple[Step, Matches | None, Floats]] = []
        for step in steps:
            amount, matches = step.amount, None
            if step.move is Move.MARK:
                matches = self._match(step)
                fit = self._see_near(step, matches, t, s)
            elif step.move is Move.WALK:
                fit = np.exp(-0.5 * ((behind - amount) / (0.2 * amount + 8.0)) ** 2) + FAR_OFF
            elif step.move is Move.SHARE and amount in (0.0, 2.0):
                fit = np.exp(-done / 12.0) + FAR_OFF
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
            elif step.where == "beyond":
                kernel = 1.0 * ((delta < 0.0) & (delta > -150.0))
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
        for step, before, weights, move, matches in reversed(self.history):
            if move.ndim == 2:  # a turn
                own = np.flatnonzero(move[2] == legs.line[leg, 0])
                leg, n = (int(x) for x in move[:2, own[np.argmax(move[3, own])]])
                legs = before
                pieces.append(self._points(legs, leg, n, np.inf))
                continue
            paths = weights[leg] * move[leg].T  # to edge n (rows) from edge m
            while n and not paths[n].any():
                n -= 1
            m = int(np.argmax(paths[n]))
            usual = float(np.einsum("tm,tmn->", weights, move))
            ratio = float(np.log(max(move[leg, m, n], 1e-12) / max(usual, 1e-12)))
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


def find_objects(city: City, step: Step) -> tuple[Rows, Floats]:
    """Find the objects that a landmark may be, and their weights."""
    pairs = [(len(city.objects.labels) + row, weight) for row, weight in step.names]
    pairs += [(row, s.weight) for s in step.kinds for row in city.label_index.get(s.label, ())]
    best: dict[int, float] = {}
    tokens = np.array([token for token, _ in pairs], np.int32)
    for (_, weight), rows in zip(pairs, city.bearers(tokens), strict=True):
        for row in rows.tolist():
            best[row] = max(weight, best.get(row, 0.0))
    return np.array(list(best), np.int64), np.array(list(best.values()))


def trace_outlines(city: City, rows: Rows, low: Floats, high: Floats) -> tuple[Floats, Rows]:
    """Return points (K, 2) [m] on the outlines of objects in a box, and the number of their object."""
    objects = city.objects
    points, owner = [np.zeros((0, 2))], [np.zeros(0, np.int64)]
    for i, row in enumerate(rows.tolist()):
        corners = np.concatenate(objects.parts(row)).astype(np.float64)
        if not ((corners.max(axis=0) >= low) & (corners.min(axis=0) <= high)).all():
            continue
        if objects.kind[row] != POINT:
            along = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))))
            at = np.linspace(0.0, along[-1], min(200, int(along[-1] / 10.0) + 2))
            corners = np.column_stack([np.interp(at, along, axis) for axis in corners.T])
        points.append(corners)
        owner.append(np.full(len(corners), i))
    return np.concatenate(points), np.concatenate(owner)
