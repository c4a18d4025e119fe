"""Queries of a world, its estimates over place, room and pose, and the questions asked back."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.estimate import Estimate, LazyEvidence, Status
from placegraph.errors import OptionError
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame
from placegraph.outdoor.language.languages import translate
from placegraph.outdoor.language.words import tokens
from placegraph.outdoor.search.ask import MIN_GAIN, NO, YES, Answer, Question, Subject
from placegraph.outdoor.search.request import is_count, to_number

if TYPE_CHECKING:
    from placegraph.core.estimate import CityEstimate, Place, PoseEstimate, PoseMode
    from placegraph.core.geo import EarthPose
    from placegraph.indoor.pose.window import Progress
    from placegraph.world.sentence import ParsedSentence
    from placegraph.world.world import World

BUILDING, ROOM = "the current building", "the current room"
"""Labels of what such questions are about; no city has things of that label."""


@dataclass(frozen=True, eq=False)
class WorldQuery:
    """Options of `World.locate`; raises `OptionError` where one is out of its range."""

    text: str | None = None
    capture: Capture | Sequence[Frame] | None = None
    frames: slice | Sequence[int] | None = None
    near: Sequence[float] | None = None
    radius: float = 1000.0
    heading: float | None = None
    seed: int = 0
    top: int = 5
    most: int = 8
    refine: bool = True
    device: str = "auto"
    answers: Sequence[Answer] = ()
    language: str | None = None
    progress: Progress | None = None
    budget: float | None = None
    """Time budget of worlds in shards [s]; if not given, 2 s, and longer for the likeliest shards."""

    def __post_init__(self) -> None:
        if self.text is None and self.capture is None and self.near is None:
            raise OptionError(
                "The query is empty; give a text, a capture, `near`, or several of these."
            )
        if self.frames is not None and self.capture is None:
            raise OptionError("frames are given without a capture; give the capture as well.")
        for name in ("top", "most"):
            if not is_count(getattr(self, name)):
                raise OptionError(
                    f"{name} is {getattr(self, name)!r}; choose an integer of at least 1."
                )
        if self.budget is not None and not 0.0 < to_number(self.budget) < np.inf:
            raise OptionError(f"budget is {self.budget!r} s; give a time greater than 0.")
        if self.heading is not None and not abs(to_number(self.heading)) < 1e6:
            raise OptionError(f"heading is {self.heading!r}; give a finite angle.")
        if not 1.0 <= to_number(self.radius) <= 1e7:
            raise OptionError(f"radius is {self.radius!r} m; choose between 1 and 10,000,000 m.")
        if self.near is not None:
            given = [to_number(x) for x in self.near]
            if len(given) != 2 or not (abs(given[0]) <= 180.0 and abs(given[1]) <= 90.0):
                raise OptionError(
                    f"near is {self.near!r}; give longitude and latitude in degrees, in this order."
                )

    def answers_about(self, label: str) -> list[Answer]:
        """Return the answers yes and no about a `BUILDING` or `ROOM`, or (empty label) those of a city.

        Raises `OptionError` for what is no answer.
        """
        for answer in self.answers:
            if not isinstance(answer, Answer):
                raise OptionError(
                    f"answers contains {answer!r}; create answers with `question.answer(option)`."
                )
        own = [(a, a.question.subjects[0].label) for a in self.answers]
        if not label:
            return [a for a, known in own if known not in (BUILDING, ROOM)]
        return [a for a, known in own if known == label and a.option in (YES, NO)]

    @property
    def spoken(self) -> str:
        """The text, and the names of buildings that the speaker is in by an answer."""
        said = [a for a in self.answers_about(BUILDING) if a.option == YES]
        return " | ".join([self.text or "", *(a.question.subjects[0].words for a in said)])


@dataclass(frozen=True, eq=False)
class WorldMode(LazyEvidence):
    """One place, room and pose that may be meant; what is not known is None, or empty."""

    longitude: float | None
    latitude: float | None
    """Degrees, WGS84, as the longitude; None for a scene without an anchor."""
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
        """In words: room, building (else the scene) and floor, or the place."""
        floor = f"floor {self.level}" if self.level else ""
        named = [p for p in (self.room, self.building or self.scene, floor) if p]
        if not self.scene and self.latitude is not None:
            named.append(f"{self.latitude:.5f}, {self.longitude:.5f}")
        return ", ".join(named)

    def __repr__(self) -> str:
        return f"WorldMode({self.where!r}, {self.probability:.0%})"

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and strings."""
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
    """Estimate of a world: one posterior over place, room and pose."""

    elsewhere: float = 0.0
    """Probability of being in none of the scenes, and nowhere on the cities' maps."""
    understood: ParsedSentence | None = None
    """The parsed text, of the outside and of the inside."""
    cities: dict[str, CityEstimate] = field(default_factory=dict)
    """Estimate of each city for the text's outside; of each shard, for a world in shards."""
    poses: dict[str, PoseEstimate] = field(default_factory=dict)
    """Estimate of the frames in each scene that was looked into."""
    has_only_rivals: bool = False
    """Whether nothing but another scene keeps the pose of the frames from `OK`."""
    notes: tuple[str, ...] = ()
    """Parts of the question that could not be used, and why."""
    answered: tuple[str, ...] = ()
    """Questions that were answered; they are not asked again."""

    def next_question(self, world: World) -> Question | None:
        """Choose the question that best tells buildings, rooms or places apart, if any does."""
        best = self.best
        if self.status is not Status.AMBIGUOUS or best is None:
            return None
        if best.place is None:
            read = self.understood
            inside = read.inside.mentions if read and read.inside else ()
            known = [read.text if read else "", *(m.words for m in inside), *self.answered]
            code = read.language if read else "en"
            return choose_question(self.modes, self.answered, " ".join(known), code)
        for part, estimate in self.cities.items():
            if best.place in estimate.modes:
                return world.towns[part.partition("//")[0]].ask(part, estimate)
        return None

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and strings, ready for `json.dumps`."""
        return super().to_dict() | {
            "elsewhere": self.elsewhere,
            "understood": self.understood.to_dict() if self.understood else None,
            "notes": list(self.notes),
        }


def choose_question(
    modes: Sequence[WorldMode], excluded: Sequence[str], text: str = "", code: str = "en"
) -> Question | None:
    """Choose the yes-or-no question with most information about the building, else about its room.

    It repeats no name of the `text`, and asks for no other if the best is in the text; `code`: a language.
    """
    known = f" {' '.join(tokens(text))} "
    buildings: dict[str, float] = defaultdict(float)
    rooms: dict[str, float] = defaultdict(float)
    for m in modes:
        if m.scene:
            buildings[m.building or m.scene] += m.probability
        if m.scene == modes[0].scene:
            rooms[m.room] += m.probability
    for label, shares, words in ((BUILDING, buildings, "{}"), (ROOM, rooms, "the {}")):
        asked = []
        for name, share in shares.items():  # of everything: where no mode is, one is elsewhere
            p = np.clip([share, 1.0 - share], 1e-12, 1.0)
            entropy = float(-(p * np.log(p)).sum())
            is_said = f" {' '.join(tokens(name))} " in known
            if is_said and name == next(iter(shares)):  # the best fits what was said
                break
            if name and not is_said and entropy > MIN_GAIN:
                question = translate(f"Are you in {words.format(name)}?", code)
                asked.append(Question(question, (YES, NO), (Subject(name, label),), entropy, code))
        left = [q for q in asked if q.text not in excluded]
        if left:
            return max(left, key=lambda q: q.gain)
    return None
