# mypy: allow-untyped-defs, allow-incomplete-defs
"""Which viewpoints are worth a look: bounds on their likelihood from the view index alone."""

from __future__ import annotations

import numpy as np

from placegraph.compiled import kernel
from placegraph.outdoor.likelihood.fit_kernels import BETWEEN, DIRECTION, ME, TABLE
from placegraph.outdoor.map.index_kernels import join_boxes, unpack_box

HERE = 0xF8F80808 - (1 << 32)
"""Where the speaker may stand around a viewpoint: `pack_box` of 8 m to each side."""
HIGHEST = 1e290
"""Bounds are cut here: texts of a hundred statements must not overflow."""


@kernel(fastmath=True)
def promising_views(statements, mentions, views, weights, most):
    """Viewpoints (K,) worth scoring, the most promising first, their bounds, and what is left out.

    Only viewpoints that have all things of at least one statement in sight are touched. The bound
    is the likelihood ratio that the statements would have if every direction were right (less what
    `noise` grants them), times the prior `weights` (W,), all equal where empty. Left out is the sum
    of the bounds of viewpoints that were touched but not returned.
    """
    length = np.zeros(len(mentions.starts) - 1, np.int64)
    for m in range(len(length)):
        for k in range(mentions.starts[m], mentions.starts[m + 1]):
            token = mentions.tokens[k]
            length[m] += views.posting_starts[token + 1] - views.posting_starts[token]
    mass = np.zeros(len(views.total), np.float32)
    boxes = np.empty(len(views.total), np.int32)
    bound = np.zeros(len(views.total))
    touched = np.empty(len(views.total), np.int32)
    n_touched = 0
    for b in range(ME, len(length)):
        filled = False
        for s in range(len(statements.op)):
            scanned, looked_up = _scanned(statements, s, length)
            if statements.negated[s] or scanned == ME or looked_up != b:
                continue
            if b != ME and not filled:
                _fill(mass, boxes, mentions, views, b)
                filled = True
            n_touched = _scan(
                statements, s, scanned, b, mentions, views, mass, boxes, bound, touched, n_touched
            )
        if filled:
            _clear(mass, mentions, views, b)
    touched = touched[:n_touched]
    for s in range(len(statements.op)):
        if statements.negated[s] and statements.target[s] == ME:
            _deny(statements, s, mentions, views, bound)
    total = 0.0
    for view in touched:
        if len(weights):
            bound[view] *= weights[view]
        total += bound[view]
    chosen = _heaviest(bound, touched, most)
    return chosen, bound[chosen], max(0.0, total - bound[chosen].sum())


