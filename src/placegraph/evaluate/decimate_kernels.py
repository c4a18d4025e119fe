"""Compiled loops of mesh decimation; see `decimate`.

Faces around a vertex are a linked list of corners (corner = 3 * face + k): when two vertices become
one their lists are joined end to end. Stale heap entries are told by the vertices' versions.
"""

from __future__ import annotations

import heapq

import numpy as np
from numba import njit

BORDER = 10.0
"""How much more a border edge's plane weighs than a face's: open sheets keep their outline."""
STUBBY = 1e-4
"""Share of the squared edge length [m^2 of error per m^2 of area] that breaks ties on flat parts:
short edges go first, and triangles stay fat."""
TURN = 0.3
"""Cosine of the angle that a face may turn in one collapse."""


@njit(cache=True)
def face_normal(points, faces, f):
    """Normal of a face, its length twice the area."""
    a, b, c = points[faces[f, 0]], points[faces[f, 1]], points[faces[f, 2]]
    u0, u1, u2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    v0, v1, v2 = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    return np.array([u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0])


@njit(cache=True)
def add_plane(quadric, normal, offset, weight):
    """Add weight * (normal . x + offset)^2 to a quadric (10,): upper triangle of a 4 x 4 matrix."""
    n0, n1, n2 = normal
    terms = (
        n0 * n0, n0 * n1, n0 * n2, n0 * offset, n1 * n1,
        n1 * n2, n1 * offset, n2 * n2, n2 * offset, offset * offset,
    )  # fmt: skip
    for k in range(10):
        quadric[k] += weight * terms[k]


@njit(cache=True)
def error(q, x, y, z):
    """Value of a quadric (10,) at a point."""
    return (
        q[0] * x * x + 2 * q[1] * x * y + 2 * q[2] * x * z + 2 * q[3] * x + q[4] * y * y
        + 2 * q[5] * y * z + 2 * q[6] * y + q[7] * z * z + 2 * q[8] * z + q[9]
    )  # fmt: skip


