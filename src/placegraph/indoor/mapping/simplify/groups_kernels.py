# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled parts of `groups`."""

from __future__ import annotations

import numpy as np

from placegraph.core.jit import kernel


@kernel
def _grouped(keys, table, group, first):
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
