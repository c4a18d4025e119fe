"""Fits what a share of the posterior is worth: the coefficients of `placegraph.outdoor.search.status`."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.errors import PlacegraphError
from placegraph.outdoor.city import CityMap
from placegraph.outdoor.locate import Hints, understand
from placegraph.outdoor.search.posterior import WITHIN, modes
from placegraph.outdoor.search.request import Matching
from placegraph.outdoor.search.status import (
    AT_A_PLACE,
    IN_SIGHT,
    LARGEST,
    Calibration,
    Claim,
    infer_claim,
)
from placegraph.outdoor.search.viewpoints import SPACING, search
from placegraph_lab.tables.outdoor.text_sets import TUNED, TextSet, Told

NAMES = {id(IN_SIGHT): "IN_SIGHT", id(AT_A_PLACE): "AT_A_PLACE"}


def fitted(sets: Iterable[TextSet], maps: dict[str, CityMap]) -> dict[str, Calibration]:
    """Coefficients by what is claimed, over the texts of known places that may be tuned on."""
    drawn: dict[str, list[tuple[float, bool]]] = defaultdict(list)
    for asked in sets:
        if asked.half != TUNED or asked.kind == "traps":
            continue
        for told in asked.texts:
            for name, share, right in shares(maps[asked.city], told):
                drawn[name].append((share, right))
    return {
        name: logistic(np.array([s for s, _ in pairs]), np.array([r for _, r in pairs]))
        for name, pairs in drawn.items()
    }


def shares(city: CityMap, told: Told) -> list[tuple[str, float, bool]]:
    """Of each radius that is claimed: its name, the best place's share, and whether it is right."""
    try:
        understood, asked = understand(city, told.text, Hints(listener=told.start), Matching())
        peaks = modes(found := search(asked), 1, SPACING)
    except PlacegraphError:
        return []
    if not peaks or told.goal is None:
        return []
    claim: Claim = infer_claim(understood)
    at = peaks[0].position
    off = float(np.hypot(*(city.plane.to_plane(told.goal) - at)))
    radii = {WITHIN: "of_place", claim.radius: "of_radius"}
    return [
        (f"{NAMES[id(claim)]}.{name}", found.within(at, radius), off <= radius)
        for radius, name in radii.items()
    ]


def logistic(share: Floats, right: NDArray[np.bool_]) -> Calibration:
    """Logistic regression (N,) of being right on log odds, by Newton's method."""
    share = np.clip(share, 1.0 - LARGEST, LARGEST)
    columns = np.stack([np.ones(len(share)), np.log(share / (1.0 - share))], axis=1)
    weights = np.zeros(2)
    for _ in range(50):
        p = 1.0 / (1.0 + np.exp(-columns @ weights))
        curvature = (columns * (p * (1.0 - p))[:, None]).T @ columns + 1e-6 * np.eye(2)
        weights = weights + np.linalg.solve(curvature, columns.T @ (right - p))
    return Calibration(float(weights[0]), float(weights[1]))