@njit(cache=True)
def meeting_point(q, a, b):
    """Where two vertices a, b (3,) meet with least error, and that error."""
    best, at = np.inf, a.copy()
    # the minimum of the quadric, if it lies near the edge
    c00, c01, c02 = q[4] * q[7] - q[5] * q[5], q[2] * q[5] - q[1] * q[7], q[1] * q[5] - q[2] * q[4]
    det = q[0] * c00 + q[1] * c01 + q[2] * c02
    length = (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2
    size = q[0] + q[4] + q[7]
    if abs(det) > 1e-6 * size**3:
        c11, c12, c22 = (
            q[0] * q[7] - q[2] * q[2],
            q[1] * q[2] - q[0] * q[5],
            q[0] * q[4] - q[1] * q[1],
        )
        x = -(c00 * q[3] + c01 * q[6] + c02 * q[8]) / det
        y = -(c01 * q[3] + c11 * q[6] + c12 * q[8]) / det
        z = -(c02 * q[3] + c12 * q[6] + c22 * q[8]) / det
        m0, m1, m2 = (a[0] + b[0]) / 2, (a[1] + b[1]) / 2, (a[2] + b[2]) / 2
        if (x - m0) ** 2 + (y - m1) ** 2 + (z - m2) ** 2 <= length:
            best = error(q, x, y, z)
            at = np.array([x, y, z])
    for share in (0.5, 0.0, 1.0):
        p = a + share * (b - a)
        e = error(q, p[0], p[1], p[2])
        if e < best * (1 - 1e-9) - 1e-18:
            best, at = e, p
    return at, max(best, 0.0) + STUBBY * length * length


@njit(cache=True)
def neighbours(v, other, faces, head, after, out):
    """Write vertices that share a living face with v into `out`; how many they are."""
    n = 0
    corner = head[v]
    while corner >= 0:
        f = corner // 3
        if faces[f, 0] >= 0:
            for k in range(3):
                w = faces[f, k]
                if w != v and w != other:
                    known = False
                    for i in range(n):
                        known |= out[i] == w
                    if not known and n < len(out):
                        out[n] = w
                        n += 1
        corner = after[corner]
    return n


@njit(cache=True)
def folds(v, other, at, points, faces, head, after):
    """Whether a face of v, but not of both, would turn over or vanish if v moved to `at`."""
    corner = head[v]
    while corner >= 0:
        f = corner // 3
        if faces[f, 0] >= 0:
            has = faces[f, 0] == other or faces[f, 1] == other or faces[f, 2] == other
            if not has:
                old = face_normal(points, faces, f)
                kept = points[v].copy()
                points[v] = at
                new = face_normal(points, faces, f)
                points[v] = kept
                dot = old[0] * new[0] + old[1] * new[1] + old[2] * new[2]
                lengths = np.sqrt(np.sum(old * old) * np.sum(new * new))
                if dot <= TURN * lengths:
                    return True
        corner = after[corner]
    return False


@njit(cache=True)
def quadrics_of(points, faces, edges, border):
    """Quadrics (V, 10) of the planes of the faces and of the borders, weighted by area."""
    quadrics = np.zeros((len(points), 10))
    for f in range(len(faces)):
        n = face_normal(points, faces, f)
        twice = np.sqrt(np.sum(n * n))
        if twice > 0:
            n /= twice
            offset = -np.sum(n * points[faces[f, 0]])
            for k in range(3):
                add_plane(quadrics[faces[f, k]], n, offset, twice / 6)
    for e in range(len(edges)):
        if border[e] < 0:
            continue
        n = face_normal(points, faces, border[e])
        along = points[edges[e, 1]] - points[edges[e, 0]]
        wall = np.cross(n, along)
        length = np.sqrt(np.sum(wall * wall))
        if length > 0:
            wall /= length
            offset = -np.sum(wall * points[edges[e, 0]])
            weight = BORDER * np.sum(along * along)
            for k in range(2):
                add_plane(quadrics[edges[e, k]], wall, offset, weight)
    return quadrics


@njit(cache=True)
def collapse(points, faces, edges, border, target):
    """Collapse edges, cheapest first, until `target` faces live; in place.

    `points`: (V, 3) float64; `faces`: (F, 3) int64, dead ones get -1; `edges`: (E, 2) int64,
    every edge once; `border`: (E,) int64, its only face, or -1 for an edge between faces. Returns
    the vertex (V,) that every vertex became part of.
    """
    quadrics = quadrics_of(points, faces, edges, border)
    head = np.full(len(points), -1)
    tail = np.full(len(points), -1)
    after = np.full(3 * len(faces), -1)
    for f in range(len(faces)):
        for k in range(3):
            v, corner = faces[f, k], 3 * f + k
            if head[v] < 0:
                head[v] = corner
            else:
                after[tail[v]] = corner
            tail[v] = corner
    version = np.zeros(len(points), np.int64)
    into = np.arange(len(points))
    heap = [(0.0, 0, 0, 0, 0) for _ in range(0)]
    for e in range(len(edges)):
        a, b = edges[e]
        _, cost = meeting_point(quadrics[a] + quadrics[b], points[a], points[b])
        heap.append((cost, a, b, 0, 0))
    heapq.heapify(heap)
    living = len(faces)
    ring, other = np.empty(256, np.int64), np.empty(256, np.int64)
    while living > target and len(heap) > 0:
        _, a, b, va, vb = heapq.heappop(heap)
        if version[a] != va or version[b] != vb:
            continue
        at, _ = meeting_point(quadrics[a] + quadrics[b], points[a], points[b])
        na = neighbours(a, b, faces, head, after, ring)
        nb = neighbours(b, a, faces, head, after, other)
        shared = 0
        for i in range(na):
            for j in range(nb):
                shared += ring[i] == other[j]
        joined, corner = 0, head[a]  # faces that vanish
        while corner >= 0:
            f = corner // 3
            joined += faces[f, 0] >= 0 and (
                faces[f, 0] == b or faces[f, 1] == b or faces[f, 2] == b
            )
            corner = after[corner]
        if shared != joined or na + nb - shared < 3 or max(na, nb) >= 250:
            continue  # the surface would be pinched, or a closed part vanish
        if folds(a, b, at, points, faces, head, after):
            continue
        if folds(b, a, at, points, faces, head, after):
            continue
        corner = head[b]
        while corner >= 0:
            f = corner // 3
            if faces[f, 0] >= 0:
                if faces[f, 0] == a or faces[f, 1] == a or faces[f, 2] == a:
                    faces[f] = -1
                    living -= 1
                else:
                    faces[f, corner % 3] = a
            corner = after[corner]
        after[tail[a]] = head[b]
        tail[a] = tail[b]
        points[a] = at
        quadrics[a] += quadrics[b]
        into[b] = a
        version[a] += 1
        version[b] = -1
        n = neighbours(a, b, faces, head, after, ring)
        for i in range(n):
            w = ring[i]
            _, cost = meeting_point(quadrics[a] + quadrics[w], points[a], points[w])
            heapq.heappush(heap, (cost, a, w, version[a], version[w]))
    return into
