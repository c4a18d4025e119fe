# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled loops of the network: parts of words, relations of graphs, attention.

Node states of B graphs are packed, one row a node, with the first node of each graph in `starts`
(B + 1,). Relations and agreement are padded.
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
"""Kinds of parts: `cafe` as a word is not `cafe` within one."""
EQUALS, SPACE, UNDERSCORE, TILDE, BEGIN, END = (ord(c) for c in "= _~<>")


@kernel
def split_words(letters, bounds, subwords):
    """Split words, one after the other in `letters`, into parts, as CSR: starts, buckets, weights."""
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
    """Hash a part to a row of the table of vectors (FNV-1a over code points)."""
    code = np.uint64(14695981039346656037) ^ np.uint64(kind)
    for letter in letters:
        code = (code * np.uint64(1099511628211)) ^ np.uint64(letter)
    code ^= code >> np.uint64(29)
    return np.int64(code % np.uint64(BUCKETS))


REACH = 34.0
"""Largest distance of the objects of a place from its centre [m]."""
MAX_OBJECTS = 36
"""Largest number of objects of a place; the nearest are taken."""


@kernel
def select_nearest(starts, offsets, rows):
    """Select the nearest `MAX_OBJECTS` entries within reach of each row, as CSR."""
    chosen = np.zeros(len(rows) + 1, np.int64)
    most = 0
    for k in range(len(rows)):
        most += min(MAX_OBJECTS, starts[rows[k] + 1] - starts[rows[k]])
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
        for i in order[:MAX_OBJECTS]:
            if distance[i] < np.inf:
                kept[n] = first + i
                n += 1
        chosen[k + 1] = n
    return chosen, kept[:n]


@kernel
def gather_rows(rows, starts, values, weights):
    """Gather the CSR entries of some rows, as CSR."""
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
"""Relations of two nodes: the first is ... (of) the second. `present`: both exist."""
NORTH, SOUTH, EAST, WEST, NEAR, INSIDE, CONTAINS, ALONG, PRESENT = range(len(CHANNELS))
OPPOSITE = np.array([SOUTH, NORTH, WEST, EAST, NEAR, CONTAINS, INSIDE, ALONG, PRESENT])
"""Inverse of each channel."""
NEAR_DISTANCE = 12.0
"""Distance at which "near" is 0.5 [m]."""
ALONG_DISTANCE = 15.0
"""Largest distance from a line of a speaker along it [m]."""
POINT, LINE, AREA = 0, 1, 2


