"""What one process of a server works with."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from placegraph.serve.options import ServeOptions
    from placegraph.serve.places import Places


@dataclass(frozen=True, slots=True, eq=False)
class Desk:
    """Maps, limits, and the trackers of the sessions that this process holds."""

    places: Places
    options: ServeOptions
    trackers: dict[str, Any] = field(default_factory=dict)
    """`CityTracker` or `Tracker` by session, with the name of its map: ``(name, tracker)``."""
