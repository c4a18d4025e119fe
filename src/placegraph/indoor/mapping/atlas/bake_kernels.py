# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled loops that cut a surface into charts."""

from __future__ import annotations

from heapq import heappop, heappush

import numpy as np

from placegraph.core.jit import kernel

STRICT = 1e-3
"""Share of each corner that a texel's centre needs to lie inside a triangle beyond doubt."""


@kernel(error_model="numpy")
def grow(normals, areas, neighbours, order, chart_of, first, least):
    """Give every triangle without a chart (-1) one, from number `first` on; returns the next number.

    A chart grows from the first triangle in `order` over its best neighbours, as long as the cosine
    between their normals (T, 3) and its mean normal is at least `least`. Triangles without area,
    whose normal is zero, always come along.
    """
    chart = first
    for seed in order:
        if chart_of[seed] >= 0:
            continue
        x, y, z = 0.0, 0.0, 0.0
        heap = [(0.0, np.int64(seed))]
        while len(heap) > 0:
            _, row = heappop(heap)
            if chart_of[row] >= 0:
                continue
            a, b, c = normals[row]
            length = np.sqrt(x * x + y * y + z * z)
            if a * x + b * y + c * z < least * length and areas[row] > 0:
                continue
            chart_of[row] = chart
            x, y, z = x + areas[row] * a, y + areas[row] * b, z + areas[row] * c
            length = max(np.sqrt(x * x + y * y + z * z), 1e-30)
            for side in range(3):
                other = neighbours[row, side]
                if other >= 0 and chart_of[other] < 0:
                    p, q, r = normals[other]
                    heappush(heap, (1.0 - (p * x + q * y + r * z) / length, np.int64(other)))
        chart += 1
    return chart


@kernel(error_model="numpy")
def absorb(normals, neighbours, chart_of, planes, small, least):
    """Join the triangles of small charts (C,) to the larger neighbour whose plane suits them best."""
    changed = True
    while changed:
        changed = False
        for row in range(len(chart_of)):
            if not small[chart_of[row]]:
                continue
            best, found = least, -1
            for side in range(3):
                other = neighbours[row, side]
                if other < 0 or small[chart_of[other]]:
                    continue
                plane = planes[chart_of[other]]
                cosine = (
                    normals[row, 0] * plane[0]
                    + normals[row, 1] * plane[1]
                    + normals[row, 2] * plane[2]
                )
                if cosine > best:
                    best, found = cosine, chart_of[other]
            if found >= 0:
                chart_of[row] = found
                changed = True


@kernel(error_model="numpy")
def turns(corners, rows, starts, angles, gain):
    """Choose the angle (C,) that makes each chart's rectangle small; 0 unless that saves the share `gain`.

    `corners`: (T, 3, 2) on the charts' planes; chart c has `rows[starts[c] : starts[c + 1]]`.
    """
    out = np.zeros(len(starts) - 1)
    for chart in range(len(out)):
        least = np.inf
        for angle in angles:
            cosine, sine = np.cos(angle), np.sin(angle)
            left, right, top, bottom = np.inf, -np.inf, np.inf, -np.inf
            for row in rows[starts[chart] : starts[chart + 1]]:
                for k in range(3):
                    x, y = corners[row, k, 0], corners[row, k, 1]
                    across, down = cosine * x + sine * y, cosine * y - sine * x
                    left, right = min(left, across), max(right, across)
                    top, bottom = min(top, down), max(bottom, down)
            area = (right - left) * (bottom - top)
            if area < least:
                # the first angle, 0, sets a bar that others must clear
                least, out[chart] = area * (1.0 - gain) if angle == 0.0 else area, angle
    return out


@kernel(error_model="numpy")
def mark_overlaps(corners, rows, starts, sizes, twice, first, last):
    """Mark in `twice` (T,) what lies over another triangle of its chart, at the texels' centres.

    `corners`: (T, 3, 2) [texels] on each chart's grid, whose size is `sizes` (C, 2).
    Of two triangles at one place the first in `rows` stays.
    """
    for chart in range(first, last):
        if starts[chart + 1] - starts[chart] < 2:
            continue
        wide, high = int(sizes[chart, 0]), int(sizes[chart, 1])
        covered = np.zeros((high, wide), np.bool_)
        for row in rows[starts[chart] : starts[chart + 1]]:
            twice[row] = _covers(corners[row], covered, False)
            if not twice[row]:
                _covers(corners[row], covered, True)


