"""Check a city map: what may surprise whoever localizes in it, each finding with a mend."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from placegraph.outdoor.map.city import City

WIDEST = 60_000.0
"""Cities wider than this are distorted by their plane [m]."""


def findings(city: City) -> list[str]:
    """Sentences about what is odd in a map that could be opened (so: sound in its bytes and columns)."""
    objects, found = city.objects, []
    span = np.ptp(objects.points, axis=0)
    if span.max() > WIDEST:
        found.append(
            f"The map spans {span.max() / 1e3:.0f} km; directions near its edge are off by the plane's "
            "distortion. Cut the extract into cities."
        )
    if not len(city.cells):
        found.append(
            "No cell holds two objects, so nothing stands beside anything. Use a larger extract."
        )
    named = float((np.diff(objects.name_starts) > 0).mean())
    if named < 0.02:
        found.append(
            f"Only {named:.1%} of the objects have a name; people who say names will not be understood."
        )
    first = objects.label_values[objects.label_starts[:-1]]
    share = np.bincount(first, minlength=len(objects.labels)) / len(objects)
    top = int(np.argmax(share))
    if share[top] > 0.8:
        found.append(
            f"{share[top]:.0%} of the objects are {objects.labels[top]}; little tells one place from "
            "another. Use an extract with more kinds of things, or extend the vocabulary."
        )
    ids = np.stack([objects.osm_type.astype(np.int64), objects.osm_id], 1)
    twice = len(ids) - len(np.unique(ids, axis=0))
    if twice:
        found.append(
            f"{twice} objects occur twice, as where extracts that overlap were joined. Export it anew."
        )
    missing = sum(n for why, n in city.left_out.items() if "missing" in why or "without" in why)
    if missing > 0.05 * len(objects):
        found.append(
            f"{missing:,} elements of the extract lacked members; it was clipped. Clip it with complete ways."
        )
    return found
