# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled simplification: groups of equal rows, quadrics, collapsing edges."""

from __future__ import annotations

import heapq
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.jit import kernel


@kernel
def fill_groups(keys, table, group, first):
    """Fill `group` and `first` by open addressing in `table`, whose length is a power of two."""
    mask = np.uint64(len(table) - 1)
    count = 0
    for i in range(len(keys)):
        h = np.uint64(0)
        for k in range(keys.shape[1]):
            h = (h ^ np.uint64(keys[i, k])) * np.uint64(0x9E3779B97F4A7C15)
            h ^= h >> np.uint64(32)
        at = h & mask
        while True:
            g = table[at]
            if g < 0:
                table[at] = count
                first[count] = i
                group[i] = count
                count += 1
                break
            same = True
            for k in range(keys.shape[1]):
                same &= keys[first[g], k] == keys[i, k]
            if same:
                group[i] = g
                break
            at = (at + np.uint64(1)) & mask
    return count


BORDER = 10.0
"""Weight of the plane of a border edge, relative to a face's: open sheets keep their outline."""
STUBBY = 1e-4
"""Share of the squared edge length [m^2 of error per m^2 of area] that breaks ties on flat parts:
short edges go first, and triangles stay fat."""


@kernel
def face_normal(points, faces, f):
    """Return normal of a face as three numbers, its length twice the area."""
    a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
    x, y, z = points[a, 0], points[a, 1], points[a, 2]
    u0, u1, u2 = points[b, 0] - x, points[b, 1] - y, points[b, 2] - z
    v0, v1, v2 = points[c, 0] - x, points[c, 1] - y, points[c, 2] - z
    return u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0


@kernel
def compute_barycentrics(f, x, y, z, points, faces):
    """Compute weights of corners 1 and 2 of a face, continued linearly to a point; NaN without area."""
    a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
    x0, y0, z0 = points[a, 0], points[a, 1], points[a, 2]
    u0, u1, u2 = points[b, 0] - x0, points[b, 1] - y0, points[b, 2] - z0
    v0, v1, v2 = points[c, 0] - x0, points[c, 1] - y0, points[c, 2] - z0
    w0, w1, w2 = x - x0, y - y0, z - z0
    uu, uv, vv = (
        u0 * u0 + u1 * u1 + u2 * u2,
        u0 * v0 + u1 * v1 + u2 * v2,
        v0 * v0 + v1 * v1 + v2 * v2,
    )
    wu, wv = w0 * u0 + w1 * u1 + w2 * u2, w0 * v0 + w1 * v1 + w2 * v2
    det = uu * vv - uv * uv
    if det <= 1e-10 * uu * vv:
        return np.nan, np.nan
    return (vv * wu - uv * wv) / det, (uu * wv - uv * wu) / det


@kernel
def metres_per_uv(f, points, faces, wedges, values):
    """Return length on the surface of one unit of texture coordinates of face f [m]; 0 where it has none."""
    n0, n1, n2 = face_normal(points, faces, f)
    a, b, c = wedges[f, 0], wedges[f, 1], wedges[f, 2]
    d0, d1 = values[b, 0] - values[a, 0], values[b, 1] - values[a, 1]
    e0, e1 = values[c, 0] - values[a, 0], values[c, 1] - values[a, 1]
    twice = abs(d0 * e1 - d1 * e0)
    return np.sqrt(np.sqrt(n0 * n0 + n1 * n1 + n2 * n2) / twice) if twice > 1e-12 else 0.0