@kernel
def place_relations(starts, offsets, kinds, rows, size):
    """Compute the relations of node i to node j of places `rows` (K,): (K, R, size, size) float32.

    Node 0 is the centre. Two objects at one point lie in no direction of each other.
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
                close = 1.0 / (1.0 + np.exp((np.sqrt(d2) - NEAR_DISTANCE) / 3.0))
                out[k, NEAR, i, j] = out[k, NEAR, j, i] = close
                if d2 > 0.25:
                    shares = share_winds(dx, dy)
                    for wind in range(4):
                        out[k, wind, i, j] = out[k, OPPOSITE[wind], j, i] = shares[wind]
                kind = kinds[first + i - 1]
                if j == 0 and kind == AREA and d2 == 0.0:  # the centre lies in i
                    out[k, INSIDE, 0, i] = out[k, CONTAINS, i, 0] = 1.0
                if j == 0 and kind == LINE and d2 <= ALONG_DISTANCE * ALONG_DISTANCE:
                    out[k, ALONG, 0, i] = out[k, ALONG, i, 0] = 1.0
    return out


@kernel
def text_relations(edge_starts, ends, channels, negated, rows, size):
    """Sum the stated relations of the nodes of texts `rows` (Q,): (Q, R, size, size) float32."""
    out = np.zeros((len(rows), len(OPPOSITE), size, size), np.float32)
    for q in range(len(rows)):
        for e in range(edge_starts[rows[q]], edge_starts[rows[q] + 1]):
            i, j = ends[e]
            for r in range(len(OPPOSITE)):
                stated = channels[e, r] * (1.0 - 2.0 * negated[e])
                out[q, r, i, j] += stated
                out[q, OPPOSITE[r], j, i] += stated
    return out


@kernel
def compute_agreement(
    text_starts, texts, fit_starts, fit_tokens, fit_weights,
    place_starts, places, word_starts, words, weights, n, m, n_words,
):  # fmt: skip
    """Compute how well objects of a place fit mentions of a text, (P, n, m); the speaker fits the centre."""
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
def pass_messages(x, starts, relations):
    """Sum x (N, c) over the neighbours by each relation, (N, R * c); rows are scaled by degree."""
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
    """Compute the attention of every node to its graph, (N, d), from queries, keys, values (N, 3 d)."""
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
            _transpose_columns(qkv, first, n, k, keys)
            _scaled_products(qkv, first, n, q, keys, n, scale, logits)
            for i in range(n):
                _softmax(logits, i, n, np.float32(-1e30))
            _add_weighted(logits, n, qkv, first, n, v, size, out, first, q)
    return out


@kernel(fastmath=True)
def _transpose_columns(x, first, n, column, out):
    """Transpose the columns from `column` of n rows of x, so that loops over rows are contiguous."""
    for j in range(n):
        for c in range(len(out)):
            out[c, j] = x[first + j, column + c]


@kernel(fastmath=True)
def _scaled_products(q, first, n, column, keys, m, scale, out):
    """Compute the scaled products (n, m) of n queries and m transposed keys, in `out`."""
    for i in range(n):
        for j in range(m):
            out[i, j] = 0.0
        for c in range(len(keys)):
            a = q[first + i, column + c] * scale
            for j in range(m):
                out[i, j] += a * keys[c, j]


@kernel(fastmath=True)
def _add_weighted(weights, n, values, first, m, column, size, out, at, to):
    """Add the sums of m values, weighted by (n, m), to n rows of `out`."""
    for i in range(n):
        for j in range(m):
            w = weights[i, j]
            for c in range(size):
                out[at + i, to + c] += w * values[first + j, column + c]


@kernel(fastmath=True)
def _softmax(weights, i, n, nothing):
    """Apply softmax to n weights of row i, in place, with one more entry `nothing`."""
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
    """Compute the attention of texts to places and back.

    `qk` are queries of the texts (N, d) and keys of the places (M, d), `values` those of the places
    and of the texts. Returns the attended values of text nodes (N, d) and of objects (M, d), and the
    attention weights (N, heads, largest place) of text nodes to objects.
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
            _transpose_columns(k, m0, m, off, keys)
            _scaled_products(q, t0, n, off, keys, m, scale, alike)
            for i in range(n):
                for j in range(m):
                    forth[i, j] = alike[i, j] + word[0, h] * agreement[p, i, j]
                    back[j, i] = alike[i, j] + word[1, h] * agreement[p, i, j]
                _softmax(forth, i, m, nothing[0, h])
                for j in range(m):
                    to_place[t0 + i, h, j] = forth[i, j]
            for j in range(m):
                _softmax(back, j, n, nothing[1, h])
            _add_weighted(forth, n, of_place, m0, m, off, size, seen, t0, off)
            _add_weighted(back, m, of_text, t0, n, off, size, meant, m0, off)
    return seen, meant, to_place


LITERAL = 5
"""Number of features of `score_literally`."""
CHANNEL_CHANCE = np.array([0.25, 0.25, 0.25, 0.25, 0.4, 0.2, 0.2, 0.2, 1.0], np.float32)
"""P(the relation holds | two objects in sight, anywhere), for each channel."""
NOISE = np.float32(0.12)
"""Share of statements about objects that are not there."""
PAIR_SMOOTHING, SINGLE_SMOOTHING = np.float32(30.0), np.float32(0.5)
"""Additive smoothing of the numbers of pairs and of objects in sight."""


@kernel(fastmath=True)
def background_probability(stated, rare_source, rare_target):
    """Compute P(statement | anywhere)."""
    chance = np.float32(0.0)
    for r in range(len(CHANNEL_CHANCE)):
        chance += CHANNEL_CHANCE[r] * stated[r]
    share = np.exp(np.float32(-10.0) * (rare_source + rare_target))
    return max(chance * share, np.float32(1e-7))


