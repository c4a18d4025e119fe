# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled parts of `table`."""

from __future__ import annotations

import numpy as np

from placegraph.compiled import kernel


@kernel
def words_in_sight(bounds, objects, sight, total, tokens, n_labels, n_words):
    """Mass and peak (T,) of words over viewpoints, and the largest sum of the shares of all labels.

    `bounds` (K + 1,) of what each has in sight, `objects` and their `sight`; `total` (K,) of it.
    """
    starts, values, weights = tokens
    mass, peak = np.zeros(n_words, np.float64), np.zeros(n_words, np.float32)
    here, met, spread = np.zeros(n_words, np.float64), np.empty(n_words, np.int32), 0.0
    for view in range(len(total)):
        count, labels = 0, 0.0
        for entry in range(bounds[view], bounds[view + 1]):
            for at in range(starts[objects[entry]], starts[objects[entry] + 1]):
                word = values[at]
                if here[word] == 0.0:
                    met[count] = word
                    count += 1
                here[word] += sight[entry] * weights[at]
        for word in met[:count]:
            share = here[word] / total[view]
            mass[word] += here[word]
            peak[word] = max(peak[word], np.float32(share))
            labels += share if word < n_labels else 0.0
            here[word] = 0.0
        spread = max(spread, labels)
    return mass, peak, spread
