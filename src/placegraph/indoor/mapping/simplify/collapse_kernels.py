# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled loops of mesh simplification; see `placegraph.indoor.mapping.simplify.simplify`.

Every vertex has two linked lists. One holds the corners (corner = 3 * face + k) of the living faces
around it. The other names the planes of the original surface that it stands for; when two vertices
become one their lists are joined end to end. Stale heap entries are told by the vertices' versions.
Vectors are triples of numbers: arrays of three would be made on the heap, millions of times.
"""

from __future__ import annotations

import heapq

import numpy as np

from placegraph.core.jit import kernel
from placegraph.indoor.mapping.simplify.quadric_kernels import (
    face_normal,
    meeting_point,
    meeting_values,
    planes_of,
    quadrics_of,
    wedges_meeting,
)

TURN = 0.3
"""Cosine of the angle that a face may turn in one collapse."""
RING = 250
"""Vertices of more faces than this stay where they are."""


@kernel
def prune(v, faces, head, tail, after):
    """Drop the dead faces from the list of a vertex."""
    last, corner = -1, head[v]
    while corner >= 0:
        following = after[corner]
        if faces[corner // 3, 0] >= 0:
            last = corner
        elif last < 0:
            head[v] = following
        else:
            after[last] = following
        corner = following
    tail[v] = last


@kernel
def join(a, b, head, tail, after):
    """Append the list of vertex b to that of vertex a."""
    if head[b] < 0:
        return
    if head[a] < 0:
        head[a] = head[b]
    else:
        after[tail[a]] = head[b]
    tail[a] = tail[b]


@kernel
def neighbours(v, other, faces, head, after, out):
    """Write vertices that share a face with v, but for `other`, into `out`; how many they are."""
    n = 0
    corner = head[v]
    while corner >= 0:
        f = corner // 3
        for k in range(3):
            w = faces[f, k]
            if w != v and w != other:
                known = False
                for i in range(n):
                    known |= out[i] == w
                if not known:
                    out[n] = w
                    n += 1
        corner = after[corner]
    return n


@kernel
def folds(v, other, x, y, z, points, faces, head, after):
    """Whether a face of v, but not of both, would turn over or vanish if v moved to x, y, z."""
    x0, y0, z0 = points[v, 0], points[v, 1], points[v, 2]
    corner = head[v]
    while corner >= 0:
        f = corner // 3
        if faces[f, 0] != other and faces[f, 1] != other and faces[f, 2] != other:
            o0, o1, o2 = face_normal(points, faces, f)
            points[v, 0], points[v, 1], points[v, 2] = x, y, z
            n0, n1, n2 = face_normal(points, faces, f)
            points[v, 0], points[v, 1], points[v, 2] = x0, y0, z0
            lengths = (o0 * o0 + o1 * o1 + o2 * o2) * (n0 * n0 + n1 * n1 + n2 * n2)
            if o0 * n0 + o1 * n1 + o2 * n2 <= TURN * np.sqrt(lengths):
                return True
        corner = after[corner]
    return False


@kernel
def beyond(v, x, y, z, limit, planes, head, after, corners):
    """Whether a point is farther than the limit from an original plane that a vertex stands for."""
    node = head[v]
    while node >= 0:
        # nodes beyond the corners are the ends of borders, two each
        p = node // 3 if node < corners else corners // 3 + (node - corners) // 2
        if abs(planes[p, 0] * x + planes[p, 1] * y + planes[p, 2] * z + planes[p, 3]) > limit:
            return True
        node = after[node]
    return False


@kernel
def linked(count, faces, ends):
    """Lists by vertex of the corners of faces, and then of the ends (B, 2) of borders.

    Heads and tails (count,), -1: none; and what follows each node (3 F + 2 B,), -1: nothing.
    """
    head, tail = np.full(count, -1, np.int32), np.full(count, -1, np.int32)
    corners = 3 * len(faces)
    after = np.full(corners + 2 * len(ends), -1, np.int32)
    for node in range(len(after)):
        if node < corners:
            v = faces[node // 3, node % 3]
        else:
            v = ends[(node - corners) // 2, (node - corners) % 2]
        if head[v] < 0:
            head[v] = node
        else:
            after[tail[v]] = node
        tail[v] = node
    return head, tail, after


@kernel
def pinches(a, b, faces, head, after, ring, other):
    """Whether the surface would be pinched, or a closed part vanish, if a and b became one."""
    na = neighbours(a, b, faces, head, after, ring)
    nb = neighbours(b, a, faces, head, after, other)
    shared = 0
    for i in range(na):
        for j in range(nb):
            shared += ring[i] == other[j]
    joined, corner = 0, head[a]  # faces that vanish
    while corner >= 0:
        f = corner // 3
        joined += faces[f, 0] == b or faces[f, 1] == b or faces[f, 2] == b
        corner = after[corner]
    return shared != joined or na + nb - shared < 3


@kernel
def judged(values, limits):
    """Whether attributes can speak against a collapse: a texture that is more than one texel."""
    textured = (values[:, 0] != values[0, 0]) | (values[:, 1] != values[0, 1])
    return limits[2] < np.inf or textured.any()


@kernel
def collapse(points, faces, edges, border, wedges, values, locked, target, limits):
    """Collapse edges, cheapest first, until `target` faces live or the limits stop it; in place.

    `points`: (V, 3) float64; `faces`: (F, 3) int64, dead ones get -1; `edges`: (E, 2) int64,
    every edge once; `border`: (E,) int64, a face of an edge to be kept in its place, or -1;
    `wedges`: (F, 3) int64, row of `values` (W, D) of every corner, u and v first; `locked`: (V,)
    bool, vertices that stay; `limits`: (3,) greatest distance from the original planes [m], slide
    of a texture [m], change of the other attributes.
    """
    kept = np.flatnonzero(border >= 0)
    ends = edges[kept]
    planes = planes_of(points, faces, ends, border[kept])
    quadrics = quadrics_of(points, faces, ends, planes)
    plane_head, plane_tail, plane_after = linked(len(points), faces, ends)
    head, tail, after = linked(len(points), faces, ends[:0])
    corners = 3 * len(faces)
    degree = np.zeros(len(points), np.int32)
    for f in range(len(faces)):
        for k in range(3):
            degree[faces[f, k]] += 1
    version = np.zeros(len(points), np.int32)
    version[locked] = -1
    moved = np.zeros((len(points), 2))  # slide and change so far
    checked = judged(values, limits)
    q = np.empty(10)
    heap = [(0.0, np.int32(0), np.int32(0), np.int32(0), np.int32(0)) for _ in range(0)]
    for e in range(len(edges)):
        a, b = np.int32(edges[e, 0]), np.int32(edges[e, 1])
        _, _, _, off, tie = meeting_point(quadrics, points, a, b, q)
        # the mean of squared distances is no more than the largest: these would never pass
        near = off <= limits[0] * limits[0] * (q[0] + q[4] + q[7])
        if near and version[a] == 0 and version[b] == 0:
            heap.append((off + tie, a, b, np.int32(0), np.int32(0)))
    heapq.heapify(heap)
    living = len(faces)
    ring, other = np.empty(4 * RING, np.int64), np.empty(4 * RING, np.int64)
    own, group = np.empty(64, np.int64), np.empty(64, np.int64)
    new, total = np.empty((64, values.shape[1])), np.empty(64)
    while living > target and len(heap) > 0:
        _, a, b, va, vb = heapq.heappop(heap)
        if version[a] != va or version[b] != vb or max(degree[a], degree[b]) > RING:
            continue
        x, y, z, _, _ = meeting_point(quadrics, points, a, b, q)
        prune(a, faces, head, tail, after)
        prune(b, faces, head, tail, after)
        if pinches(a, b, faces, head, after, ring, other):
            continue
        if folds(a, b, x, y, z, points, faces, head, after):
            continue
        if folds(b, a, x, y, z, points, faces, head, after):
            continue
        if beyond(a, x, y, z, limits[0], planes, plane_head, plane_after, corners):
            continue
        if beyond(b, x, y, z, limits[0], planes, plane_head, plane_after, corners):
            continue
        n = wedges_meeting(a, b, faces, wedges, head, after, own, group)
        if n < 0:
            continue
        slide, change = meeting_values(
            a, b, x, y, z, points, faces, wedges, values, head, after, own, group, n, new, total,
            checked,
        )  # fmt: skip
        slide += max(moved[a, 0], moved[b, 0])
        change += max(moved[a, 1], moved[b, 1])
        if slide > limits[1] or change > limits[2]:
            continue
        for v in (a, b):
            corner = head[v]
            while corner >= 0:
                f = corner // 3
                if v == b and (faces[f, 0] == a or faces[f, 1] == a or faces[f, 2] == a):
                    for k in range(3):
                        degree[faces[f, k]] -= 1
                    faces[f] = -1
                    living -= 1
                else:
                    i = 0
                    while own[i] != wedges[f, corner % 3]:
                        i += 1
                    wedges[f, corner % 3] = own[group[i]]
                    if v == b:
                        faces[f, corner % 3] = a
                corner = after[corner]
        for i in range(n):
            for k in range(values.shape[1]):
                values[own[i], k] = new[group[i], k]
        join(a, b, head, tail, after)
        join(a, b, plane_head, plane_tail, plane_after)
        degree[a] += degree[b]
        points[a, 0], points[a, 1], points[a, 2] = x, y, z
        for k in range(10):
            quadrics[a, k] += quadrics[b, k]
        moved[a, 0], moved[a, 1] = slide, change
        version[a] += np.int32(1)
        version[b] = -1
        prune(a, faces, head, tail, after)
        n = neighbours(a, b, faces, head, after, ring)
        for i in range(n):
            w = np.int32(ring[i])
            if version[w] < 0:
                continue
            _, _, _, off, tie = meeting_point(quadrics, points, a, w, q)
            if off <= limits[0] * limits[0] * (q[0] + q[4] + q[7]):
                heapq.heappush(heap, (off + tie, a, w, version[a], version[w]))