@kernel(fastmath=True)
def _scan(statements, s, a, b, mentions, views, mass, boxes, bound, touched, n_touched):
    """Multiply the bounds of all viewpoints that see the things of one statement; a is scanned."""
    gain = (1.0 - statements.noise[s]) / (statements.noise[s] * statements.background[s])
    ux, uy = statements.bearing[s]
    if a != statements.source[s]:
        ux, uy = -ux, -uy
    directed = statements.op[s] == DIRECTION
    wrong = statements.table[s, TABLE // 2]
    for k in range(mentions.starts[a], mentions.starts[a + 1]):
        token, weight = mentions.tokens[k], mentions.weights[k]
        for p in range(views.posting_starts[token], views.posting_starts[token + 1]):
            view = views.posting_views[p]
            part = weight * views.posting_mass[p]
            if b == ME:
                part /= views.total[view]
                if directed and not _may_lie(ux, uy, views.posting_boxes[p], HERE):
                    part *= wrong
            elif mass[view] > 0.0:
                part *= mass[view] / (views.pairs[view] + statements.crowd)
                if directed and not _may_lie(ux, uy, views.posting_boxes[p], boxes[view]):
                    part *= wrong
            else:
                continue
            if bound[view] == 0.0:
                bound[view] = 1.0
                touched[n_touched] = view
                n_touched += 1
            bound[view] = min(HIGHEST, bound[view] * (1.0 + gain * min(part, np.float32(1.0))))
    return n_touched


@kernel(inline="always")
def _scanned(statements, s, length):
    """Mention whose viewpoints are scanned for a statement (the rarer one), and the one looked up."""
    a, b = statements.source[s], statements.target[s]
    if statements.op[s] == BETWEEN and a == ME:
        a = statements.target2[s]
    if a == ME or (b != ME and length[b] < length[a]):
        a, b = b, a
    return a, b


@kernel(fastmath=True)
def _deny(statements, s, mentions, views, bound):
    """Lower the bounds of viewpoints that see what is said to be absent."""
    m, noise = statements.source[s], statements.noise[s]
    ux, uy = statements.bearing[s]
    for k in range(mentions.starts[m], mentions.starts[m + 1] if m != ME else 0):
        token, weight = mentions.tokens[k], mentions.weights[k]
        for p in range(views.posting_starts[token], views.posting_starts[token + 1]):
            box = views.posting_boxes[p]
            if statements.op[s] != DIRECTION or _must_lie(ux, uy, box):
                absent = np.exp(-2.0 * weight * views.posting_mass[p])
                bound[views.posting_views[p]] *= (1.0 - noise) * absent + noise


@kernel(fastmath=True, inline="always")
def _must_lie(ux, uy, box):
    """Whether all of a box lies near the direction u from the viewpoint."""
    west, south, east, north = unpack_box(box)
    ahead = min(west * ux, east * ux) + min(south * uy, north * uy)
    left = min(-west * uy, -east * uy) + min(south * ux, north * ux)
    right = max(-west * uy, -east * uy) + max(south * ux, north * ux)
    return ahead > 8.0 and max(-left, right) < 0.7 * ahead


@kernel(fastmath=True)
def _fill(mass, boxes, mentions, views, m):
    """How much of a mention every viewpoint has in sight, and the box it lies in."""
    for k in range(mentions.starts[m], mentions.starts[m + 1]):
        token, weight = mentions.tokens[k], mentions.weights[k]
        for p in range(views.posting_starts[token], views.posting_starts[token + 1]):
            view = views.posting_views[p]
            box = views.posting_boxes[p]
            boxes[view] = box if mass[view] == 0.0 else join_boxes(boxes[view], box)
            mass[view] += weight * views.posting_mass[p]


@kernel
def _clear(mass, mentions, views, m):
    """Undo `_fill`."""
    for k in range(mentions.starts[m], mentions.starts[m + 1]):
        token = mentions.tokens[k]
        for p in range(views.posting_starts[token], views.posting_starts[token + 1]):
            mass[views.posting_views[p]] = 0.0


@kernel(fastmath=True, inline="always")
def _may_lie(ux, uy, box_a, box_b):
    """Whether anything in one box may lie, seen from something in the other, near the direction u."""
    west_a, south_a, east_a, north_a = unpack_box(box_a)
    west_b, south_b, east_b, north_b = unpack_box(box_b)
    west, east = np.float32(west_a - east_b), np.float32(east_a - west_b)
    south, north = np.float32(south_a - north_b), np.float32(north_a - south_b)
    ahead = max(west * ux, east * ux) + max(south * uy, north * uy)
    left = min(-west * uy, -east * uy) + min(south * ux, north * ux)
    right = max(-west * uy, -east * uy) + max(south * ux, north * ux)
    aside = max(left, -right, np.float32(0.0))
    return ahead > 0.0 and aside < np.float32(1.4) * ahead + np.float32(2.0)


@kernel
def _heaviest(bound, touched, most):
    """The `most` touched views of largest bound, largest first (buckets by the exponent's bits)."""
    bits = bound.view(np.int64)
    histogram = np.zeros(1 << 14, np.int64)
    for view in touched:
        histogram[bits[view] >> 49] += 1
    floor, kept = len(histogram), 0
    while floor > 0 and kept + histogram[floor - 1] <= most:
        floor -= 1
        kept += histogram[floor]
    chosen = np.empty(len(touched), np.int32)
    edge = np.empty(len(touched), np.int32)
    n = n_edge = 0
    for view in touched:
        bucket = bits[view] >> 49
        if bucket >= floor:
            chosen[n] = view
            n += 1
        elif bucket == floor - 1:  # the bucket that is kept in part: its heaviest
            edge[n_edge] = view
            n_edge += 1
    if n < most and n_edge:
        heavier = np.argsort(-bound[edge[:n_edge]])[: most - n]
        for k in heavier:
            chosen[n] = edge[k]
            n += 1
    return chosen[:n][np.argsort(-bound[chosen[:n]])]
