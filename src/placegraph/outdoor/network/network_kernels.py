# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled loops of the network: parts of words, graphs of places and texts, attention.

Node states of B graphs are packed: one row a node, `starts` (B + 1,) says where a graph begins.
Relations and agreement come padded, and are read only where there are nodes.
"""

from __future__ import annotations

import numpy as np

from placegraph.core.jit import kernel
from placegraph.outdoor.map.directions_kernels import share_winds

BUCKETS = 8192
"""Rows of the table of vectors that parts are hashed into."""


SHORTEST, LONGEST = 3, 5
"""Letters of a subword."""


WHOLE, KEY, SUBWORD = range(3)
"""What a part is: `cafe` as a word is not `cafe` within one."""


EQUALS, SPACE, UNDERSCORE, TILDE, BEGIN, END = (ord(c) for c in "= _~<>")


@kernel
def _parts(letters, bounds, subwords):
    """Parts of words that follow each other in `letters`, as CSR: starts, buckets, weights."""
    starts = np.zeros(len(bounds), np.int64)
    most = (LONGEST - SHORTEST + 1) * (3 * len(letters) + 2) + 2 * len(bounds)
    buckets, weights = np.empty(most, np.int64), np.empty(most, np.float32)
    n = 0
    for w in range(len(bounds) - 1):
        word = letters[bounds[w] : bounds[w + 1]]
        buckets[n], weights[n] = _bucket(word, WHOLE), 1.0
        n += 1
        value = 0
        for i in range(len(word)):
            if word[i] == EQUALS:
                buckets[n], weights[n] = _bucket(word[:i], KEY), 0.5
                n += 1
                value = i + 1
                break
        if value == 0 and len(word) and word[0] == TILDE:
            value = 1
        first = n
        i = value
        while i < len(word):
            j = i
            while j < len(word) and word[j] != SPACE and word[j] != UNDERSCORE:
                j += 1
            marked = np.empty(j - i + 2, np.uint32)
            marked[0], marked[1 : j - i + 1], marked[j - i + 1] = BEGIN, word[i:j], END
            for size in range(SHORTEST, LONGEST + 1):
                for k in range(len(marked) - size + 1 if j > i else 0):
                    buckets[n] = _bucket(marked[k : k + size], SUBWORD)
                    n += 1
            i = j + 1
        weights[first:n] = subwords / np.sqrt(max(1, n - first))
        starts[w + 1] = n
    return starts, buckets[:n], weights[:n]


@kernel
def _bucket(letters, kind):
    """Row of the table of vectors (FNV-1a over the letters' code points)."""
    code = np.uint64(14695981039346656037) ^ np.uint64(kind)
    for letter in letters:
        code = (code * np.uint64(1099511628211)) ^ np.uint64(letter)
    code ^= code >> np.uint64(29)
    return np.int64(code % np.uint64(BUCKETS))


REACH = 34.0
"""Things nearer than this to its centre belong to a place: who stands 10 m aside sees them [m]."""


MOST_THINGS = 36
"""At most this many things of a place are read, the nearest ones."""


@kernel
def _nearest_things(starts, offsets, rows):
    """Entries of each row within reach, the nearest `MOST_THINGS`; starts (K + 1,), entries."""
    chosen = np.zeros(len(rows) + 1, np.int64)
    most = 0
    for k in range(len(rows)):
        most += min(MOST_THINGS, starts[rows[k] + 1] - starts[rows[k]])
    kept = np.empty(most, np.int64)
    n = 0
    for k in range(len(rows)):
        first, last = starts[rows[k]], starts[rows[k] + 1]
        distance = np.empty(last - first, np.float32)
        for e in range(first, last):
            x, y = offsets[e, 0], offsets[e, 1]
            d2 = x * x + y * y
            distance[e - first] = d2 if d2 <= REACH * REACH else np.float32(np.inf)
        order = np.argsort(distance, kind="mergesort")
        for i in order[:MOST_THINGS]:
            if distance[i] < np.inf:
                kept[n] = first + i
                n += 1
        chosen[k + 1] = n
    return chosen, kept[:n]


@kernel
def _gather(rows, starts, values, weights):
    """CSR entries of some rows, as CSR."""
    out = np.zeros(len(rows) + 1, np.int64)
    for i in range(len(rows)):
        out[i + 1] = out[i] + starts[rows[i] + 1] - starts[rows[i]]
    found = np.empty(out[-1], np.int32)
    weight = np.empty(out[-1], np.float32)
    for i in range(len(rows)):
        a, b = starts[rows[i]], starts[rows[i] + 1]
        found[out[i] : out[i + 1]] = values[a:b]
        weight[out[i] : out[i + 1]] = weights[a:b]
    return out, found, weight


CHANNELS = ("north", "south", "east", "west", "near", "inside", "contains", "along", "present")
"""Relations of two nodes: the first is ... (of) the second. `present`: both are there."""
NORTH, SOUTH, EAST, WEST, NEAR, INSIDE, CONTAINS, ALONG, PRESENT = range(len(CHANNELS))
OPPOSITE = np.array([SOUTH, NORTH, WEST, EAST, NEAR, CONTAINS, INSIDE, ALONG, PRESENT])
"""Channel seen from the other end."""
CLOSE = 12.0
"""Distance at which "near" is half true [m]."""
BESIDE = 15.0
"""Distance to a line that counts as along it [m]."""
POINT, LINE, AREA = 0, 1, 2


@kernel
def place_relations(starts, offsets, kinds, rows, size):
    """Return the relations of node i to node j of places `rows` (K,): (K, R, size, size) float32.

    Node 0 is the centre. Two things in one spot lie in no direction of each other.
    """
    out = np.zeros((len(rows), len(OPPOSITE), size, size), np.float32)
    for k in range(len(rows)):
        first = starts[rows[k]]
        n = 1 + starts[rows[k] + 1] - first
        for i in range(n):
            xi, yi = (offsets[first + i - 1, 0], offsets[first + i - 1, 1]) if i else (
                np.float32(0.0), np.float32(0.0)
            )  # fmt: skip
            for j in range(i):
                xj, yj = (offsets[first + j - 1, 0], offsets[first + j - 1, 1]) if j else (
                    np.float32(0.0), np.float32(0.0)
                )  # fmt: skip
                dx, dy = xi - xj, yi - yj
                d2 = dx * dx + dy * dy
                out[k, PRESENT, i, j] = out[k, PRESENT, j, i] = 1.0
                close = 1.0 / (1.0 + np.exp((np.sqrt(d2) - CLOSE) / 3.0))
                out[k, NEAR, i, j] = out[k, NEAR, j, i] = close
                if d2 > 0.25:
                    told = share_winds(dx, dy)
                    for wind in range(4):
                        out[k, wind, i, j] = out[k, OPPOSITE[wind], j, i] = told[wind]
                kind = kinds[first + i - 1]
                if j == 0 and kind == AREA and d2 == 0.0:  # the centre stands in i
                    out[k, INSIDE, 0, i] = out[k, CONTAINS, i, 0] = 1.0
                if j == 0 and kind == LINE and d2 <= BESIDE * BESIDE:
                    out[k, ALONG, 0, i] = out[k, ALONG, i, 0] = 1.0
    return out


@kernel
def text_relations(edge_starts, ends, channels, negated, rows, size):
    """Return what texts `rows` (Q,) say of their nodes: (Q, R, size, size) float32."""
    out = np.zeros((len(rows), len(OPPOSITE), size, size), np.float32)
    for q in range(len(rows)):
        for e in range(edge_starts[rows[q]], edge_starts[rows[q] + 1]):
            i, j = ends[e]
            for r in range(len(OPPOSITE)):
                said = channels[e, r] * (1.0 - 2.0 * negated[e])
                out[q, r, i, j] += said
                out[q, OPPOSITE[r], j, i] += said
    return out


@kernel
def agreement(
    text_starts, texts, fit_starts, fit_tokens, fit_weights,
    place_starts, places, word_starts, words, weights, n, m, n_words,
):  # fmt: skip
    """Return how well things of a place fit mentions of a text, (P, n, m); the speaker fits the centre."""
    out = np.zeros((len(texts), n, m), np.float32)
    fits = np.zeros((n, n_words), np.float32)
    last = -1
    for p in range(len(texts)):
        first = text_starts[texts[p]]
        many = text_starts[texts[p] + 1] - first
        if texts[p] != last:
            if last >= 0:
                for a in range(text_starts[last], text_starts[last + 1]):
                    for k in range(fit_starts[a], fit_starts[a + 1]):
                        fits[a - text_starts[last], fit_tokens[k]] = 0.0
            for a in range(many):
                for k in range(fit_starts[first + a], fit_starts[first + a + 1]):
                    fits[a, fit_tokens[k]] = fit_weights[k]
            last = texts[p]
        out[p, 0, 0] = 1.0
        begin = place_starts[places[p]]
        for i in range(place_starts[places[p] + 1] - begin):
            for w in range(word_starts[begin + i], word_starts[begin + i + 1]):
                for a in range(1, many):
                    fit = fits[a, words[w]] * weights[w]
                    if fit > out[p, a, i + 1]:
                        out[p, a, i + 1] = fit
    return out


@kernel(fastmath=True)
def messages(x, starts, relations):
    """Sum over neighbours j of relation r, (N, R * c), of x (N, c); rows are scaled by their degree."""
    c, n_relations = x.shape[1], relations.shape[1]
    out = np.zeros((len(x), n_relations * c), np.float32)
    for b in range(len(starts) - 1):
        first = starts[b]
        n = starts[b + 1] - first
        for r in range(n_relations):
            for i in range(n):
                degree = np.float32(1.0)
                for j in range(n):
                    degree += abs(relations[b, r, i, j])
                if degree == 1.0:
                    continue
                scale = np.float32(1.0) / np.sqrt(degree)
                for j in range(n):
                    a = relations[b, r, i, j] * scale
                    if a != 0.0:
                        for k in range(c):
                            out[first + i, r * c + k] += a * x[first + j, k]
    return out


@kernel(fastmath=True)
def self_attention(qkv, starts, heads):
    """Attention of every node to its graph, (N, d), from queries, keys and values (N, 3 d)."""
    d = qkv.shape[1] // 3
    size = d // heads
    scale = np.float32(1.0 / np.sqrt(size))
    out = np.zeros((len(qkv), d), np.float32)
    most = np.max(starts[1:] - starts[:-1])
    keys = np.empty((size, most), np.float32)
    logits = np.empty((most, most), np.float32)
    for b in range(len(starts) - 1):
        first = starts[b]
        n = starts[b + 1] - first
        for h in range(heads):
            q, k, v = h * size, d + h * size, 2 * d + h * size
            _turned(qkv, first, n, k, keys)
            _products(qkv, first, n, q, keys, n, scale, logits)
            for i in range(n):
                _softmax(logits, i, n, np.float32(-1e30))
            _mixed(logits, n, qkv, first, n, v, size, out, first, q)
    return out


@kernel(fastmath=True)
def _turned(x, first, n, column, out):
    """Columns from `column` of n rows of x, turned so that loops over rows run over neighbours."""
    for j in range(n):
        for c in range(len(out)):
            out[c, j] = x[first + j, column + c]


@kernel(fastmath=True)
def _products(q, first, n, column, keys, m, scale, out):
    """Scaled products (n, m) of n queries and m turned keys, into `out`."""
    for i in range(n):
        for j in range(m):
            out[i, j] = 0.0
        for c in range(len(keys)):
            a = q[first + i, column + c] * scale
            for j in range(m):
                out[i, j] += a * keys[c, j]


@kernel(fastmath=True)
def _mixed(weights, n, values, first, m, column, size, out, at, to):
    """Add values of m rows, mixed by weights (n, m), to n rows of `out`."""
    for i in range(n):
        for j in range(m):
            w = weights[i, j]
            for c in range(size):
                out[at + i, to + c] += w * values[first + j, column + c]


@kernel(fastmath=True)
def _softmax(weights, i, n, nothing):
    """Softmax of n weights of row i in place, with one more entry `nothing` that takes its share."""
    top = nothing
    for j in range(n):
        top = max(top, weights[i, j])
    total = np.exp(nothing - top)
    for j in range(n):
        weights[i, j] = np.exp(weights[i, j] - top)
        total += weights[i, j]
    scale = np.float32(1.0) / total
    for j in range(n):
        weights[i, j] *= scale


@kernel(fastmath=True)
def cross_attention(qk, values, t_starts, m_starts, agreement, word, nothing, heads):
    """Attention of texts to places and back.

    `qk` are queries of the texts (N, d) and keys of the places (M, d), `values` those of the
    places and of the texts. Returns what text nodes see (N, d), what things mean (M, d), and the
    weights (N, heads, largest place) by which text nodes see things.
    """
    q, k = qk
    of_place, of_text = values
    d = q.shape[1]
    size = d // heads
    scale = np.float32(1.0 / np.sqrt(size))
    most = np.max(m_starts[1:] - m_starts[:-1])
    widest = np.max(t_starts[1:] - t_starts[:-1])
    to_place = np.zeros((len(q), heads, most), np.float32)
    seen, meant = np.zeros_like(q), np.zeros_like(k)
    keys = np.empty((size, most), np.float32)
    alike = np.empty((widest, most), np.float32)
    forth = np.empty((widest, most), np.float32)
    back = np.empty((most, widest), np.float32)
    for p in range(len(t_starts) - 1):
        t0, m0 = t_starts[p], m_starts[p]
        n, m = t_starts[p + 1] - t0, m_starts[p + 1] - m0
        for h in range(heads):
            off = h * size
            _turned(k, m0, m, off, keys)
            _products(q, t0, n, off, keys, m, scale, alike)
            for i in range(n):
                for j in range(m):
                    forth[i, j] = alike[i, j] + word[0, h] * agreement[p, i, j]
                    back[j, i] = alike[i, j] + word[1, h] * agreement[p, i, j]
                _softmax(forth, i, m, nothing[0, h])
                for j in range(m):
                    to_place[t0 + i, h, j] = forth[i, j]
            for j in range(m):
                _softmax(back, j, n, nothing[1, h])
            _mixed(forth, n, of_place, m0, m, off, size, seen, t0, off)
            _mixed(back, m, of_text, t0, n, off, size, meant, m0, off)
    return seen, meant, to_place


LITERAL = 5
"""Numbers of `literal_of`."""
CHANCE = np.array([0.25, 0.25, 0.25, 0.25, 0.4, 0.2, 0.2, 0.2, 1.0], np.float32)
"""P(two things in sight stand so, anywhere) of each channel."""
NOISE = np.float32(0.12)
"""Share of statements about things that are not there."""
CROWD, LONELY = np.float32(30.0), np.float32(0.5)
"""Added to the pairs, and to the things, that could have been spoken of."""


@kernel(fastmath=True)
def background_of(said, rare_source, rare_target):
    """P(statement | anywhere)."""
    chance = np.float32(0.0)
    for r in range(len(CHANCE)):
        chance += CHANCE[r] * said[r]
    share = np.exp(np.float32(-10.0) * (rare_source + rare_target))
    return max(chance * share, np.float32(1e-7))


@kernel(fastmath=True)
def literal_of(source, target, as_said, m, background, of_me, negated, out):
    """Score a statement at a place as if words alone decide, into `out` (LITERAL,).

    Logs of how many pairs of things fit and stand so, how many things fit the source, how many the
    target, how many there are; and the log-likelihood ratio that relational matching would give,
    without what it knows of distance and of one thing serving many statements.
    """
    held = of_source = of_target = np.float32(0.0)
    for i in range(m):
        row = np.float32(0.0)
        for j in range(m):
            row += as_said[i, j] * target[j]
        held += row * source[i]
        of_source += source[i]
        of_target += target[i]
    least = np.float32(0.02)
    out[0], out[1] = np.log(held + least), np.log(of_source + least)
    out[2], out[3] = np.log(of_target + least), np.log(np.float32(m))
    things = np.float32(m - 1)
    if negated:
        out[4] = np.log((1 - NOISE) * np.exp(np.float32(-2.0) * held) + NOISE)
        return
    p = held / (things + LONELY) if of_me else held / (things * (things - 1) + CROWD)
    out[4] = np.log((1 - NOISE) * min(p, np.float32(1.0)) / background + NOISE)


@kernel(fastmath=True)
def heard(weights, agreement, t_starts, m_starts, relations, ends, known, bounds):
    """Return what every statement of every pair finds, (E, 3 H + LITERAL).

    Of each head how far what its ends attend to stands as said, how far they attend to anything,
    and the ratio; then `literal_of`. `bounds` (P + 1,) are those of a pair's statements, `ends`
    (E, 2) nodes within a text, `known` (E, R + 3) what is said and how rare both ends are, row p of
    `relations` those of the place of pair p.
    """
    heads, most = weights.shape[1], weights.shape[2]
    features = np.zeros((len(ends), 3 * heads + LITERAL), np.float32)
    as_said = np.empty((most, most), np.float32)
    for p in range(len(bounds) - 1):
        m = m_starts[p + 1] - m_starts[p]
        for e in range(bounds[p], bounds[p + 1]):
            as_said[:m, :m] = 0.0
            for r in range(len(CHANCE)):
                said = known[e, r]
                if said > 0.0:
                    for i in range(m):
                        for j in range(m):
                            as_said[i, j] += said * relations[p, r, i, j]
            a, b = t_starts[p] + ends[e, 0], t_starts[p] + ends[e, 1]
            for h in range(heads):
                held = source = target = np.float32(0.0)
                for i in range(m):
                    row = np.float32(0.0)
                    for j in range(m):
                        row += as_said[i, j] * weights[b, h, j]
                    held += row * weights[a, h, i]
                    source += weights[a, h, i]
                    target += weights[b, h, i]
                there = source * target
                features[e, h] = held
                features[e, heads + h] = there
                features[e, 2 * heads + h] = held / (there + np.float32(0.05))
            channels = len(CHANCE)
            background = background_of(known[e], known[e, channels + 1], known[e, channels + 2])
            literal_of(
                agreement[p, ends[e, 0]], agreement[p, ends[e, 1]], as_said, m, background,
                min(ends[e, 0], ends[e, 1]) == 0, known[e, channels] > 0.0,
                features[e, 3 * heads :],
            )  # fmt: skip
    return features


@kernel
def add_to_ends(told, ends, bounds, t_starts):
    """Sum what statements tell (E, 2 d) their sources and targets, (N, d)."""
    d = told.shape[1] // 2
    out = np.zeros((t_starts[-1], d), np.float32)
    for p in range(len(bounds) - 1):
        for e in range(bounds[p], bounds[p + 1]):
            for side in range(2):
                node = t_starts[p] + ends[e, side]
                for c in range(d):
                    out[node, c] += told[e, side * d + c]
    return out


@kernel
def literally(agreement, t_starts, m_starts, relations, ends, known, bounds):
    """Sum over the statements of each pair (P,) of the last number of `literal_of`."""
    nothing = np.zeros((t_starts[-1], 0, np.max(m_starts[1:] - m_starts[:-1])), np.float32)
    each = heard(nothing, agreement, t_starts, m_starts, relations, ends, known, bounds)
    out = np.zeros(len(bounds) - 1, np.float32)
    for p in range(len(out)):
        for e in range(bounds[p], bounds[p + 1]):
            out[p] += each[e, LITERAL - 1]
    return out