@kernel(error_model="numpy")
def _covers(corner, covered, take):
    """Return whether a triangle (3, 2) covers a texel's centre that is taken; or take those it covers."""
    ax, ay = corner[0]
    bx, by = corner[1, 0] - ax, corner[1, 1] - ay
    cx, cy = corner[2, 0] - ax, corner[2, 1] - ay
    area = bx * cy - by * cx
    if area == 0:
        return False
    left = max(int(np.floor(corner[:, 0].min() - 0.5)), 0)
    top = max(int(np.floor(corner[:, 1].min() - 0.5)), 0)
    right = min(int(corner[:, 0].max() + 0.5) + 1, covered.shape[1])
    bottom = min(int(corner[:, 1].max() + 0.5) + 1, covered.shape[0])
    for i in range(top, bottom):
        for j in range(left, right):
            x, y = j + 0.5 - ax, i + 0.5 - ay
            u, v = (x * cy - y * cx) / area, (bx * y - by * x) / area
            if u > STRICT and v > STRICT and u + v < 1 - STRICT:
                if take:
                    covered[i, j] = True
                elif covered[i, j]:
                    return True
    return False


@kernel(error_model="numpy")
def spread(neighbours, colours, valid):
    """Colour unknown triangles (T, 3) like their known neighbours, ring by ring."""
    queue = np.empty(len(valid), np.int64)
    last = 0
    for row in range(len(valid)):
        if valid[row]:
            queue[last] = row
            last += 1
    first = 0
    while first < last:
        row = queue[first]
        first += 1
        for side in range(3):
            other = neighbours[row, side]
            if other >= 0 and not valid[other]:
                _mean_of(neighbours, colours, valid, other)
                valid[other] = True
                queue[last] = other
                last += 1


@kernel(error_model="numpy")
def _mean_of(neighbours, colours, valid, row):
    count = 0
    colours[row] = 0.0
    for side in range(3):
        other = neighbours[row, side]
        if other >= 0 and valid[other]:
            colours[row] += colours[other]
            count += 1
    colours[row] /= count


REACH = 1.5
"""Texels this far from a chart are coloured like its nearest point: bilinear looks touch them."""
BLOCK = 8  # Errors are means over blocks of so many texels a side, as JPEG's
FEW = 16.0  # A block with fewer samples than this counts as if the others had no error
NOTHING, UNSEEN, SEEN = 0, 1, 2
FLAT, DARK = -1, -2  # Instead of a level: a chart of one colour, and one of which nothing is known


@kernel(error_model="numpy")
def cover(corners, rows, starts, sizes, extents, firsts, margin, owner, shares, start, end):
    """Find the triangle and the place in it that each texel of charts `start` to `end` shows.

    Parameters
    ----------
    corners
        (T, 3, 2) of triangles on their charts [texels].
    rows, starts
        Triangles of chart c: `rows[starts[c] : starts[c + 1]]`.
    sizes
        (C, 2) width and height of each chart's grid, margins included [texels].
    extents
        (C, 2) width and height of each chart itself [texels].
    firsts
        (C,) first texel of each grid.
    margin
        Texels around a chart.
    owner
        (P,) int32, filled with triangles; -1 where no chart is near.
    shares
        (P, 2) float32, filled with weights of corners 1 and 2 of the nearest point.

    """
    for chart in range(start, end):
        wide, high = sizes[chart, 0], sizes[chart, 1]
        first = firsts[chart]
        off = np.full(wide * high, REACH * REACH, np.float32)
        left = margin + 0.5 * (wide - 2 * margin - extents[chart, 0])
        top = margin + 0.5 * (high - 2 * margin - extents[chart, 1])
        for row in rows[starts[chart] : starts[chart + 1]]:
            corner = corners[row]
            x0 = max(int(np.floor(corner[:, 0].min() + left - REACH - 0.5)), 0)
            y0 = max(int(np.floor(corner[:, 1].min() + top - REACH - 0.5)), 0)
            x1 = min(int(corner[:, 0].max() + left + REACH) + 1, wide)
            y1 = min(int(corner[:, 1].max() + top + REACH) + 1, high)
            for i in range(y0, y1):
                for j in range(x0, x1):
                    u, v, d = _nearest(corner, j + 0.5 - left, i + 0.5 - top)
                    at = i * wide + j
                    if d < off[at]:
                        off[at] = d
                        owner[first + at] = row
                        shares[first + at, 0], shares[first + at, 1] = u, v