@kernel(fastmath=True)
def score_literally(source, target, stated, m, background, of_me, negated, out):
    """Compute features of a statement at a place by words and relations alone, in `out` (LITERAL,).

    Logs of the numbers of pairs of objects that fit and are so related, of objects that fit the
    source, the target, and of all objects; and the log-likelihood ratio of relational matching,
    without distances and coherence.
    """
    held = of_source = of_target = np.float32(0.0)
    for i in range(m):
        row = np.float32(0.0)
        for j in range(m):
            row += stated[i, j] * target[j]
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
    p = (
        held / (things + SINGLE_SMOOTHING)
        if of_me
        else held / (things * (things - 1) + PAIR_SMOOTHING)
    )
    out[4] = np.log((1 - NOISE) * min(p, np.float32(1.0)) / background + NOISE)


@kernel(fastmath=True)
def evaluate_statements(weights, agreement, t_starts, m_starts, relations, ends, inputs, bounds):
    """Compute the features of every statement of every pair, (E, 3 H + LITERAL).

    For each head: the attention mass of both ends on objects that are related as stated, on any
    objects, and the ratio; then `score_literally`. `bounds` (P + 1,) delimit the statements of a pair,
    `ends` (E, 2) are nodes of its text, `inputs` (E, R + 3) the stated channels and the rarity of both
    ends, row p of `relations` those of the place of pair p.
    """
    heads, most = weights.shape[1], weights.shape[2]
    features = np.zeros((len(ends), 3 * heads + LITERAL), np.float32)
    stated = np.empty((most, most), np.float32)
    for p in range(len(bounds) - 1):
        m = m_starts[p + 1] - m_starts[p]
        for e in range(bounds[p], bounds[p + 1]):
            stated[:m, :m] = 0.0
            for r in range(len(CHANNEL_CHANCE)):
                share = inputs[e, r]
                if share > 0.0:
                    for i in range(m):
                        for j in range(m):
                            stated[i, j] += share * relations[p, r, i, j]
            a, b = t_starts[p] + ends[e, 0], t_starts[p] + ends[e, 1]
            for h in range(heads):
                held = source = target = np.float32(0.0)
                for i in range(m):
                    row = np.float32(0.0)
                    for j in range(m):
                        row += stated[i, j] * weights[b, h, j]
                    held += row * weights[a, h, i]
                    source += weights[a, h, i]
                    target += weights[b, h, i]
                there = source * target
                features[e, h] = held
                features[e, heads + h] = there
                features[e, 2 * heads + h] = held / (there + np.float32(0.05))
            channels = len(CHANNEL_CHANCE)
            background = background_probability(
                inputs[e], inputs[e, channels + 1], inputs[e, channels + 2]
            )
            score_literally(
                agreement[p, ends[e, 0]], agreement[p, ends[e, 1]], stated, m, background,
                min(ends[e, 0], ends[e, 1]) == 0, inputs[e, channels] > 0.0,
                features[e, 3 * heads :],
            )  # fmt: skip
    return features


@kernel
def scatter_to_ends(messages, ends, bounds, t_starts):
    """Add the messages (E, 2 d) of statements to their sources and targets, (N, d)."""
    d = messages.shape[1] // 2
    out = np.zeros((t_starts[-1], d), np.float32)
    for p in range(len(bounds) - 1):
        for e in range(bounds[p], bounds[p + 1]):
            for side in range(2):
                node = t_starts[p] + ends[e, side]
                for c in range(d):
                    out[node, c] += messages[e, side * d + c]
    return out


@kernel
def sum_literal_scores(agreement, t_starts, m_starts, relations, ends, inputs, bounds):
    """Sum the literal log-likelihood ratios over the statements of each pair, (P,)."""
    nothing = np.zeros((t_starts[-1], 0, np.max(m_starts[1:] - m_starts[:-1])), np.float32)
    each = evaluate_statements(
        nothing, agreement, t_starts, m_starts, relations, ends, inputs, bounds
    )
    out = np.zeros(len(bounds) - 1, np.float32)
    for p in range(len(out)):
        for e in range(bounds[p], bounds[p + 1]):
            out[p] += each[e, LITERAL - 1]
    return out