@kernel
def wedges_meeting(a, b, faces, wedges, head, after, own, group):
    """Write the wedges of vertices a and b, and which become one as their edge vanishes.

    `own` gets wedges, `group` the row in `own` of each one's first fellow. Returns how many there
    are, or -1 where there are more than fit.
    """
    n = 0
    for v in (a, b):
        corner = head[v]
        while corner >= 0:
            w = wedges[corner // 3, corner % 3]
            known = False
            for i in range(n):
                known |= own[i] == w
            if not known:
                if n == len(own):
                    return -1
                own[n] = w
                group[n] = n
                n += 1
            corner = after[corner]
    corner = head[a]
    while corner >= 0:  # faces that vanish tie a wedge of a to one of b
        f = corner // 3
        for k in range(3):
            if faces[f, k] == b:
                i, j = 0, 0
                while own[i] != wedges[f, corner % 3]:
                    i += 1
                while own[j] != wedges[f, k]:
                    j += 1
                low, high = min(group[i], group[j]), max(group[i], group[j])
                for m in range(n):
                    if group[m] == high:
                        group[m] = low
        corner = after[corner]
    return n


@kernel
def meeting_values(
    a, b, x, y, z, points, faces, wedges, values, head, after, own, group, n, new, total, checked
):
    """Return attributes of each group of wedges where its vertices meet, and how far the worst face slides.

    A group that loses a face takes that face's values, continued to the point; another one the mean
    of its faces' values. Returns the greatest shift of a texture on the surface [m] and of the
    other attributes, if it is to be `checked`.
    """
    total[:n] = 0.0
    new[:n] = 0.0
    for vanishing in (True, False):
        for v in (a, b):
            corner = head[v]
            while corner >= 0:
                f = corner // 3
                fellow = b if v == a else a
                both = faces[f, 0] == fellow or faces[f, 1] == fellow or faces[f, 2] == fellow
                i = 0
                while own[i] != wedges[f, corner % 3]:
                    i += 1
                g = group[i]
                # second round: only groups that lost no face are open
                if both == vanishing and (vanishing or total[g] <= 0.0):
                    s, t = compute_barycentrics(f, x, y, z, points, faces)
                    if not np.isnan(s):
                        n0, n1, n2 = face_normal(points, faces, f)
                        weight = np.sqrt(n0 * n0 + n1 * n1 + n2 * n2) + 1e-12
                        for k in range(values.shape[1]):
                            new[g, k] += weight * value_at(f, s, t, wedges, values, k)
                        total[g] += weight if vanishing else -weight
                corner = after[corner]
        for g in range(n):
            if total[g] != 0.0:
                for k in range(new.shape[1]):
                    new[g, k] /= abs(total[g])
                total[g] = 1.0
    for i in range(n):
        if total[group[i]] == 0.0:  # nothing but slivers
            for k in range(values.shape[1]):
                new[group[i], k] = values[own[group[i]], k]
    if not checked:
        return 0.0, 0.0
    return measure_shift(a, b, x, y, z, points, faces, wedges, values, head, after, own, group, new)


@kernel
def value_at(f, s, t, wedges, values, k):
    """Return attribute k of face f where its corners 1 and 2 weigh s and t."""
    first = values[wedges[f, 0], k]
    return first + s * (values[wedges[f, 1], k] - first) + t * (values[wedges[f, 2], k] - first)


@kernel
def measure_shift(a, b, x, y, z, points, faces, wedges, values, head, after, own, group, new):
    """Return the slide [m] of textures of the faces that stay, and the change of other attributes."""
    slide, change = 0.0, 0.0
    for v in (a, b):
        corner = head[v]
        while corner >= 0:
            f = corner // 3
            fellow = b if v == a else a
            if faces[f, 0] != fellow and faces[f, 1] != fellow and faces[f, 2] != fellow:
                s, t = compute_barycentrics(f, x, y, z, points, faces)
                if not np.isnan(s):
                    i = 0
                    while own[i] != wedges[f, corner % 3]:
                        i += 1
                    g = group[i]
                    du = value_at(f, s, t, wedges, values, 0) - new[g, 0]
                    dv = value_at(f, s, t, wedges, values, 1) - new[g, 1]
                    step = np.sqrt(du * du + dv * dv)
                    if step > 0.0:
                        step *= metres_per_uv(f, points, faces, wedges, values)
                        slide = max(slide, step)
                    for k in range(2, values.shape[1]):
                        off = value_at(f, s, t, wedges, values, k) - new[g, k]
                        change = max(change, abs(off))
            corner = after[corner]
    return slide, change


@kernel
def add_plane(quadric, n0, n1, n2, offset, weight):
    """Add weight * (normal . x + offset)^2 to a quadric (10,): upper triangle of a 4 x 4 matrix."""
    quadric[0] += weight * n0 * n0
    quadric[1] += weight * n0 * n1
    quadric[2] += weight * n0 * n2
    quadric[3] += weight * n0 * offset
    quadric[4] += weight * n1 * n1
    quadric[5] += weight * n1 * n2
    quadric[6] += weight * n1 * offset
    quadric[7] += weight * n2 * n2
    quadric[8] += weight * n2 * offset
    quadric[9] += weight * offset * offset


@kernel
def error(q, x, y, z):
    """Return value of a quadric (10,) at a point."""
    return (
        q[0] * x * x + 2 * q[1] * x * y + 2 * q[2] * x * z + 2 * q[3] * x + q[4] * y * y
        + 2 * q[5] * y * z + 2 * q[6] * y + q[7] * z * z + 2 * q[8] * z + q[9]
    )  # fmt: skip


@kernel
def meeting_point(quadrics, points, a, b, q):
    """Find where vertices a and b meet with least error; `q` (10,) gets their quadric."""
    for k in range(10):
        q[k] = quadrics[a, k] + quadrics[b, k]
    a0, a1, a2 = points[a, 0], points[a, 1], points[a, 2]
    b0, b1, b2 = points[b, 0], points[b, 1], points[b, 2]
    best, x, y, z = np.inf, a0, a1, a2
    # the minimum of the quadric, if it lies near the edge
    c00, c01, c02 = q[4] * q[7] - q[5] * q[5], q[2] * q[5] - q[1] * q[7], q[1] * q[5] - q[2] * q[4]
    det = q[0] * c00 + q[1] * c01 + q[2] * c02
    length = (a0 - b0) ** 2 + (a1 - b1) ** 2 + (a2 - b2) ** 2
    size = q[0] + q[4] + q[7]
    if abs(det) > 1e-6 * size * size * size:
        c11, c12, c22 = (
            q[0] * q[7] - q[2] * q[2],
            q[1] * q[2] - q[0] * q[5],
            q[0] * q[4] - q[1] * q[1],
        )
        m0 = -(c00 * q[3] + c01 * q[6] + c02 * q[8]) / det
        m1 = -(c01 * q[3] + c11 * q[6] + c12 * q[8]) / det
        m2 = -(c02 * q[3] + c12 * q[6] + c22 * q[8]) / det
        d0, d1, d2 = m0 - (a0 + b0) / 2, m1 - (a1 + b1) / 2, m2 - (a2 + b2) / 2
        if d0 * d0 + d1 * d1 + d2 * d2 <= length:
            best, x, y, z = error(q, m0, m1, m2), m0, m1, m2
    for share in (0.5, 0.0, 1.0):
        p0, p1, p2 = a0 + share * (b0 - a0), a1 + share * (b1 - a1), a2 + share * (b2 - a2)
        e = error(q, p0, p1, p2)
        if e < best * (1 - 1e-9) - 1e-18:
            best, x, y, z = e, p0, p1, p2
    return x, y, z, max(best, 0.0), STUBBY * length * length


@kernel
def compute_planes(points, faces, ends, side):
    """Compute planes (F + B, 4) of the faces, and of the borders: upright on their face, or zeros."""
    planes = np.zeros((len(faces) + len(ends), 4))
    for f in range(len(faces)):
        n0, n1, n2 = face_normal(points, faces, f)
        twice = np.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
        if twice > 0:
            put_plane(planes[f], n0 / twice, n1 / twice, n2 / twice, points, faces[f, 0])
    for e in range(len(ends)):
        n0, n1, n2 = face_normal(points, faces, side[e])
        a, b = ends[e]
        d0, d1, d2 = (
            points[b, 0] - points[a, 0],
            points[b, 1] - points[a, 1],
            points[b, 2] - points[a, 2],
        )
        w0, w1, w2 = n1 * d2 - n2 * d1, n2 * d0 - n0 * d2, n0 * d1 - n1 * d0
        length = np.sqrt(w0 * w0 + w1 * w1 + w2 * w2)
        if length > 0:
            put_plane(
                planes[len(faces) + e], w0 / length, w1 / length, w2 / length, points, ends[e, 0]
            )
    return planes


@kernel
def put_plane(plane, n0, n1, n2, points, v):
    """Write the plane (4,) with a unit normal through a vertex."""
    plane[0], plane[1], plane[2] = n0, n1, n2
    plane[3] = -(n0 * points[v, 0] + n1 * points[v, 1] + n2 * points[v, 2])


@kernel
def compute_quadrics(points, faces, ends, planes):
    """Compute quadrics (V, 10) of the planes of the faces and of the borders, weighted by area."""
    quadrics = np.zeros((len(points), 10))
    for f in range(len(faces)):
        n0, n1, n2 = face_normal(points, faces, f)
        weight = np.sqrt(n0 * n0 + n1 * n1 + n2 * n2) / 6
        p = planes[f]
        for k in range(3):
            add_plane(quadrics[faces[f, k]], p[0], p[1], p[2], p[3], weight)
    for e in range(len(ends)):
        p = planes[len(faces) + e]
        weight = 0.0
        for k in range(3):
            weight += BORDER * (points[ends[e, 1], k] - points[ends[e, 0], k]) ** 2
        for k in range(2):
            add_plane(quadrics[ends[e, k]], p[0], p[1], p[2], p[3], weight)
    return quadrics


TURN = 0.3  # Cosine of the angle that a face may turn in one collapse
RING = 250  # Vertices of more faces than this stay where they are


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
def is_folded(v, other, x, y, z, points, faces, head, after):
    """Return whether a face of v, but not of both, would turn over or vanish if v moved to x, y, z."""
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
def exceeds_limit(v, x, y, z, limit, planes, head, after, corners):
    """Return whether a point is farther than the limit from an original plane that a vertex stands for."""
    node = head[v]
    while node >= 0:
        # nodes beyond the corners are the ends of borders, two each
        p = node // 3 if node < corners else corners // 3 + (node - corners) // 2
        if abs(planes[p, 0] * x + planes[p, 1] * y + planes[p, 2] * z + planes[p, 3]) > limit:
            return True
        node = after[node]
    return False


@kernel
def link_corners(count, faces, ends):
    """Link the corners of faces, and then the ends (B, 2) of borders, by vertex.

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
def is_pinched(a, b, faces, head, after, ring, other):
    """Return whether the surface would be pinched, or a closed part vanish, if a and b became one."""
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


class CollapsePart(NamedTuple):
    """Triangles to simplify; `collapse` changes points, faces, wedges and values in place."""

    points: NDArray[np.float64]  # (V, 3)
    faces: NDArray[np.int32]  # (F, 3) rows of points; -1: dead
    edges: NDArray[np.int32]  # (E, 2) rows of points, every edge once
    border: NDArray[np.int64]  # (E,) face of an edge that is kept in its place, or -1
    wedges: NDArray[np.int32]  # (F, 3) row of `values` of every corner
    values: NDArray[np.float64]  # (W, D) texture coordinates u and v, then other attributes
    locked: NDArray[np.bool_]  # (V,) whether a point stays


@kernel
def queue_edges(points, edges, quadrics, version, limit):
    """Return a heap of the edges that may collapse: cost, ends, versions of the ends."""
    q = np.empty(10)
    heap = [(0.0, np.int32(0), np.int32(0), np.int32(0), np.int32(0)) for _ in range(0)]
    for e in range(len(edges)):
        a, b = np.int32(edges[e, 0]), np.int32(edges[e, 1])
        _, _, _, off, tie = meeting_point(quadrics, points, a, b, q)
        # the mean of squared distances is no more than the largest: these would never pass
        near = off <= limit * limit * (q[0] + q[4] + q[7])
        if near and version[a] == 0 and version[b] == 0:
            heap.append((off + tie, a, b, np.int32(0), np.int32(0)))
    heapq.heapify(heap)
    return heap


@kernel
def queue_neighbours(heap, a, ring, points, quadrics, version, limit):
    """Push the edges from vertex a to the vertices of its ring."""
    q = np.empty(10)
    for i in range(len(ring)):
        w = np.int32(ring[i])
        if version[w] < 0:
            continue
        _, _, _, off, tie = meeting_point(quadrics, points, a, w, q)
        if off <= limit * limit * (q[0] + q[4] + q[7]):
            heapq.heappush(heap, (off + tie, a, w, version[a], version[w]))


@kernel
def merge_faces(a, b, faces, wedges, head, after, own, group, degree):
    """Give the faces of vertex b to vertex a; returns how many died, those of both."""
    died = 0
    for v in (a, b):
        corner = head[v]
        while corner >= 0:
            f = corner // 3
            if v == b and (faces[f, 0] == a or faces[f, 1] == a or faces[f, 2] == a):
                for k in range(3):
                    degree[faces[f, k]] -= 1
                faces[f] = -1
                died += 1
            else:
                i = 0
                while own[i] != wedges[f, corner % 3]:
                    i += 1
                wedges[f, corner % 3] = own[group[i]]
                if v == b:
                    faces[f, corner % 3] = a
            corner = after[corner]
    degree[a] += degree[b]
    return died


@kernel
def collapse(part, target, limits):
    """Collapse edges of a `CollapsePart`, cheapest first, until `target` faces live; in place.

    `limits`: (3,) greatest distance from the original planes [m], slide of a texture [m] and change
    of the other attributes.
    """
    points, faces, wedges, values = part.points, part.faces, part.wedges, part.values
    kept = np.flatnonzero(part.border >= 0)
    ends = part.edges[kept]
    planes = compute_planes(points, faces, ends, part.border[kept])
    quadrics = compute_quadrics(points, faces, ends, planes)
    plane_head, plane_tail, plane_after = link_corners(len(points), faces, ends)
    head, tail, after = link_corners(len(points), faces, ends[:0])
    corners = 3 * len(faces)
    degree = np.zeros(len(points), np.int32)
    for f in range(len(faces)):
        for k in range(3):
            degree[faces[f, k]] += 1
    version = np.zeros(len(points), np.int32)
    version[part.locked] = -1
    moved = np.zeros((len(points), 2))  # slide and change so far
    # attributes can speak against a collapse where a texture has more than one texel
    textured = (values[:, 0] != values[0, 0]) | (values[:, 1] != values[0, 1])
    checked = limits[2] < np.inf or textured.any()
    heap = queue_edges(points, part.edges, quadrics, version, limits[0])
    living, q = len(faces), np.empty(10)
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
        if (
            is_pinched(a, b, faces, head, after, ring, other)
            or is_folded(a, b, x, y, z, points, faces, head, after)
            or is_folded(b, a, x, y, z, points, faces, head, after)
            or exceeds_limit(a, x, y, z, limits[0], planes, plane_head, plane_after, corners)
            or exceeds_limit(b, x, y, z, limits[0], planes, plane_head, plane_after, corners)
        ):
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
        living -= merge_faces(a, b, faces, wedges, head, after, own, group, degree)
        for i in range(n):
            values[own[i]] = new[group[i]]
        join(a, b, head, tail, after)
        join(a, b, plane_head, plane_tail, plane_after)
        points[a, 0], points[a, 1], points[a, 2] = x, y, z
        quadrics[a] += quadrics[b]
        moved[a, 0], moved[a, 1] = slide, change
        version[a] += np.int32(1)
        version[b] = -1
        prune(a, faces, head, tail, after)
        n = neighbours(a, b, faces, head, after, ring)
        queue_neighbours(heap, a, ring[:n], points, quadrics, version, limits[0])