@kernel(error_model="numpy")
def _nearest(corner, x, y):
    """Return weights of corners 1 and 2 of the point of a triangle (3, 2) nearest to (x, y); distance^2."""
    ax, ay = corner[0, 0], corner[0, 1]
    bx, by = corner[1, 0] - ax, corner[1, 1] - ay
    cx, cy = corner[2, 0] - ax, corner[2, 1] - ay
    px, py = x - ax, y - ay
    area = bx * cy - by * cx
    if area != 0:
        u, v = (px * cy - py * cx) / area, (bx * py - by * px) / area
        if u >= 0 and v >= 0 and u + v <= 1:
            return u, v, 0.0
    best, u, v = np.inf, 0.0, 0.0
    for side in range(3):
        if side == 0:  # a + s (b - a)
            ox, oy, ex, ey = 0.0, 0.0, bx, by
        elif side == 1:  # b + s (c - b)
            ox, oy, ex, ey = bx, by, cx - bx, cy - by
        else:  # c + s (a - c)
            ox, oy, ex, ey = cx, cy, -cx, -cy
        length = ex * ex + ey * ey
        s = ((px - ox) * ex + (py - oy) * ey) / length if length > 0 else 0.0
        s = min(max(s, 0.0), 1.0)
        d = (ox + s * ex - px) ** 2 + (oy + s * ey - py) ** 2
        if d < best:
            best = d
            u = s if side == 0 else (1.0 - s if side == 1 else 0.0)
            v = 0.0 if side == 0 else (s if side == 1 else 1.0 - s)
    return u, v, best


@kernel(error_model="numpy")
def choose(colours, state, sizes, extents, firsts, margin, tolerance, levels, means, start, end):
    """Choose the coarsest level (C,) int32 of each chart that keeps its content; also mean colours (C, 3).

    At level l a texel is 2^l texels wide. A level will do if what a renderer would show differs
    from the samples by at most `tolerance` of 255 (root of the mean square over each block).
    """
    for chart in range(start, end):
        wide, high = sizes[chart, 0], sizes[chart, 1]
        first = firsts[chart]
        last = first + wide * high
        mean, seen = np.zeros(3), 0
        for at in range(first, last):
            if state[at] == SEEN:
                mean += colours[at]
                seen += 1
        if seen == 0:
            levels[chart] = DARK
            continue
        mean /= seen
        means[chart] = mean
        own, marks = colours[first:last], state[first:last]
        image, weight = mean.astype(np.float32).reshape(1, 1, 3), np.ones((1, 1), np.float32)
        if _error(own, marks, wide, high, image, weight, 0.0, 0.0, 0.0) <= tolerance:
            levels[chart] = FLAT
            continue
        level = 0
        while (1 << (level + 1)) < max(extents[chart, 0], extents[chart, 1]):
            level += 1
        while level > 0:
            image, weight = shrink_chart(own, marks, wide, high, extents[chart], margin, level)
            x, y, scale = _frame(wide, high, extents[chart], margin, level)
            if _error(own, marks, wide, high, image, weight, x, y, scale) <= tolerance:
                break
            level -= 1
        levels[chart] = level


@kernel(error_model="numpy")
def grid(extent, margin, level):
    """Return texels along a chart of this extent [texels of level 0], margins included."""
    return max(int(np.ceil(extent / (1 << level) - 1e-6)), 1) + 2 * margin


@kernel(error_model="numpy")
def _frame(wide, high, extent, margin, level):
    """Return x0, y0, scale: texel (j, i) of level 0 has its centre at x0 + scale j, y0 + scale i."""
    scale = 1.0 / (1 << level)
    x = margin + 0.5 * (grid(extent[0], margin, level) - 2 * margin - extent[0] * scale)
    y = margin + 0.5 * (grid(extent[1], margin, level) - 2 * margin - extent[1] * scale)
    left = margin + 0.5 * (wide - 2 * margin - extent[0])
    top = margin + 0.5 * (high - 2 * margin - extent[1])
    return x + (0.5 - left) * scale, y + (0.5 - top) * scale, scale


@kernel(error_model="numpy")
def shrink_chart(colours, state, wide, high, extent, margin, level):
    """Shrink a chart's image (h, w, 3) to a level; also counts the samples of each texel (h, w)."""
    columns, rows = grid(extent[0], margin, level), grid(extent[1], margin, level)
    x, y, scale = _frame(wide, high, extent, margin, level)
    image = np.zeros((rows, columns, 3), np.float32)
    weight = np.zeros((rows, columns), np.float32)
    for i in range(high):
        for j in range(wide):
            at = i * wide + j
            if state[at] != SEEN:
                continue
            row = min(max(int(y + scale * i), 0), rows - 1)
            column = min(max(int(x + scale * j), 0), columns - 1)
            weight[row, column] += 1
            for k in range(3):
                image[row, column, k] += colours[at, k]
    for row in range(rows):
        for column in range(columns):
            if weight[row, column] > 0:
                image[row, column] /= weight[row, column]
    return image, weight


