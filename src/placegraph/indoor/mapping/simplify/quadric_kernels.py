# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled loops of mesh simplification: where two vertices meet, with which colours and coordinates.

A wedge is what the faces around a vertex that look alike there share; where a texture jumps, at a
seam, a vertex has several. Lists of corners: `placegraph.indoor.mapping.simplify.collapse_kernels`.
"""

from __future__ import annotations

import numpy as np

from placegraph.core.jit import kernel

BORDER = 10.0
"""How much more a border edge's plane weighs than a face's: open sheets keep their outline."""
STUBBY = 1e-4
"""Share of the squared edge length [m^2 of error per m^2 of area] that breaks ties on flat parts:
short edges go first, and triangles stay fat."""


@kernel
def face_normal(points, faces, f):
    """Normal of a face as three numbers, its length twice the area."""
    a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
    x, y, z = points[a, 0], points[a, 1], points[a, 2]
    u0, u1, u2 = points[b, 0] - x, points[b, 1] - y, points[b, 2] - z
    v0, v1, v2 = points[c, 0] - x, points[c, 1] - y, points[c, 2] - z
    return u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0


@kernel
def shares_at(f, x, y, z, points, faces):
    """Weights of corners 1 and 2 of a face, continued linearly to a point; NaN without area."""
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
    """Length on the surface of one unit of texture coordinates of face f [m]; 0 where it has none."""
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
    """Attributes of each group of wedges where its vertices meet, and how far the worst face slides.

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
                    s, t = shares_at(f, x, y, z, points, faces)
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
    return shift_of(a, b, x, y, z, points, faces, wedges, values, head, after, own, group, new)


@kernel
def value_at(f, s, t, wedges, values, k):
    """Attribute k of face f where its corners 1 and 2 weigh s and t."""
    first = values[wedges[f, 0], k]
    return first + s * (values[wedges[f, 1], k] - first) + t * (values[wedges[f, 2], k] - first)


@kernel
def shift_of(a, b, x, y, z, points, faces, wedges, values, head, after, own, group, new):
    """How far the texture of faces that stay would slide [m], and other attributes change."""
    slide, change = 0.0, 0.0
    for v in (a, b):
        corner = head[v]
        while corner >= 0:
            f = corner // 3
            fellow = b if v == a else a
            if faces[f, 0] != fellow and faces[f, 1] != fellow and faces[f, 2] != fellow:
                s, t = shares_at(f, x, y, z, points, faces)
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
    """Value of a quadric (10,) at a point."""
    return (
        q[0] * x * x + 2 * q[1] * x * y + 2 * q[2] * x * z + 2 * q[3] * x + q[4] * y * y
        + 2 * q[5] * y * z + 2 * q[6] * y + q[7] * z * z + 2 * q[8] * z + q[9]
    )  # fmt: skip


@kernel
def meeting_point(quadrics, points, a, b, q):
    """Where vertices a and b meet with least error, and that error; `q` (10,) gets their quadric."""
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
def planes_of(points, faces, ends, side):
    """Planes (F + B, 4) of the faces, and of the borders: upright on their face, or zeros."""
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
def quadrics_of(points, faces, ends, planes):
    """Quadrics (V, 10) of the planes of the faces and of the borders, weighted by area."""
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
