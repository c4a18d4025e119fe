"""Compiled loops of mesh simplification; see `placegraph.indoor.simplify`.

Faces around a vertex are a linked list of corners (corner = 3 * face + k): when two vertices become
one their lists are joined end to end, dead faces included, so that a list names every plane of the
original surface that the vertex stands for. Stale heap entries are told by the vertices' versions.
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


@njit(cache=True, nogil=True)
def face_normal(points, faces, f):
    """Normal of a face, its length twice the area."""
    a, b, c = points[faces[f, 0]], points[faces[f, 1]], points[faces[f, 2]]
    u0, u1, u2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    v0, v1, v2 = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    return np.array([u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0])


@njit(cache=True, nogil=True)
def add_plane(quadric, normal, offset, weight):
    """Add weight * (normal . x + offset)^2 to a quadric (10,): upper triangle of a 4 x 4 matrix."""
    n0, n1, n2 = normal
    terms = (
        n0 * n0, n0 * n1, n0 * n2, n0 * offset, n1 * n1,
        n1 * n2, n1 * offset, n2 * n2, n2 * offset, offset * offset,
    )  # fmt: skip
    for k in range(10):
        quadric[k] += weight * terms[k]


@njit(cache=True, nogil=True)
def error(q, x, y, z):
    """Value of a quadric (10,) at a point."""
    return (
        q[0] * x * x + 2 * q[1] * x * y + 2 * q[2] * x * z + 2 * q[3] * x + q[4] * y * y
        + 2 * q[5] * y * z + 2 * q[6] * y + q[7] * z * z + 2 * q[8] * z + q[9]
    )  # fmt: skip


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def neighbours(v, other, faces, head, after, corners, out):
    """Write vertices that share a living face with v into `out`; how many they are."""
    n = 0
    corner = head[v]
    while corner >= 0:
        f = corner // 3
        if corner < corners and faces[f, 0] >= 0:
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


@njit(cache=True, nogil=True)
def folds(v, other, at, points, faces, head, after, corners):
    """Whether a face of v, but not of both, would turn over or vanish if v moved to `at`."""
    corner = head[v]
    while corner >= 0:
        f = corner // 3
        if corner < corners and faces[f, 0] >= 0:
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


@njit(cache=True, nogil=True)
def planes_of(points, faces, edges, border):
    """Planes (F + E, 4) of faces, and through border edges upright on their face; else zeros."""
    planes = np.zeros((len(faces) + len(edges), 4))
    for f in range(len(faces)):
        n = face_normal(points, faces, f)
        twice = np.sqrt(np.sum(n * n))
        if twice > 0:
            n /= twice
            planes[f, :3] = n
            planes[f, 3] = -np.sum(n * points[faces[f, 0]])
    for e in range(len(edges)):
        if border[e] < 0:
            continue
        n = face_normal(points, faces, border[e])
        wall = np.cross(n, points[edges[e, 1]] - points[edges[e, 0]])
        length = np.sqrt(np.sum(wall * wall))
        if length > 0:
            wall /= length
            planes[len(faces) + e, :3] = wall
            planes[len(faces) + e, 3] = -np.sum(wall * points[edges[e, 0]])
    return planes


@njit(cache=True, nogil=True)
def quadrics_of(points, faces, edges, planes):
    """Quadrics (V, 10) of the planes of the faces and of the borders, weighted by area."""
    quadrics = np.zeros((len(points), 10))
    for f in range(len(faces)):
        n = face_normal(points, faces, f)
        area = np.sqrt(np.sum(n * n)) / 2
        for k in range(3):
            add_plane(quadrics[faces[f, k]], planes[f, :3], planes[f, 3], area / 3)
    for e in range(len(edges)):
        plane = planes[len(faces) + e]
        along = points[edges[e, 1]] - points[edges[e, 0]]
        weight = BORDER * np.sum(along * along)
        for k in range(2):
            add_plane(quadrics[edges[e, k]], plane[:3], plane[3], weight)
    return quadrics


@njit(cache=True, nogil=True)
def farthest(v, at, planes, head, after, corners):
    """Greatest distance of a point from the original planes that a vertex stands for."""
    most = 0.0
    node = head[v]
    while node >= 0:
        # nodes beyond the corners are the ends of border edges, two an edge
        p = node // 3 if node < corners else corners // 3 + (node - corners) // 2
        d = abs(planes[p, 0] * at[0] + planes[p, 1] * at[1] + planes[p, 2] * at[2] + planes[p, 3])
        most = max(most, d)
        node = after[node]
    return most


@njit(cache=True, nogil=True)
def values_at(f, at, points, faces, wedges, values, out):
    """Attributes (D,) of face f, continued linearly to a point beside it; false without area."""
    a = points[faces[f, 0]]
    u, v, w = points[faces[f, 1]] - a, points[faces[f, 2]] - a, at - a
    uu, uv, vv, wu, wv = np.sum(u * u), np.sum(u * v), np.sum(v * v), np.sum(w * u), np.sum(w * v)
    det = uu * vv - uv * uv
    if det <= 1e-10 * uu * vv:
        return False
    s, t = (vv * wu - uv * wv) / det, (uu * wv - uv * wu) / det
    for k in range(values.shape[1]):
        x, y, z = values[wedges[f, 0], k], values[wedges[f, 1], k], values[wedges[f, 2], k]
        out[k] = x + s * (y - x) + t * (z - x)
    return True


@njit(cache=True, nogil=True)
def metres_per_uv(f, points, faces, wedges, values):
    """Length on the surface of one unit of texture coordinates of face f [m]; 0 where it has none."""
    n = face_normal(points, faces, f)
    a, b, c = values[wedges[f, 0]], values[wedges[f, 1]], values[wedges[f, 2]]
    twice = abs((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))
    return np.sqrt(np.sqrt(np.sum(n * n)) / twice) if twice > 1e-12 else 0.0


@njit(cache=True, nogil=True)
def wedges_meeting(a, b, faces, wedges, head, after, corners, own, group):
    """Write the wedges of vertices a and b, and which become one as their edge vanishes.

    `own` gets wedges, `group` the row in `own` of each one's first fellow. Returns how many there
    are, or -1 where there are more than fit.
    """
    n = 0
    for v in (a, b):
        node = head[v]
        while node >= 0:
            if node < corners and faces[node // 3, 0] >= 0:
                w = wedges[node // 3, node % 3]
                known = False
                for i in range(n):
                    known |= own[i] == w
                if not known:
                    if n == len(own):
                        return -1
                    own[n] = w
                    group[n] = n
                    n += 1
            node = after[node]
    node = head[a]
    while node >= 0:  # faces that vanish tie a wedge of a to one of b
        f = node // 3
        if node < corners and faces[f, 0] >= 0:
            for k in range(3):
                if faces[f, k] == b:
                    i, j = 0, 0
                    while own[i] != wedges[f, node % 3]:
                        i += 1
                    while own[j] != wedges[f, k]:
                        j += 1
                    low, high = min(group[i], group[j]), max(group[i], group[j])
                    for m in range(n):
                        if group[m] == high:
                            group[m] = low
        node = after[node]
    return n


@njit(cache=True, nogil=True)
def meeting_values(
    a, b, at, points, faces, wedges, values, head, after, corners, own, group, n, new
):
    """Attributes of each group of wedges where its vertices meet, and how far the worst face slides.

    A group that loses a face takes that face's values, continued to the point; another one the mean
    of its faces' values. Returns the greatest shift of a texture on the surface [m] and of the
    other attributes.
    """
    total = np.zeros(n)
    new[:n] = 0.0
    value = np.empty(values.shape[1])
    for vanishing in (True, False):
        for v in (a, b):
            node = head[v]
            while node >= 0:
                f = node // 3
                if node < corners and faces[f, 0] >= 0:
                    both = False
                    for k in range(3):
                        both |= faces[f, k] == (b if v == a else a)
                    i = 0
                    while own[i] != wedges[f, node % 3]:
                        i += 1
                    g = group[i]
                    # second round: only groups that lost no face are open
                    if both != vanishing or (total[g] > 0.0 and not vanishing):
                        pass
                    elif values_at(f, at, points, faces, wedges, values, value):
                        x = face_normal(points, faces, f)
                        weight = np.sqrt(np.sum(x * x)) + 1e-12
                        new[g] += weight * value
                        total[g] += weight if vanishing else -weight
                node = after[node]
        for g in range(n):
            if total[g] != 0.0:
                new[g] /= abs(total[g])
                total[g] = 1.0
    for i in range(n):
        if total[group[i]] == 0.0:  # nothing but slivers
            new[group[i]] = values[own[group[i]]]
    return shift_of(a, b, at, points, faces, wedges, values, head, after, corners, own, group, new)


@njit(cache=True, nogil=True)
def shift_of(a, b, at, points, faces, wedges, values, head, after, corners, own, group, new):
    """How far the texture of faces that stay would slide [m], and other attributes change."""
    slide, change = 0.0, 0.0
    value = np.empty(values.shape[1])
    for v in (a, b):
        node = head[v]
        while node >= 0:
            f = node // 3
            if node < corners and faces[f, 0] >= 0:
                both = False
                for k in range(3):
                    both |= faces[f, k] == (b if v == a else a)
                if not both and values_at(f, at, points, faces, wedges, values, value):
                    i = 0
                    while own[i] != wedges[f, node % 3]:
                        i += 1
                    difference = np.abs(value - new[group[i]])
                    step = np.sqrt(difference[0] ** 2 + difference[1] ** 2)
                    slide = max(slide, step * metres_per_uv(f, points, faces, wedges, values))
                    for k in range(2, values.shape[1]):
                        change = max(change, difference[k])
            node = after[node]
    return slide, change


@njit(cache=True, nogil=True)
def linked(points, faces, edges, planes):
    """Lists of the corners, and of the ends of border edges, of every vertex: head, tail, after."""
    corners = 3 * len(faces)
    head, tail = np.full(len(points), -1), np.full(len(points), -1)
    after = np.full(corners + 2 * len(edges), -1)
    for node in range(len(after)):
        if node < corners:
            v = faces[node // 3, node % 3]
        else:
            e = (node - corners) // 2
            plane = planes[len(faces) + e]
            if plane[0] == 0.0 and plane[1] == 0.0 and plane[2] == 0.0:
                continue
            v = edges[e, (node - corners) % 2]
        if head[v] < 0:
            head[v] = node
        else:
            after[tail[v]] = node
        tail[v] = node
    return head, tail, after


@njit(cache=True, nogil=True)
def pinches(a, b, faces, head, after, corners, ring, other):
    """Whether the surface would be pinched, or a closed part vanish, if a and b became one."""
    na = neighbours(a, b, faces, head, after, corners, ring)
    nb = neighbours(b, a, faces, head, after, corners, other)
    shared = 0
    for i in range(na):
        for j in range(nb):
            shared += ring[i] == other[j]
    joined, node = 0, head[a]  # faces that vanish
    while node >= 0:
        f = node // 3
        if node < corners and faces[f, 0] >= 0:
            joined += faces[f, 0] == b or faces[f, 1] == b or faces[f, 2] == b
        node = after[node]
    return shared != joined or na + nb - shared < 3 or max(na, nb) >= 250


@njit(cache=True, nogil=True)
def collapse(points, faces, edges, border, wedges, values, target, limits):
    """Collapse edges, cheapest first, until `target` faces live or the limits stop it; in place.

    `points`: (V, 3) float64; `faces`: (F, 3) int64, dead ones get -1; `edges`: (E, 2) int64,
    every edge once; `border`: (E,) int64, a face of an edge to be kept in its place, or -1;
    `wedges`: (F, 3) int64, row of `values` (W, D) of every corner, u and v first; `limits`: (3,)
    greatest distance from the original planes [m], slide of a texture [m], change of the other
    attributes.
    """
    planes = planes_of(points, faces, edges, border)
    quadrics = quadrics_of(points, faces, edges, planes)
    head, tail, after = linked(points, faces, edges, planes)
    corners = 3 * len(faces)
    version = np.zeros(len(points), np.int64)
    moved = np.zeros((len(points), 2))  # slide and change so far
    heap = [(0.0, 0, 0, 0, 0) for _ in range(0)]
    for e in range(len(edges)):
        a, b = edges[e]
        _, cost = meeting_point(quadrics[a] + quadrics[b], points[a], points[b])
        heap.append((cost, a, b, 0, 0))
    heapq.heapify(heap)
    living = len(faces)
    ring, other = np.empty(256, np.int64), np.empty(256, np.int64)
    own, group = np.empty(64, np.int64), np.empty(64, np.int64)
    new = np.empty((64, values.shape[1]))
    while living > target and len(heap) > 0:
        _, a, b, va, vb = heapq.heappop(heap)
        if version[a] != va or version[b] != vb:
            continue
        at, _ = meeting_point(quadrics[a] + quadrics[b], points[a], points[b])
        if farthest(a, at, planes, head, after, corners) > limits[0]:
            continue
        if farthest(b, at, planes, head, after, corners) > limits[0]:
            continue
        if pinches(a, b, faces, head, after, corners, ring, other):
            continue
        if folds(a, b, at, points, faces, head, after, corners):
            continue
        if folds(b, a, at, points, faces, head, after, corners):
            continue
        n = wedges_meeting(a, b, faces, wedges, head, after, corners, own, group)
        if n < 0:
            continue
        slide, change = meeting_values(
            a, b, at, points, faces, wedges, values, head, after, corners, own, group, n, new
        )
        slide += max(moved[a, 0], moved[b, 0])
        change += max(moved[a, 1], moved[b, 1])
        if slide > limits[1] or change > limits[2]:
            continue
        for v in (a, b):
            node = head[v]
            while node >= 0:
                f = node // 3
                if node < corners and faces[f, 0] >= 0:
                    if v == b and (faces[f, 0] == a or faces[f, 1] == a or faces[f, 2] == a):
                        faces[f] = -1
                        living -= 1
                    else:
                        i = 0
                        while own[i] != wedges[f, node % 3]:
                            i += 1
                        wedges[f, node % 3] = own[group[i]]
                        if v == b:
                            faces[f, node % 3] = a
                node = after[node]
        for i in range(n):
            values[own[i]] = new[group[i]]
        after[tail[a]] = head[b]
        tail[a] = tail[b]
        points[a] = at
        quadrics[a] += quadrics[b]
        moved[a, 0], moved[a, 1] = slide, change
        version[a] += 1
        version[b] = -1
        n = neighbours(a, b, faces, head, after, corners, ring)
        for i in range(n):
            w = ring[i]
            _, cost = meeting_point(quadrics[a] + quadrics[w], points[a], points[w])
            heapq.heappush(heap, (cost, a, w, version[a], version[w]))
