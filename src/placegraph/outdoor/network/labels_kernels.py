# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled parts of `labels`."""

from __future__ import annotations

import numpy as np

from placegraph.core.jit import kernel

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