@kernel(error_model="numpy")
def _error(colours, state, wide, high, image, weight, x, y, scale):
    """Return largest error of a block: of an image, between its texels, against the samples."""
    rows, columns = weight.shape
    across = (wide + BLOCK - 1) // BLOCK
    down = (high + BLOCK - 1) // BLOCK
    error, count = np.zeros((down, across)), np.zeros((down, across))
    for i in range(high):
        for j in range(wide):
            at = i * wide + j
            if state[at] != SEEN:
                continue
            s, t = x + scale * j - 0.5, y + scale * i - 0.5
            left, top = int(np.floor(s)), int(np.floor(t))
            s, t = s - left, t - top
            red = green = blue = total = 0.0
            for k in range(4):
                column = min(max(left + (k & 1), 0), columns - 1)
                row = min(max(top + (k >> 1), 0), rows - 1)
                if weight[row, column] > 0:
                    w = (s if k & 1 else 1.0 - s) * (t if k >> 1 else 1.0 - t)
                    red += w * image[row, column, 0]
                    green += w * image[row, column, 1]
                    blue += w * image[row, column, 2]
                    total += w
            total = max(total, 1e-9)
            d = (
                (red / total - colours[at, 0]) ** 2
                + (green / total - colours[at, 1]) ** 2
                + (blue / total - colours[at, 2]) ** 2
            )
            error[i // BLOCK, j // BLOCK] += d / 3.0
            count[i // BLOCK, j // BLOCK] += 1
    worst = 0.0
    for i in range(down):
        for j in range(across):
            worst = max(worst, error[i, j] / max(count[i, j], FEW))
    return np.sqrt(worst)


@kernel(error_model="numpy")
def draw(
    colours, state, sizes, extents, firsts, margin, levels, targets, texels, valid, start, end
):
    """Write the images of charts of level 0 and above to `texels` (Q, 3) from `targets` (C,) on.

    `valid` (Q,) marks texels that belong to a chart; those that nobody saw look like the nearest
    that were seen.
    """
    for chart in range(start, end):
        level = levels[chart]
        if level < 0:
            continue
        wide, high = sizes[chart, 0], sizes[chart, 1]
        first = firsts[chart]
        last = first + wide * high
        own, marks, extent = colours[first:last], state[first:last], extents[chart]
        image, weight = shrink_chart(own, marks, wide, high, extent, margin, level)
        rows, columns = weight.shape
        wanted = np.zeros((rows, columns), np.bool_)
        x, y, scale = _frame(wide, high, extent, margin, level)
        for i in range(high):
            for j in range(wide):
                if marks[i * wide + j] != NOTHING:
                    row = min(max(int(y + scale * i), 0), rows - 1)
                    column = min(max(int(x + scale * j), 0), columns - 1)
                    wanted[row, column] = True
        _fill(image, weight)
        for row in range(rows):
            for column in range(columns):
                at = targets[chart] + row * columns + column
                valid[at] = wanted[row, column]
                for k in range(3):
                    texels[at, k] = np.uint8(image[row, column, k] + 0.5)


@kernel(error_model="numpy")
def _fill(image, weight):
    """Give texels of weight 0 the mean of their neighbours that have a colour, ring by ring."""
    rows, columns = weight.shape
    queue = np.empty(rows * columns, np.int64)
    first = last = 0
    for at in range(rows * columns):
        if weight[at // columns, at % columns] > 0:
            queue[last] = at
            last += 1
    while first < last:
        row, column = queue[first] // columns, queue[first] % columns
        first += 1
        for side in range(4):
            i, j = row + (side == 1) - (side == 3), column + (side == 0) - (side == 2)
            if i < 0 or j < 0 or i >= rows or j >= columns or weight[i, j] > 0:
                continue
            count = 0
            for p in range(max(i - 1, 0), min(i + 2, rows)):
                for q in range(max(j - 1, 0), min(j + 2, columns)):
                    if weight[p, q] > 0:
                        count += 1
                        image[i, j] += image[p, q]
            image[i, j] /= count
            weight[i, j] = 1.0
            queue[last] = i * columns + j
            last += 1
