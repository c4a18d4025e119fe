"""What a tracker is given, checked: numbers, and where the speaker starts."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from placegraph.errors import OptionError
from placegraph.outdoor.search.whereabouts import Whereabouts

if TYPE_CHECKING:
    from collections.abc import Sequence

    from placegraph.geometry import Floats
    from placegraph.outdoor.map.city import City


def shares_near(city: City, near: Sequence[float] | None, radius: float) -> Floats | None:
    """Prior shares (W,) of the viewpoints; None where nothing is known."""
    if near is None:
        return None
    known = Whereabouts.around(city, near, radius)
    shares = np.exp(known.log(city.views.positions.astype(np.float64)))
    return np.asarray(shares / max(1.0, float(shares.sum())))


def finite(value: object, name: str, what: str) -> float:
    """Return a finite number; raises `OptionError` otherwise."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        number = float("nan")
    if isinstance(value, bool | str | bytes) or not np.isfinite(number):
        raise OptionError(f"{name} is {value!r}; give {what} as a finite number.")
    return number


def positive(value: object, name: str) -> float:
    """Return a finite number from 0 on; raises `OptionError` otherwise."""
    number = finite(value, name, "an amount")
    if number < 0.0:
        raise OptionError(f"{name} is {value!r}; give 0 or more.")
    return number
