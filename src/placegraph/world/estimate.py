"""The answer of a world: modes over place, room and pose."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from placegraph.core.estimate import Estimate, Explained, Status
from placegraph.world.ask import question_of

if TYPE_CHECKING:
    import numpy as np

    from placegraph.core.estimate import CityEstimate, Place, PoseEstimate, PoseMode
    from placegraph.core.geo import EarthPose
    from placegraph.outdoor.search.ask import Question
    from placegraph.world.split import Understood
    from placegraph.world.world import World


@dataclass(frozen=True, eq=False)
class WorldMode(Explained):
    """One place, room and pose that may be meant; what is not known is None, or empty."""

    longitude: float | None
    latitude: float | None
    """Degrees, WGS84, as the longitude; None of a scene that stands nowhere on Earth."""
    probability: float
    """Over all places, rooms and poses, and being elsewhere."""
    covariance: NDArray[np.float64]
    """(2, 2) float64, east-north [m^2]; NaN where there is no longitude."""
    building: str = ""
    """Name of the building."""
    scene: str = ""
    """Name of the scene map; empty: outdoors, or in a building that is not mapped."""
    level: str = ""
    """OSM level of the floor."""
    room: str = ""
    """Room of the scene."""
    earth: EarthPose | None = None
    """Pose of the last frame on Earth, by the likeliest anchor."""
    pose: PoseMode | None = None
    """Pose of the last frame in the scene's map."""
    place: Place | None = None
    """Place of a sentence in a city."""

    @property
    def where(self) -> str:
        """In words: room, scene, building and level, or the place."""
        level = f"level {self.level}" if self.level else ""
        named = [p for p in (self.room, self.scene, self.building, level) if p]
        if not self.scene and self.latitude is not None:
            named.append(f"{self.latitude:.5f}, {self.longitude:.5f}")
        return ", ".join(named)

    def __repr__(self) -> str:
        return f"WorldMode({self.where!r}, {self.probability:.0%})"

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings."""
        return {
            "longitude": self.longitude,
            "latitude": self.latitude,
            "probability": self.probability,
            "covariance": None if self.longitude is None else self.covariance.tolist(),
            "building": self.building,
            "scene": self.scene,
            "level": self.level,
            "room": self.room,
            "pose": self.pose.to_dict() if self.pose else None,
            "geopose": self.earth.geopose() if self.earth else None,
        } | super().to_dict()


@dataclass(frozen=True, repr=False)
class WorldEstimate(Estimate[WorldMode]):
    """Where in a world: one posterior over place, room and pose."""

    elsewhere: float = 0.0
    """Probability of being in none of the scenes, and nowhere on the cities' maps."""
    understood: Understood | None = None
    """What was understood of the text, of the outside and of the inside."""
    cities: dict[str, CityEstimate] = field(default_factory=dict)
    """What each city alone says of the text's outside; each shard, of a world in shards."""
    poses: dict[str, PoseEstimate] = field(default_factory=dict)
    """What the frames say in each scene looked into."""
    notes: tuple[str, ...] = ()
    """What of the question could not be used, and why."""
    answered: tuple[str, ...] = ()
    """Questions that were answered; they are not asked again."""

    def next_question(self, world: World) -> Question | None:
        """Question that is expected to tell buildings, rooms or places of a city apart; None: none would."""
        best = self.best
        if self.status is not Status.AMBIGUOUS or best is None:
            return None
        if best.place is None:
            return question_of(self.modes, self.answered)
        for part, estimate in self.cities.items():
            if best.place in estimate.modes:
                return world.towns[part.partition("//")[0]].ask(part, estimate)
        return None

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings, ready for `json.dumps`."""
        return super().to_dict() | {
            "elsewhere": self.elsewhere,
            "understood": self.understood.to_dict() if self.understood else None,
            "notes": list(self.notes),
        }
